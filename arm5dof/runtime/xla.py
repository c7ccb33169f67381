"""XLA settings that make MJX usable on a CPU, set where they are safe."""

from __future__ import annotations

import functools
import gc
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from arm5dof.errors import UserError

T = TypeVar("T")
U = TypeVar("U")

FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
"""Worth 4 to 8 times in `mjx.step` on a CPU; it concerns no other back end."""

KNOWN_JAXLIB = ((0, 8, 3), (0, 10, 2))
"""First and last jaxlib seen to know the flag. XLA ends a process that names a flag it does not know."""


def flags(current: str, jaxlib_version: str) -> str:
    """`XLA_FLAGS` to use, given the user's own and jaxlib's version: theirs win, unknown versions are left alone, and
    so is the name of a file that has them."""
    is_file = bool(current.strip()) and not current.strip().startswith("-")
    if is_file or "xla_cpu_use_fusion_emitters" in current or not _known(jaxlib_version):
        return current
    return f"{current} {FUSION_EMITTERS}".strip()


def _known(jaxlib_version: str) -> bool:
    release = tuple(int(n) for n in re.findall(r"\d+", jaxlib_version)[:3])
    return KNOWN_JAXLIB[0] <= release <= KNOWN_JAXLIB[1]


def configure() -> None:
    """Put the flags into this process's environment. JAX reads them when its first back end starts."""
    chosen = flags(os.environ.get("XLA_FLAGS", ""), metadata.version("jaxlib"))
    if chosen:
        os.environ["XLA_FLAGS"] = chosen


def effort(level: int) -> dict[str, int]:
    """`compiler_options` of `jax.jit` for a CPU: how hard LLVM tries, 0 to 3. 3 is XLA's own choice; 2 takes three
    quarters of its time for programs as fast, and what runs only once can do with 0."""
    import jax  # This module is imported before it, to set its flags.

    return {"xla_backend_optimization_level": level} if jax.default_backend() == "cpu" else {}


def fusion_emitters() -> dict[str, bool]:
    """`compiler_options` of `jax.jit` for a program that is faster with XLA's own choice than with ours above:
    convolutional networks are, by a quarter."""
    import jax

    known = jax.default_backend() == "cpu" and _known(metadata.version("jaxlib"))
    return {"xla_cpu_use_fusion_emitters": True} if known else {}


ONE_CORE = {"xla_cpu_multi_thread_eigen": False}
"""`compiler_options` of a program for a CPU that is to stay on one core: see `on_all_cores`."""


def on_all_cores(function: Callable[[T], U], items: Iterable[T]) -> list[U]:
    """The function of each of some items, one or more, so many at a time as this process has cores: of the programs
    that one thread asks for XLA runs one after the other, and most of each on one core."""
    import jax

    first, *others = items
    found = [function(first)]  # Alone, so that it is traced and compiled once.
    pool = ThreadPoolExecutor(cores())
    try:
        return found + list(pool.map(lambda item: jax.block_until_ready(function(item)), others))
    finally:
        pool.shutdown(cancel_futures=True)  # What has not begun when this is interrupted.


@contextmanager
def gc_paused() -> Iterator[None]:
    """Tracing makes many objects that stay: to search them for garbage again and again takes much of its time."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def cores() -> int:
    """How many CPU cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_programs: Path | None = None


def enable_compilation_cache() -> None:
    """Keep compiled and traced programs on disk between runs, unless the user has said where or wants none."""
    global _programs
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(_cache() / "arm5dof" / "xla")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    seconds = os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    if "jax" in sys.modules:  # It has read its environment already.
        import jax

        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(seconds))
    _programs = Path(folder) / "traced"


def _cache() -> Path:
    """The user's folder for caches. One without a home, as in many containers, has it among temporary files, and so
    has matplotlib then, which would look for a home, too."""
    if (given := Path(os.environ.get("XDG_CACHE_HOME", ""))).is_absolute():
        return given
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        folder = Path(tempfile.gettempdir()) / f"cache-{os.getuid()}"
        os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))
        return folder


def check_platform() -> None:
    """Raise `UserError` if the user asked for devices that JAX does not find, or for flags that XLA does not know: it
    would end the process. It is asked in another one."""
    given = os.environ.get("XLA_FLAGS", "").replace(FUSION_EMITTERS, "").strip()
    if given and (reason := _ends_xla(os.environ["XLA_FLAGS"])):
        raise UserError(f"XLA_FLAGS={given} ends XLA ({reason}): mend it, or unset it")
    asked = os.environ.get("JAX_PLATFORMS")
    if not asked:
        return
    import jax

    try:
        jax.devices()
    except Exception as error:  # AssertionError, RuntimeError: it depends on what is installed.
        raise UserError(
            f"JAX_PLATFORMS={asked}: JAX finds no such device here; unset it, or install its plugin"
        ) from error


@functools.cache
def _ends_xla(chosen: str) -> str:
    """Why XLA ends a process of these flags, "" if it does not. One process may run several commands."""
    start = [sys.executable, "-c", "from jaxlib import xla_client; xla_client.make_cpu_client()"]
    environment = {**os.environ, "XLA_FLAGS": chosen}
    done = subprocess.run(start, env=environment, capture_output=True, text=True, errors="replace", check=False)
    reason = done.stderr.strip().partition("\n")[0].rpartition("] ")[2]
    return (reason or f"exit status {done.returncode}") if done.returncode else ""


def check_numbers() -> None:
    """Raise `UserError` if JAX is set to other arithmetic than what this package is written for."""
    import jax

    here: Any = jax.config  # Has what is set for this thread alone as attributes, of which no type checker knows.
    if here.jax_enable_x64:
        raise UserError("JAX_ENABLE_X64 is set, but environments and networks are of 32 bits: unset it")
    if here.jax_numpy_rank_promotion == "raise":
        raise UserError("JAX_NUMPY_RANK_PROMOTION=raise is set, but this package promotes ranks: unset it")
    if here.jax_numpy_dtype_promotion == "strict":
        raise UserError("JAX_NUMPY_DTYPE_PROMOTION=strict is set, but this package promotes types: unset it")
    if "disallow" in str(here.jax_transfer_guard):
        raise UserError("JAX_TRANSFER_GUARD is set, but this package lets JAX fetch what it needs: unset it")
    if here.jax_disable_jit:
        raise UserError("JAX_DISABLE_JIT is set, and without compilation a training takes days: unset it")
    if here.jax_default_prng_impl != "threefry2x32" or not here.jax_threefry_partitionable:
        raise UserError(
            "JAX_DEFAULT_PRNG_IMPL or JAX_THREEFRY_PARTITIONABLE is set, but seeds stand for the numbers of JAX's own "
            "default: unset both"
        )


def programs_folder() -> Path | None:
    """Where traced programs are kept, or None if they are not."""
    import jax

    return _programs if jax.config.values["jax_enable_compilation_cache"] else None
