"""The shipped detector's two networks, in Flax: one proposes where in an image objects are, one refines each proposal.

As in Faster R-CNN (Ren et al., 2015), but the second sees the image itself, at full resolution. Nearly all of an image
is background, and so a pixel of an object can have ten times the arithmetic that the others get.

Their shapes follow from what CPUs are fast at: convolutions of 3 x 3 on 32 channels and more, matrix products, and
little else. The proposer begins with patches (Dosovitskiy et al., 2021) and goes on with bottlenecks (He et al., 2016)
at two scales, which are added up (Lin et al., 2017a). Each of its cells says how likely there is an object, and how far
from the cell's center the edges of a box around it are (Tian et al., 2019).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

STRIDE = 8
"""Pixels per cell of the proposer's output, in the image that it sees."""
COARSE_STRIDE = 16
"""Pixels per cell of its coarser map: width and height of images are multiples of it."""
STEM_CHANNELS, FINE_CHANNELS, COARSE_CHANNELS = 32, 80, 112
"""Of the proposer, at 4, 8 and 16 pixels per cell."""

CROP = 48
"""Width and height of what the refiner sees of an object, pixels."""
REFINER_CHANNELS = 24, 48, 96
"""At 2, 4 and 8 pixels of the crop per cell."""

PRIOR = 0.01
"""The score of every cell before training: nearly all cells are background (Lin et al., 2017b)."""
INITIAL_DISTANCE = 8.0
"""How far from the center of a cell the edges of its box are before training, pixels."""
INITIAL_BOX = np.array([0.2, 0.2, 0.8, 0.8], np.float32)
"""The refiner's box before training, relative to the crop."""
EPSILON = 1e-3
"""Keeps normalization from dividing by zero."""


class Unit(nn.Module):
    """Convolution, or for size 1 matrix product, then batch normalization (Ioffe and Szegedy, 2015), or a bias where
    there is none, then activation: (b, h, w, in) to (b, h / stride, w / stride, out)."""

    features: int
    size: int = 1
    stride: int = 1
    batch_norm: bool = True
    training: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        init, bias = nn.initializers.he_normal(), not self.batch_norm
        if self.size == 1:
            # Of matrices: XLA takes twice as long for gradients of the same product with more axes.
            flat = nn.Dense(self.features, bias, kernel_init=init, name="linear")(x.reshape(-1, x.shape[-1]))
            x = flat.reshape(*x.shape[:-1], self.features)
        else:
            kernel, strides = (self.size, self.size), (self.stride, self.stride)
            x = nn.Conv(self.features, kernel, strides, use_bias=bias, kernel_init=init, name="linear")(x)
        if self.batch_norm:
            x = nn.BatchNorm(not self.training, momentum=0.97, epsilon=EPSILON, name="norm")(x)
        return nn.hard_swish(x)


class Proposer(nn.Module):
    """Finds where in images there may be objects, of whatever class.

    Called with RGB uint8 images (b, h, w, 3), it returns boxes (b, h w / 64, 4), pixels of the image, and logits
    (b, h w / 64) of there being an object, row after row of cells.
    """

    batch_norm: bool = True
    """False for weights from `fold_batch_norm`."""
    training: bool = False

    @nn.compact
    def __call__(self, images: jax.Array) -> tuple[jax.Array, jax.Array]:
        batch, height, width, _ = images.shape
        x = self._unit(STEM_CHANNELS)(space_to_depth(scale_pixels(images), 4))
        fine = self._bottleneck(self._unit(FINE_CHANNELS)(space_to_depth(x, 2)))
        coarse = self._bottleneck(self._unit(COARSE_CHANNELS)(space_to_depth(fine, 2)))
        fine = self._bottleneck(fine + upsample(self._unit(FINE_CHANNELS)(coarse)))

        prior = np.log(PRIOR / (1 - PRIOR))
        logits = nn.Dense(1, bias_init=nn.initializers.constant(prior), name="logits")(fine)
        edges = nn.Dense(4, kernel_init=nn.initializers.zeros, name="edges")(fine)
        distance = (STRIDE * edges + INITIAL_DISTANCE).reshape(batch, -1, 4)
        centers = jnp.asarray(cell_centers(height, width))
        boxes = jnp.concatenate([centers - distance[..., :2], centers + distance[..., 2:]], axis=-1)
        return boxes, logits.reshape(batch, -1)

    def _unit(self, features: int, size: int = 1) -> Unit:
        return Unit(features, size, 1, self.batch_norm, self.training)

    def _bottleneck(self, x: jax.Array) -> jax.Array:
        features = x.shape[-1]
        return x + self._unit(features)(self._unit(features // 2, 3)(self._unit(features // 2)(x)))


class Refiner(nn.Module):
    """Classifies what is in crops, and fits its box.

    Called with RGB uint8 crops (b, CROP, CROP, 3) and how wide they were in the image (b,), pixels, it returns boxes
    (b, 4) relative to the crops and logits (b, classes). It is told the width since a can looks like a beaker but for
    its size.
    """

    classes: int
    batch_norm: bool = True
    """False for weights from `fold_batch_norm`."""
    training: bool = False

    @nn.compact
    def __call__(self, crops: jax.Array, widths: jax.Array) -> tuple[jax.Array, jax.Array]:
        few, more, many = REFINER_CHANNELS
        x = self._unit(more)(space_to_depth(self._unit(few)(space_to_depth(scale_pixels(crops), 2)), 2))
        x = x + self._unit(more, 3)(x)
        x = self._unit(many)(space_to_depth(x, 2))
        x = x + self._unit(many, 3)(self._unit(many, 3)(x))
        x = self._unit(32)(x).reshape(len(x), -1)
        x = jnp.concatenate([x, 4 * jnp.log(widths / CROP)[:, None]], axis=1)
        x = self._unit(128)(x)
        logits = nn.Dense(self.classes, bias_init=nn.initializers.constant(-2.5), name="logits")(x)
        edges = nn.Dense(4, kernel_init=nn.initializers.zeros, name="edges")(x)
        return jnp.asarray(INITIAL_BOX) + 0.2 * edges, logits

    def _unit(self, features: int, size: int = 1) -> Unit:
        return Unit(features, size, 1, self.batch_norm, self.training)


def scale_pixels(images: jax.Array) -> jax.Array:
    """uint8 as float32 in [-2, 2)."""
    return images.astype(jnp.float32) / 64 - 2


def space_to_depth(x: jax.Array, size: int) -> jax.Array:
    """Squares of `size` pixels as channels: (b, h, w, c) to (b, h / size, w / size, size² c)."""
    b, h, w, c = x.shape
    rows = x.reshape(b, h // size, size, w // size, size * c)
    return jnp.concatenate([rows[:, :, i] for i in range(size)], axis=-1)


def upsample(x: jax.Array) -> jax.Array:
    """Every pixel twice in both directions: (b, h, w, c) to (b, 2 h, 2 w, c)."""
    b, h, w, c = x.shape
    return jnp.broadcast_to(x[:, :, None, :, None], (b, h, 2, w, 2, c)).reshape(b, 2 * h, 2 * w, c)


def cell_centers(height: int, width: int) -> np.ndarray:
    """Centers of the proposer's cells in an image, row after row: x and y, (n, 2) float32, pixels."""
    y, x = np.mgrid[: height // STRIDE, : width // STRIDE]
    return (STRIDE * (np.stack([x, y], -1).reshape(-1, 2) + 0.5)).astype(np.float32)


def fold_batch_norm(params: dict[str, Any], statistics: dict[str, Any]) -> dict[str, Any]:
    """Fold batch normalization into the weights before it.

    Args:
        params: Weights of a trained network.
        statistics: The means and variances that it has seen.

    Returns:
        Weights of the network with `batch_norm=False` that gives the same answers.
    """
    if "norm" in params:
        scale = params["norm"]["scale"] / np.sqrt(statistics["norm"]["var"] + EPSILON)
        bias = params["norm"]["bias"] - statistics["norm"]["mean"] * scale
        return {"linear": {"kernel": params["linear"]["kernel"] * scale, "bias": bias}}
    return {
        name: fold_batch_norm(value, statistics.get(name, {})) if isinstance(value, dict) else value
        for name, value in params.items()
    }
