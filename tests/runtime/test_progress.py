"""A bar that people watch, and may interrupt."""

import os
import signal
import time

import pytest

from arm5dof.errors import Terminated
from arm5dof.runtime import progress
from arm5dof.runtime.progress import Bar, late_bar


def test_the_eta_counts_what_is_to_come_besides(capsys: pytest.CaptureFixture, monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1.0)
    with Bar("training", 10, "episodes") as bar:
        for done, later in ((5, 0.0), (5, 3000.0), (10, 70.0), (10, 0.0)):
            bar.update(done, "evaluating", later)
    etas = [int(line.partition(" ETA ")[2].removesuffix(" s") or 0) for line in capsys.readouterr().err.splitlines()]
    assert 3000 <= etas[1] <= 3010 and etas[0] < 10 and etas[2:] == [70, 0]


def test_on_a_terminal_too(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # A terminal for rich, whatever stderr is.
    with Bar("training", 10, "episodes") as bar:
        for done, later, shown in ((0, 70.0, ""), (10, 70.0, "ETA 0:01:10"), (10, 0.0, "")):
            bar.update(done, "", later)
            assert progress._Remaining()(bar._progress.tasks[0]).plain == shown


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
