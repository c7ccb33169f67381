"""A sweep on a Ray cluster of two nodes, one of which is killed in the middle."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from helpers.errors import said
from helpers.sweeps import environment, same, toy

from arm5dof import sweep

ray = pytest.importorskip("ray")

# In processes of their own: Ray is started once in a process, and must not be in that of the tests.
CODE = """
import sys
from arm5dof import sweep
asked = {"base": sys.argv[1], "axes": {"seed": {"count": 6}}}
sweep(asked, sys.argv[2], executor="ray", address=sys.argv[3], resume=True)
"""


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def start(*arguments):
    """A node with one CPU, that ends with its process."""
    command = [sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", *arguments]
    small = ["--num-cpus=1", "--object-store-memory=80000000", "--block", "--disable-usage-stats"]
    return subprocess.Popen(
        [*command, *small], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


@pytest.fixture
def nodes():
    port = free_port()
    head = start("--head", f"--port={port}", "--include-dashboard=false")
    started = [head]
    try:
        for _ in range(300):
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        started.append(start(f"--address=127.0.0.1:{port}"))
        yield f"127.0.0.1:{port}", started
    finally:
        for process in started:
            kill(process)


def kill(process):
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_killed_node_costs_nothing(nodes, tmp_path):
    address, (_, second) = nodes
    experiment, out = toy(tmp_path), tmp_path / "ray"
    driver = subprocess.Popen([sys.executable, "-c", CODE, str(experiment), str(out), address], env=environment())
    timer = threading.Timer(240, driver.kill)
    timer.start()
    while driver.poll() is None and len(list(out.glob("members/m*.json"))) < 2:
        time.sleep(0.1)
    assert driver.poll() is None
    kill(second)
    assert driver.wait() == 0
    timer.cancel()
    asked = {"base": str(experiment), "axes": {"seed": {"count": 6}}}
    found = sweep(asked, out, resume=True)
    alone = sweep(asked, tmp_path / "local", workers=1)
    assert same(found.table) == same(alone.table)


def test_a_cluster_that_cannot_be_reached_is_one_line(tmp_path):
    asked = {"base": str(toy(tmp_path)), "axes": {"seed": {"count": 2}}}
    nobody = f"127.0.0.1:{free_port()}"
    text = said(lambda: sweep(asked, tmp_path / "out", executor="ray", address=nobody))
    assert f"cannot reach a Ray cluster at {nobody}" in text
    assert not (tmp_path / "out").exists()
