"""Traced programs on disk: found again for the same thing only, and never needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arm5dof.arm import Arm, load_arm
from arm5dof.ddpg import DDPG
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.runtime import programs, xla
from arm5dof.runtime.programs import Program
from arm5dof.training import policy_program
from arm5dof.training.config import Config, build
from arm5dof.training.evaluate import evaluate
from arm5dof.training.loop import make_trainer
from arm5dof.training.trainer import Trainer

SMALL = {
    "env": {"dynamics": "kinematic", "episode_length": 4},
    "ddpg": {"batch_size": 4, "updates_per_step": 2, "replay_capacity": 64, "heads": 2},
    "train": {"episodes": 8, "num_envs": 4, "epoch_steps": 2, "evaluate_every": 4, "checkpoint_every": 4},
}
X = jnp.linspace(0.1, 2, 8)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(xla, "_programs", tmp_path / "cache" / "traced")
    return tmp_path / "cache" / "traced"


def wave(x: jax.Array, scale: dict[str, float]) -> list[jax.Array]:
    return [jnp.sin(x * scale["by"]), jax.lax.fori_loop(0, 5, lambda _, y: jnp.cos(y), x)]


def forget() -> None:
    """What this process keeps: the next program is found as another process would find it."""
    programs._JITTED.clear()
    policy_program._compiled.cache_clear()


def unexpected(*_: object) -> None:
    raise AssertionError("traced again")


def program(*identity: object, function=wave, x: jax.Array = X) -> Program:
    forget()
    unexpected.__name__ = "wave"  # What a program is called is a part of what it is found by.
    return Program(function, (x, {"by": 2.0}), identity)


def test_a_kept_program_is_not_traced_again(folder: Path):
    first = program("arm").jit()(X, {"by": 3.0})
    again = program("arm", function=unexpected).jit()(X, {"by": 3.0})
    direct = jax.jit(wave)(X, {"by": 3.0})
    for values in (first, again):
        assert jax.tree.structure(values) == jax.tree.structure(direct)
        for left, right in zip(values, direct, strict=True):
            np.testing.assert_array_equal(left, right)
    assert [path.name.split("-")[0] for path in folder.iterdir()] == ["wave"]


def test_a_process_makes_a_program_once(folder: Path, monkeypatch: pytest.MonkeyPatch):
    first = program("arm").jit(donate_argnums=0)
    again = Program(unexpected, (X, {"by": 2.0}), ("arm",))
    assert again.jit(donate_argnums=0) is first
    monkeypatch.setattr(programs, "MOST_JITTED", 2)
    assert again.jit(donate_argnums=1) is not first
    again.jit()
    assert again.jit(donate_argnums=0) is not first


@pytest.mark.parametrize(
    "other",
    [
        lambda: program("another arm", function=unexpected),
        lambda: program("arm", function=unexpected, x=X[1:]),
        lambda: program("arm", function=unexpected, x=X.astype(jnp.int32)),
    ],
)
def test_nothing_else_finds_it(folder: Path, other):
    program("arm").jit()
    assert other().kept is None
    with pytest.raises(AssertionError, match="traced again"):
        other().jit()


def test_the_model_is_part_of_what_a_program_is_found_by(folder: Path, arm: Arm):
    program(arm.mj_model).jit()
    other = load_arm("reach.xml")
    assert program(other.mj_model).kept is not None
    other.mj_model.body_pos[1] += 1e-12
    assert program(other.mj_model).kept is None


def test_jaxs_configuration_is_part_of_what_a_program_is_found_by(folder: Path):
    program("arm").jit()
    before = jax.config.values["jax_default_matmul_precision"]
    try:
        jax.config.update("jax_default_matmul_precision", "bfloat16")
        assert program("arm").kept is None
    finally:
        jax.config.update("jax_default_matmul_precision", before)
    assert program("arm").kept is not None


@pytest.mark.parametrize("spoil", [lambda b: b[:-1], lambda b: b"", lambda b: b[:50] + bytes([b[50] ^ 1]) + b[51:]])
def test_a_spoilt_file_is_made_anew(folder: Path, spoil):
    program("arm").jit()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(spoil(whole))
    assert program("arm").kept is None
    program("arm").jit()
    assert program("arm", function=unexpected).jit()(X, {"by": 1.0})[0].shape == X.shape


def test_where_nothing_can_be_kept_all_works(folder: Path, monkeypatch: pytest.MonkeyPatch):
    folder.parent.write_text("a file where the folder should be")
    np.testing.assert_allclose(program("arm").jit()(X, {"by": 2.0})[0], np.sin(2 * np.asarray(X)), atol=1e-6)
    monkeypatch.setattr(xla, "_programs", None)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, program("arm").jit()(X, {"by": 2.0}), wave(X, {"by": 2.0})))


def test_a_program_that_jax_cannot_keep_runs(folder: Path):
    def wave(x: jax.Array, scale: dict[str, float]) -> jax.Array:
        return jax.pure_callback(lambda y: 2 * np.asarray(y), jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    np.testing.assert_array_equal(program(function=wave).jit()(X, {"by": 1.0}), 2 * X)
    assert not folder.exists()


def trained(trainer: Trainer) -> list[np.ndarray]:
    forget()
    trainer.start()
    for _ in range(3):
        trainer.advance()
    return [np.asarray(leaf) for leaf in jax.tree.leaves((trainer.state.networks, trainer.state.replay.rows))]


def settings(episodes: int = 8, **ddpg: float) -> Config:
    train = {**SMALL["train"], "episodes": episodes}
    return build({**SMALL, "train": train, "ddpg": {**SMALL["ddpg"], **ddpg}}, "test")


def test_training_has_the_same_bits_with_and_without(folder: Path, monkeypatch: pytest.MonkeyPatch):
    kept = trained(make_trainer(settings()))
    assert len(list(folder.glob("epoch-*"))) == 1
    monkeypatch.setattr(DDPG, "epoch", unexpected)
    again = trained(make_trainer(settings()))
    monkeypatch.undo()
    monkeypatch.setattr(xla, "_programs", None)
    without = trained(make_trainer(settings()))
    for a, b, c in zip(kept, again, without, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_answers_and_evaluations_have_the_same_bits_with_and_without(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def answers() -> list[np.ndarray]:
        forget()
        trainer = make_trainer(settings())
        trainer.state = trainer._init(trainer.config.ddpg, jax.random.key(0))
        policy = trainer.policy()
        found = policy.solve([[0.15, 0.05, 0.12]] * 3, corrections=1), policy.solve([0.15, 0.05, 0.12])
        return [np.asarray(x) for x in jax.tree.leaves((evaluate(policy, 10)["means"], found))]

    kept = answers()
    assert {path.name.split("-")[0] for path in folder.iterdir()} == {"measure", "solve"}
    monkeypatch.setattr(Reach, "question", unexpected)
    again = answers()
    monkeypatch.undo()
    monkeypatch.setattr(xla, "_programs", None)
    for a, b, c in zip(kept, again, answers(), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_numbers_share_a_program_and_sizes_do_not(folder: Path):
    """Step sizes, budgets and the like are inputs of the program, not parts of it."""
    first = trained(make_trainer(settings()))
    for changed in settings(actor_lr=1e-4), settings(episodes=16):
        other = trained(make_trainer(changed))
        assert len(list(folder.glob("epoch-*"))) == 1
        assert any((a != b).any() for a, b in zip(first, other, strict=True))
    trained(make_trainer(settings(heads=3)))
    assert len(list(folder.glob("epoch-*"))) == 2


def test_trainers_share_how_they_begin():
    """What they start from is traced once in a process, for whatever seed, numbers and budget."""
    begin = lambda **changed: make_trainer(settings(**changed))._init
    assert begin() is begin(actor_lr=1e-4) is begin(episodes=16)
    assert begin() is not begin(heads=3)
    config = settings()
    longer = replace(config, env=replace(config.env, episode_length=8))
    more = replace(config, train=replace(config.train, num_envs=2))
    assert len({begin(), make_trainer(longer)._init, make_trainer(more)._init}) == 3


def test_an_environment_of_others_is_not_kept(folder: Path, arm: Arm):
    """Its source is not ours, so nothing would say that it has changed."""

    class Mine(Reach):
        pass

    trained(Trainer(Mine(ReachConfig(dynamics="kinematic", episode_length=4), arm), settings()))
    assert not folder.exists()
