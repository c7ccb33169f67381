"""`arm5dof sweep` and `compare`: what they do, and what they say of bad input."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers.sweeps import environment, toy

from arm5dof import Sweep, load_config, load_policy
from arm5dof.cli import main as cli
from arm5dof.sweeps import spec


def run(*arguments):
    return cli.main([str(a) for a in arguments])


@pytest.fixture
def fails(capsys):
    """Run a command that must fail; return its one line."""

    def check(*arguments):
        capsys.readouterr()
        assert run(*arguments) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("arm5dof: ")
        return lines[0]

    return check


def test_the_smoke_sweep_ends_in_two_minutes_with_everything(tmp_path, capsys):
    out, started = tmp_path / "smoke", time.monotonic()
    assert run("sweep", "sweep_smoke.toml", "--out", out) == 0
    assert time.monotonic() - started < 120
    found = Sweep.open(out)
    assert [(r["status"], r["episodes"]) for r in found.table] == [("done", 10), ("done", 20)] * 4
    for name in ("results.csv", "results.parquet", "summary.md", "learning.png", "axes.png"):
        assert (out / name).stat().st_size > 0
    assert load_config(out / "best.toml") == found.best.config
    target = [0.15, 0.05, 0.12]  # The file has its robot to six digits.
    answers = [p.solve(target, corrections=2) for p in (load_policy(out / "best.zip"), found.best.policy())]
    assert np.allclose(answers[0].q, answers[1].q, atol=1e-3)
    assert run("compare", out, out / "members" / "m0001", "--figure", tmp_path / "side.png") == 0
    printed = capsys.readouterr().out
    assert "actor_lr 0.005" in printed and "m0001" in printed and (tmp_path / "side.png").stat().st_size > 0


def test_help_teaches(capsys):
    for command, words in (
        ("sweep", ["log_uniform", "--resume", "sample_seed", "results.csv"]),
        ("compare", ["SWEEP"]),
    ):
        with pytest.raises(SystemExit) as ended:
            run(command, "--help")
        assert ended.value.code == 0
        shown = capsys.readouterr().out
        assert all(word in shown for word in words)


def test_bad_input_is_one_line(fails, tmp_path):
    out = Sweep.create(spec.read("sweep_smoke.toml"), tmp_path / "begun").folder
    toy(tmp_path)

    def sweep(axes, *options):
        (tmp_path / "s.toml").write_text(f'base = "toy.toml"\n[axes]\n{axes}\n')
        return fails("sweep", tmp_path / "s.toml", "--out", tmp_path / "out", *options)

    assert "unknown setting 'actor_rl': did you mean 'actor_lr'" in sweep("actor_rl = [1e-3]")
    assert "axis 'actor_lr' is empty" in sweep("actor_lr = []")
    assert "ddpg.noise is set twice" in sweep("noise = [0.1]\n'ddpg.noise' = [0.2]")
    assert "a smaller replay_capacity" in sweep("replay_capacity = [2147483647]")
    assert "exists: choose another --out, or add --resume" in fails("sweep", "sweep_smoke.toml", "--out", out)
    (tmp_path / "other.toml").write_text('base = "toy.toml"\n[axes]\nnoise = [0.1]\n')
    assert "of another sweep" in fails("sweep", tmp_path / "other.toml", "--out", out, "--resume")
    assert "name it with --out DIR" in fails("sweep", "sweep_smoke.toml", "--resume")
    assert "which sweep?" in fails("sweep")
    assert "add --executor ray" in sweep("noise = [0.1]", "--address", "here:1")
    assert "invalid choice: 'slurm'" in sweep("noise = [0.1]", "--executor", "slurm")
    assert "is neither a run nor a sweep" in fails("compare", tmp_path)
    assert "is a sweep, not an experiment" in fails("train", "sweep_smoke.toml")
    assert not (tmp_path / "out").exists()


def test_an_interrupted_sweep_says_how_to_go_on(tmp_path):
    toy(tmp_path)
    (tmp_path / "s.toml").write_text('base = "toy.toml"\n[axes]\nseed = { count = 50 }\n')
    command = [sys.executable, "-m", "arm5dof", "sweep", "s.toml", "--out", "out", "--workers", "1"]
    started = subprocess.Popen(command, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True)
    while not list(tmp_path.glob("out/members/m*.json")) and started.poll() is None:
        time.sleep(0.1)
    os.kill(started.pid, signal.SIGINT)
    _, said = started.communicate(timeout=60)
    assert started.returncode == 130
    last = said.splitlines()[-1]
    assert last == "arm5dof: interrupted; go on with arm5dof sweep s.toml --out out --resume"
