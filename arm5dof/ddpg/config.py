"""The agent's settings."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt

from arm5dof.settings import settings, static

Unit = Annotated[float, Ge(0), Le(1)]
Positive = Annotated[float, Gt(0)]
Count = Annotated[int, Ge(1), Lt(2**31)]
Depth = Annotated[int, Ge(1), Le(100)]


@settings
class DDPGConfig:
    """The agent. Defaults are for ordinary control; what suits a task better stands in the task's TOML. Units of
    reward are the task's, or where it has a forward model that model's `reward_unit`: an arm's reach."""

    actor_lr: Positive = 1e-3
    """The optimizer's step size for the actor at the start of training."""
    critic_lr: Positive = 1e-3
    """Adam's step size for the critic at the start of training."""
    actor_optimizer: Literal["adam", "muon"] = static(default="adam")
    """muon: the actor's matrices move by orthogonal steps (Jordan et al. 2024), all else by Adam's. For wide networks:
    fewer updates do, each of which takes longer."""
    final_lr: Unit = 0.0
    """Share of both step sizes that is left at the end; they follow a cosine."""
    adam_b2: Annotated[float, Ge(0), Lt(1)] = 0.99
    """How long Adam remembers the size of gradients. It shrinks as the networks learn: the usual 0.999 is slow."""
    discount: Unit = 0.98
    """gamma in Eq. 4. Where an action is judged at once, as with absolute joint targets, 0 is enough."""
    tau: Unit = 0.01
    """How far the target networks follow at each update."""
    noise: Annotated[float, Ge(0)] = 0.5
    """Standard deviation of the normal exploration noise at the start; actions are in [-1, 1]."""
    final_noise: Annotated[float, Ge(0)] = 0.05
    """The same at the end of training; it falls linearly."""
    random_action_prob: Unit = 0.0
    """Share of actions that are drawn uniformly at random at the start of training; it falls linearly to none. What
    they reach covers the workspace, and hindsight makes goals of it."""
    her_ratio: Unit = 0.8
    """Share of sampled transitions whose goal is exchanged in hindsight, where the task has goals."""
    her_goals: Literal["buffer", "future", "reset"] = static(default="buffer")
    """Where goals in hindsight come from. buffer: what any transition reached, for tasks of one step; future: what
    was reached later in the same episode, for tasks of many; reset: what a new episode would ask for, never the same
    twice."""
    head_temperature: Positive = 0.01
    """How sharply heads divide the observations among them, in units of reward."""
    heads: Count = static(default=1)
    """Candidate answers of the actor, among which the critic chooses. 1 is plain DDPG."""
    critic_error_weight: Annotated[float, Ge(0)] = 0.0
    """An error of the critic at a target value v counts 1 / (1 + critic_error_weight |v|) times; 1 / units of reward.
    Where rewards are minus a distance the actor learns the last millimetres from values near a goal. 0: all count
    alike."""
    actor_error_weight: Annotated[float, Ge(0)] = 0.0
    """An observation whose best candidate has the value v counts 1 + actor_error_weight |v| times for the actor; 1 /
    units of reward. Where rewards are minus a distance this is for goals that are few and hard. 0: all count alike."""
    limit_weight: Annotated[float, Ge(0)] = 0.0
    """What an action near its limits, -1 or 1, costs the actor, in units of reward: so much at the limit, and nothing
    inside `losses.FREE`. Where several actions are as good, those in the middle are learnt."""
    imitation_weight: Annotated[float, Ge(0)] = static(default=0.0)
    """How strongly the actor's nearest candidate is drawn to the action that is known to have reached a goal in
    hindsight, where the critic finds it better than all candidates (Nair et al. 2018, the Q-filter): so branches that
    no candidate is near are found. For tasks of one step, with goals from the buffer. 0: not at all."""
    imitation_margin: Annotated[float, Ge(0)] = 0.0
    """How much better that action must be to count, in units of reward."""
    critic_input: Literal["outcome", "state"] = static(default="state")
    """state: the critic sees the observation and the action; outcome: it sees where the action leads by the task's
    forward model, as the paper's does."""
    critic_form: Literal["scalar", "distance", "linear"] = static(default="scalar")
    """scalar: Q is any number; distance: Q is minus a learnt distance, for rewards that are minus a distance; linear:
    minus the length of a linear function of the critic's input, which has no hidden layers then."""
    batch_size: Count = static(default=64)
    """Transitions in an update."""
    updates_per_step: Count = static(default=128)
    """Updates after each step of all environments."""
    actor_products: bool = static(default=False)
    """Whether the actor also sees the product of every pair of its observation's components."""
    actor_width: Count = static(default=128)
    """Units in a hidden layer of the actor."""
    actor_depth: Depth = static(default=3)
    """The actor's hidden layers."""
    critic_width: Count = static(default=32)
    """Units in a hidden layer of the critic."""
    critic_depth: Depth = static(default=2)
    """The critic's hidden layers."""
    activation: Literal["relu", "gelu", "tanh"] = static(default="gelu")
    """Of the hidden layers."""
    layer_norm: bool = static(default=False)
    """Whether hidden layers are normalised."""
    replay_capacity: Count = static(default=65_536)
    """Transitions kept; rounded up to a multiple of the number of environments."""
