"""`arm5dof vision train` and `eval`: bad command lines are one line, and a training in small leaves its folder."""

import pytest

from arm5dof.cli.main import main
from arm5dof.runtime import progress
from arm5dof.vision.detectors.tabletop.training import train as training


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["train", "--out", "."], "exists"),
        (["train", "--scenes", "0", "--out", "nowhere"], "scenes is 1 or more"),
        (["train", "--seed", "-1", "--out", "nowhere"], "seed is 0 or more"),
        (["train", "--epochs", "3"], "--epochs"),
        (["eval", "--scenes", "0"], "scenes is 1 or more"),
        (["eval", "--seed", "-1"], "seed is 0 or more"),
        (["eval", "--weights", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_bad_command_lines(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["vision", *arguments]) == 2
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == 1 and not printed.out
    assert not list(tmp_path.iterdir())


def test_each_stage_has_a_bar_of_its_own(tmp_path, monkeypatch, capsys):
    """Where stderr is no terminal it says how far each is, line by line."""

    def train(out, budget, progress):
        assert (budget.seed, budget.scenes, budget.refiner_steps) == (0, 7, 3)
        progress("rendering", 7, 7)
        progress("proposer", 0, 5500)
        progress("proposer", 5500, 5500, "loss 0.700")

    monkeypatch.setattr(training, "train", train)
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1)
    out = tmp_path / "detector"
    assert main(["vision", "train", "--scenes", "7", "--refiner-steps", "3", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"weights: {out / 'weights.npz'}\n"
    lines = printed.err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["rendering", "learning", "learning"]
    assert "7/7 scenes" in lines[0] and "proposer: 5500/5500 steps" in lines[2] and "loss 0.700" in lines[2]
