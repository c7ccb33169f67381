"""The shipped detector's two networks, in Flax: one proposes where in a picture things are, one looks closely at each.

As in Faster R-CNN (Ren et al., 2015), but the second has its own look at the picture, at full resolution. Nearly all of
a picture is background, and so a pixel of a thing can have ten times the arithmetic that the others get.

Their shapes follow from what CPUs are fast at: convolutions of 3 x 3 on 32 channels and more, matrix products, and
little else. The proposer begins with patches (Dosovitskiy et al., 2021) and goes on with bottlenecks (He et al., 2016)
at two scales, which are added up (Lin et al., 2017a). Each of its cells says how likely there is something, and how far
from the cell's middle the edges of a box round it are (Tian et al., 2019).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

STRIDE = 8
"""Pixels per cell of the proposer's output, in the picture that it sees."""
COARSEST = 16
"""Pixels per cell of its coarsest map: width and height of pictures are multiples of it."""
STEM, FINE, COARSE = 32, 80, 112
"""Its channels at 4, 8 and 16 pixels per cell."""

CROP = 48
"""Width and height of what the refiner sees of a thing, pixels."""
CHANNELS = 24, 48, 96
"""Of the refiner, at 2, 4 and 8 pixels of the crop per cell."""

RARE = 0.01
"""The score of every cell before training: nearly all cells are background (Lin et al., 2017b)."""
REACH = 8.0
"""How far from the middle of a cell the edges of its box are before training, pixels."""
INNER = np.array([0.2, 0.2, 0.8, 0.8], np.float32)
"""Where in a crop the edges of a thing are before training."""
EPSILON = 1e-3
"""Keeps normalisation from dividing by nothing."""


class Unit(nn.Module):
    """Convolution, or for size 1 matrix product, then batch normalisation (Ioffe and Szegedy, 2015), or a bias where it
    is not `normalised`, then activation: (b, h, w, in) to (b, h / stride, w / stride, out)."""

    features: int
    size: int = 1
    stride: int = 1
    normalised: bool = True
    training: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        start, bias = nn.initializers.he_normal(), not self.normalised
        if self.size == 1:
            # Of matrices: XLA takes twice as long for gradients of the same product with more axes.
            flat = nn.Dense(self.features, bias, kernel_init=start, name="linear")(x.reshape(-1, x.shape[-1]))
            x = flat.reshape(*x.shape[:-1], self.features)
        else:
            shape, steps = (self.size, self.size), (self.stride, self.stride)
            x = nn.Conv(self.features, shape, steps, use_bias=bias, kernel_init=start, name="linear")(x)
        if self.normalised:
            x = nn.BatchNorm(not self.training, momentum=0.97, epsilon=EPSILON, name="norm")(x)
        return nn.hard_swish(x)


class Proposer(nn.Module):
    """RGB uint8 pictures (b, h, w, 3) to boxes and logits.

    boxes:  (b, h w / 64, 4) left, top, right and bottom edges, pixels of the picture, row after row of cells
    logits: (b, h w / 64) of there being a thing of any class
    """

    normalised: bool = True
    """False for the network of `fold`ed weights."""
    training: bool = False

    @nn.compact
    def __call__(self, pictures: jax.Array) -> tuple[jax.Array, jax.Array]:
        batch, height, width, _ = pictures.shape
        x = self._unit(STEM)(centred(patches(pictures, 4)))
        fine = self._bottleneck(self._unit(FINE)(patches(x, 2)))
        coarse = self._bottleneck(self._unit(COARSE)(patches(fine, 2)))
        fine = self._bottleneck(fine + enlarge(self._unit(FINE)(coarse)))

        likely = np.log(RARE / (1 - RARE))
        logits = nn.Dense(1, bias_init=nn.initializers.constant(likely), name="logits")(fine)
        edges = nn.Dense(4, kernel_init=nn.initializers.zeros, name="edges")(fine)
        away = (STRIDE * edges + REACH).reshape(batch, -1, 4)
        middles = jnp.asarray(cells(height, width))
        return jnp.concatenate([middles - away[..., :2], middles + away[..., 2:]], axis=-1), logits.reshape(batch, -1)

    def _unit(self, features: int, size: int = 1) -> Unit:
        return Unit(features, size, 1, self.normalised, self.training)

    def _bottleneck(self, x: jax.Array) -> jax.Array:
        features = x.shape[-1]
        return x + self._unit(features)(self._unit(features // 2, 3)(self._unit(features // 2)(x)))


class Refiner(nn.Module):
    """RGB uint8 crops (b, CROP, CROP, 3) and how wide they were in the picture (b,), pixels, to boxes (b, 4), edges as
    shares of the crop, and logits (b, classes). A can looks like a beaker but for its size."""

    classes: int
    normalised: bool = True
    training: bool = False

    @nn.compact
    def __call__(self, crops: jax.Array, widths: jax.Array) -> tuple[jax.Array, jax.Array]:
        few, more, many = CHANNELS
        x = self._unit(more)(patches(self._unit(few)(centred(patches(crops, 2))), 2))
        x = x + self._unit(more, 3)(x)
        x = self._unit(many)(patches(x, 2))
        x = x + self._unit(many, 3)(self._unit(many, 3)(x))
        x = self._unit(32)(x).reshape(len(x), -1)
        x = jnp.concatenate([x, 4 * jnp.log(widths / CROP)[:, None]], axis=1)
        x = self._unit(128)(x)
        logits = nn.Dense(self.classes, bias_init=nn.initializers.constant(-2.5), name="logits")(x)
        edges = nn.Dense(4, kernel_init=nn.initializers.zeros, name="edges")(x)
        return jnp.asarray(INNER) + 0.2 * edges, logits

    def _unit(self, features: int, size: int = 1, stride: int = 1) -> Unit:
        return Unit(features, size, stride, self.normalised, self.training)


def centred(pictures: jax.Array) -> jax.Array:
    """Bytes as numbers round zero."""
    return pictures.astype(jnp.float32) / 64 - 2


def patches(x: jax.Array, size: int) -> jax.Array:
    """Squares of `size` pixels as channels: (b, h, w, c) to (b, h / size, w / size, size² c)."""
    b, h, w, c = x.shape
    rows = x.reshape(b, h // size, size, w // size, size * c)
    return jnp.concatenate([rows[:, :, i] for i in range(size)], axis=-1)


def enlarge(x: jax.Array) -> jax.Array:
    """Every pixel twice in both directions: (b, h, w, c) to (b, 2 h, 2 w, c)."""
    b, h, w, c = x.shape
    return jnp.broadcast_to(x[:, :, None, :, None], (b, h, 2, w, 2, c)).reshape(b, 2 * h, 2 * w, c)


def cells(height: int, width: int) -> np.ndarray:
    """Middles of the cells of a picture, row after row, (n, 2) float32: x and y, pixels."""
    y, x = np.mgrid[: height // STRIDE, : width // STRIDE]
    return (STRIDE * (np.stack([x, y], -1).reshape(-1, 2) + 0.5)).astype(np.float32)


def fold(params: dict[str, Any], statistics: dict[str, Any]) -> dict[str, Any]:
    """Weights of the network that is not normalised and gives the same answers, from those of the trained one and the
    means and variances that it has seen."""
    if "norm" in params:
        scale = params["norm"]["scale"] / np.sqrt(statistics["norm"]["var"] + EPSILON)
        bias = params["norm"]["bias"] - statistics["norm"]["mean"] * scale
        return {"linear": {"kernel": params["linear"]["kernel"] * scale, "bias": bias}}
    return {
        name: fold(value, statistics.get(name, {})) if isinstance(value, dict) else value
        for name, value in params.items()
    }
