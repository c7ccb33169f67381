"""The tabletop detector's weights in a file: a `.npz` with arrays by their names in the networks, batch normalization
folded in, and the names of the classes. Nothing in it is ever unpickled."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.detectors.tabletop.networks import COARSE_STRIDE, CROP, Proposer, Refiner

SHIPPED = resources.files(__package__) / "tabletop.npz"
CLASS_NAMES = "class_names"
"""The name of the array that holds them."""
DAMAGED = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    tokenize.TokenError,
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    AttributeError,
    MemoryError,
)
"""What NumPy raises for files that are no archives of arrays."""


def save_weights(path: Path, params: dict[str, Any], class_names: Sequence[str]) -> None:
    """Write weights atomically, rounded to half precision. The same weights give the same bits.

    Args:
        path: The file, which is replaced if it exists.
        params: Weights of both networks, `proposer` and `refiner`, from `fold_batch_norm`.
        class_names: Names of the classes.
    """
    arrays = {name: np.asarray(value, np.float16) for name, value in flatten_dict(params, sep="/").items()}
    with files.replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{CLASS_NAMES: np.array(class_names)}, **arrays)


def load_weights(path: str | Path | None = None) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Read weights.

    Args:
        path: A file that `save_weights` wrote; None for the one that ships.

    Returns:
        Weights of both networks in single precision, and the names of the classes.

    Raises:
        UserError: There is no such file, it is damaged, or it holds weights of other networks.
    """
    source = SHIPPED if path is None else Path(path)
    if not source.is_file():
        raise UserError(f"no weights {str(source)!r}: train the tabletop detector, which writes such a file")
    try:
        with source.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        class_names = tuple(str(name) for name in arrays.pop(CLASS_NAMES))
        arrays = {name: value.astype(np.float32) for name, value in arrays.items()}
    except DAMAGED:
        raise UserError(
            f"{source} is damaged, or no weights of this detector: train the tabletop detector to get such a file"
        ) from None
    shapes = {name: value.shape for name, value in arrays.items()}
    if shapes != _shapes(len(class_names)) or not all(np.isfinite(value).all() for value in arrays.values()):
        raise UserError(f"{source} holds other weights than the networks have: train the tabletop detector anew")
    return unflatten_dict(arrays, sep="/"), class_names


@cache
def _shapes(classes: int) -> dict[str, tuple[int, ...]]:
    """Of all arrays, by their names."""
    image, crops = (np.zeros((1, side, side, 3), np.uint8) for side in (COARSE_STRIDE, CROP))
    variables = {
        "proposer": jax.eval_shape(Proposer(False).init, jax.random.key(0), image),
        "refiner": jax.eval_shape(Refiner(classes, False).init, jax.random.key(0), crops, np.ones(1, np.float32)),
    }
    params = {name: one["params"] for name, one in variables.items()}
    return {name: value.shape for name, value in flatten_dict(params, sep="/").items()}
