"""A run's folder is all that it takes: to answer, to be measured and to go on, wherever it lies, whatever became of
what it was made from, and for no other settings than its own."""

from __future__ import annotations

import gzip
import itertools
import json
import re
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import orbax.checkpoint as ocp
import pytest
import tomli_w
from helpers.errors import said

from arm5dof.cli import main as cli
from arm5dof.ddpg import DDPGConfig
from arm5dof.envs.reach_pose import ReachPoseConfig
from arm5dof.errors import FolderGoneError
from arm5dof.runtime import files
from arm5dof.sweeps.compare import compare
from arm5dof.training import config, evaluate, loop, trainer
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import load_config
from arm5dof.training.loop import Silent, resume, train
from arm5dof.training.run import Run

TINY = {
    **{"episodes": 4, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "targets": 40, "interim_targets": 40},
    **{"episode_length": 16, "epoch_steps": 8, "refinements": 0, "replay_capacity": 1024, "batch_size": 16},
    **{"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "heads": 2, "updates_per_step": 2},
}
GOALS = [[0.15, 0.05, 0.12], [-0.1, 0.1, 0.2], [0.0, 0.2, 0.1]]
MESH = "\n".join(["v 0 0 0", "v 0.01 0 0", "v 0 0.01 0", "v 0 0 0.01", "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"])


@pytest.fixture(scope="module", autouse=True)
def one_chunk() -> Iterator[None]:
    """All evaluations here are one program, whatever the number of targets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "CHUNK", 20)
        yield


class Killed(BaseException):
    """Ends a training as a kill does: nothing is saved."""


class Told(Silent):
    """A reporter that remembers, and kills the training once so many episodes are done."""

    def __init__(self, until: float = np.inf) -> None:
        self.until, self.lines, self.later = until, list[str](), list[float]()

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        self.later.append(later)
        if done > self.until:
            raise Killed

    def say(self, line: str) -> None:
        self.lines.append(line)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with somebody's own arm: the shipped one with a longer forearm and a mesh, in three files."""
    folder = tmp_path_factory.mktemp("place") / "workshop"
    for made in (folder, folder.parent / "parts"):
        made.mkdir()
    arm, scene = (files.shipped_file("mjcf", name).read_text() for name in ("arm5.xml", "reach.xml"))
    assert 'pos="0.145 0 0.030"' in arm
    mesh = '<asset><mesh name="badge" file="badge.obj"/></asset><worldbody>'
    badge = '<geom type="mesh" mesh="badge" mass="0.01"/><site name="ee"'
    arm = arm.replace('pos="0.145 0 0.030"', 'pos="0.1612345678 0 0.030"').replace('<site name="ee"', badge)
    arm = arm.replace("<worldbody>", mesh).replace("<compiler ", '<compiler meshdir="../parts" ')
    (folder / "arm5.xml").write_text(arm)
    (folder / "reach.xml").write_text(scene)
    (folder.parent / "parts/badge.obj").write_text(MESH)
    return folder


@pytest.fixture(scope="module")
def runs(workshop: Path) -> dict[str, Path]:
    """A finished run, and the same one stopped half-way; then the arm's files are edited or gone, and the folder of
    runs is elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(workshop)
        settings = load_config("kinematic.toml", arm="./reach.xml", **TINY)
        train(settings, "runs/finished")
        with pytest.raises(Killed):
            train(settings, "runs/half", Told(until=2))
        expected = Run.open("runs/finished")
        np.save("runs/answers.npy", expected.policy().solve(GOALS, corrections=2).q)
        (workshop / "runs/eval.json").write_text(json.dumps(expected.evaluate(40, seed=1)))
        assert len(Run.open("runs/half").metrics["steps"]) < len(expected.metrics["steps"])
    (workshop / "runs").rename(workshop.parent / "moved")
    (workshop / "arm5.xml").write_text("<mujoco/>")
    for name in ("reach.xml", "../parts/badge.obj"):
        (workshop / name).unlink()
    return {name: workshop.parent / "moved" / name for name in ("finished", "half", "answers.npy", "eval.json")}


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: one where another arm has the file names of ours."""
    for name in ("reach.xml", "arm5.xml"):
        (tmp_path / name).write_text(files.shipped_file("mjcf", "arm7.xml").read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def copy(folder: Path, target: Path) -> Path:
    return Path(shutil.copytree(folder, target))


def final_state(run: Run) -> dict[str, np.ndarray]:
    """Every array of the last checkpoint."""
    kept = Checkpoints(run.folder / "checkpoints", config.fixed(run.config), read_only=True)
    leaves = jax.tree_util.tree_leaves_with_path(kept.restore(run.trainer().like))
    raw = lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(path): np.asarray(raw(leaf)) for path, leaf in leaves}


def test_a_run_answers_for_its_own_robot_anywhere(runs: dict[str, Path], elsewhere: Path):
    run = Run.open(runs["finished"])
    assert run.env.arm.reach > 0.28, "not the shipped arm, nor the one of seven joints"
    answer = run.policy().solve(GOALS, corrections=2)
    np.testing.assert_array_equal(answer.q, np.load(runs["answers.npy"]))
    assert json.loads(json.dumps(run.evaluate(40, seed=1))) == json.loads(runs["eval.json"].read_text())
    data = mujoco.MjData(run.env.arm.mj_model)
    for q, outcome in zip(answer.q, answer.outcome, strict=True):
        data.qpos[run.env.arm.qpos] = q
        mujoco.mj_kinematics(data.model, data)
        np.testing.assert_allclose(outcome, data.site("ee").xpos, atol=1e-6)


def test_half_a_run_goes_on_to_the_same_end_anywhere(runs: dict[str, Path], elsewhere: Path):
    told = Told()
    run = resume(Run.open(copy(runs["half"], elsewhere / "half")), told)
    assert any("resuming" in line and "episode 2" in line for line in told.lines)
    assert not any("changed" in line for line in told.lines)
    whole = Run.open(runs["finished"])
    found, expected = final_state(run), final_state(whole)
    assert found.keys() == expected.keys() and len(found) > 20
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)
    assert run.evaluations == whole.evaluations
    timeless = lambda run: {name: values for name, values in run.metrics.items() if name != "seconds"}
    assert timeless(run) == timeless(whole)


@pytest.mark.parametrize("name", ["sweep[lr=0.1]", "[/b]", r"back\slash", "what*?", "a b", "\u00e4\u65e5", "x" * 200])
def test_a_folder_may_have_any_name(runs: dict[str, Path], elsewhere: Path, name: str, capsys: pytest.CaptureFixture):
    """Orbax takes brackets for patterns, tensorstore a backslash for a separator, and rich [/b] for its markup."""
    folder, whole = copy(runs["half"], elsewhere / name), Run.open(runs["finished"])
    status = int(bool(whole.env.failure(whole.evaluations[-1])))  # 1 if so short a training reaches nothing.
    assert cli.main(["train", "--resume", str(folder)]) == status
    assert f"resuming {folder}" in capsys.readouterr().err
    found, expected = final_state(Run.open(folder)), final_state(whole)
    assert found.keys() == expected.keys()
    assert all(np.array_equal(found[leaf], value) for leaf, value in expected.items())


def test_a_checkpoint_that_cannot_be_read_back_does_not_count(runs: dict[str, Path], elsewhere: Path, monkeypatch):
    folder, write = copy(runs["half"], elsewhere / "half"), ocp.args.StandardSave
    before = final_state(Run.open(folder))
    other = lambda leaves: write({name: np.zeros_like(values) for name, values in leaves.items()})
    monkeypatch.setattr(ocp.args, "StandardSave", other)
    told = said(lambda: resume(Run.open(folder)))
    assert "the last complete one is kept" in told and "do not match their digest" in told
    after = final_state(Run.open(folder))
    assert all(np.array_equal(after[leaf], value) for leaf, value in before.items())


MAY_CHANGE = {
    *("train.episodes", "train.evaluate_every", "train.checkpoint_every"),
    *(
        "evaluate.targets",
        "evaluate.interim_targets",
        "env.branches",
        "env.correction",
        "env.restarts",
        "env.refinements",
    ),
}


def another(value: object, choices: list[str] | None) -> object:
    """Another valid value of a setting."""
    match value:
        case str():
            return next(choice for choice in choices or ["another"] if choice != value)
        case bool():
            return not value
        case int():
            return 2 * value or 1
        case _:
            return value / 2 or 0.5


def edit(folder: Path, **changes: object) -> Run:
    """Change settings in a run's config.toml, by full name."""
    path = folder / "config.toml"
    values = tomllib.loads(path.read_text())
    for name, value in changes.items():
        section, _, key = name.partition(".")
        assert values[section][key] != value
        values[section][key] = value
    path.write_text(tomli_w.dumps(values))
    return Run.open(folder)


def test_every_edited_setting_is_refused_by_name_or_may_change(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["half"], elsewhere / "edited")
    text = (folder / "config.toml").read_text()
    settings = Run.open(folder).config
    now, known = settings.flat(), [(f"{f.section}.{f.name}", f) for f in config.fields(settings)]
    assert {"env.task", *(name for name, _ in known)} == now.keys() > MAY_CHANGE
    for name, f in known:
        value = another(now[name], f.choices)
        (folder / "config.toml").write_text(text)
        run = edit(folder, **{name: value})
        if name in MAY_CHANGE:
            run.checkpoints(read_only=True).check()
            continue
        for call in (run.policy, lambda run=run: resume(run), lambda run=run: run.evaluate(1)):
            assert f"({name} = {now[name]!r}, now {value!r})" in said(call), name


def forget(folder: Path, name: str, record: bool) -> Run:
    """Make a run one of a version that did not have a setting yet, or let its config.toml alone lack it."""
    path, (section, _, key) = folder / "config.toml", name.partition(".")
    values = tomllib.loads(path.read_text())
    del values[section][key]
    path.write_text(tomli_w.dumps(values))
    for path in folder.glob("checkpoints/*/record/metadata") if record else ():
        kept = json.loads(path.read_text())
        del kept["settings"][name]
        path.write_text(json.dumps(kept))
    return Run.open(folder)


def test_runs_of_a_version_without_a_setting_answer_and_go_on(runs: dict[str, Path], elsewhere: Path):
    run = forget(copy(runs["half"], elsewhere / "half"), "ddpg.actor_products", record=True)
    assert run.left_open == {"ddpg.actor_products"} and not run.config.ddpg.actor_products
    assert resume(run).evaluations == Run.open(runs["finished"]).evaluations
    np.testing.assert_array_equal(run.policy().solve(GOALS, corrections=2).q, np.load(runs["answers.npy"]))
    other = forget(copy(runs["half"], elsewhere / "other"), "ddpg.heads", record=True)
    assert "does not fit the run's config.toml" in said(other.policy), "networks show how many heads they have"


def test_a_setting_that_only_one_of_configuration_and_checkpoint_has_is_compared(
    runs: dict[str, Path], elsewhere: Path
):
    name = "ddpg.random_action_prob"
    run = forget(copy(runs["finished"], elsewhere / "lost"), name, record=False)
    assert f"({name} = 1.0, now {run.config.ddpg.random_action_prob!r})" in said(run.policy)
    folder = forget(copy(runs["finished"], elsewhere / "added"), name, record=True).folder
    text = (folder / "config.toml").read_text()
    (folder / "config.toml").write_text(text.replace("[ddpg]\n", "[ddpg]\nrandom_action_prob = 0.5\n"))
    assert f"({name} = None, now 0.5)" in said(Run.open(folder).policy)


def test_a_setting_of_which_an_older_version_did_not_know_that_it_may_change(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["half"], elsewhere / "half")
    for path in folder.glob("checkpoints/*/record/metadata"):
        kept = json.loads(path.read_text())
        kept["settings"]["env.branches"] = kept["budget"].pop("env.branches")
        path.write_text(json.dumps(kept))
    assert Run.open(folder).policy().solve(GOALS).q.shape == (3, 5)
    assert edit(folder, **{"env.branches": 2}).checkpoints(read_only=True).check() == {"env.branches": (1, 2)}


def test_a_run_does_not_change_with_the_tasks_toml(tmp_path: Path):
    """What a run's config.toml lacks is as the classes have it, whatever the TOML file says today."""
    shipped = load_config("reach_pose.toml")
    run = Run.create(shipped, tmp_path / "run")
    assert Run.open(run.folder).config == shipped and not Run.open(run.folder).left_open
    (run.folder / "config.toml").write_text('[env]\ntask = "reach_pose"\n')
    opened = Run.open(run.folder).config
    assert (opened.env, opened.ddpg) == (ReachPoseConfig(), DDPGConfig())
    assert opened.env.branches != shipped.env.branches and opened.ddpg.heads != shipped.ddpg.heads


def test_budget_and_intervals_may_change_and_are_named(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["half"], elsewhere / "longer")
    budget = {"train.episodes": 8, "train.evaluate_every": 4, "train.checkpoint_every": 4}
    run = edit(folder, **budget, **{"evaluate.targets": 50, "evaluate.interim_targets": 30})
    assert run.policy().solve(GOALS).q.shape == (3, 5)
    told = Told()
    resume(run, told)
    (line,) = [line for line in told.lines if "changed" in line]
    assert line == (
        "changed since the last checkpoint: train.episodes 4 -> 8, train.evaluate_every 2 -> 4, "
        "train.checkpoint_every 2 -> 4, evaluate.targets 40 -> 50, evaluate.interim_targets 40 -> 30"
    )
    assert [(e["episodes"], e["targets"]) for e in run.evaluations] == [(2, 40), (4, 30), (8, 50)]
    assert run.metrics["steps"][-1] == 64
    again = Told()
    resume(Run.open(folder), again)
    assert not any("changed" in line for line in again.lines), "the checkpoint was made with these"


def test_a_run_that_did_all_there_is_left_to_do_ends(runs: dict[str, Path], elsewhere: Path):
    run = resume(edit(copy(runs["finished"], elsewhere / "shorter"), **{"train.episodes": 2}))
    assert run.evaluations == Run.open(runs["finished"]).evaluations


TWENTY = {**TINY, "episodes": 20, "num_envs": 10, "evaluate_every": 10, "checkpoint_every": 10, "targets": 20}


@pytest.fixture(scope="module")
def twenty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 20 episodes, 32 steps of ten environments."""
    settings = load_config("kinematic.toml", noise=0.5, final_noise=0.1, **{**TWENTY, "interim_targets": 20})
    return train(settings, tmp_path_factory.mktemp("runs") / "twenty").folder


def test_a_longer_budget_goes_on_and_stretches_the_schedules(twenty: Path, tmp_path: Path):
    run = Run.open(copy(twenty, tmp_path / "run"))
    before, evaluations, state = run.metrics, run.evaluations, final_state(run)
    longer, told = run.extend(episodes="40"), Told()
    assert Run.open(run.folder) == longer and longer.config == config.override(run.config, {"episodes": 40})
    kept = final_state(longer)
    assert all((kept[name] == value).all() for name, value in state.items()), "nothing is trained yet"

    by_hand = longer.trainer()
    by_hand.state = longer.checkpoints(read_only=True).restore(by_hand.like)
    while not by_hand.finished:
        by_hand.advance()
    resume(longer, told)
    assert any("resuming" in line and line.endswith("at episode 20") for line in told.lines)
    assert any(line.endswith("train.episodes 20 -> 40") for line in told.lines)
    # Nobody knows how long evaluations take before the first; then the last is counted, until it is done.
    assert told.later[0] == 0 < told.later[-2] and told.later[-1] == 0
    assert sum(later > 0 for later in told.later) >= 3
    for found, expected in zip(
        jax.tree.leaves(longer.policy().networks), jax.tree.leaves(by_hand.state.networks), strict=True
    ):
        np.testing.assert_array_equal(found, expected)

    steps = np.array(longer.metrics["steps"])
    np.testing.assert_array_equal(steps, np.arange(8, 65, 8))
    assert all(values[:4] == before[name] for name, values in longer.metrics.items()), "what was, stays"
    assert [e["episodes"] for e in longer.evaluations] == [10, 20, 30, 40] and longer.evaluations[:2] == evaluations
    done = (steps - 4.5) / np.where(steps <= 32, 32, 64)  # Means over an epoch of the share of all steps done before.
    np.testing.assert_allclose(longer.metrics["noise"], 0.5 - 0.4 * done, rtol=1e-5)
    assert by_hand.agent.total_steps == 64, "of which step sizes are the same function: see test_ddpg.py"


def test_the_same_budget_is_no_change(twenty: Path, tmp_path: Path):
    folder = copy(twenty, tmp_path / "run")
    rows = (folder / "metrics.csv").read_bytes()
    text = (folder / "config.toml").read_text()
    run = resume(Run.open(folder).extend(episodes=20, seed=0))
    assert (folder / "metrics.csv").read_bytes() == rows and (folder / "config.toml").read_text() == text
    assert run.evaluations == Run.open(twenty).evaluations


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"episodes": 10}, "has trained 20 episodes, more than 10: give 20 or more, or train a new run"),
        ({"episodes": 45}, "episodes = 45 is no multiple of num_envs = 10"),
        ({"episodes": "many"}, "train.episodes = 'many': input should be a valid integer"),
        ({"episodes": 40, "targets": 0}, "evaluate.targets = 0"),
        ({"episode": 40}, "unknown setting 'episode': did you mean 'episodes'?"),
        (
            {"seed": 3, "episodes": 40, "ddpg.batch_size": 8},
            "was made with ddpg.batch_size = 16, train.seed = 0: leave out ddpg.batch_size, train.seed; what may "
            "change is env.correction, env.branches, env.restarts, env.refinements, train.episodes, "
            "train.evaluate_every, train.checkpoint_every, evaluate.targets, evaluate.interim_targets",
        ),
    ],
)
def test_what_a_run_cannot_become_is_refused(twenty: Path, changes: dict, expected: str):
    before = (twenty / "config.toml").read_bytes()
    assert expected in said(lambda: Run.open(twenty).extend(**changes))
    assert (twenty / "config.toml").read_bytes() == before
    assert not list(twenty.glob(".config*"))


def test_a_run_in_training_or_with_a_damaged_checkpoint_is_not_extended(twenty: Path, tmp_path: Path):
    folder = copy(twenty, tmp_path / "run")
    before = (folder / "config.toml").read_bytes()
    with Run.open(folder).locked():
        assert "is being trained by another process" in said(lambda: Run.open(folder).extend(episodes=40))
    for path in folder.glob("checkpoints/*/record/metadata"):
        path.write_text("garbage")
    assert "damaged" in said(lambda: Run.open(folder).extend(episodes=40))
    assert (folder / "config.toml").read_bytes() == before


def test_what_an_extended_run_leaves_open_stays_open(twenty: Path, tmp_path: Path):
    run = forget(copy(twenty, tmp_path / "run"), "ddpg.actor_products", record=True)
    run = forget(run.folder, "evaluate.targets", record=False)
    assert run.left_open == {"ddpg.actor_products", "evaluate.targets"}
    longer = run.extend(targets=30, evaluate_every=20)
    assert Run.open(run.folder) == longer and longer.left_open == {"ddpg.actor_products"}
    assert longer.policy().solve(GOALS).q.shape == (3, 5)


@pytest.mark.parametrize("harm", ["missing", "garbage", "truncated", "another"])
def test_a_damaged_robot_is_refused(runs: dict[str, Path], elsewhere: Path, harm: str):
    folder = copy(runs["finished"], elsewhere / "run")
    path = folder / "model.mjb.gz"
    match harm:
        case "missing":
            path.unlink()
        case "garbage":
            path.write_bytes(b"garbage")
        case "truncated":
            path.write_bytes(path.read_bytes()[:-100])
        case "another":
            path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes())[:-8] + bytes(8)))
    for call in (Run.open(folder).policy, lambda: resume(Run.open(folder)), lambda: Run.open(folder).env):
        assert "model.mjb.gz, the run's robot, is missing or damaged: take it from a copy of the run" in said(call)


@pytest.mark.parametrize(
    "text", ["", "garbage", "[]", "3", "{}", '{"model": {}}', '{"versions": {}, "model": {}}', "\x00\xff", "[" * 10_000]
)
@pytest.mark.parametrize("name", ["run.json", "evaluations.json"])
def test_damaged_records_are_refused(runs: dict[str, Path], elsewhere: Path, name: str, text: str):
    folder = copy(runs["finished"], elsewhere / "run")
    (folder / name).write_bytes(text.encode("latin-1"))
    calls = {"run.json": lambda: Run.open(folder).policy(), "evaluations.json": lambda: Run.open(folder).evaluations}
    if name == "evaluations.json" and text == "[]":
        assert Run.open(folder).evaluations == []
        return
    for call in (calls[name], lambda: resume(Run.open(folder))):
        assert re.search(rf"{name} is damaged \(.+\): take it from a copy of the run", said(call))


@pytest.mark.parametrize("name", ["steps", "targets", "one_shot", "means"])
@pytest.mark.parametrize("value", ["gone", None, "x", -1, {}])
def test_evaluations_that_are_none_are_refused(runs: dict[str, Path], elsewhere: Path, name: str, value: object):
    """Whatever is read of them later is read at once."""
    folder = copy(runs["finished"], elsewhere / "run")
    kept = json.loads((folder / "evaluations.json").read_text())
    kept[-1][name] = value
    if value == "gone":
        del kept[-1][name]
    (folder / "evaluations.json").write_text(json.dumps(kept))
    calls = [lambda: resume(Run.open(folder))]
    if (name, value) not in (("one_shot", "gone"), ("means", {})):  # Which this task alone asks for.
        calls.append(lambda: compare(folder))
    for call in calls:
        assert re.search(r"evaluations.json is damaged \(.+\): .*, or remove it to go on", said(call))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\n8,", "\neight,"),
        ("steps,", "step,"),
        ("reward", "price"),
        ("\n8,", "\n9,8,"),
        ("\n8,", "\n80,"),
        ("s", "\x00"),
    ],
)
def test_damaged_metrics_are_refused(runs: dict[str, Path], elsewhere: Path, old: str, new: str):
    folder = copy(runs["finished"], elsewhere / "run")
    text = (folder / "metrics.csv").read_text()
    (folder / "metrics.csv").write_text(text.replace(old, new, 1))
    for call in (lambda: Run.open(folder).metrics, lambda: resume(Run.open(folder)), lambda: compare(folder)):
        assert "metrics.csv is damaged" in said(call)


def test_a_row_that_is_being_written_does_not_count(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["finished"], elsewhere / "run")
    text = (folder / "metrics.csv").read_bytes()
    (folder / "metrics.csv").write_bytes(text[:-3])  # Its last number would be another.
    assert Run.open(folder).metrics["steps"] == Run.open(runs["finished"]).metrics["steps"][:-1]


class Removes(Told):
    """A reporter that removes the folder, or puts a copy of it in its place, after the first epoch."""

    def __init__(self, folder: Path, copied: bool) -> None:
        super().__init__()
        self.folder, self.copied = folder, copied

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        if done and self.folder.exists():
            if self.copied:
                copy(self.folder, self.folder.parent / "copy")
            shutil.rmtree(self.folder)
            if self.copied:
                (self.folder.parent / "copy").rename(self.folder)


@pytest.mark.parametrize("copied", [False, True])
def test_a_folder_that_goes_away_ends_its_training(runs: dict[str, Path], elsewhere: Path, copied: bool):
    folder = copy(runs["half"], elsewhere / "run")
    with pytest.raises(FolderGoneError, match="was moved or removed while it was trained"):
        resume(Run.open(folder), Removes(folder, copied))
    assert folder.exists() == copied
    if copied:
        assert resume(Run.open(folder)).evaluations == Run.open(runs["finished"]).evaluations


def test_what_is_lost_of_the_curves_is_said_and_measured_anew(runs: dict[str, Path], elsewhere: Path):
    folder, told, whole = copy(runs["finished"], elsewhere / "run"), Told(), Run.open(runs["finished"])
    (folder / "metrics.csv").unlink()
    assert compare(folder).table.rows[0][2:5] == ["4", "50", "-"]
    (folder / "evaluations.json").unlink()
    run = resume(Run.open(folder), told)
    assert any("metrics.csv lacks what was trained before episode 4" in line for line in told.lines)
    assert run.evaluations == whole.evaluations[-1:] and "an unknown time" in (folder / "report.md").read_text()


@pytest.mark.parametrize("gone", [False, True])
def test_a_run_that_names_no_robot_does_not_fall_back_to_the_arms_own_file(
    runs: dict[str, Path], elsewhere: Path, gone: bool
):
    """`elsewhere` has another arm in a file of the name that the run's settings give."""
    folder = copy(runs["finished"], elsewhere / "run")
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "model": {}}))
    if gone:
        for name in record["model"]:
            (folder / name).unlink()
    for call in (Run.open(folder).policy, lambda: resume(Run.open(folder)), lambda: Run.open(folder).env):
        assert said(call).endswith("run.json is damaged (it names no robot): take it from a copy of the run")


def test_a_record_without_the_compiled_robot_is_refused(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["finished"], elsewhere / "run")
    record = json.loads((folder / "run.json").read_text())
    del record["model"]["model.mjb.gz"]
    (folder / "run.json").write_text(json.dumps(record))
    assert "model.mjb.gz, the run's robot, is missing or damaged" in said(Run.open(folder).policy)


def of_another_version(folder: Path) -> dict:
    """What a run says that was made with another MuJoCo."""
    record = json.loads((folder / "run.json").read_text())
    return {**record, "versions": {**record["versions"], "mujoco": "3.0.0"}}


def test_another_mujoco_compiles_the_robot_anew(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["finished"], elsewhere / "run")
    (folder / "run.json").write_text(json.dumps(of_another_version(folder)))
    (folder / "model.mjb.gz").write_bytes(b"which another version cannot read")
    with pytest.warns(UserWarning, match=r"made with MuJoCo 3\.0\.0: its robot is compiled anew"):
        policy = Run.open(folder).policy()
    exact = Run.open(runs["finished"]).policy()
    goals = exact.env.arm.forward(exact.env.arm.sample(jax.random.key(0), (200,)))
    found, expected = policy.solve(goals, corrections=1), exact.solve(goals, corrections=1)
    assert policy.env.arm.mj_model.nmesh == 1
    np.testing.assert_allclose(found.outcome, expected.outcome, atol=1e-4)
    np.testing.assert_allclose(found.errors["distance"], expected.errors["distance"], atol=1e-4)


def test_another_mujoco_needs_the_robots_mjcf(runs: dict[str, Path], elsewhere: Path):
    folder = copy(runs["finished"], elsewhere / "run")
    record = of_another_version(folder)
    del record["model"]["model.zip"]
    (folder / "run.json").write_text(json.dumps(record))
    assert "keeps its robot as MuJoCo 3.0.0 has it: install that version" in said(Run.open(folder).policy)


def test_a_program_beyond_the_memory_is_refused_before_it_runs(twenty: Path, monkeypatch: pytest.MonkeyPatch):
    made = Run.open(twenty).trainer()
    monkeypatch.setattr(trainer, "memory_free", lambda: 1000)
    for call in (made.check, made.start, made.advance):
        assert re.search(r"takes 0.0 GB.* and 0.0 GB are free: choose a smaller", said(call))


def test_an_evaluation_says_how_long_it_takes_still(twenty: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """20 targets a chunk, of which the second and third take a second each."""
    folder, notes, clock = copy(twenty, tmp_path / "run"), list[tuple[str, float]](), itertools.count(100.0)
    (folder / "evaluations.json").unlink()
    told = Told()
    told.update = lambda done, note="", later=0.0: notes.append((note, later))
    monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    resume(edit(folder, **{"evaluate.targets": 80}), told)
    seconds = zip((0, 20, 40, 60, 80), (0, 3, 2, 1, 0), strict=True)
    assert notes[-5:] == [(f"evaluating {done}/80 targets", pytest.approx(later)) for done, later in seconds]
