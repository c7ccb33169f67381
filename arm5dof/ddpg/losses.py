"""The two losses of DDPG."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def critic_loss(q: jax.Array, target: jax.Array, weight: jax.Array, focus: jax.Array | float = 0.0) -> jax.Array:
    """Eq. 4: mean of [R + gamma Q'(s', mu'(s')) - Q(s, a)]^2; `target` is the part before the minus. All (batch,).

    An error counts 1 / (1 + focus |target|) times.
    """
    target = jax.lax.stop_gradient(target)
    return _mean((target - q) ** 2 / (1 + focus * jnp.abs(target)), weight)


def actor_loss(q: jax.Array, weight: jax.Array, temperature: jax.Array | float) -> jax.Array:
    """Eq. 5: minus the critic's opinion of the actor's actions; its gradient is grad_a Q grad_theta mu.

    `q` is (batch, heads). Each sample teaches its heads in proportion to softmax(Q / temperature), so that heads
    divide the targets among them. With one head this is the paper's loss.
    """
    share = jax.lax.stop_gradient(jax.nn.softmax(q / temperature, axis=-1))
    return -_mean((share * q).sum(-1), weight)


def _mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    return (values * weight).sum() / jnp.maximum(weight.sum(), 1.0)
