"""Runs whose files are not as their training left them are refused in one line, and left as they are."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.errors import said

from arm5dof.cli import main as cli
from arm5dof.training.config import load_config
from arm5dof.training.loop import train
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
    for words in (["solve", folder, "--target=0.1", "0", "0.2"], ["eval", folder], ["train", "--resume", folder]):
        assert cli.main([str(word) for word in words]) == 2
        *_, line = capfd.readouterr().err.splitlines()
        assert line.startswith("arm5dof: ") and expected in line and "no checkpoint yet" not in line
        assert content(folder) == before
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    assert "has no checkpoint yet: resume it" in said(Run.open(folder).policy)


def test_checkpoints_that_one_may_not_read(folder: Path):
    (folder / "checkpoints").chmod(0)
    code = (
        "import os, sys; from pathlib import Path; from arm5dof.training.checkpoint import names_in\n"
        "if os.geteuid() == 0: os.seteuid(65534)\n"  # Root may read all.
        "names_in(Path(sys.argv[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code, folder / "checkpoints"], capture_output=True, text=True)
    (folder / "checkpoints").chmod(0o755)
    assert "UserError" in done.stderr and "cannot be read (Permission denied): " in done.stderr
