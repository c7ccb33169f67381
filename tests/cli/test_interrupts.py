"""Ctrl-C ends a command, whatever it is doing, with one line and status 130."""

import subprocess
import sys
from pathlib import Path

import pytest

KILL = "import os, signal, time\ndef kill():\n    os.kill(os.getpid(), signal.SIGINT)\n"
START = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # Jobs in a shell's background start without it.
from hit import kill
from arm5dof.__main__ import main
from arm5dof.cli import compare

def run(args, rest):
    {}

compare.run, sys.argv = run, ["arm5dof", "compare", "runs"]
main()
"""


@pytest.mark.parametrize(
    "body",
    [
        "import inside",
        "kill()",
        "kill()\n    time.sleep(20)",
        "try:\n        kill()\n    except KeyboardInterrupt:\n        pass\n    time.sleep(20)",
        "try:\n        kill()\n    except KeyboardInterrupt:\n        raise RuntimeError('of it') from None",
        "class A:\n        def __del__(self):\n            kill()\n    A()\n    time.sleep(20)",
        "try:\n        kill()\n    finally:\n        time.sleep(1)\n        print('saved')",
    ],
    ids=["import", "raised", "soon", "swallowed", "another error", "unraisable", "cleaning up"],
)
def test_an_interrupt_ends_a_command(body: str, tmp_path: Path):
    (tmp_path / "hit.py").write_text(KILL)
    (tmp_path / "inside.py").write_text(
        "from hit import kill\ntry:\n    kill()\nexcept BaseException:\n    raise ImportError"
    )
    (tmp_path / "start.py").write_text(START.format(body))
    done = subprocess.run([sys.executable, tmp_path / "start.py"], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (130, "arm5dof: interrupted\n")
    assert done.stdout == "saved\n" * body.endswith("print('saved')")
