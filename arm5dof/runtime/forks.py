"""A process that is forked once JAX has started hangs in its first computation: its threads stay behind."""

from __future__ import annotations

import os
import sys

from arm5dof.errors import UserError

_started = _forked = False


def _before() -> None:
    global _started
    bridge = sys.modules.get("jax._src.xla_bridge")
    _started = bridge is not None and getattr(bridge, "backends_are_initialized", lambda: True)()


def _after() -> None:
    global _forked
    _forked = _started


os.register_at_fork(before=_before, after_in_child=_after)


def check() -> None:
    """Raise `UserError` in a process in which JAX would hang."""
    if _forked:
        raise UserError(
            "this process was forked after JAX had started, which would hang in it: start processes by spawn, as "
            'multiprocessing.get_context("spawn") and AsyncVectorEnv(..., context="spawn") do'
        )
