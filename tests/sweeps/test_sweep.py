"""Real sweeps of a task that is learnt in a second: nothing lost, nothing twice, whatever is killed or diverges."""

from __future__ import annotations

import itertools
import random
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import psutil
import pytest
from helpers.errors import said
from helpers.sweeps import environment, same, toy

from arm5dof import Run, Sweep, compare, load_config, make_env, sweep
from arm5dof.sweeps import local, population, spec
from arm5dof.sweeps.groups import member_bytes
from arm5dof.sweeps.worker import Job, Worker, ended
from arm5dof.training import trainer
from arm5dof.training.loop import Silent, train

ABSURD = 1e30
"""A learning rate."""


class Told(Silent):
    """A reporter that remembers."""

    def __init__(self):
        self.lines, self.notes = [], []

    def say(self, line):
        self.lines.append(line)

    def update(self, done, note="", later=0.0):
        self.notes.append((done, note))


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return toy(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def asked(experiment):
    return {"base": str(experiment), "axes": {"actor_lr": [1e-3, 1e-2, ABSURD], "seed": {"count": 2}}}


@pytest.fixture(scope="module")
def told():
    return Told()


@pytest.fixture(scope="module")
def done(asked, told, tmp_path_factory):
    return sweep(asked, tmp_path_factory.mktemp("sweep") / "done", workers=2, reporter=told)


def test_a_table_has_every_member_and_evaluation(done):
    rows = done.table
    assert [(r["member"], r.get("episodes")) for r in rows] == [
        *((f"m{i:04}", episodes) for i in range(4) for episodes in (4, 8)),
        *((f"m{i:04}", None) for i in (4, 5)),
    ]
    assert [r["status"] for r in rows] == ["done"] * 8 + ["diverged"] * 2
    assert all("is nan by episode" in r["reason"] or "is inf by episode" in r["reason"] for r in rows[8:])
    last = rows[7]
    assert (last["ddpg.actor_lr"], last["train.seed"], last["jax"]) == (1e-2, 1, jax.__version__)
    assert last["headline"] == last["return.mean"] == pytest.approx(last["means.return"]) and last["seconds"] > 0
    assert (done.folder / "results.csv").read_text().count("\n") == 11
    assert (done.folder / "results.parquet").stat().st_size > 0


@pytest.mark.parametrize("name", ["m0001", "m0002"])
def test_a_member_is_the_run_that_train_would_make(done, name, tmp_path):
    run = done.runs[name]
    alone = train(run.config, tmp_path / "alone")
    assert alone.evaluations == run.evaluations
    mine, theirs = alone.metrics, run.metrics
    assert {k: v for k, v in mine.items() if k != "seconds"} == {k: v for k, v in theirs.items() if k != "seconds"}
    states = [jax.tree.leaves(each.policy().networks) for each in (alone, run)]
    assert all(np.array_equal(a, b) for a, b in zip(*states, strict=True))
    names = lambda folder: {path.name for path in folder.iterdir()}
    assert names(alone.folder) == names(run.folder)


def test_its_progress_is_told(done, told):
    assert told.lines[0].endswith("6 members, 1 program, 0 MB a member, 2 workers")
    assert sorted(line.split()[:2] for line in told.lines[1:3]) == [["m0004", "diverged:"], ["m0005", "diverged:"]]
    assert [count for count, _ in told.notes] == list(range(7))
    assert told.notes[-1][1].startswith("best return -") and "2 failed or diverged" in told.notes[-1][1]


def test_the_best_comes_first_and_can_be_trained_again(done):
    lines = done.summary()
    assert [line.lost for line in lines] == [0, 0, 2] and lines[0].headline.value >= lines[1].headline.value
    best = done.best
    assert best.folder.name == lines[0].best and load_config(done.folder / "best.toml") == best.config
    assert all((done.folder / name).stat().st_size > 0 for name in ("summary.md", "learning.png", "axes.png"))
    shown, html = repr(done), done._repr_html_()
    assert "return, higher is better" in shown and lines[0].best in html


def test_going_on_with_what_is_done_changes_nothing(done, asked):
    before = done.table
    again = sweep(asked, done.folder, resume=True)
    assert again.table == before == Sweep.open(done.folder).table


def test_what_cannot_be_done_is_said_before_anything_starts(done, asked, experiment, tmp_path):
    assert "exists: choose another folder, or resume" in said(lambda: sweep(asked, done.folder))
    other = {**asked, "axes": {"actor_lr": [1e-3]}}
    assert "holds the results of another sweep" in said(lambda: sweep(other, done.folder, resume=True))
    (tmp_path / "other").mkdir()
    assert "is no sweep" in said(lambda: sweep(asked, tmp_path / "other", resume=True))
    huge = {**asked, "fixed": {"replay_capacity": 2**31 - 1}}
    assert "choose fewer workers or a smaller replay_capacity" in said(lambda: sweep(huge, tmp_path / "huge"))
    odd = {**asked, "fixed": {"episodes": 7}}
    assert "is no multiple of num_envs" in said(lambda: sweep(odd, tmp_path / "odd"))
    assert not (tmp_path / "huge").exists() and not (tmp_path / "odd").exists()


def test_runs_and_sweeps_stand_side_by_side(done, tmp_path):
    found = compare(done.folder, done.folder / "members" / "m0000")
    assert [line[1] for line in found.table.rows] == ["2", "2", "1"]
    found.save(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 0
    assert "neither a run nor a sweep" in said(lambda: compare(tmp_path))
    assert "is named twice" in said(lambda: compare(done.folder, done.folder))
    assert "has no evaluation yet" in said(lambda: compare(done.folder / "members" / "m0004"))


def test_whatever_is_killed_the_table_is_the_same(done, asked, tmp_path):
    """A worker, and then the driver, at random moments."""
    out, moments, before = tmp_path / "killed", random.Random(), set(psutil.Process().children())
    code = f"from arm5dof import sweep; sweep({asked!r}, {str(out)!r}, workers=2)"
    driver = subprocess.Popen([sys.executable, "-c", code], env=environment())
    while driver.poll() is None and not list(out.glob("members/m0*")):
        time.sleep(0.02)
    time.sleep(moments.uniform(0, 2))
    psutil.Process(driver.pid).children()[0].kill()
    while driver.poll() is None and not list(out.glob("members/*.json")):
        time.sleep(0.02)
    time.sleep(moments.uniform(0, 0.5))
    driver.kill()
    assert driver.wait() == -signal.SIGKILL and len(list(out.glob("members/*.json"))) < 6
    again = sweep(asked, out, workers=2, resume=True)
    assert same(again.table) == same(done.table)
    assert set(psutil.Process().children()) <= before, "no worker is left"


def test_a_member_that_fails_costs_nobody_else_anything(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr(local, "ATTEMPTS", 2)
    monkeypatch.setattr("arm5dof.sweeps.sweep.ATTEMPTS", 2)
    axes = {"trouble": ["kill", "raise", ""]}
    found = sweep({"base": str(experiment), "axes": axes}, tmp_path / "trouble", workers=1).table
    last = {row["env.trouble"]: row for row in found}
    assert {name: (row["status"], row["reason"]) for name, row in last.items()} == {
        "kill": ("failed", "its worker died 2 times"),
        "raise": ("failed", "RuntimeError: no such luck"),
        "": ("done", ""),
    }


def test_a_search_tries_ends_early_and_goes_on(experiment, tmp_path):
    axes = {"actor_lr": {"log_uniform": [1e-5, 1e-2]}, "seed": {"count": 2}}
    asked = {"base": str(experiment), "axes": axes, "sample_seed": 0, "search": {"method": "tpe", "trials": 3}}
    first = sweep(asked, tmp_path / "search", workers=1)
    names = [member.name for member in first.members]
    assert names == [f"t{trial:04}-{seed}" for trial in range(3) for seed in range(2)]
    ends = {row["member"]: (row["status"], row["ddpg.actor_lr"]) for row in first.table}
    assert {status for status, _ in ends.values()} <= {"done", "pruned"} and ends["t0000-0"][0] == "done"
    more = sweep({**asked, "search": {**asked["search"], "trials": 4}}, first.folder, workers=1, resume=True)
    assert len(more.members) == 8
    assert {name: ends[name] for name in ends} == {
        row["member"]: (row["status"], row["ddpg.actor_lr"]) for row in more.table if row["member"] in ends
    }
    assert "another sweep" in said(lambda: sweep({**asked, "search": {"method": "random"}}, first.folder, resume=True))


def test_members_in_one_program_are_what_they_are_alone(done, asked, tmp_path, monkeypatch):
    """As on a GPU: within the reordering of sums; one of them diverges."""
    monkeypatch.setattr(population, "SAVE_EVERY_S", 0.0)
    members = [spec.parse(asked).members[i] for i in (0, 3, 4)]
    (tmp_path / "members").mkdir()
    job = Job.of(tmp_path / "members", members, together=True)
    Worker().work(Job.loads(job.dumps()))
    endings = {m.name: ended(tmp_path / "members", m.name).status for m in members}
    assert endings == {"m0000": "done", "m0003": "done", "m0004": "diverged"}
    for name in ("m0000", "m0003"):
        together, alone = Run.open(tmp_path / "members" / name), done.runs[name]
        for column, values in alone.metrics.items():
            if column != "seconds":
                assert together.metrics[column] == pytest.approx(values, rel=1e-5, abs=1e-5), column
        assert [e["steps"] for e in together.evaluations] == [e["steps"] for e in alone.evaluations]
        for mine, other in zip(together.evaluations, alone.evaluations, strict=True):
            assert mine["return"] == pytest.approx(other["return"], rel=1e-4)
        leaves = zip(*(jax.tree.leaves(r.policy().networks) for r in (together, alone)), strict=True)
        assert all(np.allclose(a, b, atol=1e-5) for a, b in leaves)
    # Killed between the checkpoints of two members they go on from where each is.
    for name, lost in (("m0000", True), ("m0003", False)):
        (tmp_path / "members" / f"{name}.json").unlink()
        if lost:
            newest = max((tmp_path / "members" / name / "checkpoints").glob("[0-9]*"), key=lambda path: int(path.name))
            newest.rename(tmp_path / "lost")
    before = [Run.open(tmp_path / "members" / name).evaluations for name in ("m0000", "m0003")]
    Worker().work(job)
    after = [Run.open(tmp_path / "members" / name).evaluations for name in ("m0000", "m0003")]
    assert [[e["steps"] for e in each] for each in after] == [[e["steps"] for e in each] for each in before]
    for mine, other in zip(itertools.chain(*after), itertools.chain(*before), strict=True):
        assert mine["return"] == pytest.approx(other["return"], rel=1e-4)


def test_memory_is_at_least_what_a_state_takes(experiment):
    config = load_config(experiment)
    made = trainer.Trainer(make_env(config), config)
    assert member_bytes(config) >= 2 * made.replay_bytes


def test_members_log_where_they_are_told_to(experiment, tmp_path):
    asked = {"base": str(experiment), "axes": {"seed": {"count": 1}}}
    assert said(lambda: sweep(asked, tmp_path / "none", loggers="tensorbord")).startswith("no logger 'tensorbord'")
    assert not (tmp_path / "none").exists()
    done = sweep(asked, tmp_path / "logged", workers=1, loggers="tensorboard")
    assert list((done.runs["m0000"].folder / "tensorboard").glob("events.out.tfevents.*"))
