"""Accuracy, defined once.

Targets are the forward kinematics of joint positions drawn uniformly inside the limits, from a stream of random
numbers that training never touches. Three questions are asked of the same targets:

- `one_shot`: how far from the target does one answer of the policy put the end effector, by forward kinematics?
- `refined`: the same, the policy asked again with the target shifted by the error it made (`Policy.__call__`);
- `episode`: how far is the end effector at the last step of an episode from a random pose, in the environment? The
  policy is asked again here too, in the first steps, with the target shifted by the error that the arm then shows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge

from arm5dof.ddpg import DDPG, DDPGConfig, Networks
from arm5dof.envs import Reach, State
from arm5dof.settings import settings, static
from arm5dof.training.policy import Policy

WITHIN_MM = (1, 5, 10, 20)
CHUNK = 1000
"""Targets in one device call: what the progress bar moves by, and no more memory than a training batch."""


@settings
class EvaluateConfig:
    """The accuracy protocol."""

    targets: Annotated[int, Ge(1)] = static(default=10_000)
    """Targets in the final evaluation."""
    interim_targets: Annotated[int, Ge(1)] = static(default=2_000)
    """Targets in the evaluations on the way."""
    refinements: Annotated[int, Ge(0)] = static(default=10)
    """How often the policy is asked again for the `refined` and the `episode` figure."""


Accuracy = dict[str, Any]
"""`median_mm`, `p95_mm`, and `within`: percentages of targets within 1, 5, 10 and 20 mm."""


def evaluate(
    policy: Policy, targets: int, refinements: int = 10, seed: int = 0, progress: Callable[[int], object] | None = None
) -> tuple[dict[str, Accuracy], float]:
    """Measure a policy on `targets` unseen targets.

    Returns the three accuracies by name and the paper-style normalised accuracy of the episodes in percent: what
    share of the initial distance, on average, is gone at the end. (The paper gives no tolerance; this is the reading
    that its Figure 8 of normalised errors suggests.) `progress` is told the number of targets done, now and then.
    """
    key = jax.random.fold_in(jax.random.key(seed), 0xE7A1)
    chunk = min(CHUNK, targets)
    errors: dict[str, list[np.ndarray]] = {name: [] for name in ("one_shot", "refined", "episode", "start")}
    for done in range(0, targets, chunk):
        found = _measure(
            policy.env, policy.agent, policy.config, policy.networks, jax.random.fold_in(key, done), chunk, refinements
        )
        for name, values in found.items():
            errors[name].append(np.asarray(values)[: targets - done])
        if progress:
            progress(min(done + chunk, targets))
    joined = {name: np.concatenate(values) for name, values in errors.items()}
    normalised = 100 * (1 - joined["episode"].mean() / joined.pop("start").mean())
    return {name: accuracy(values) for name, values in joined.items()}, float(normalised)


def accuracy(errors: np.ndarray) -> Accuracy:
    """Summarise errors (n,) in metres."""
    mm = errors * 1e3
    return {
        "median_mm": float(np.median(mm)),
        "p95_mm": float(np.percentile(mm, 95)),
        "within": {str(limit): float(100 * (mm <= limit).mean()) for limit in WITHIN_MM},
    }


def table(results: dict[str, Accuracy]) -> str:
    """The accuracies as a Markdown table."""
    shares = " | ".join(f"<= {limit} mm" for limit in WITHIN_MM)
    lines = [f"| | median | 95th percentile | {shares} |", "| --- |" + " ---: |" * (2 + len(WITHIN_MM))]
    for name, found in results.items():
        shares = " | ".join(f"{found['within'][str(limit)]:.2f} %" for limit in WITHIN_MM)
        lines.append(f"| {name} | {found['median_mm']:.2f} mm | {found['p95_mm']:.2f} mm | {shares} |")
    return "\n".join(lines)


class Asking(NamedTuple):
    """Episodes under way: the target to ask for next, the one that led closest so far, and how close, metres."""

    state: State
    asked: jax.Array
    best: jax.Array
    error: jax.Array


@partial(jax.jit, static_argnames=("env", "agent", "count", "refinements"))
def _measure(
    env: Reach, agent: DDPG, config: DDPGConfig, networks: Networks, key: jax.Array, count: int, refinements: int
) -> dict[str, jax.Array]:
    goal_key, pose_key = jax.random.split(key)
    goals = jax.vmap(env.sample_goal)(jax.random.split(goal_key, count))
    state = jax.vmap(env.start)(env.arm.sample(pose_key, (count,)), goals)
    start = state.metrics["distance"]
    head = agent.head(config, networks.actor, networks.critic, state.obs)

    def step(asking: Asking, again: jax.Array) -> tuple[Asking, None]:
        asked = jnp.where(again, asking.asked, asking.best)
        obs = jax.vmap(env.relabel)(asking.state.obs, asked)
        state = jax.vmap(env.step)(asking.state, agent.answer(networks.actor, obs, head))
        error = state.metrics["distance"]
        better = again & (error < asking.error)
        return Asking(
            state=state,
            asked=asked + goals - jax.vmap(env.achieved)(state.obs),
            best=jnp.where(better[:, None], asked, asking.best),
            error=jnp.where(better, error, asking.error),
        ), None

    again = jnp.arange(env.config.episode_length) <= refinements
    final, _ = jax.lax.scan(step, Asking(state, goals, goals, jnp.full(count, jnp.inf)), again)
    last = final.state.metrics["distance"]
    policy = Policy(env, agent, config, networks)
    return {
        "one_shot": policy(goals).error,
        "refined": policy(goals, refinements).error,
        "episode": jnp.where(jnp.isfinite(last), last, jnp.inf),
        "start": start,
    }
