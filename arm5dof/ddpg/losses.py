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


FREE = 0.9
"""Actions closer to zero cost nothing."""


def actor_loss(
    q: jax.Array,
    weight: jax.Array,
    temperature: jax.Array | float,
    cost: jax.Array | float = 0.0,
    focus: jax.Array | float = 0.0,
) -> jax.Array:
    """Eq. 5: minus the critic's opinion of the actor's actions; its gradient is grad_a Q grad_theta mu.

    `q` is (batch, heads). Each sample teaches its heads in proportion to softmax(Q / temperature), so that heads
    divide the targets among them, and counts 1 + focus |Q| times by the Q of the best. With one head and no focus this
    is the paper's loss; `cost` is what actions cost besides.
    """
    share = jax.lax.stop_gradient(jax.nn.softmax(q / temperature, axis=-1) * (1 + focus * jnp.abs(q.max(-1))[:, None]))
    return -_mean((share * (q - cost)).sum(-1), weight)


def imitation_loss(
    actions: jax.Array, q: jax.Array, shown: jax.Array, weight: jax.Array, margin: jax.Array | float = 0.0
) -> jax.Array:
    """How far the nearest of the candidates `actions` (batch, heads, size) is from an action `shown` (batch, size),
    squared, times by how much more than `margin` the critic prefers that; `q` (batch, heads + 1), the last that of
    `shown`."""
    gain = jax.lax.stop_gradient(jnp.maximum(q[:, -1] - q[:, :-1].max(-1) - margin, 0))
    apart = ((actions - shown[:, None]) ** 2).sum(-1).min(-1)
    return _mean(gain * apart, weight)


def limit_cost(action: jax.Array) -> jax.Array:
    """Sum of squares of how far the components of an action (..., size) lie from `FREE` on towards a limit: 1 for each
    that is at it."""
    return (jnp.maximum(jnp.abs(action) - FREE, 0) ** 2).sum(-1) / (1 - FREE) ** 2


def _mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    return (values * weight).sum() / jnp.maximum(weight.sum(), 1.0)
