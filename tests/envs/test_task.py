"""A task of one's own: what it inherits, and that one file and one TOML outside the package are all it takes."""

import ast
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from helpers.errors import said

from arm5dof.envs import State, Task, VectorEnv
from arm5dof.envs.base import episode_returns
from arm5dof.settings import settings, static
from arm5dof.training import evaluate
from arm5dof.training.config import load_config, make_env
from arm5dof.training.loop import train
from arm5dof.training.run import Run
from arm5dof.training.trainer import Trainer

ROOT = Path(__file__).parents[2]
OWN_TASK = ROOT / "experiments" / "own_task"
TINY = (
    "--episodes 10 --batch-size 16 --updates-per-step 1 --actor-width 16 --actor-depth 1 --critic-width 8 "
    "--replay-capacity 4096 --targets 50 --interim-targets 50"
)


@settings
class CountdownConfig:
    """Settings of `Countdown`."""

    episode_length: int = static(default=6)
    """Steps after which an episode is cut off."""


class Countdown(Task):
    """Starts from a whole number and counts down by one; the reward is ten times the number plus the action, and the
    episode ends for good at 0."""

    Config: ClassVar[type] = CountdownConfig
    action_size = 1

    def reset(self, key: jax.Array) -> State:
        return self._state(jax.random.randint(key, (), 1, 10).astype(float), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.data - 1, 10 * state.data + action[0])

    def _state(self, number: jax.Array, reward: jax.Array) -> State:
        seen = number[None]
        obs = {"state": seen, "privileged_state": seen}
        return State(number, obs, reward, (number <= 0).astype(float), {}, {})


def act(obs: dict[str, jax.Array], branch: jax.Array | None = None) -> jax.Array:
    """A hundredth of what is seen."""
    return obs["state"] / 100


def test_returns_are_those_of_a_loop_that_stops_at_the_end():
    env, key, n = Countdown(CountdownConfig()), jax.random.key(3), 40
    expected, lengths = [], []
    for one in jax.random.split(key, n):
        number, total, steps = int(env.reset(one).data), 0.0, 0
        while number > 0 and steps < 6:
            total += 10 * number + number / 100
            number, steps = number - 1, steps + 1
        expected.append(total)
        lengths.append(steps)
    assert min(lengths) < 6 and max(lengths) == 6, "some end for good and some are cut off"
    found = jax.jit(lambda key: episode_returns(env, act, key, n))(key)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_array_equal(env.evaluate(act, key, n)["return"], found)


def test_what_a_task_inherits():
    env = Countdown(CountdownConfig(episode_length=4))
    assert env.episode_length == 4 and env.headline == "return" and env.metrics["return"].higher_is_better
    assert env.mj_model is None and env.mj_spec is None and env.fingerprint is None
    assert env.watch(act, jax.random.key(0)) == {}
    env.check()
    with pytest.raises(TypeError, match="abstract"):
        Task(CountdownConfig())


def test_a_task_need_not_carry_what_others_keep_in_its_states():
    batch = VectorEnv(Countdown(CountdownConfig()), episode_length=6)
    state = jax.jit(batch.reset)(jax.random.split(jax.random.key(0), 8))
    for _ in range(6):
        before, state = state, jax.jit(batch.step)(state, jnp.zeros((8, 1)))
        ended = (before.data == 1) | (before.info["steps"] == 5)
        np.testing.assert_array_equal(state.done, ended)
        np.testing.assert_array_equal(state.info["truncation"], ended & (before.data > 1))
        np.testing.assert_array_equal(state.info["steps"], jnp.where(ended, 0, before.info["steps"] + 1))
        np.testing.assert_array_equal(state.info["next_obs"]["state"][:, 0], before.data - 1)
    assert (state.info["key"] != before.info["key"]).any()


@pytest.fixture
def pendulum():
    """The user's module, which is not on the import path."""
    spec = importlib.util.spec_from_file_location("own_pendulum", OWN_TASK / "pendulum.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["own_pendulum"] = module
    spec.loader.exec_module(module)
    yield module.Pendulum(module.PendulumConfig())
    del sys.modules["own_pendulum"]


def test_the_pendulum_is_gymnasiums(pendulum: Task):
    """Step by step, from where ours stands: angles, speeds, rewards and what is seen."""
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    theirs.reset()
    n = 20
    state = jax.jit(jax.vmap(pendulum.reset))(jax.random.split(jax.random.key(0), n))
    step = jax.jit(jax.vmap(pendulum.step))
    rng = np.random.default_rng(0)
    fastest = 0.0
    for _ in range(pendulum.episode_length):
        actions = rng.uniform(-1.2, 1.2, (n, 1)) * (rng.random() < 0.8)
        before, state = np.asarray(state.data, float), step(state, jnp.asarray(actions))
        after, seen, rewards = map(np.asarray, (state.data, state.obs["state"], state.reward))
        for i in range(n):
            theirs.state = before[i]
            obs, reward, terminated, _, _ = theirs.step(2 * actions[i])
            assert np.abs(after[i] - theirs.state).max() < 2e-5 and np.abs(seen[i] - obs / [1, 1, 8]).max() < 2e-5
            assert abs(rewards[i] - reward) < 2e-4 and not terminated
        assert not state.done.any()
        fastest = max(fastest, np.abs(after[:, 1]).max())
    assert fastest == 8.0, "the limit on speed was met"


def test_the_pendulum_starts_where_gymnasiums_does(pendulum: Task):
    starts = jax.jit(jax.vmap(pendulum.reset))(jax.random.split(jax.random.key(1), 4000)).data
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    drawn = []
    for seed in range(1000):
        theirs.reset(seed=seed)
        drawn.append(theirs.state)
    limits = np.array([np.pi, 1.0])
    for found in (np.asarray(starts), np.array(drawn)):
        assert (np.abs(found) <= limits).all()
        np.testing.assert_allclose(
            np.quantile(found / limits, [0.25, 0.5, 0.75], axis=0).T, [[-0.5, 0, 0.5]] * 2, atol=0.1
        )


def arm5dof(*arguments, cwd: Path, status: int = 0, path: Path | None = None) -> tuple[str, str]:
    """The command line in a process and a folder of its own. Returns what it says on stdout and stderr."""
    places = [str(place) for place in (path, ROOT) if place]
    done = subprocess.run(
        [sys.executable, "-m", "arm5dof", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(places)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == status and "Traceback" not in done.stderr, done.stderr
    return done.stdout, done.stderr


def test_a_task_outside_the_package_from_the_command_line(tmp_path: Path):
    mine, elsewhere = tmp_path / "mine", tmp_path / "elsewhere"
    mine.mkdir()
    elsewhere.mkdir()
    for name in ("pendulum.py", "pendulum.toml"):
        shutil.copy(OWN_TASK / name, mine)
    out, _ = arm5dof("train", "pendulum.toml", *TINY.split(), cwd=mine)
    assert "| return |" in out
    run = mine / "runs" / "pendulum"
    report = (run / "report.md").read_text()
    assert "Task pendulum:Pendulum: 10 episodes of 200 steps (2000 transitions)" in report and "| return |" in report
    assert (run / "learning.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((run / "run.json").read_text())["model"] == {} and not list(run.glob("model.*"))

    evaluate_it = ("eval", run, "--targets", 30, "--seed", 1, "--json")
    here = json.loads(arm5dof(*evaluate_it, cwd=mine)[0])
    assert list(here) == ["return"] and list(here["return"]) == ["mean", "min", "max"]

    _, err = arm5dof(*evaluate_it, cwd=elsewhere, status=2)
    (line,) = [line for line in err.splitlines() if line.startswith("arm5dof: ")]
    assert "cannot import task 'pendulum:Pendulum'" in line and "PYTHONPATH" in line
    assert json.loads(arm5dof(*evaluate_it, cwd=elsewhere, path=mine)[0]) == here

    values = tomllib.loads((run / "config.toml").read_text())
    values["train"]["episodes"] = 20
    (run / "config.toml").write_text(tomli_w.dumps(values))
    out, err = arm5dof("train", "--resume", run, cwd=mine)
    assert "changed since the last checkpoint: train.episodes 10 -> 20" in err and "at episode 10" in err
    assert [e["episodes"] for e in json.loads((run / "evaluations.json").read_text())] == [10, 20]


MARKSMAN = '''
import jax
import jax.numpy as jnp

from arm5dof import Task
from arm5dof.envs import State
from arm5dof.settings import settings, static


@settings
class MarksmanConfig:
    """Settings whose values are of all sorts."""

    mark: tuple[float, float] = static(default=(0.25, -0.5))
    """Where to hit."""
    name: str = static(default="marksman")
    weight: float = 1.0
    """A number that may be traced."""
    strict: bool = static(default=True)
    episode_length: int = static(default=2)


class Marksman(Task):
    """One action hits the mark or not."""

    Config = MarksmanConfig
    action_size = 2

    def reset(self, key):
        seen, zero = jax.random.uniform(key, (1,)), jnp.zeros(())
        return State(seen, {"state": seen, "privileged_state": seen}, zero, zero, {}, {})

    def step(self, state, action):
        miss = jnp.linalg.norm(action - jnp.array(self.config.mark))
        return state.replace(reward=-self.config.weight * miss, done=jnp.ones(()))
'''


def test_settings_of_all_sorts_survive_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """TOML has lists where Python has tuples: they are as the task declares them, in a run's folder too."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "marksman.py").write_text(MARKSMAN)
    budget = "episodes = 64\nnum_envs = 4\nepoch_steps = 2\nevaluate_every = 32\ncheckpoint_every = 64"
    agent = "batch_size = 16\nupdates_per_step = 4\nactor_width = 16\nactor_depth = 1\ncritic_width = 8"
    (tmp_path / "marksman.toml").write_text(
        f'[env]\ntask = "marksman:Marksman"\nmark = [0, 0.75]\n[train]\n{budget}\n[ddpg]\n{agent}\n'
        "[evaluate]\ntargets = 20\ninterim_targets = 20\n"
    )
    config = load_config("marksman.toml")
    for text in ("0.1,-0.5", "-.5, 1e-1", "(0.1, -0.5)", "[0.1, -0.5,]", "0, 1"):
        assert load_config("marksman.toml", mark=text).env.mark == ast.literal_eval(f"({text.strip('([,])')})")
    for wrong in ("0.1", "0.1,x", "0.1,0.2,0.3", "", "0.1 0.2"):
        assert said(lambda wrong=wrong: load_config("marksman.toml", mark=wrong)).startswith("env.mark")
    assert config.env.mark == (0.0, 0.75) and make_env(config).config is config.env
    run = train(config, "runs/marksman")
    opened = Run.open("runs/marksman")
    assert opened.config == config and opened.evaluations == run.evaluations
    actions = opened.policy()({"state": np.zeros((3, 1)), "privileged_state": np.zeros((3, 1))})
    assert actions.shape == (3, 2)
    assert {e["return"]["max"] <= 0 for e in run.evaluations} == {True}


def test_modules_of_one_name_in_two_folders_are_not_mistaken_for_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "path", list(sys.path))
    for folder in (tmp_path / "mine", tmp_path / "theirs"):
        folder.mkdir()
        (folder / "archer.py").write_text(MARKSMAN)
        (folder / "archer.toml").write_text('[env]\ntask = "archer:Marksman"\n')
    (tmp_path / "archer.toml").write_text('[env]\ntask = "archer:Marksman"\n')
    mine = load_config(tmp_path / "mine/archer.toml")
    assert load_config(tmp_path / "mine/archer.toml") == mine == load_config(tmp_path / "archer.toml")
    text = said(lambda: load_config(tmp_path / "theirs/archer.toml"))
    assert f"'archer' is {tmp_path}/mine/archer.py here and not {tmp_path}/theirs/archer.py: rename one" in text


@pytest.mark.parametrize("seed", range(3))
def test_the_pendulum_swings_up(seed: int, monkeypatch: pytest.MonkeyPatch):
    """With the settings that ship, 10,000 transitions: a mean return above -200 over 1,000 episodes."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    config = load_config(OWN_TASK / "pendulum.toml", seed=seed)
    env = make_env(config)
    trainer = Trainer(env, config)
    trainer.start()
    before = evaluate.evaluate(trainer.policy(), 1000, seed)["return"]["mean"]
    while not trainer.finished:
        trainer.advance()
    assert trainer.counters.env_steps == 10_000
    after = evaluate.evaluate(trainer.policy(), 1000, seed)["return"]["mean"]
    assert before < -700 and after > -200, (before, after)
