"""What a task is: `State` and the protocols by which trainers, runs and commands know it.

`Env` can be simulated, which is all that the agent needs. `Task` can be configured, measured and kept in a run's
folder. `GoalEnv` has goals that can be exchanged in hindsight, and `ForwardModel` tells where an action leads, so that
a policy can be asked for the action that leads to a goal: inverse kinematics.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from arm5dof.envs.metrics import Error, Metric, Score
from arm5dof.errors import UserError
from arm5dof.runtime import forks, xla

if TYPE_CHECKING:
    import mujoco

Observation = dict[str, jax.Array]
"""`state` is what the actor sees, `privileged_state` what the critic sees besides the action; both are vectors."""

Goal = Any
"""A pytree of arrays."""


class State(struct.PyTreeNode):
    """One environment's state, with the fields that MuJoCo Playground and Brax use."""

    data: Any
    obs: Observation
    reward: jax.Array
    done: jax.Array
    """1.0 if the episode has ended for good (no bootstrapping beyond it), else 0.0."""
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


class Act(Protocol):
    """A policy as tasks see it."""

    def __call__(self, obs: Observation, branch: jax.Array | None = None) -> jax.Array:
        """Actions (n, action_size) for a batch of observations, of given branches (n,) if there are any."""
        ...

    def branch(self, obs: Observation) -> jax.Array:
        """Which of its candidate answers the policy prefers for a batch of observations, (n,) int32. Kept from call to
        call, it keeps a motion on one branch of solutions."""
        ...

    def answers(self, obs: Observation) -> jax.Array:
        """The actions of all its candidate answers, (n, branches, action_size), whichever it prefers."""
        ...


@runtime_checkable
class Env(Protocol):
    """A pure environment without a batch axis. Actions are vectors in [-1, 1].

    `step` sets `done` if the episode has ended for good.
    """

    @property
    def action_size(self) -> int: ...

    def reset(self, key: jax.Array) -> State: ...

    def step(self, state: State, action: jax.Array) -> State: ...


class Task(ABC):
    """An environment that can be trained from a TOML file. Inherit from it, and write `Config` (a class decorated with
    `arm5dof.settings.settings`), `action_size`, `reset` and `step` as `Env` has them; the rest has defaults.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> from arm5dof import Task
    >>> from arm5dof.envs import State
    >>> from arm5dof.settings import settings, static
    >>> @settings
    ... class PushConfig:
    ...     episode_length: int = static(default=50)
    >>> class Push(Task):
    ...     "Push a point from anywhere on a line to 0."
    ...     Config = PushConfig
    ...     action_size = 1
    ...
    ...     def reset(self, key):
    ...         return self._state(jax.random.uniform(key, minval=-1.0, maxval=1.0))
    ...
    ...     def step(self, state, action):
    ...         return self._state(state.data + 0.1 * action[0])
    ...
    ...     def _state(self, x):
    ...         return State(x, {"state": x[None], "privileged_state": x[None]}, -jnp.abs(x), jnp.zeros(()), {}, {})
    >>> push = Push(PushConfig())
    >>> state = push.step(push.reset(jax.random.key(0)), jnp.ones(1))
    >>> state.obs["state"].shape, push.episode_length
    ((1,), 50)
    """

    Config: ClassVar[type]
    """The task's settings, the section `[env]` of a TOML file. One of them is `episode_length`."""
    metrics: ClassVar[Mapping[str, Metric]] = MappingProxyType({"return": Score()})
    """How people read what `evaluate` and `watch` return, by name."""

    def __init__(self, config: Any) -> None:
        forks.check()
        xla.check_numbers()
        self.config = config

    @property
    @abstractmethod
    def action_size(self) -> int: ...

    @abstractmethod
    def reset(self, key: jax.Array) -> State: ...

    @abstractmethod
    def step(self, state: State, action: jax.Array) -> State: ...

    @property
    def mj_model(self) -> mujoco.MjModel | None:
        """The MuJoCo model that a run is to keep, so that it answers for the same robot anywhere; None without one. A
        task that has one takes it as its second argument."""
        return None

    @property
    def mj_spec(self) -> mujoco.MjSpec | None:
        """What that was compiled from, if it is at hand."""
        return None

    @property
    def headline(self) -> str:
        """By which of `metrics` a run is judged."""
        return "return"

    @property
    def episode_length(self) -> int:
        """Steps after which an episode is cut off, a truncation."""
        return int(self.config.episode_length)

    def check(self) -> None:  # noqa: B027
        """Raise `UserError` if the environment cannot be simulated."""

    @property
    def about(self) -> str:
        """What people should know of it before a training, lines of text: which robot it is, and how it was read."""
        return ""

    def failure(self, results: Mapping[str, Any]) -> str:
        """Why what was measured (`arm5dof.training.evaluate.Results`) says that the policy is of no use at all, in one
        line of text; empty if it does not say so."""
        return ""

    @property
    def fingerprint(self) -> tuple[object, ...] | None:
        """All that the environment's functions depend on but this package's source, so that its compiled programs can
        be found again; None if that is not known."""
        return None

    def evaluate(self, act: Act, key: jax.Array, n: int) -> dict[str, jax.Array]:
        """Measure a policy on `n` episodes, or whatever the task is judged by: (n,) arrays by name, in SI units. Called
        inside `jax.jit`."""
        return {"return": episode_returns(self, act, key, n)}

    def watch(self, act: Act, key: jax.Array) -> dict[str, jax.Array]:
        """Numbers () to watch after every epoch, cheap to compute. Called inside `jax.jit`."""
        return {}


@runtime_checkable
class GoalEnv(Env, Protocol):
    """An environment whose reward depends on a goal in a known way, so that goals can be exchanged in hindsight.
    Without a batch axis, as everywhere. The goal of an episode is kept in `info["goal"]`."""

    def achieved(self, obs: Observation) -> Goal:
        """The goal that this observation has reached."""
        ...

    def replace_goal(self, obs: Observation, goal: Goal) -> Observation:
        """The same observation, had the goal been another."""
        ...

    def goal_reward(self, achieved: Goal, goal: Goal, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The reward for having reached one goal by an action when another was asked for, and 1.0 if that ends the
        episode for good, else 0.0. `step` says the same."""
        ...


@runtime_checkable
class ForwardModel(GoalEnv, Protocol):
    """A goal environment that knows where an action leads, by the robot's own model."""

    @property
    def goal_inputs(self) -> Mapping[str, tuple[str, ...]]:
        """How people state a goal: names of vectors (options of `arm5dof solve`, arguments of `Policy.solve`), and the
        names of each one's components (columns of a CSV)."""
        ...

    @property
    def components(self) -> Mapping[str, Error]:
        """What `errors` returns, and how people read it."""
        ...

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joint positions that answer a goal."""
        ...

    @property
    def correction(self) -> Literal["target", "jacobian"]:
        """How answers are corrected: see `inverse_kinematics.solve`."""
        ...

    @property
    def slides(self) -> tuple[bool, ...]:
        """Which of them are metres, since the joint slides, rather than radians."""
        ...

    @property
    def turns(self) -> tuple[bool, ...]:
        """Which of them are angles modulo a turn, since the joint can make more than one. Their actions from -1 to 1
        are a turn."""
        ...

    @property
    def stops(self) -> np.ndarray:
        """How far the joints go, (dof, 2); infinite where nothing limits them."""
        ...

    @property
    def branches(self) -> int:
        """How many of a policy's candidate answers are followed where answers are corrected."""
        ...

    @property
    def restarts(self) -> int:
        """From how many random actions damped least squares starts beside."""
        ...

    @property
    def reward_unit(self) -> float:
        """How far goals lie apart, in terms of rewards: what the agent measures rewards in while it learns, so that
        one recipe serves robots of any size."""
        ...

    @property
    def workspace(self) -> str:
        """What can be reached, in words."""
        ...

    def goals(self, **inputs: np.ndarray) -> Goal:
        """Goals with a leading axis (n,) from what people state by the names of `goal_inputs`: rows (n, k) or one row
        (k,). Raises `UserError` for what is no goal."""
        ...

    def question(self, goal: Goal) -> Observation:
        """The observation by which a policy is asked for an action that leads to a goal."""
        ...

    def outcome(self, action: jax.Array) -> Goal:
        """Where an action leads."""
        ...

    def joints(self, action: jax.Array) -> jax.Array:
        """The joint positions that an action asks for, (dof,), radians (metres for slides)."""
        ...

    def errors(self, achieved: Goal, goal: Goal) -> dict[str, jax.Array]:
        """How far one goal is from another, by component: () each, metres or radians."""
        ...

    def residual(self, achieved: Goal, goal: Goal) -> jax.Array:
        """The difference between two goals as a vector, whose length the reward is minus, or nearly. Metres."""
        ...

    def correct(self, asked: Goal, achieved: Goal, goal: Goal) -> Goal:
        """What to ask for next, if asking for `asked` achieved `achieved` where `goal` was wanted."""
        ...

    def critic_input(self, obs: Observation, action: jax.Array) -> jax.Array:
        """What the critic is shown of an action: where it leads, beside the goal; a vector."""
        ...


def episode_returns(env: Task, act: Act, key: jax.Array, n: int) -> jax.Array:
    """Undiscounted returns, (n,), of `n` episodes from `env.reset`."""
    state = jax.vmap(env.reset)(jax.random.split(key, n))

    def step(carry: tuple[State, jax.Array, jax.Array], _: None) -> tuple[tuple[State, jax.Array, jax.Array], None]:
        state, total, alive = carry
        state = jax.vmap(env.step)(state, act(state.obs))
        return (state, total + alive * state.reward, alive * (1 - state.done)), None

    (_, total, _), _ = jax.lax.scan(step, (state, jnp.zeros(n), jnp.ones(n)), None, env.episode_length)
    return total


LARGEST = 1e18
"""What people state, at most: in 32 bits squares of more are infinite."""


def vectors(name: str, values: Any, components: tuple[str, ...]) -> np.ndarray:
    """What people state, rows of finite numbers (n, k) or one (k,), as rows. Raises `UserError` for anything else."""
    shape = f"{len(components)} numbers ({', '.join(components)}), or rows of them"
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        raise UserError(f"{name} takes {shape}, not {values!r}") from None
    if array.ndim not in (1, 2) or array.shape[-1] != len(components) or not len(array):
        raise UserError(f"{name} takes {shape}, not an array of shape {array.shape}")
    rows = np.atleast_2d(array)
    for good, why in ((np.isfinite(rows), "is not finite"), (np.abs(rows) <= LARGEST, "is too large to compute with")):
        if not good.all():
            i = int(good.all(1).argmin())
            raise UserError(f"{name} {i + 1} {why}: {' '.join(map(str, rows[i].tolist()))}")
    return rows
