"""Checkpoints with orbax: complete, atomic, verified when read.

A checkpoint has two items, `networks` (all that answering needs) and `training` (optimizers, replay buffer,
environments, random keys, counters), and a record of names, shapes and digests by which damage and foreign
checkpoints are recognised, and of the settings that made it. Nothing in it is ever unpickled.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.ddpg import Networks, Training
from arm5dof.errors import UserError
from arm5dof.training.checkpoint_folder import check_room, names_in, plain

T = TypeVar("T")
KEEP = 2


class Checkpoints:
    """The checkpoints of one run, in one folder, numbered by the steps taken.

    `settings` are those that shape what is kept, by name: a checkpoint made with others is refused. Those of `budget`
    may change, and `check` says which did. One of `left_open` that a record lacks is not compared: it is younger than
    the run. Only the process that trains the run may open them for writing: it clears away what a killed one left
    unfinished.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        budget: Mapping[str, Any] | None = None,
        read_only: bool = False,
        left_open: Collection[str] = (),
    ) -> None:
        import orbax.checkpoint as ocp  # Takes half a second, which what needs no checkpoint does without.

        names_in(folder)
        self.folder = folder
        self._left_open = left_open
        # As a record gives them back: JSON has no tuples.
        self._settings, self._budget = json.loads(json.dumps([dict(settings), dict(budget or {})]))
        logging.getLogger("absl").setLevel(logging.CRITICAL)
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEEP,
            enable_async_checkpointing=False,
            cleanup_tmp_directories=not read_only,
            create=not read_only,
            read_only=read_only,
        )
        self._open = contextlib.ExitStack()
        with _as_user_error(f"cannot open the checkpoints in {folder}"):
            path = self._open.enter_context(plain(folder.resolve(), create=not read_only))
            self._manager = ocp.CheckpointManager(path, options=options)
        self._open.callback(self._manager.close)

    def close(self) -> None:
        """Let go of orbax's threads: a process may train thousands of runs."""
        self._open.close()

    @property
    def latest(self) -> int | None:
        """Steps at the newest complete checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, training: Training) -> None:
        """Write a checkpoint. It counts once it is complete and was read back; until then, and if it fails, the last
        one does."""
        import orbax.checkpoint as ocp

        items = {"networks": _leaves(training.networks), "training": _leaves(training.replace(networks=None))}
        record = {name: _describe(leaves) for name, leaves in items.items()}
        record |= {"settings": self._settings, "budget": self._budget}
        kept = "" if self.latest is None else ", the last complete one is kept"
        failure = f"cannot write a checkpoint to {self.folder}{kept}"
        step = int(training.steps)
        with _as_user_error(failure):
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    record=ocp.args.JsonSave(record),
                    **{name: ocp.args.StandardSave(leaves) for name, leaves in items.items()},
                ),
            )
            self._manager.wait_until_finished()
            try:
                for name, leaves in items.items():
                    self._restore(step, name, _abstract(leaves), record)
            except Exception:
                self._manager.delete(step)
                raise

    def check_room(self) -> None:
        """Raise `UserError` unless another checkpoint like the newest can be written."""
        if self.latest is not None:
            check_room(self.folder, self.folder / str(self.latest))

    def restore(self, like: Training) -> Training:
        """The newest checkpoint, bit for bit. `like` gives shapes and types (`jax.eval_shape` of `DDPG.init`)."""
        rest = self._read("training", like.replace(networks=None))
        return rest.replace(networks=self.restore_networks(like.networks))

    def restore_networks(self, like: Networks) -> Networks:
        """The networks of the newest checkpoint."""
        return self._read("networks", like)

    def check(self) -> dict[str, tuple[Any, Any]]:
        """Raise `UserError` if the newest checkpoint, where there is one, was made with other settings or is damaged.
        Returns what of the budget has changed since: from what to what, by name."""
        if self.latest is None and (names := names_in(self.folder)):
            raise UserError(
                f"the checkpoints in {self.folder} ({', '.join(names)}) are damaged or none of ours: take them from a "
                "copy of the run, or remove them to begin anew"
            )
        record = {} if self.latest is None else self._record(self.latest)
        before = {**record.get("settings", {}), **record.get("budget", {})}
        return {name: (before[name], v) for name, v in self._budget.items() if name in before and before[name] != v}

    def _read(self, item: str, like: T) -> T:
        step = self.latest
        if step is None:
            raise UserError(f"{self.folder} holds no complete checkpoint yet")
        template = {name: _storable(leaf) for name, leaf in named(like).items() if leaf.size}
        abstract = _abstract(template)
        with self._damage(step):
            record = self._record(step)
            expected = {name: [list(leaf.shape), str(leaf.dtype)] for name, leaf in abstract.items()}
            if expected != record[item]["leaves"]:
                raise UserError(
                    f"the checkpoint {self.folder / str(step)} does not fit the run's config.toml: it is of another "
                    "run or version"
                )
            restored = self._restore(step, item, abstract, record)
        return rebuild(like, restored)

    def _restore(self, step: int, item: str, abstract: dict[str, Any], record: Mapping[str, Any]) -> dict[str, Any]:
        """An item's leaves of given shapes and types. Raises `ValueError`, or what orbax does, if it is damaged."""
        import orbax.checkpoint as ocp

        args = ocp.args.Composite(**{item: ocp.args.StandardRestore(abstract)})
        restored: dict[str, Any] = self._manager.restore(step, args=args)[item]
        if _describe(restored)["sha256"] != record[item]["sha256"]:
            raise ValueError("its contents do not match their digest")
        return restored

    def _record(self, step: int) -> dict[str, Any]:
        """What a checkpoint says of itself. Raises `UserError` if it was made with other settings."""
        import orbax.checkpoint as ocp

        where = self.folder / str(step)
        with self._damage(step):
            record = self._manager.restore(step, args=ocp.args.Composite(record=ocp.args.JsonRestore())).record
            made_with = record.get("settings")
        if made_with is None:
            raise UserError(f"the checkpoint {where} is of an older version: train the run anew")
        names = [*made_with, *(name for name in self._settings if name not in {*made_with, *self._left_open})]
        fixed = [name for name in names if name not in self._budget]
        if changed := [name for name in fixed if made_with.get(name) != self._settings.get(name)]:
            told = "; ".join(f"{n} = {made_with.get(n)!r}, now {self._settings.get(n)!r}" for n in changed[:3])
            raise UserError(
                f"the checkpoint {where} was made with other settings ({told}): set them back in config.toml"
            )
        return dict(record)

    def _damage(self, step: int) -> AbstractContextManager[None]:
        """What is said of a checkpoint that cannot be read."""
        where = self.folder / str(step)
        return _as_user_error(f"the checkpoint {where} is damaged or not one of ours; remove it to use an older one")


def _abstract(leaves: Mapping[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and types of named leaves."""
    return {name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for name, leaf in leaves.items()}


def named(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their names."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _storable(leaf: Any) -> Any:
    """PRNG keys as the integers they are made of; works on arrays and on their shapes."""
    if not _is_key(leaf):
        return leaf
    abstract = isinstance(leaf, jax.ShapeDtypeStruct)
    return jax.eval_shape(jax.random.key_data, leaf) if abstract else jax.random.key_data(leaf)


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    """A pytree as named arrays; empty arrays, which tensorstore cannot write, are left out."""
    return {name: np.asarray(_storable(leaf)) for name, leaf in named(tree).items() if leaf.size}


def rebuild(like: T, leaves: dict[str, Any]) -> T:
    """The pytree of the structure of `like` (shapes and types) from its leaves by their names."""

    def leaf(path: Any, template: Any) -> jax.Array:
        if not template.size:
            return jnp.zeros(template.shape, template.dtype)
        value = jnp.array(leaves[jax.tree_util.keystr(path, simple=True, separator=".")])
        return jax.random.wrap_key_data(value) if _is_key(template) else value

    return jax.tree_util.tree_map_with_path(leaf, like)


def _describe(leaves: dict[str, Any]) -> dict[str, Any]:
    digest = hashlib.sha256()
    for name in sorted(leaves):
        digest.update(np.ascontiguousarray(leaves[name]).tobytes())
    shapes = {name: [list(leaf.shape), str(leaf.dtype)] for name, leaf in leaves.items()}
    return {"leaves": shapes, "sha256": digest.hexdigest()}


@contextlib.contextmanager
def _as_user_error(message: str) -> Iterator[None]:
    """Orbax and tensorstore raise many types for a bad file or a full disk; to the user they are one.

    After one failure the rest of tensorstore's threads fail too: see `silence_abandoned_writes`.
    """
    undo = silence_abandoned_writes()
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        reason = (str(error) or type(error).__name__).strip().splitlines()[0].split(" [source")[0]
        reason = reason if len(reason) < 160 else "..." + reason[-160:]
        if code := re.search(r"os_error_code='(\d+)'", str(error)):  # It is said after all of the array's metadata.
            reason = os.strerror(int(code[1]))
        error.with_traceback(None)  # Its frames hold what is to be collected.
        gc.collect()
        raise UserError(f"{message} ({reason})") from error
    finally:
        undo()


def silence_abandoned_writes() -> Callable[[], None]:
    """Keep quiet what tensorstore's threads say when one of them has failed: each a traceback, about its closed event
    loop, or by asyncio because nobody waits for it any more. Returns what undoes it; a process that ends with such a
    failure leaves it, since some of them fail as late as that."""
    report, asyncio = sys.unraisablehook, logging.getLogger("asyncio")
    sys.unraisablehook = lambda failure: None if "loop is closed" in str(failure.exc_value) else report(failure)
    asyncio.addFilter(_is_awaited)

    def undo() -> None:
        sys.unraisablehook = report
        asyncio.removeFilter(_is_awaited)

    return undo


def _is_awaited(record: logging.LogRecord) -> bool:
    return "exception was never retrieved" not in record.getMessage()
