"""rejax (whole algorithms in JAX): TD3 and SAC on the task as a Gymnax environment."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import rejax
from flax import linen, struct
from gymnax.environments import environment, spaces
from task import DOF, EPISODE, LOWER, UPPER, Record, forward, scaled, to_joints


@struct.dataclass
class State(environment.EnvState):
    goal: jax.Array


class Reach(environment.Environment):
    """The task for Gymnax, which knows no time limits other than as terminations: so an episode never ends, and what
    would be the next one's goal is drawn on the way. Observations are the goal (3,), scaled.

    rejax cannot scale rewards other than by their own spread, so `reward_scale` does.
    """

    def __init__(self, reward_scale: float) -> None:
        self.reward_scale = reward_scale

    @property
    def default_params(self) -> environment.EnvParams:
        return environment.EnvParams(max_steps_in_episode=EPISODE)

    def reset_env(self, key, params):
        goal = forward(jax.random.uniform(key, (DOF,), minval=LOWER, maxval=UPPER), jnp)
        return scaled(goal, jnp), State(time=0, goal=goal)

    def step_env(self, key, state, action, params):
        distance = jnp.linalg.norm(forward(to_joints(action, jnp), jnp) - state.goal)
        time = state.time + 1
        _, fresh = self.reset_env(key, params)
        over = time >= params.max_steps_in_episode
        goal = jnp.where(over, fresh.goal, state.goal)
        state = State(time=jnp.where(over, 0, time), goal=goal)
        return scaled(goal, jnp), state, -self.reward_scale * distance, jnp.array(False), {}

    def action_space(self, params=None):
        return spaces.Box(-1.0, 1.0, (DOF,))

    def observation_space(self, params=None):
        return spaces.Box(-2.0, 2.0, (3,))


def train(algorithm: str, settings: dict, seed: int, record: Record) -> None:
    s = dict(settings)
    iterations = s.pop("iterations_per_call")
    shape = {"hidden_layer_sizes": s.pop("layers"), "activation": getattr(linen, s.pop("activation"))}
    algo = getattr(rejax, algorithm).create(env=Reach(s.pop("reward_scale")), **s)
    algo = algo.replace(actor=algo.actor.copy(**shape), critic=algo.critic.copy(**shape))

    # rejax's own `train` is one program without a way out; its loop over iterations is kept, the outer one is ours.
    @partial(jax.jit, donate_argnums=0)
    def advance(state):
        return jax.lax.fori_loop(0, iterations, lambda _, each: algo.train_iteration(each), state)

    @jax.jit
    def actions(params, obs):
        if algorithm == "TD3":
            return algo.actor.apply(params, obs)
        mean = algo.actor.apply(params, obs, method=lambda actor, x: actor._action_dist(x).mean())
        return jnp.tanh(mean)

    state = jax.jit(algo.init_state)(jax.random.key(seed))
    while True:
        state = jax.block_until_ready(advance(state))
        answer = lambda goals, params=state.actor_ts.params: actions(params, scaled(goals).astype(np.float32))
        if record.due and record.measure(int(state.global_step), answer):
            break
