"""How accurately a policy brings an arm's end effector to unseen goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.arm.servos import Servos
from arm5dof.envs.base import Act
from arm5dof.envs.episodes import corrected, settled
from arm5dof.envs.inverse_kinematics import solve
from arm5dof.envs.metrics import Error, Share

if TYPE_CHECKING:
    from arm5dof.envs.arm_goal import ArmGoalEnv

PROBES = 500
"""Goals by which a policy is watched while it learns."""
SPARED = 10
"""Of so many goals one is simulated where servos are slow: to come to rest takes thousands of small steps of physics,
and for all goals longer than training."""
NEAR_LIMIT = 0.02
"""Share of a joint's range."""
AT_LIMIT = Share(f"refined with a joint within {NEAR_LIMIT:.0%} of a limit", higher_is_better=False)


def evaluate(env: ArmGoalEnv, servos: Servos | None, act: Act, key: jax.Array, n: int) -> dict[str, jax.Array]:
    """Errors on `n` unseen goals, (n,) each, of three kinds:

    - `one_shot`: one call of the policy: of its candidate answers the one that forward kinematics finds nearest;
    - `refined`: the same with closed-loop target correction (`solve`);
    - `episode`: the last step of an episode from a random pose, in the environment, corrected in its first steps by
      the error that the arm then shows; with slow servos, of one goal in `SPARED`, in C MuJoCo, the arm at rest
      after the `refined` answer, which is told again as often with what the joints lack. Infinite where physics
      blew up.

    By the name of the kind for the first component of the errors, followed by that of the component for others;
    and `initial`, the errors before the first step. `at_limit` says which `refined` answers have a joint within
    2 % of its range of a limit.
    """
    goal_key, pose_key = jax.random.split(key)
    goals = jax.vmap(env.sample_goal)(jax.random.split(goal_key, n))
    state = jax.vmap(env.start)(env.arm.sample(pose_key, (n,)), goals)
    refined = solve(env, act, goals, env.config.refinements)
    if servos:
        told, some = jax.tree.map(lambda x: x[::SPARED], (refined.answer.q, state))
        episode = settled(env, servos, told, some, env.config.refinements)
    else:
        episode = corrected(env, act, state, goals, env.config.refinements)
    kinds = {
        "one_shot": solve(env, act, goals, 0).answer.errors,
        "refined": refined.answer.errors,
        "episode": episode,
        "initial": state.metrics,
    }
    found = {
        kind if i == 0 else f"{kind}_{component}": errors[component]
        for kind, errors in kinds.items()
        for i, component in enumerate(env.components)
    }
    near = jnp.abs(refined.action) > 1 - 2 * NEAR_LIMIT
    return {**found, "at_limit": (near & ~np.array(env.turns)).any(-1)}


def watch(env: ArmGoalEnv, act: Act, key: jax.Array) -> dict[str, jax.Array]:
    """Mean errors of one answer to a few hundred goals, `policy_<component>`."""
    goals = jax.vmap(env.sample_goal)(jax.random.split(key, PROBES))
    return {f"policy_{name}": values.mean() for name, values in solve(env, act, goals, 0).answer.errors.items()}


def failure(env: ArmGoalEnv, results: Mapping[str, Any]) -> str:
    """See `Task`: not one goal was reached, and the errors are about those of an arm that does not move."""

    def fails(kind: str) -> bool:
        metric = env.metrics[kind]
        assert isinstance(metric, Error)
        still = metric.scale * results["means"]["initial"]
        reached = results[kind]["within"][f"{metric.within[-1]:g}"]
        return bool(reached == 0 and not metric.number(results[kind]) < still / 2)

    if env.config.dynamics == "servo" and fails("episode") and not fails("one_shot"):
        return (
            "the policy's answers are right, but the servos do not bring the arm there: stiffen or damp them, or "
            'choose dynamics = "kinematic"'
        )
    if fails("one_shot"):
        return "the policy reaches nothing: train it for longer, or choose other step sizes"
    return ""
