"""Ctrl-C ends a command whatever it is doing, with one line.

Python raises `KeyboardInterrupt` wherever it happens to be: where something is imported, which makes other errors of it
or crashes, and where exceptions are swallowed, as in callbacks of the garbage collector, of which JAX has one.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # What is imported here takes time in which nobody listens.
    from types import FrameType
    from typing import Any, NoReturn

AGAIN_S = 0.5
"""So long after an interrupt it is raised anew, unless it is being handled."""

_heard = False


def listen() -> None:
    """Hear interrupts from now on, if nobody does or wants none. Call it before what takes long to import."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    signal.signal(signal.SIGALRM, _once_more)
    signal.signal(signal.SIGINT, _interrupt)
    report = sys.unraisablehook

    def unless_interrupted(failure: Any) -> None:
        if not isinstance(failure.exc_value, KeyboardInterrupt):
            report(failure)

    sys.unraisablehook = unless_interrupted


def handled() -> None:
    """The interrupt has come to where the command ends."""
    signal.setitimer(signal.ITIMER_REAL, 0)


def leave(status: int) -> NoReturn:
    """End the process. After an interrupt at once, for threads that compile would be waited for."""
    handled()
    if status not in (130, 143):
        sys.exit(status)
    import contextlib

    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # Closed.
            stream.flush()
    os._exit(status)


def heard() -> bool:
    """Whether there was an interrupt, of which other errors may have come."""
    return _heard


def end() -> NoReturn:
    """End the process as one that was interrupted."""
    cursor = b"\x1b[?25h" if os.isatty(2) else b""  # Which a progress bar hides.
    os.write(2, cursor + b"arm5dof: interrupted\n")
    os._exit(130)


def _interrupt(_: int, frame: FrameType | None) -> None:
    global _heard
    _heard = True
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            end()
        frame = frame.f_back
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
    raise KeyboardInterrupt


def _once_more(number: int, frame: FrameType | None) -> None:
    if not isinstance(sys.exc_info()[1], KeyboardInterrupt):
        _interrupt(number, frame)
