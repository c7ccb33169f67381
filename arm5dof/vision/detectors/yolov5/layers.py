"""The parts of YOLOv5 v6 in JAX, as published, with batch normalization folded into the convolutions.

Feature maps are (batch, height, width, channels). Each layer is a pytree of its weights; what shapes the program is
static.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


def _convolve(x: jax.Array, weight: jax.Array, stride: tuple[int, int], padding: tuple[int, int]) -> jax.Array:
    layout = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, weight, stride, [(p, p) for p in padding], dimension_numbers=layout)


def _space_to_depth(x: jax.Array) -> jax.Array:
    """Blocks of 2 x 2 as channels: (2 height, 2 width, channels, ...) to (height, width, 4 channels, ...)."""
    return jnp.concatenate([x[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=2)


class Conv(struct.PyTreeNode):
    """Convolution, then SiLU where `activated`."""

    weight: jax.Array
    """(height, width, channels in, channels out)."""
    bias: jax.Array
    stride: tuple[int, int] = struct.field(pytree_node=False)
    padding: tuple[int, int] = struct.field(pytree_node=False)
    activated: bool = struct.field(pytree_node=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        if self.weight.shape[:2] == (1, 1) == self.stride:
            x = x @ self.weight[0, 0]  # XLA's convolutions on a CPU do not see that this is all there is to it.
        elif self.weight.shape[:2] == (6, 6) and (self.stride, self.padding) == ((2, 2), (2, 2)):
            # The first layer, on three channels. The same sum over blocks of 2 x 2 pixels takes two thirds of its time.
            x = _convolve(_space_to_depth(x[0])[None], _space_to_depth(self.weight), (1, 1), (1, 1))
        else:
            x = _convolve(x, self.weight, self.stride, self.padding)
        x = x + self.bias
        return jax.nn.silu(x) if self.activated else x


class Bottleneck(struct.PyTreeNode):
    """Two convolutions, and around them a shortcut where `add`."""

    cv1: Conv
    cv2: Conv
    add: bool = struct.field(pytree_node=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        y = self.cv2(self.cv1(x))
        return x + y if self.add else y


class C3(struct.PyTreeNode):
    """Half of the channels through bottlenecks, half past them, and both mixed."""

    cv1: Conv
    cv2: Conv
    cv3: Conv
    inner: tuple[Bottleneck, ...]

    def __call__(self, x: jax.Array) -> jax.Array:
        y = self.cv1(x)
        for bottleneck in self.inner:
            y = bottleneck(y)
        return self.cv3(jnp.concatenate([y, self.cv2(x)], axis=-1))


class SPPF(struct.PyTreeNode):
    """Maxima over windows of three sizes, the larger ones by taking the maximum again."""

    cv1: Conv
    cv2: Conv
    size: int = struct.field(pytree_node=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        maps = [self.cv1(x)]
        for _ in range(3):
            maps.append(self._pool(maps[-1]))
        return self.cv2(jnp.concatenate(maps, axis=-1))

    def _pool(self, x: jax.Array) -> jax.Array:
        window = (1, self.size, self.size, 1)
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 1, 1, 1), "SAME")


class Upsample(struct.PyTreeNode):
    """Every pixel repeated."""

    factor: int = struct.field(pytree_node=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        return x.repeat(self.factor, axis=1).repeat(self.factor, axis=2)


class Concat(struct.PyTreeNode):
    """Several maps' channels in one."""

    def __call__(self, *maps: jax.Array) -> jax.Array:
        return jnp.concatenate(maps, axis=-1)


class Detect(struct.PyTreeNode):
    """The head: at every cell of every scale, a box for each anchor."""

    convs: tuple[Conv, ...]
    anchors: jax.Array
    """Widths and heights, (scales, anchors, 2), pixels."""
    strides: tuple[int, ...] = struct.field(pytree_node=False)
    """Pixels per cell of each scale."""

    def __call__(self, *maps: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Boxes (n, 4), center and size in pixels, and scores (n, classes), of the first image in the batch: by
        scale, anchor, row and column, the published order."""
        boxes, scores = [], []
        for conv, anchors, stride, x in zip(self.convs, self.anchors, self.strides, maps, strict=True):
            grid = jnp.stack(jnp.meshgrid(jnp.arange(x.shape[2]), jnp.arange(x.shape[1])), axis=-1)
            weights = jnp.split(conv.weight[0, 0], len(anchors), axis=-1)
            for weight, bias, anchor in zip(weights, jnp.split(conv.bias, len(anchors)), anchors, strict=True):
                y = jax.nn.sigmoid(x[0] @ weight + bias)
                center = (2 * y[..., :2] - 0.5 + grid) * stride
                size = (2 * y[..., 2:4]) ** 2 * anchor
                boxes.append(jnp.concatenate([center, size], axis=-1).reshape(-1, 4))
                scores.append((y[..., 4:5] * y[..., 5:]).reshape(-1, y.shape[-1] - 5))
        return jnp.concatenate(boxes), jnp.concatenate(scores)


class Network(struct.PyTreeNode):
    """The layers in order, each fed by earlier ones."""

    layers: tuple[Any, ...]
    inputs: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)
    """Which layers feed each; -1 is the one before."""

    def __call__(self, image: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Boxes (n, 4) and scores (n, classes) in one image, RGB uint8 (h, w, 3), h and w multiples of the stride."""
        x: Any = image[None].astype(jnp.float32) / 255
        kept: list[Any] = []
        for layer, inputs in zip(self.layers, self.inputs, strict=True):
            x = layer(*(x if i == -1 else kept[i] for i in inputs))
            kept.append(x)
        return x
