"""Weights of the tabletop detector's networks that make them say what a test wants to hear."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from arm5dof.vision.detectors.tabletop.crops import CONTEXT
from arm5dof.vision.detectors.tabletop.networks import CROP, INITIAL_BOX, INITIAL_DISTANCE, STRIDE, Proposer, Refiner

NETWORKS: dict[str, Callable[..., Any]] = {"proposer": Proposer, "refiner": partial(Refiner, 3)}


def inputs(name: str, count: int, random: np.random.Generator | None = None) -> tuple[np.ndarray, ...]:
    """What one of the networks takes: images, and for the refiner the widths of crops."""
    side = CROP if name == "refiner" else 64
    random = random or np.random.default_rng(0)
    images = random.integers(0, 256, (count, side, side, 3), np.uint8)
    return (images, random.uniform(20, 90, count).astype(np.float32)) if name == "refiner" else (images,)


def zeros(name: str) -> dict[str, Any]:
    """Folded weights of one of the networks, all zero."""
    like = jax.eval_shape(NETWORKS[name](False).init, jax.random.key(0), *inputs(name, 1))
    return jax.tree.map(lambda x: np.zeros(x.shape, np.float32), like["params"])


def weights_of(size: float, likely: float, sure: float) -> dict[str, Any]:
    """Folded weights of networks of which one says that a square object of that size, in pixels of the reduced image,
    lies round every cell, so likely, and the other that it is of the first class, so sure, and moves it nowhere."""
    proposer, refiner = zeros("proposer"), zeros("refiner")
    proposer["edges"]["bias"] = np.full(4, (size / 2 - INITIAL_DISTANCE) / STRIDE, np.float32)
    proposer["logits"]["bias"] = np.array([likely], np.float32)
    inner = 0.5 + np.array([-1, -1, 1, 1]) / (2 * CONTEXT)
    refiner["edges"]["bias"] = ((inner - INITIAL_BOX) / 0.2).astype(np.float32)
    refiner["logits"]["bias"] = np.array([sure, -9, -9], np.float32)
    return {"proposer": proposer, "refiner": refiner}
