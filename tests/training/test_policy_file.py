"""A policy in one file answers as its run does; what is no such file is refused in one line, and never unpickled."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from helpers.errors import said
from hypothesis import given, settings
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.training.config import load_config
from arm5dof.training.policy_file import NETWORKS, ROBOT, SETTINGS, load_policy, save_policy
from arm5dof.training.run import Run

SMALL = {"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "heads": 2, "replay_capacity": 64}
POINTS, DOWN = [[0.15, 0.05, 0.12], [-0.1, 0.1, 0.2], [0.0, 0.2, 0.1]], [0.0, 0.0, -1.0]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run with the checkpoint of a policy that has learnt nothing."""
    config = load_config("reach_pose.toml", arm="arm5.xml", site="grasp", branches=2, restarts=1, **SMALL)
    created = Run.create(config, tmp_path_factory.mktemp("runs") / "small")
    trainer = created.trainer()
    created.checkpoints().save(trainer._init(config.ddpg, jax.random.key(0)))
    return created


@pytest.fixture(scope="module")
def saved(run: Run) -> Path:
    """Its policy's file."""
    save_policy(run, run.folder.parent / "policy.zip")
    return run.folder.parent / "policy.zip"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a file for `load_policy` is written again and again."""
    return tmp_path_factory.mktemp("scratch") / "policy.zip"


def with_member(saved: Path, path: Path, name: str, content: bytes | None) -> Path:
    """A policy's file with another content of a member, or none."""
    with zipfile.ZipFile(saved) as before, zipfile.ZipFile(path, "w") as after:
        for member in before.namelist():
            if member != name:
                after.writestr(member, before.read(member))
        if content is not None:
            after.writestr(name, content)
    return path


def test_it_answers_as_the_run_does_wherever_it_lies(run: Run, saved: Path, tmp_path: Path):
    directions = np.tile(DOWN, (3, 1))
    ours, theirs = load_policy(shutil.copy(saved, tmp_path / "renamed")), run.policy()
    np.testing.assert_allclose(ours.solve(POINTS, directions).q, theirs.solve(POINTS, directions).q, atol=1e-5)
    assert ours.env.config == theirs.env.config
    jax.tree.map(np.testing.assert_array_equal, load_policy(run.folder).networks, theirs.networks)


def test_the_same_policy_gives_the_same_bytes(run: Run, saved: Path, tmp_path: Path):
    save_policy(run, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == saved.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.zip"]
    with zipfile.ZipFile(saved) as archive:
        assert archive.namelist() == [SETTINGS, NETWORKS, ROBOT]
        with np.load(io.BytesIO(archive.read(NETWORKS)), allow_pickle=False) as arrays:
            assert all(arrays[name].dtype == np.float32 for name in arrays)


def test_what_cannot_be_saved_is_refused(run: Run, saved: Path, tmp_path: Path):
    before = saved.read_bytes()
    assert said(lambda: save_policy(run, saved)) == f"{saved} exists: choose another name"
    assert saved.read_bytes() == before
    bare = Run.open(shutil.copytree(run.folder, tmp_path / "bare"))
    (bare.folder / "model.zip").unlink()
    assert "keeps no MJCF of its robot" in said(lambda: save_policy(bare, tmp_path / "out.zip"))
    assert not (tmp_path / "out.zip").exists()


class Bomb:
    """Unpickled, it leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return shutil.rmtree, (self.path,)


def test_what_is_no_policy_is_refused(run: Run, saved: Path, tmp_path: Path):
    assert "no policy" in said(lambda: load_policy(tmp_path / "absent.zip"))
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in said(lambda: load_policy(tmp_path / "empty"))
    members = {name: zipfile.ZipFile(saved).read(name) for name in (SETTINGS, NETWORKS, ROBOT)}
    wider = members[SETTINGS].replace(b"actor_width = 16", b"actor_width = 32")
    arm7 = io.BytesIO()
    mujoco.MjSpec.from_file(str(Path(__file__).parents[2] / "mjcf/arm7_gripper.xml")).to_zip(arm7)
    (tmp_path / "precious").mkdir()
    pickled, single = io.BytesIO(), io.BytesIO()
    np.savez(pickled, networks=np.array([Bomb(tmp_path / "precious")], object))
    np.save(single, np.zeros(3))
    for name, content in [
        *((name, None) for name in members),
        *((name, b"") for name in members),
        *((name, members[name][: len(members[name]) // 2]) for name in (NETWORKS, ROBOT)),
        *((name, b"nonsense") for name in members),
        *((NETWORKS, found.getvalue()) for found in (pickled, single)),
        (SETTINGS, wider),
        (SETTINGS, members[SETTINGS].replace(b'"reach_pose"', b'"antigravity:Task"')),
        (SETTINGS, members[SETTINGS].replace(b'"grasp"', b'"moon"')),
        (ROBOT, members[NETWORKS]),
        (ROBOT, arm7.getvalue()),
    ]:
        path = with_member(saved, tmp_path / "bad.zip", name, content)
        assert str(path) in said(lambda path=path: load_policy(path)), (name, content and content[:40])
    assert (tmp_path / "precious").is_dir()


@settings(max_examples=100)
@given(st.data())
def test_damage_never_gives_anything_but_one_line(saved: Path, scratch: Path, data: st.DataObject):
    content = bytearray(saved.read_bytes())
    near_the_end = st.integers(len(content) - 250, len(content) - 1)  # The archive's directory.
    place = data.draw(st.one_of(near_the_end, st.integers(0, 60), st.integers(0, len(content) - 1)))
    if data.draw(st.booleans()):
        del content[place : place + data.draw(st.integers(1, len(content)))]
    else:
        content[place] ^= data.draw(st.integers(1, 255))
    scratch.write_bytes(content)
    try:
        load_policy(scratch)
    except UserError as error:
        assert "\n" not in str(error) and str(scratch) in str(error)
