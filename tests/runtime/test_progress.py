"""A bar that people watch, and may interrupt."""

import contextlib
import os
import signal
import time

import pytest

from arm5dof.runtime.progress import Bar, late_bar


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)


def test_an_interrupt_that_is_lost_is_raised_again():
    with Bar("counting", 10, "things") as bar, late_bar("inside", 3, "things") as late:
        late(1, "")
        with contextlib.suppress(KeyboardInterrupt):  # As by a callback whose exceptions nobody sees.
            interrupt()
        with pytest.raises(KeyboardInterrupt):
            bar.update(1)


def test_an_interrupt_is_an_interrupt():
    with pytest.raises(KeyboardInterrupt), Bar("counting", 10, "things"):
        interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with Bar("counting", 10, "things") as bar:
        bar.update(1)
