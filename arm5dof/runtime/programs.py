"""Traced programs kept on disk, beside the compiled ones that JAX keeps.

JAX finds a compiled program by what tracing made of the Python function, so each process traces anew, which takes
longer than all else in a warm start. A program kept here is found by what the function is made from instead.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jax import export

from arm5dof.runtime import files, xla

PACKAGE = Path(__file__).parents[1]
MOST_JITTED = 16
"""Programs that a process keeps, by the last use; each takes memory."""
_JITTED: dict[str, Any] = {}
TRACED_BY = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


class Program:
    """A function of arrays in lists, tuples and dicts (and named tuples registered with `jax.export`), for arguments of
    the shapes and types of `arguments`.

    `identity` is all that it depends on besides its arguments and the source of this package: MuJoCo models, and things
    whose `repr` says what they are. With None, or where the user wants no compilation cache, nothing is kept.
    """

    def __init__(
        self, function: Callable[..., Any], arguments: Sequence[Any], identity: Sequence[object] | None
    ) -> None:
        self._function = function
        self._shapes = jax.eval_shape(lambda *x: x, *arguments)
        folder, name = xla.programs_folder(), function.__name__
        self._path = None
        if folder is not None and identity is not None:
            self._path = folder / f"{name}-{_digest(name, self._shapes, *identity)}.bin"

    @cached_property
    def kept(self) -> export.Exported | None:
        """The traced program, if it is on disk."""
        try:
            found = self._path.read_bytes() if self._path else b""
        except OSError:
            return None
        checksum, program = found[:32], found[32:]
        return export.deserialize(bytearray(program)) if hashlib.sha256(program).digest() == checksum else None

    def jit(self, **options: Any) -> Any:
        """`jax.jit(function, **options)`, its trace read from disk or kept there, and what it makes of it kept by this
        process."""
        if self._path is None:
            return self._jit(options)
        return _shared(f"{self._path} {sorted(options.items())}", lambda: self._jit(options))

    def _jit(self, options: dict[str, Any]) -> Any:
        exported = self.kept
        if exported is None and self._path:
            try:
                exported = export.export(jax.jit(self._function))(*self._shapes)
                _keep(self._path, exported)
            except (ValueError, NotImplementedError):  # It calls something that JAX keeps in no file.
                pass
        if exported is None:
            return jax.jit(self._function, **options)
        return jax.jit(functools.wraps(self._function)(lambda *arguments: exported.call(*arguments)), **options)


def jit(function: Callable[..., Any], identity: Sequence[object] | None, **options: Any) -> Any:
    """`jax.jit(function, **options)` that this process makes once for all functions of an `identity` (see `Program`,
    but for arguments of any shapes), so that what it traces and compiles is used again."""
    make = lambda: jax.jit(function, **options)
    if identity is None:
        return make()
    return _shared(f"{_digest(function.__name__, *identity)} {sorted(options.items())}", make)


def _shared(name: str, make: Callable[[], Any]) -> Any:
    """What this process keeps under a name, made if it keeps none."""
    found = _JITTED.pop(name, None) or make()
    _JITTED[name] = found
    if len(_JITTED) > MOST_JITTED:
        del _JITTED[next(iter(_JITTED))]
    return found


def _keep(path: Path, exported: export.Exported) -> None:
    """Write a program to disk, if there is room: it is only to save time."""
    program = bytes(exported.serialize())
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.replacing(path) as temporary:
            temporary.write_bytes(hashlib.sha256(program).digest() + program)


def _digest(*parts: object) -> str:
    digest = hashlib.sha256(_surroundings())
    for part in parts:
        if isinstance(part, mujoco.MjModel):
            model = np.empty(mujoco.mj_sizeModel(part), np.uint8)
            mujoco.mj_saveModel(part, None, model)
            digest.update(model.tobytes())
        else:
            digest.update(f"{part!r}\n".encode())
    return digest.hexdigest()[:32]


def _surroundings() -> bytes:
    """What every program depends on: this package's source, its libraries, and JAX's configuration."""
    return hashlib.sha256(
        _source() + repr((jax.default_backend(), sorted(jax.config.values.items()))).encode()
    ).digest()


@functools.cache
def _source() -> bytes:
    """This package's source and its libraries, which stay as they are while a process runs."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    digest.update(repr([(name, metadata.version(name)) for name in TRACED_BY]).encode())
    return digest.digest()
