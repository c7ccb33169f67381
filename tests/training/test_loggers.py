"""Curves arrive whole and once in TensorBoard and Weights & Biases, whatever became of the process before, and what
goes wrong there costs a warning and never the training."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from helpers.errors import said

from arm5dof.training import evaluate
from arm5dof.training.config import load_config
from arm5dof.training.loggers import Point, Values, logging, make_loggers
from arm5dof.training.loop import Silent, resume, train
from arm5dof.training.run import Run

TINY = {
    **{"episodes": 4, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "targets": 20, "interim_targets": 20},
    **{"episode_length": 16, "epoch_steps": 8, "refinements": 0, "replay_capacity": 1024, "batch_size": 16},
    **{"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "heads": 2, "updates_per_step": 2},
}


class Memory:
    """A logger that remembers, and fails in a method if asked to."""

    def __init__(self, fails: str = "") -> None:
        self.fails, self.points, self.closed = fails, list[Point](), 0

    def start(self, run: Run, history: Sequence[Point]) -> None:
        self.run, self.points = run, list(history)
        self._fail("start")

    def log(self, step: int, values: Values) -> None:
        self.points.append((step, values))
        self._fail("log")

    def close(self) -> None:
        self.closed += 1
        self._fail("close")

    def _fail(self, method: str) -> None:
        if self.fails == method:
            raise ConnectionError("no\nnetwork")


class Interrupted(Silent):
    """A reporter that interrupts the training in its third epoch: after the checkpoint, which is then behind."""

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        if done > 2:
            raise KeyboardInterrupt


@pytest.fixture(scope="module", autouse=True)
def one_chunk() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "CHUNK", 20)
        yield


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run that has not begun."""
    return Run.create(load_config("kinematic.toml", seed=7), tmp_path / "run")


def row(steps: int, reward: float) -> dict[str, Any]:
    """A row of metrics of two environments, as text where a CSV file would give it."""
    return {"steps": str(steps), "episodes": steps // 16, "env_steps": str(2 * steps), "reward": str(reward)}


def evaluation(steps: int, error: float) -> dict[str, Any]:
    measured = {"median_mm": error, "within": {"5": 90.0}}
    return {"steps": steps, "episodes": steps // 16, "env_steps": 2 * steps, "targets": 20, "one_shot": measured}


def curves(run: Run) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard reads in a run's folder, by TensorBoard's own reader."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(run.folder / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    return {tag: [(e.step, e.value) for e in found.Scalars(tag)] for tag in found.Tags()["scalars"]}


def sent(run: Run) -> list[dict[str, str]]:
    """The rows in a run's offline files of Weights & Biases, oldest first, their values as JSON."""
    import wandb
    from wandb.proto.wandb_internal_pb2 import Record

    wandb.teardown()  # Its own process writes the files.
    rows = []
    for path in sorted(run.folder.glob("wandb/offline-run-*/*.wandb")):
        data, at, parts = path.read_bytes(), 7, b""  # LevelDB's log format: blocks of 32 KiB, headers of 7 bytes.
        while at + 7 <= len(data):
            if 2**15 - at % 2**15 < 7:
                at += 2**15 - at % 2**15
                continue
            length, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
            parts, at = parts + data[at + 7 : at + 7 + length], at + 7 + length
            if kind in (1, 4):  # A whole record, or the last part of one.
                record, parts = Record.FromString(parts), b""
                if record.WhichOneof("record_type") == "history":
                    items = record.history.item
                    rows.append({item.key or "/".join(item.nested_key): item.value_json for item in items})
    return rows


def test_tensorboard_shows_a_resumed_run_whole_and_once(run: Run):
    with logging(run, make_loggers("tensorboard"), [], []) as log:
        for steps in (8, 16, 24):
            log.epoch(row(steps, steps))
        log.evaluation(evaluation(24, 3.0))
    (first,) = (run.folder / "tensorboard").iterdir()
    first.write_bytes(first.read_bytes()[:-5])  # As a kill would leave it.
    with logging(run, make_loggers("tensorboard"), [row(8, 8), row(16, 16)], []) as log:
        log.epoch(row(24, 24.5))
        log.evaluation(evaluation(24, 2.0))
        log.epoch(row(32, float("inf")))
    found = curves(run)
    assert found["train/reward"] == [(16, 8), (32, 16), (48, 24.5), (64, float("inf"))]
    assert found["train/episodes"] == [(16, 0), (32, 1), (48, 1), (64, 2)]
    assert found["evaluation/one_shot/median_mm"] == [(48, 2.0)]
    assert found["evaluation/one_shot/within/5"] == [(48, 90.0)]
    assert not any("steps" in name for name in found)
    assert len(list((run.folder / "tensorboard").iterdir())) == 1


def test_a_tensorboard_that_is_open_forgets_what_is_void(run: Run):
    with logging(run, make_loggers("tensorboard"), [], []) as log:
        for steps in (8, 16, 24):
            log.epoch(row(steps, steps))
    with logging(run, make_loggers("tensorboard"), [row(8, 8)], []) as log:
        log.epoch(row(16, 16.5))
        assert len(list((run.folder / "tensorboard").iterdir())) == 2
        assert curves(run)["train/reward"] == [(16, 8), (32, 16.5)]
    assert len(list((run.folder / "tensorboard").iterdir())) == 1


def test_what_tensorboard_had_outlives_a_failure_to_write_it_anew(run: Run, monkeypatch: pytest.MonkeyPatch):
    from tensorboard.summary.writer.record_writer import RecordWriter

    with logging(run, make_loggers("tensorboard"), [], []) as log:
        log.epoch(row(8, 8))

    def full(self: RecordWriter, data: bytes) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(RecordWriter, "write", full)
    with (
        pytest.warns(UserWarning, match="no longer logged by TensorBoard \\(No space left on device\\)"),
        logging(run, make_loggers("tensorboard"), [row(8, 8)], []) as log,
    ):
        log.epoch(row(16, 16))
    assert curves(run)["train/reward"] == [(8 * 2, 8)]


def test_tensorboard_knows_the_settings(run: Run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    with logging(run, make_loggers("tensorboard"), [], []):
        pass
    found = EventAccumulator(str(run.folder / "tensorboard")).Reload()
    content = found.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    settings = HParamsPluginData.FromString(content).session_start_info.hparams
    assert settings["train.seed"].number_value == 7 and settings["env.task"].string_value == "reach"
    assert settings.keys() == run.config.flat().keys()


def test_wandb_offline_gets_a_resumed_run_once(run: Run, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    with logging(run, make_loggers("wandb"), [], []) as log:
        for steps in (8, 16, 24):
            log.epoch(row(steps, steps))
    with logging(run, make_loggers("wandb"), [row(8, 8), row(16, 16)], []) as log:
        log.evaluation(evaluation(16, 5.0))
        log.epoch(row(24, 24))
        log.epoch(row(32, 32))
        log.evaluation(evaluation(32, 4.0))
    rows = sent(run)
    kinds = [("train" if "train/reward" in r else "evaluation", int(r["env_steps"])) for r in rows]
    assert kinds == [
        *(("train", steps) for steps in (16, 32, 48)),
        *(("evaluation", 32), ("train", 64), ("evaluation", 64)),
    ]
    assert [int(r["_step"]) for r in rows] == list(range(6)), "Weights & Biases drops steps that do not rise"
    assert float(rows[-1]["evaluation/one_shot/median_mm"]) == 4.0
    names = {path.stem for path in run.folder.glob("wandb/offline-run-*/*.wandb")}
    assert len(names) == 1, "one run, whose name the folder keeps"


def test_wandb_keeps_runs_of_one_process_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    settings = load_config("kinematic.toml")
    runs = [Run.create(settings, tmp_path / name) for name in ("a", "b")]
    with logging(runs[0], make_loggers("wandb"), [], []) as a, logging(runs[1], make_loggers("wandb"), [], []) as b:
        for steps in (8, 16):
            a.epoch(row(steps, steps))
            b.epoch(row(steps, -steps))
    assert [[float(r["train/reward"]) for r in sent(run)] for run in runs] == [[8, 16], [-8, -16]]


def test_wandb_without_an_account_is_refused(monkeypatch: pytest.MonkeyPatch):
    wandb = pytest.importorskip("wandb")

    def login() -> None:
        raise wandb.errors.UsageError("No API key configured.")

    monkeypatch.setattr(wandb, "login", login)
    monkeypatch.setenv("WANDB_MODE", "online")
    wandb.teardown()
    assert said(lambda: make_loggers("wandb")) == (
        "wandb cannot be used (No API key configured.): run wandb login, or set WANDB_MODE=offline"
    )
    wandb.teardown()


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_extra_is_one_line_before_anything_starts(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for module in [module for module in sys.modules if module.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, name, None)
    settings = load_config("kinematic.toml", **TINY)
    assert said(lambda: train(settings, "run", loggers=[name])).endswith(f"pip install 'arm5dof[{name}]'")
    assert not list(tmp_path.iterdir())


def test_loggers_by_name():
    own = Memory()
    assert [type(made).__name__ for made in make_loggers(["tensorboard", own, "tensorboard"])] == [
        "TensorBoard",
        "Memory",
    ]
    assert make_loggers([]) == []
    assert len(make_loggers("tensorboard, tensorboard")) == 1
    assert said(lambda: make_loggers("tensorbord")) == "no logger 'tensorbord': did you mean 'tensorboard'?"
    assert said(lambda: make_loggers("")) == "no logger '': valid are tensorboard, wandb"


def test_a_failure_costs_that_logger_and_a_warning(run: Run):
    for method, kept in (("start", 0), ("log", 1), ("close", 2)):
        bad, good = Memory(fails=method), Memory()
        expected = f"{run.folder} is no longer logged by Memory (no)"
        with pytest.warns(UserWarning, match=re.escape(expected)) as caught, logging(run, [bad, good], [], []) as log:
            log.epoch(row(8, 8))
            log.epoch(row(16, 16))
        assert len(caught) == 1 and len(bad.points) == kept and len(good.points) == 2
        assert bad.closed >= 1 and good.closed == 1


def test_a_training_logs_what_its_folder_keeps_and_loses_nothing_to_a_bad_logger(tmp_path: Path):
    settings, folder = load_config("kinematic.toml", **TINY), tmp_path / "run"
    memory, bad = Memory(), Memory(fails="log")
    with pytest.warns(UserWarning, match="no longer logged"), pytest.raises(KeyboardInterrupt):
        train(settings, folder, Interrupted(), loggers=[bad, memory, "tensorboard"])
    assert memory.run.config == settings and memory.closed == 1
    assert [step for step, _ in memory.points] == [16, 32, 32, 48], "an epoch beyond the checkpoint"
    again = Memory()
    run = resume(Run.open(folder), loggers=[again, "tensorboard"])
    assert [step for step, _ in again.points] == [16, 32, 32, 48, 64, 64]
    shown = curves(run)
    for name in ("reward", "critic_loss", "seconds", "updates"):
        metrics = run.metrics
        assert [step for step, _ in shown[f"train/{name}"]] == metrics["env_steps"]
        assert [value for _, value in shown[f"train/{name}"]] == pytest.approx(metrics[name])
    errors = [e["one_shot"]["median_mm"] for e in run.evaluations]
    assert shown["evaluation/one_shot/median_mm"] == [(32, pytest.approx(errors[0])), (64, pytest.approx(errors[1]))]
    late = Memory()
    resume(run, loggers=[late])
    assert late.points == again.points, "also of a run that has ended"
