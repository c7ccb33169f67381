"""brax: SAC on the task as a Brax environment."""

from __future__ import annotations

from contextlib import suppress

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs.wrappers.training import VmapWrapper
from brax.training import acting
from brax.training.agents.sac import networks
from brax.training.agents.sac import train as sac
from flax import linen
from task import DOF, EPISODE, LOWER, UPPER, Record, forward, scaled, to_joints


class Reach(envs.Env):
    """The task for Brax. Observations are the goal (3,), scaled. Brax's own time limit would bring back each
    environment's first goal for ever, so an episode never ends here: the next one's goal is drawn on the way."""

    observation_size = 3
    action_size = DOF
    backend = "none"

    def reset(self, rng):
        rng, goal = self.draw(rng)
        zero = jnp.zeros(())
        info = {"rng": rng, "goal": goal, "time": jnp.zeros((), int), "truncation": zero}
        return envs.State(None, scaled(goal, jnp), zero, zero, {}, info)

    def step(self, state, action):
        distance = jnp.linalg.norm(forward(to_joints(action, jnp), jnp) - state.info["goal"])
        time = state.info["time"] + 1
        over = time >= EPISODE
        rng, fresh = self.draw(state.info["rng"])
        goal = jnp.where(over, fresh, state.info["goal"])
        info = {**state.info, "rng": rng, "goal": goal, "time": jnp.where(over, 0, time)}
        return state.replace(obs=scaled(goal, jnp), reward=-distance, info=info)

    def draw(self, rng):
        rng, key = jax.random.split(rng)
        return rng, forward(jax.random.uniform(key, (DOF,), minval=LOWER, maxval=UPPER), jnp)


class OverError(Exception):
    """Brax's trainer has no other way out before its budget is spent."""


class Answers:
    """Takes the place of Brax's evaluator, which is the only one that is shown the policy during training."""

    def __init__(self, eval_env, eval_policy_fn, **_) -> None:
        self.answer = jax.jit(lambda params, obs: eval_policy_fn(params)(obs, jax.random.key(0))[0])

    def run_evaluation(self, policy_params, training_metrics) -> dict:
        return {"answer": lambda goals: self.answer(policy_params, scaled(goals).astype(np.float32))}


def train(algorithm: str, settings: dict, seed: int, record: Record) -> None:
    def progress(transitions: int, metrics: dict) -> None:
        if record.due and record.measure(transitions, metrics["answer"]):
            raise OverError

    s = dict(settings)
    shape = {"hidden_layer_sizes": tuple(s.pop("layers")), "activation": getattr(linen, s.pop("activation"))}
    acting.Evaluator = Answers
    every = s.pop("evaluate_every")
    with suppress(OverError):
        sac.train(
            Reach(),
            num_timesteps=int(record.transitions),
            num_evals=int(record.transitions) // every + 1,
            episode_length=EPISODE,
            wrap_env_fn=lambda env, **_: VmapWrapper(env),
            network_factory=lambda *args, **kwargs: networks.make_sac_networks(*args, **kwargs, **shape),
            progress_fn=progress,
            seed=seed,
            **s,
        )
