"""Writes YOLOv5 v6 files of any width and depth with random weights, laid out as the published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from helpers.pickles import Shell, save

ANCHORS = [[[1.25, 1.625], [2, 3.75]], [[1.875, 3.8125], [3.875, 2.8125]], [[3.625, 2.8125], [4.875, 6.1875]]]
"""Two a scale, in cells; the published networks have three."""


class Architecture:
    """The published lay-out at `width` channels in the first layer and `depth` bottlenecks in the first C3."""

    def __init__(self, width: int, depth: int, classes: int, folded: bool = False) -> None:
        self.width, self.depth, self.classes, self.folded = width, depth, classes, folded
        self.random = np.random.default_rng(0)

    def conv2d(self, into: int, out: int, size: int, stride: int, bias: bool) -> Shell:
        weight = self.random.normal(0, (into * size * size) ** -0.5, (out, into, size, size)).astype(np.float32)
        return Shell(
            "torch.nn.modules.conv.Conv2d",
            _parameters={"weight": weight, "bias": np.zeros(out, np.float32) if bias else None},
            _buffers={},
            _modules={},
            stride=(stride, stride),
            padding=((size - 1) // 2 if size < 6 else 2,) * 2,
            dilation=(1, 1),
            groups=1,
        )

    def conv(self, into: int, out: int, size: int = 1, stride: int = 1) -> Shell:
        conv = self.conv2d(into, out, size, stride, bias=self.folded)
        weight, bias, mean = (self.random.normal(1, 0.2, out).astype(np.float32) for _ in range(3))
        variance = self.random.uniform(0.5, 1.5, out).astype(np.float32)
        norm = Shell(
            "torch.nn.modules.batchnorm.BatchNorm2d",
            _parameters={"weight": weight, "bias": bias},
            _buffers={"running_mean": mean, "running_var": variance},
            _modules={},
            eps=0.001,
        )
        parts = {"conv": conv, "bn": norm, "act": Shell("torch.nn.modules.activation.SiLU", _modules={})}
        if self.folded:
            scale = weight / np.sqrt(variance + 0.001)
            parameters = conv.state["_parameters"]
            parameters["weight"] = parameters["weight"] * scale[:, None, None, None]
            parameters["bias"] = bias - mean * scale
            del parts["bn"]
        return Shell("models.common.Conv", _parameters={}, _buffers={}, _modules=parts)

    def c3(self, into: int, out: int, depth: int, add: bool = True) -> Shell:
        half = out // 2
        inner = {
            str(i): Shell(
                "models.common.Bottleneck",
                _modules={"cv1": self.conv(half, half), "cv2": self.conv(half, half, 3)},
                add=add,
            )
            for i in range(depth)
        }
        parts = {"cv1": self.conv(into, half), "cv2": self.conv(into, half), "cv3": self.conv(2 * half, out)}
        sequence = Shell("torch.nn.modules.container.Sequential", _modules=inner)
        return Shell("models.common.C3", _modules={**parts, "m": sequence})

    def layers(self) -> list[tuple[Any, Shell]]:
        """Each layer and what feeds it."""
        w, d = self.width, self.depth
        pool = Shell("torch.nn.modules.pooling.MaxPool2d", _modules={}, kernel_size=5)
        sppf = {"cv1": self.conv(16 * w, 8 * w), "cv2": self.conv(32 * w, 16 * w), "m": pool}
        up = Shell("torch.nn.modules.upsampling.Upsample", _modules={}, scale_factor=2.0)
        concat = Shell("models.common.Concat", _modules={}, d=1)
        heads = {str(i): self.conv2d(n * w, 2 * (5 + self.classes), 1, 1, bias=True) for i, n in enumerate((4, 8, 16))}
        detect = Shell(
            "models.yolo.Detect",
            _buffers={"anchors": np.array(ANCHORS, np.float32)},
            _modules={"m": Shell("torch.nn.modules.container.ModuleList", _modules=heads)},
            stride=np.array([8, 16, 32], np.float32),
        )
        backbone = [self.conv(3, w, 6, 2)]
        for i, n in enumerate((d, 2 * d, 3 * d, d)):
            backbone += [self.conv(2**i * w, 2 ** (i + 1) * w, 3, 2), self.c3(2 ** (i + 1) * w, 2 ** (i + 1) * w, n)]
        neck = [
            (-1, self.conv(16 * w, 8 * w)),
            (-1, up),
            ([-1, 6], concat),
            (-1, self.c3(16 * w, 8 * w, d, add=False)),
            (-1, self.conv(8 * w, 4 * w)),
            (-1, up),
            ([-1, 4], concat),
            (-1, self.c3(8 * w, 4 * w, d, add=False)),
            (-1, self.conv(4 * w, 4 * w, 3, 2)),
            ([-1, 14], concat),
            (-1, self.c3(8 * w, 8 * w, d, add=False)),
            (-1, self.conv(8 * w, 8 * w, 3, 2)),
            ([-1, 10], concat),
            (-1, self.c3(16 * w, 16 * w, d, add=False)),
            ([17, 20, 23], detect),
        ]
        return [(-1, layer) for layer in backbone] + [(-1, Shell("models.common.SPPF", _modules=sppf)), *neck]

    def save(self, path: Path, **changes: Any) -> Path:
        """Write the file; `changes` are to the model's attributes."""
        modules = {}
        for i, (source, layer) in enumerate(self.layers()):
            modules[str(i)] = Shell(layer.kind, **layer.state, f=source, i=i)
        sequence = Shell("torch.nn.modules.container.Sequential", _modules=modules)
        names = {i: f"class {i}" for i in range(self.classes)}
        return save(
            path, {"model": Shell("models.yolo.Model", **{"_modules": {"model": sequence}, "names": names} | changes)}
        )
