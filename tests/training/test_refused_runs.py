"""Runs whose files are not as their training left them are refused in one line, and left as they are."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.errors import said

from arm5dof.cli import main as cli
from arm5dof.sweeps.compare import compare
from arm5dof.training.config import load_config
from arm5dof.training.loop import resume, train
from arm5dof.training.run import Run

TINY = {
    **{"episodes": 4, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "targets": 20, "interim_targets": 20},
    **{"episode_length": 16, "epoch_steps": 8, "refinements": 0, "replay_capacity": 1024, "batch_size": 16},
    **{"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "heads": 2, "updates_per_step": 2},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(load_config("kinematic.toml", **TINY), tmp_path_factory.mktemp("runs") / "finished").folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """A copy of a finished run."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("harm", "expected"),
    [
        ("no folder", "checkpoints cannot be read (Not a directory): take them from a copy of the run"),
        ("no folders", "(16, 32) are damaged or none of ours: take them from a copy of the run, or remove them"),
        ("empty", "checkpoints/32 is damaged or not one of ours; remove it"),
    ],
)
def test_checkpoints_that_cannot_be_read_are_not_taken_for_none(folder: Path, harm: str, expected: str, capfd):
    """Going on without them would begin anew, and lose the curves."""
    place = folder / "checkpoints"
    for path in (place,) if harm == "no folder" else list(place.iterdir()):
        shutil.rmtree(path)
        path.mkdir() if harm == "empty" else path.write_text("")
    before = content(folder)
    for words in (["solve", folder, "--target", 0.1, 0, 0.2], ["eval", folder], ["train", "--resume", folder]):
        assert cli.main([str(word) for word in words]) == 2
        *_, line = capfd.readouterr().err.splitlines()
        assert line.startswith("arm5dof: ") and expected in line and "no checkpoint yet" not in line
        assert content(folder) == before
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    assert "has no checkpoint yet: resume it" in said(Run.open(folder).policy)


LONGER = ("--episodes", "8")


@pytest.mark.parametrize("damaged", ["checkpoints/32/training/manifest.ocdbt", "evaluations.json", "metrics.csv"])
def test_a_resume_that_is_refused_changes_nothing(folder: Path, damaged: str, capfd):
    """Nor does it keep the longer budget."""
    (folder / damaged).write_bytes(b"damaged\n1\n")
    before = content(folder)
    assert cli.main(["train", "--resume", str(folder), *LONGER]) == 2
    assert "damaged" in capfd.readouterr().err.splitlines()[-1]
    assert content(folder) == before


@pytest.mark.parametrize("limit", [100, 4096])
def test_a_resume_on_a_full_disk_changes_nothing(folder: Path, limit: int):
    """Past its file-size limit a process gets the errors of a full disk: of the configuration, or of checkpoints."""
    code = (
        "import resource, sys; from arm5dof.cli.main import main;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit})); sys.exit(main(sys.argv[1:]))"
    )
    before = content(folder)
    words = [sys.executable, "-c", code, "train", "--resume", folder, *LONGER]
    done = subprocess.run(
        words, capture_output=True, text=True, env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "0"}
    )
    assert done.returncode == 2 and "File too large" in done.stderr.splitlines()[-1], done.stderr
    assert content(folder) == before
    assert cli.main(["train", "--resume", str(folder), *LONGER]) in (0, 1)
    assert Run.open(folder).config.train.episodes == Run.open(folder).evaluations[-1]["episodes"] == 8


def test_what_is_extended_for_one_resume_is_kept_when_that_begins(folder: Path):
    run = Run.open(folder).extended(episodes=8)
    assert Run.open(folder).config.train.episodes == 4
    assert Run.open(resume(run).folder) == run


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another finished run of the same settings, all but the seed."""
    return train(load_config("kinematic.toml", seed=1, **TINY), tmp_path_factory.mktemp("runs") / "other").folder


def without_ids(folder: Path) -> None:
    """Make a run one of before there were ids."""
    record = json.loads((folder / "run.json").read_text())
    del record["run"]
    (folder / "run.json").write_text(json.dumps(record))
    evaluations = json.loads((folder / "evaluations.json").read_text())
    (folder / "evaluations.json").write_text(
        json.dumps([{**e, "run": None} for e in evaluations]).replace(', "run": null', "")
    )
    lines = (folder / "metrics.csv").read_text().splitlines()
    (folder / "metrics.csv").write_text("".join(line.rpartition(",")[0] + "\n" for line in lines))


@pytest.mark.parametrize("older", [set(), {"run"}, {"other"}])
@pytest.mark.parametrize("name", ["metrics.csv", "evaluations.json"])
def test_curves_of_another_run_are_refused(
    folder: Path, other: Path, tmp_path: Path, name: str, older: set[str], capfd
):
    """Also where either run is of before there were ids."""
    copied = Path(shutil.copytree(other, tmp_path / "other"))
    for place in (folder, copied):
        if place.name in older:
            without_ids(place)
    shutil.copy(copied / name, folder / name)
    before = content(folder)
    run = Run.open(folder)
    reads = (lambda: run.metrics) if name == "metrics.csv" else (lambda: run.evaluations)
    for call in (reads, lambda: compare(folder), lambda: resume(run)):
        assert f"{folder / name} is of another run: take it from a copy of the run, or remove it to go on" in said(call)
    for words in (["compare", folder], ["train", "--resume", folder, *LONGER]):
        assert cli.main([str(word) for word in words]) == 2
        assert f"{name} is of another run: " in capfd.readouterr().err.splitlines()[-1]
    assert content(folder) == before


def test_runs_of_before_there_were_ids_go_on_without(folder: Path):
    whole = Run.open(folder)
    metrics, evaluations = whole.metrics, whole.evaluations
    assert len(metrics["steps"]) == 4 and len(evaluations) == 2 and "run" not in metrics and "run" not in evaluations[0]
    without_ids(folder)
    run = Run.open(folder)
    assert run.metrics == metrics and run.evaluations == evaluations
    longer = resume(run.extended(episodes=6))
    assert longer.evaluations[:2] == evaluations and longer.evaluations[-1]["episodes"] == 6
    assert longer.metrics["steps"][:4] == metrics["steps"] and len(longer.metrics["steps"]) == 6


def test_checkpoints_that_one_may_not_read(folder: Path):
    (folder / "checkpoints").chmod(0)
    code = (
        "import os, sys; from pathlib import Path; from arm5dof.training.checkpoint_folder import names_in\n"
        "if os.geteuid() == 0: os.seteuid(65534)\n"  # Root may read all.
        "names_in(Path(sys.argv[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code, folder / "checkpoints"], capture_output=True, text=True)
    (folder / "checkpoints").chmod(0o755)
    assert "UserError" in done.stderr and "cannot be read (Permission denied): " in done.stderr
