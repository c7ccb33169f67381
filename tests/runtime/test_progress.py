"""A bar that people watch, and may interrupt."""

import os
import signal
import time

import pytest

from arm5dof.errors import Terminated
from arm5dof.runtime import progress
from arm5dof.runtime.progress import Bar, late_bar


def test_what_is_done_but_for_the_rest_that_its_note_tells_has_no_eta(capsys: pytest.CaptureFixture, monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1.0)
    with Bar("training", 10, "episodes") as bar:
        bar.update(5)
        bar.update(10, "evaluating 3000/10000 targets, 70 s left")
    half, whole = capsys.readouterr().err.splitlines()
    assert " ETA " in half and "ETA" not in whole and whole.endswith("70 s left")


def test_a_request_to_end_is_obeyed_between_two_updates():
    before = signal.getsignal(signal.SIGTERM)
    with Bar("counting", 10, "things") as bar, late_bar("inside", 3, "things") as late:
        late(1, "")
        bar.update(1)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)
        with pytest.raises(Terminated):
            bar.update(2)
    assert signal.getsignal(signal.SIGTERM) is before
