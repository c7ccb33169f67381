"""A trained policy as an inverse-kinematics solver: targets in, joint angles out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from arm5dof.arm import Arm
from arm5dof.ddpg import DDPG, DDPGConfig, Networks
from arm5dof.envs import Reach


class Answer(NamedTuple):
    """Joint positions (n, dof) in radians, the end effector they lead to (n, 3) and its distance from the target (n,)
    in metres, both by forward kinematics."""

    q: jax.Array
    position: jax.Array
    error: jax.Array


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy for one arm."""

    env: Reach
    agent: DDPG
    config: DDPGConfig
    networks: Networks

    @property
    def arm(self) -> Arm:
        return self.env.arm

    def __call__(self, targets: ArrayLike, refine: int = 0) -> Answer:
        """Answer `targets` (n, 3), metres in the world frame, asked from the arm's home pose.

        With `refine` > 0 the policy is asked again as often, with the target shifted by the error it was seen to
        make; the best answer counts. No Jacobian is involved. The head that the critic chose first is kept.
        """
        return _answer(self.env, self.agent, self.config, self.networks, jnp.asarray(targets, jnp.float32), refine)


@partial(jax.jit, static_argnames=("env", "agent", "refine"))
def _answer(env: Reach, agent: DDPG, config: DDPGConfig, networks: Networks, targets: jax.Array, refine: int) -> Answer:
    """Compiled once for an environment and an agent, whatever the networks."""
    seen = env.start(jnp.asarray(env.arm.home, jnp.float32), targets[0]).obs
    observe = jax.vmap(partial(env.relabel, seen))

    head = agent.head(config, networks.actor, networks.critic, observe(targets))

    def ask(points: jax.Array) -> Answer:
        q = env.arm.to_joints(agent.answer(networks.actor, observe(points), head))
        position = env.arm.forward(q)
        return Answer(q, position, jnp.linalg.norm(position - targets, axis=-1))

    best = latest = ask(targets)
    asked = targets
    for _ in range(refine):
        asked = asked + targets - latest.position
        latest = ask(asked)
        better = latest.error < best.error
        best = Answer(*(jnp.where(_like(better, a), a, b) for a, b in zip(latest, best, strict=True)))
    return best


def _like(mask: jax.Array, array: jax.Array) -> jax.Array:
    return mask.reshape(mask.shape + (1,) * (array.ndim - mask.ndim))
