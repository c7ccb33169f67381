"""YOLOv5 v6 in JAX, straight from the published weights: n, s, m, l, x and whatever was trained from them.

The network is built from the modules that the file lists, so widths, depths and the number of scales are the file's.
Decoding and non-maximum suppression are the published ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import forks, xla
from arm5dof.vision.detections import Detections, check_thresholds
from arm5dof.vision.detectors.yolov5.layers import C3, SPPF, Bottleneck, Concat, Conv, Detect, Network, Upsample
from arm5dof.vision.detectors.yolov5.pt_reader import Module, read_pt
from arm5dof.vision.images import check_size, letterbox, rgb


def _conv(module: Module) -> Conv:
    """A published `Conv` (convolution, batch normalization, SiLU), or a bare convolution, as one convolution."""
    if module.kind.endswith(".Conv2d"):
        return _bare(module, module.get("bias"), activated=False)
    if (activation := module.get("act").kind) != "torch.nn.modules.activation.SiLU":
        raise UserError(f"the network's activation is {activation}: only SiLU, which YOLOv5 v6 uses, is supported")
    conv = _bare(module.get("conv"), None, activated=True)
    if not module.has("bn"):  # The file was saved with the normalization folded in already.
        return replace(conv, bias=jnp.asarray(module.get("conv").get("bias"), jnp.float32))
    norm = module.get("bn")
    mean, variance, weight, bias = (
        norm.get(name).astype(np.float64) for name in ("running_mean", "running_var", "weight", "bias")
    )
    scale = weight / np.sqrt(variance + norm.get("eps"))
    return replace(
        conv,
        weight=jnp.asarray(np.asarray(conv.weight) * scale, jnp.float32),
        bias=jnp.asarray(bias - mean * scale, jnp.float32),
    )


def _bare(module: Module, bias: np.ndarray | None, activated: bool) -> Conv:
    """A `Conv2d` by itself. PyTorch's weights are (channels out, channels in, height, width)."""
    weight = jnp.asarray(module.get("weight").transpose(2, 3, 1, 0), jnp.float32)
    if module.get("groups") != 1 or tuple(module.get("dilation")) != (1, 1):
        raise UserError("the network has grouped or dilated convolutions, which YOLOv5 v6 has not")
    offset = jnp.zeros(weight.shape[-1]) if bias is None else jnp.asarray(bias, jnp.float32)
    return Conv(weight, offset, tuple(module.get("stride")), tuple(module.get("padding")), activated)


def _bottleneck(module: Module) -> Bottleneck:
    return Bottleneck(_conv(module.get("cv1")), _conv(module.get("cv2")), bool(module.get("add")))


def _c3(module: Module) -> C3:
    inner = tuple(_bottleneck(child) for child in module.get("m").children())
    return C3(_conv(module.get("cv1")), _conv(module.get("cv2")), _conv(module.get("cv3")), inner)


def _sppf(module: Module) -> SPPF:
    return SPPF(_conv(module.get("cv1")), _conv(module.get("cv2")), int(module.get("m").get("kernel_size")))


def _detect(module: Module) -> Detect:
    strides = tuple(int(s) for s in module.get("stride"))
    anchors = module.get("anchors").astype(np.float32) * np.array(strides, np.float32)[:, None, None]
    convs = tuple(_conv(child) for child in module.get("m").children())
    return Detect(convs, jnp.asarray(anchors), strides)


LAYERS: dict[str, Callable[[Module], Any]] = {
    "models.common.Conv": _conv,
    "models.common.C3": _c3,
    "models.common.SPPF": _sppf,
    "models.common.Concat": lambda module: Concat(),
    "models.yolo.Detect": _detect,
    "torch.nn.modules.upsampling.Upsample": lambda module: Upsample(int(module.get("scale_factor"))),
}


def _layer_of(module: Module) -> Any:
    if module.kind not in LAYERS:
        raise UserError(f"the network has a layer {module.kind}, which YOLOv5 v6's n, s, m, l and x have not")
    return LAYERS[module.kind](module)


def load_network(path: str | Path) -> tuple[Network, tuple[str, ...]]:
    """Build the network in a `.pt` file.

    Returns:
        The network, and the names of its classes.

    Raises:
        UserError: The file is missing, damaged, or holds no YOLOv5 v6.
    """
    saved = read_pt(path)
    try:
        model = saved.get("ema") or saved["model"]
        modules = model.get("model").children()
        names = model.get("names")
        sources = [module.get("f") for module in modules]
        network = Network(
            tuple(_layer_of(module) for module in modules),
            tuple(tuple(f) if isinstance(f, list) else (f,) for f in sources),
        )
        class_names = tuple(str(n) for n in (names.values() if isinstance(names, dict) else names))
        head = network.layers[-1]
        outputs = {conv.weight.shape[-1] for conv in head.convs}
        if outputs != {head.anchors.shape[1] * (5 + len(class_names))}:
            raise UserError(f"the head's outputs ({outputs}) do not match the {len(class_names)} class names")
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} holds no YOLOv5 v6 network ({error}): give weights such as yolov5n.pt") from None
    return network, class_names


@cache
def _program() -> Callable[[Network, np.ndarray], tuple[jax.Array, jax.Array]]:
    """The network as a program, compiled once for each architecture and input size, whatever the weights."""
    return jax.jit(Network.__call__, compiler_options=xla.fusion_emitters())


class YOLOv5:
    """A detector with the weights of a YOLOv5 v6 `.pt` file.

    Args:
        path: The file.
        class_names: Names of the network's classes; None for those in the file.
        confidence: Detections below it are dropped, in [0, 1].
        iou: Of boxes of one class that overlap more, the best stays, in [0, 1].
        size: Longer side of the network's input, pixels: a multiple of the largest stride, 32 or 64.
        square: Use a square input whatever the image, one program for all. Otherwise the shorter side is only as long
            as the image needs, with one program for each aspect ratio, and 4:3 images take three quarters of the time.

    Raises:
        UserError: The file is missing, damaged, or holds no YOLOv5 v6; it has another number of classes than were
            named; the size is no such multiple; or a threshold lies outside [0, 1].
    """

    def __init__(
        self,
        path: str | Path,
        class_names: Sequence[str] | None = None,
        confidence: float = 0.25,
        iou: float = 0.45,
        size: int = 640,
        square: bool = True,
    ) -> None:
        check_thresholds(confidence, iou)
        self._network, names = load_network(path)
        if class_names is not None and len(class_names) != len(names):
            raise UserError(
                f"{path} tells {len(names)} classes apart, and {len(class_names)} names were given: give one name for "
                "each class"
            )
        self.class_names = names if class_names is None else tuple(class_names)
        self._stride = max(self._network.layers[-1].strides)
        check_size(size, self._stride)
        self._confidence, self._iou, self._size, self._square = confidence, iou, size, square

    def __call__(self, image: np.ndarray) -> Detections:
        """What is in an image (h, w, 3), RGB uint8 or anything else that `images.rgb` takes."""
        forks.check()
        boxed = letterbox(rgb(image), (self._size, self._size), None if self._square else self._stride)
        boxes, scores = (np.asarray(x) for x in self.forward(boxed.image))
        found = Detections.from_scores(boxes, scores, self.class_names, self._confidence, self._iou)
        return replace(found, xyxy=boxed.to_source(found.xyxy))

    def forward(self, image: np.ndarray) -> tuple[jax.Array, jax.Array]:
        """The network's output.

        Args:
            image: RGB uint8 (h, w, 3), height and width multiples of the largest stride.

        Returns:
            Every box (n, 4), center and size in pixels, and its scores (n, classes).
        """
        return _program()(self._network, image)
