"""Episodes by which the answers of a policy are judged where servos move the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.arm.servos import Servos
from arm5dof.envs.base import Act, Goal, State
from arm5dof.envs.inverse_kinematics import choose

if TYPE_CHECKING:
    from arm5dof.envs.arm_goal import ArmGoalEnv

AT_REST = 1e-6
"""Radians (metres) a control step: arms that move less, all of them, count as at rest. Float32 is as exact."""

Errors = dict[str, jax.Array]
"""By component, (n,) each, metres or radians; infinite where physics blew up."""


class Correction(NamedTuple):
    """Episodes under way: the goal to ask for next, the one that led closest so far, and the reward there."""

    state: State
    asked: Goal
    best: Goal
    reward: jax.Array


def corrected(env: ArmGoalEnv, act: Act, state: State, goals: Goal, corrections: int) -> Errors:
    """Errors at the end of episodes of an environment's own steps; once all arms are at rest nothing more is simulated.

    Args:
        env: The environment.
        act: The policy, which keeps the branch of its first answer.
        state: The first states, (n,).
        goals: The goals, (n,).
        corrections: In how many of the first steps the goal that is asked for is shifted by the error that the arm
            shows. Then the best goal of these is asked for.
    """
    branch = act.branch(state.obs)

    def step(carry: tuple[jax.Array, jax.Array, Correction]) -> tuple[jax.Array, jax.Array, Correction]:
        done, _, now = carry
        correcting = done <= corrections
        asked = choose(jnp.broadcast_to(correcting, now.reward.shape), now.asked, now.best)
        obs = jax.vmap(env.replace_goal)(now.state.obs, asked)
        state = jax.vmap(env.step)(now.state, act(obs, branch))
        moved = jnp.abs(state.data.qpos - now.state.data.qpos).max()
        better = correcting & (state.reward > now.reward)
        return (
            done + 1,
            moved > AT_REST,
            Correction(
                state=state,
                asked=jax.vmap(env.correct)(asked, jax.vmap(env.achieved)(state.obs), goals),
                best=choose(better, asked, now.best),
                reward=jnp.where(better, state.reward, now.reward),
            ),
        )

    def goes_on(carry: tuple[jax.Array, jax.Array, Correction]) -> jax.Array:
        done, moving, _ = carry
        return (done < env.episode_length) & (moving | (done <= corrections + 1))

    start = Correction(state, goals, goals, jnp.full(len(state.reward), -jnp.inf))
    _, _, final = jax.lax.while_loop(goes_on, step, (jnp.array(0), jnp.array(True), start))
    return _finite(final.state)


class Settling(NamedTuple):
    """Arms that are told something and come to rest: what to tell them next, what led closest so far, and the reward
    there."""

    state: State
    told: jax.Array
    best: jax.Array
    reward: jax.Array


def settled(env: ArmGoalEnv, servos: Servos, wanted: jax.Array, state: State, corrections: int) -> Errors:
    """Errors of arms at rest, which slow servos have brought to joint positions in C MuJoCo.

    Args:
        env: The environment.
        servos: The arm's.
        wanted: The joint positions, (n, dof), radians (metres for slides).
        state: The first states, (n,), with the goals.
        corrections: How often the servos are told again, with what the joints lack when they have come to rest, within
            the joints' stops. In the end they are told what led closest. An arm that is within a tenth of what counts
            as met is told nothing new, so that it stays and costs no simulation.
    """
    low, high = np.asarray(env.stops, np.float32).T

    def step(now: Settling, correcting: jax.Array) -> tuple[Settling, None]:
        told = jnp.where(correcting, now.told, now.best)
        state = _at_rest(env, servos, now.state, told)
        better = correcting & (state.reward > now.reward)
        lacks = wanted - state.data.qpos[:, env.arm.qpos]
        met = jnp.stack([state.metrics[name] <= error.close / 10 for name, error in env.components.items()]).all(0)
        again = jnp.where(met[:, None], told, jnp.clip(told + lacks, low, high))
        best = jnp.where(better[:, None], told, now.best)
        return Settling(state, again, best, jnp.where(better, state.reward, now.reward)), None

    correcting = jnp.arange(corrections + 2) <= corrections
    held = jax.vmap(env.arm.to_ctrl)(state.data.qpos[:, env.arm.qpos])
    data = state.data.replace(ctrl=state.data.ctrl.at[:, env.arm.actuators].set(held))
    start = Settling(state.replace(data=data), wanted, wanted, jnp.full(len(wanted), -jnp.inf))
    final, _ = jax.lax.scan(step, start, correcting)
    return _finite(final.state)


def _at_rest(env: ArmGoalEnv, servos: Servos, state: State, told: jax.Array) -> State:
    """The states (n,) in which arms have come to rest that are told joint positions (n, dof)."""
    data = state.data
    ctrl = data.ctrl.at[:, env.arm.actuators].set(jax.vmap(env.arm.to_ctrl)(told))

    def rest(*values: Any) -> tuple[np.ndarray, ...]:
        return tuple(np.asarray(x, np.float32) for x in servos.rest(*map(np.asarray, values)))

    parts = (data.qpos, data.qvel, data.act)
    qpos, qvel, activation = jax.pure_callback(rest, parts, *parts, data.ctrl, ctrl, vmap_method="broadcast_all")
    data = data.replace(qpos=qpos, qvel=qvel, act=activation, ctrl=ctrl)
    return jax.vmap(env.arrived)(state, data, jax.vmap(env.arm.to_action)(told))


def _finite(state: State) -> Errors:
    return {name: jnp.where(jnp.isfinite(values), values, jnp.inf) for name, values in state.metrics.items()}
