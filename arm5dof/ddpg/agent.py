"""DDPG as the paper's Algorithm 1, in pure functions: `init`, `act`, `update`, `collect`, `epoch`.

Every function takes the configuration as an argument: its numbers are traced, so seeds and hyperparameters vary
together under one `jax.vmap` of `init` and `epoch`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from flax import struct

from arm5dof.ddpg import losses
from arm5dof.ddpg.config import DDPGConfig
from arm5dof.ddpg.networks import Actor, Critic
from arm5dof.ddpg.replay import Replay, Transition
from arm5dof.envs.base import Env, ForwardModel, GoalEnv, Observation, State
from arm5dof.envs.vector import VectorEnv
from arm5dof.errors import UserError

Params = Any
Metrics = dict[str, jax.Array]


class Networks(struct.PyTreeNode):
    """Parameters of the four networks."""

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params


class Training(struct.PyTreeNode):
    """Everything a run is made of: restored, it goes on as if nothing had happened."""

    networks: Networks
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    replay: Replay
    env: State
    key: jax.Array
    steps: jax.Array
    """Steps taken by every environment, int32."""
    updates: jax.Array
    """Updates made, int32."""


class DDPG:
    """The agent for one environment and one program shape (the static part of the configuration).

    `total_steps` is the number of steps that each environment takes in the whole run: noise and step sizes fall over
    it. Raises `UserError` if the configuration asks for what the environment cannot do.
    """

    def __init__(self, env: Env, config: DDPGConfig, num_envs: int, episode_length: int, total_steps: int) -> None:
        self.goal_env: GoalEnv | None = env if isinstance(env, GoalEnv) else None
        self.forward_model: ForwardModel | None = env if isinstance(env, ForwardModel) else None
        if config.critic_input == "outcome" and self.forward_model is None:
            raise UserError('this environment foresees no outcome of an action: choose critic_input = "state"')
        if config.critic_form != "scalar" and self.goal_env is None:
            raise UserError('this environment\'s rewards may be no distances: choose critic_form = "scalar"')
        self.reward_unit = 1.0 if self.forward_model is None else self.forward_model.reward_unit
        self.vector = VectorEnv(env, episode_length)
        self.episode_length = episode_length
        self.num_envs = num_envs
        self.total_steps = total_steps
        style = (config.activation, config.layer_norm)
        self.actor = Actor(
            env.action_size, config.heads, config.actor_products, config.actor_width, config.actor_depth, *style
        )
        self.critic = Critic(config.critic_form, config.critic_width, config.critic_depth, *style)

    def init(self, config: DDPGConfig, key: jax.Array) -> Training:
        """Random networks, target networks equal to them, an empty replay buffer, environments at their start."""
        key, actor_key, critic_key, env_key = jax.random.split(key, 4)
        env = self.vector.reset(jax.random.split(env_key, self.num_envs))
        obs = jax.tree.map(lambda x: x[0], env.obs)
        action = jnp.zeros(self.vector.env.action_size)
        actor = self.actor.init(actor_key, obs["state"])
        critic = self.critic.init(critic_key, self.critic_input(config, obs, action))
        zero = jnp.zeros(())
        count = jnp.zeros((), jnp.int32)
        example = Transition(obs, action, zero, obs, zero, zero, zero)
        capacity = -(-config.replay_capacity // self.num_envs) * self.num_envs
        return Training(
            networks=Networks(actor, critic, actor, critic),
            actor_optimizer=_actor_optimizer(config).init(actor),
            critic_optimizer=optax.scale_by_adam().init(critic),
            replay=Replay.create(example, capacity, self.num_envs),
            env=env,
            key=key,
            steps=count,
            updates=count,
        )

    def critic_input(self, config: DDPGConfig, obs: Observation, action: jax.Array) -> jax.Array:
        """What the critic sees of one observation and one action."""
        if config.critic_input == "outcome" and self.forward_model is not None:
            return self.forward_model.critic_input(obs, action)
        return jnp.concatenate([obs["privileged_state"], action])

    def critic_inputs(self, config: DDPGConfig, batch: Transition) -> jax.Array:
        """What the critic sees of transitions with any leading axes."""
        one = partial(self.critic_input, config)
        for _ in batch.reward.shape:
            one = jax.vmap(one)
        return one(batch.obs, batch.action)

    def candidates(self, actor: Params, obs: Observation) -> jax.Array:
        """The actor's candidate actions for a batch of observations, (batch, heads, action_size)."""
        return jnp.asarray(self.actor.apply(actor, obs["state"]))

    def value(self, config: DDPGConfig, critic: Params, obs: Observation, actions: jax.Array) -> jax.Array:
        """Q for a batch of observations and their candidate actions: (batch, heads, action_size) to (batch, heads)."""
        each_head = jax.vmap(self.critic_input, in_axes=(None, None, 0))
        inputs = jax.vmap(each_head, in_axes=(None, 0, 0))(config, obs, actions)
        return jnp.asarray(self.critic.apply(critic, inputs))

    def act(self, config: DDPGConfig, actor: Params, critic: Params, obs: Observation) -> tuple[jax.Array, jax.Array]:
        """The policy: the candidate that the critic prefers, and its value; (batch, action_size) and (batch,)."""
        actions = self.candidates(actor, obs)
        q = self.value(config, critic, obs, actions)
        best = q.argmax(-1)
        return _pick(actions, best), _pick(q, best)

    def head(self, config: DDPGConfig, actor: Params, critic: Params, obs: Observation) -> jax.Array:
        """Which of the actor's heads the critic prefers for a batch of observations, (batch,) int32."""
        return self.value(config, critic, obs, self.candidates(actor, obs)).argmax(-1)

    def answer(self, actor: Params, obs: Observation, head: jax.Array) -> jax.Array:
        """The actions of given heads (batch,) for a batch of observations, (batch, action_size)."""
        return _pick(self.candidates(actor, obs), head)

    def epoch(self, config: DDPGConfig, training: Training, steps: int) -> tuple[Training, Metrics]:
        """Lines 6 to 15 of Algorithm 1, `steps` times: act, store, learn. Returns the metrics' means."""

        def step(training: Training, _: None) -> tuple[Training, Metrics]:
            training, collected = self.collect(config, training)
            ready = training.replay.size >= config.batch_size
            nothing = dict.fromkeys(("critic_loss", "q"), jnp.zeros(()))
            training, learnt = jax.lax.cond(ready, lambda t: self.learn(config, t), lambda t: (t, nothing), training)
            return training, {**collected, **learnt}

        training, metrics = jax.lax.scan(step, training, None, steps)
        nonfinite = metrics.pop("nonfinite").sum()
        return training, {**jax.tree.map(jnp.mean, metrics), "nonfinite": nonfinite}

    def collect(self, config: DDPGConfig, training: Training) -> tuple[Training, Metrics]:
        """Lines 7 to 9: every environment acts with noise, and the replay buffer stores what came of it."""
        key, noise_key, random_key, which_key = jax.random.split(training.key, 4)
        networks, obs, progress = training.networks, training.env.obs, self._progress(training)
        noise = config.noise + (config.final_noise - config.noise) * progress
        action, _ = self.act(config, networks.actor, networks.critic, obs)
        action = jnp.clip(action + noise * jax.random.normal(noise_key, action.shape), -1, 1)
        random = jax.random.bernoulli(which_key, config.random_action_prob * (1 - progress), (self.num_envs, 1))
        action = jnp.where(random, jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0), action)
        env = self.vector.step(training.env, action)
        transition = Transition(
            obs=obs,
            action=action,
            reward=env.reward,
            next_obs=env.info["next_obs"],
            terminal=env.done * (1 - env.info["truncation"]),
            weight=1 - env.info["nonfinite"],
            step=training.env.info["steps"].astype(jnp.float32),
        )
        metrics = {
            **{name: value.mean() for name, value in env.metrics.items()},
            "reward": env.reward.mean(),
            "noise": noise,
            "nonfinite": env.info["nonfinite"].sum(),
        }
        replay = training.replay.insert(transition)
        return training.replace(replay=replay, env=env, key=key, steps=training.steps + 1), metrics

    def learn(self, config: DDPGConfig, training: Training) -> tuple[Training, Metrics]:
        """Lines 10 to 15, `updates_per_step` times."""
        key, sample_key, relabel_key = jax.random.split(training.key, 3)
        shape = (config.updates_per_step, config.batch_size)
        rows = training.replay.sample(sample_key, shape)
        batches, shown = self.relabel(config, training.replay, rows, relabel_key)
        inputs = self.critic_inputs(config, batches)
        training, metrics = jax.lax.scan(lambda t, x: self.update(config, t, *x), training, (batches, inputs, shown))
        return training.replace(key=key), jax.tree.map(jnp.mean, metrics)

    def relabel(
        self, config: DDPGConfig, replay: Replay, rows: jax.Array, key: jax.Array
    ) -> tuple[Transition, jax.Array]:
        """The transitions in rows of the buffer (any leading axes), the goals of a share of them exchanged for what
        others reached (Andrychowicz et al. 2017, hindsight experience replay) or for new ones (Nair et al. 2018). The
        reward for any goal is known, and whether it ends the episode, so this is exact. And the actions to imitate:
        those that reached these goals, where they come from the buffer, and elsewhere the transitions' own."""
        env, batch = self.goal_env, replay.read(rows)
        if env is None:
            return batch, batch.action
        shape = batch.reward.shape
        choice_key, goal_key = jax.random.split(key)
        chosen = jax.random.uniform(choice_key, shape) < config.her_ratio
        source: Any
        shown = batch.action
        if config.her_goals == "reset":
            source, goal_of = jax.random.split(goal_key, shape), lambda key: env.reset(key).info["goal"]
        else:
            buffer = config.her_goals == "buffer"
            donors = replay.sample(goal_key, shape) if buffer else replay.later(goal_key, rows, self.episode_length)
            donor = replay.read(donors)
            source, goal_of = donor.next_obs, env.achieved
            if buffer:
                shown = jnp.where(chosen[..., None], donor.action, shown)

        def one(transition: Transition, source: Any, chosen: jax.Array) -> Transition:
            goal = goal_of(source)
            reward, terminal = env.goal_reward(env.achieved(transition.next_obs), goal, transition.action)
            changed = transition.replace(
                obs=env.replace_goal(transition.obs, goal),
                next_obs=env.replace_goal(transition.next_obs, goal),
                reward=reward,
                terminal=terminal,
            )
            return jax.tree.map(lambda new, old: jnp.where(chosen, new, old), changed, transition)

        for _ in shape:
            one = jax.vmap(one)
        return one(batch, source, chosen), shown

    def update(
        self, config: DDPGConfig, training: Training, batch: Transition, critic_input: jax.Array, shown: jax.Array
    ) -> tuple[Training, Metrics]:
        """Lines 11 to 15 on one batch: critic (Eq. 4), actor (Eq. 5), target networks by tau. `critic_input` is what
        the critic sees of the batch's observations and actions, (batch, size), `shown` as `relabel` gives it."""
        networks = training.networks
        unit = self.reward_unit
        target = batch.reward / unit + jax.lax.cond(
            config.discount > 0, lambda: self._bootstrap(config, networks, batch), lambda: jnp.zeros_like(batch.reward)
        )

        def critic_loss(critic: Params) -> tuple[jax.Array, jax.Array]:
            q = jnp.asarray(self.critic.apply(critic, critic_input))
            return losses.critic_loss(q, target, batch.weight, config.critic_error_weight), q.mean()

        def actor_loss(actor: Params) -> jax.Array:
            actions = self.candidates(actor, batch.obs)
            imitate = config.imitation_weight > 0
            judged = jnp.concatenate([actions, shown[:, None]], axis=1) if imitate else actions
            q = self.value(config, critic, batch.obs, judged)
            cost = config.limit_weight * losses.limit_cost(actions)
            loss = losses.actor_loss(
                q[:, : self.actor.heads], batch.weight, config.head_temperature, cost, config.actor_error_weight
            )
            if imitate:
                imitation = losses.imitation_loss(actions, q, shown, batch.weight, config.imitation_margin)
                loss += config.imitation_weight * imitation
            return loss

        rate = config.final_lr + (1 - config.final_lr) * (1 + jnp.cos(jnp.pi * self._progress(training))) / 2
        (loss, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(networks.critic)
        adam = optax.scale_by_adam(b2=config.adam_b2)
        step, critic_optimizer = adam.update(gradient, training.critic_optimizer)
        critic = optax.tree.add_scale(networks.critic, -rate * config.critic_lr, step)
        gradient = jax.grad(actor_loss)(networks.actor)
        step, actor_optimizer = _actor_optimizer(config).update(gradient, training.actor_optimizer, networks.actor)
        actor = optax.tree.add_scale(networks.actor, -rate * config.actor_lr, step)
        networks = Networks(
            actor=actor,
            critic=critic,
            target_actor=optax.incremental_update(actor, networks.target_actor, config.tau),
            target_critic=optax.incremental_update(critic, networks.target_critic, config.tau),
        )
        training = training.replace(
            networks=networks,
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
            updates=training.updates + 1,
        )
        return training, {"critic_loss": unit**2 * loss, "q": unit * q}

    def _bootstrap(self, config: DDPGConfig, networks: Networks, batch: Transition) -> jax.Array:
        """gamma Q'(s', mu'(s')), nothing beyond a terminal state."""
        _, q = self.act(config, networks.target_actor, networks.target_critic, batch.next_obs)
        return config.discount * (1 - batch.terminal) * q

    def _progress(self, training: Training) -> jax.Array:
        # What XLA makes of a division by a constant: so the bits are the same where the total is traced.
        return jnp.minimum(training.steps * (1 / self.total_steps), 1.0)


def _actor_optimizer(config: DDPGConfig) -> optax.GradientTransformation:
    """What makes of gradients the steps to be taken back, in units of the step size."""
    if config.actor_optimizer == "adam":
        return optax.scale_by_adam(b2=config.adam_b2)
    return optax.contrib.muon(-1.0, adam_b2=config.adam_b2)


def _pick(values: jax.Array, index: jax.Array) -> jax.Array:
    """values[i, index[i]] for each i."""
    return jax.vmap(lambda v, i: v[i])(values, index)
