"""Actor and critic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

EMBEDDING = 16
"""Dimensions of the space in which a critic of the forms "distance" and "linear" measures."""


def gelu(x: jax.Array) -> jax.Array:
    """x sigmoid(1.702 x), the cheaper of the two approximations in Hendrycks and Gimpel (2016), section 2."""
    return x * nn.sigmoid(1.702 * x)


ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"relu": nn.relu, "gelu": gelu, "tanh": nn.tanh}


class MLP(nn.Module):
    """Hidden layers of equal width, optionally layer-normalised, and a linear last layer; (..., in) to (..., out)."""

    width: int
    depth: int
    out: int
    activation: str
    layer_norm: bool
    bias_init: Callable[..., jax.Array] = nn.initializers.zeros_init()

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(self.depth):
            x = nn.Dense(self.width)(x)
            if self.layer_norm:
                x = nn.LayerNorm()(x)
            x = ACTIVATIONS[self.activation](x)
        return nn.Dense(self.out, kernel_init=nn.initializers.orthogonal(0.1), bias_init=self.bias_init)(x)


class Actor(nn.Module):
    """mu(s): observations (..., state) to `heads` candidate actions (..., heads, action_size) in [-1, 1].

    A single continuous map from targets to joint angles must tear somewhere: several heads can cover it in pieces.
    They start from random constants all over the actions, so as to differ in branch. With `products` the network sees,
    beside the observation, the product of every pair of its components: lengths, moments and angles between directions
    are sums of these.
    """

    action_size: int
    heads: int
    products: bool
    width: int
    depth: int
    activation: str
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        if self.products:
            i, j = jnp.triu_indices(obs.shape[-1])
            obs = jnp.concatenate([obs, obs[..., i] * obs[..., j]], axis=-1)
        spread = _all_over if self.heads > 1 else nn.initializers.zeros_init()
        x = MLP(self.width, self.depth, self.heads * self.action_size, self.activation, self.layer_norm, spread)(obs)
        return jnp.tanh(x).reshape(*obs.shape[:-1], self.heads, self.action_size)


def _all_over(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> jax.Array:
    """Biases for which tanh is uniform, but for the limits, where it has no slope."""
    return jnp.arctanh(jax.random.uniform(key, shape, dtype, -0.95, 0.95))


class Critic(nn.Module):
    """Q(s, a): what the critic sees of an observation and an action, (..., size), to values (...).

    In the form "distance" Q = -|MLP(x)|, the length of a learnt vector: where rewards are minus a distance (Eq. 7),
    values have a tip at the goal that a smooth network rounds off. In "linear" Q = -|A x|, without hidden layers: where
    the critic sees the difference from the goal, that can be the distance itself. "scalar" is a plain network with
    one output.
    """

    form: str
    width: int
    depth: int
    activation: str
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        if self.form == "linear":
            out = nn.Dense(EMBEDDING, use_bias=False)(x)
        else:
            size = 1 if self.form == "scalar" else EMBEDDING
            out = MLP(self.width, self.depth, size, self.activation, self.layer_norm)(x)
        return out[..., 0] if self.form == "scalar" else -jnp.sqrt((out**2).sum(-1) + 1e-12)
