"""Gymnasium's interface: its checkers, and the same episodes as `VectorEnv`'s."""

from __future__ import annotations

import copy
import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from helpers.environments import Bandit, Walk

from arm5dof.envs import VectorEnv
from arm5dof.envs.gym import GymEnv, GymGoalEnv, GymVectorEnv
from arm5dof.envs.reach import Reach
from arm5dof.errors import UserError

ENVS, LENGTH, SEED = 6, 5, 7

Step = tuple[Any, Any, Any, Any, dict[str, Any]]


def arrays_equal(left: Any, right: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, left, right)


def walks(**kwargs: float) -> GymVectorEnv:
    """A batch of walks to the right, in whole steps from a start in [0, 1)."""
    return GymVectorEnv(Walk(**kwargs), ENVS, LENGTH)


def run(env: gymnasium.vector.VectorEnv, steps: int) -> tuple[Any, list[Step]]:
    """The first observations after a reset with the seed, and what each step of random actions gave."""
    env.action_space.seed(SEED)
    first, _ = env.reset(seed=SEED)
    return first, [env.step(env.action_space.sample()) for _ in range(steps)]


@pytest.fixture(scope="module")
def singles(kinematic: Reach) -> dict[str, GymEnv]:
    """Environments by what they show. The arm compiles long, a walk does not."""
    return {
        "state": GymEnv(kinematic, LENGTH),
        "dict": GymEnv(Walk(), LENGTH, "dict"),
        "goal": GymGoalEnv(kinematic, LENGTH),
    }


@pytest.fixture(scope="module")
def arms(kinematic: Reach) -> GymVectorEnv:
    return GymVectorEnv(kinematic, ENVS, LENGTH)


# The checkers


@pytest.mark.filterwarnings("error::UserWarning", "ignore:.*infinity:UserWarning")
@pytest.mark.parametrize("shown", ["state", "dict", "goal"])
def test_gymnasiums_checker(singles: dict[str, GymEnv], shown: str):
    check_env(singles[shown], skip_render_check=True)


@pytest.mark.filterwarnings("error::UserWarning", "ignore:.*infinity:UserWarning")
def test_gymnasiums_checker_where_the_first_step_is_the_last():
    check_env(GymEnv(Bandit(), LENGTH), skip_render_check=True)


@pytest.mark.parametrize("shown", ["state", "dict", "goal"])
def test_stable_baselines_checker(singles: dict[str, GymEnv], shown: str):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(singles[shown])


def test_stable_baselines_replays_in_hindsight(singles: dict[str, GymEnv]):
    sb3 = pytest.importorskip("stable_baselines3")
    agent = sb3.DDPG(
        "MultiInputPolicy", singles["goal"], replay_buffer_class=sb3.HerReplayBuffer, learning_starts=20, batch_size=32
    )
    agent.learn(40)
    batch = agent.replay_buffer.sample(32)
    achieved, desired = (batch.next_observations[name].numpy() for name in ("achieved_goal", "desired_goal"))
    np.testing.assert_allclose(batch.rewards[:, 0].numpy(), -np.linalg.norm(achieved - desired, axis=-1), atol=1e-6)


def test_infos_are_laid_out_as_gymnasiums_own(arms: GymVectorEnv, singles: dict[str, GymEnv]):
    """The same names and shapes as a `SyncVectorEnv` gives that resets in the same step."""
    walkers = GymVectorEnv(Walk(), 1, LENGTH, "dict")
    for env, single in ((arms, singles["state"]), (walkers, singles["dict"])):
        own = SyncVectorEnv([lambda single=single: single], autoreset_mode=AutoresetMode.SAME_STEP)
        assert env.metadata["autoreset_mode"] == own.metadata["autoreset_mode"]
        (_, ours), (_, theirs) = run(env, LENGTH), run(own, LENGTH)
        for left, right in zip(ours, theirs, strict=True):
            layouts = [jax.tree.map(lambda x: x.shape[1:], step[4]) for step in (left, right)]
            assert layouts[0] == layouts[1]
        rows = [steps[-1][4]["final_obs"][0] for steps in (ours, theirs)]
        assert jax.tree.map(np.shape, rows[0]) == jax.tree.map(np.shape, rows[1])


def test_gymnasiums_wrappers_understand_the_infos():
    first, steps = run(RecordEpisodeStatistics(walks()), LENGTH)
    episode = steps[-1][4]["episode"]
    arrays_equal(episode["l"], np.full(ENVS, LENGTH))
    np.testing.assert_allclose(episode["r"], LENGTH * first[:, 0] + sum(range(LENGTH + 1)), rtol=1e-6)

    _, steps = run(DictInfoToList(walks(end=2.5)), 2)
    _, _, terminated, _, infos = steps[-1]
    assert 0 < terminated.sum() < ENVS
    assert [set(info) for info in infos] == [{"final_obs", "final_info"} if t else {"nonfinite"} for t in terminated]


# The same episodes


def test_steps_are_the_vector_environments(kinematic: Reach, arms: GymVectorEnv):
    vector = VectorEnv(kinematic, LENGTH)
    bits = np.random.default_rng(SEED).integers(2**32, dtype=np.uint32)
    state = jax.jit(vector.reset)(jax.random.split(jax.random.key(bits), ENVS))
    step = jax.jit(vector.step)

    first, steps = run(arms, 2 * LENGTH + 1)
    arrays_equal(first, state.obs["state"])
    arms.action_space.seed(SEED)
    for obs, rewards, terminated, truncated, infos in steps:
        state = step(state, arms.action_space.sample())
        arrays_equal(obs, state.obs["state"])
        arrays_equal(rewards, state.reward)
        arrays_equal(truncated, state.info["truncation"] > 0)
        assert not terminated.any()
        arrays_equal(infos["distance"], state.metrics["distance"])
        if truncated.any():
            arrays_equal(np.stack(infos["final_obs"]), state.info["next_obs"]["state"])
            arrays_equal(infos["final_info"]["distance"], state.metrics["distance"])
    assert sum(step[3].any() for step in steps) == 2


@pytest.mark.parametrize("shown", ["state", "dict"])
def test_one_is_a_batch_of_one(shown: str):
    batch, one = GymVectorEnv(Walk(end=3), 1, LENGTH, shown), GymEnv(Walk(end=3), LENGTH, shown)
    first, steps = run(batch, 3)
    arrays_equal(one.reset(seed=SEED)[0], jax.tree.map(lambda x: x[0], first))
    for obs, rewards, terminated, truncated, infos in steps:
        seen, *outcome = one.step(np.zeros(1))
        assert outcome == [rewards[0], terminated[0], truncated[0], {"nonfinite": False}]
        arrays_equal(seen, infos["final_obs"][0] if terminated[0] else jax.tree.map(lambda x: x[0], obs))
    assert terminated[0]


def test_what_came_back_is_the_callers():
    """The next step takes the device's memory over, not the caller's arrays."""
    env = walks()
    first, steps = run(env, 3)
    np.testing.assert_allclose(np.stack([step[0] for step in steps]), first + np.arange(1, 4)[:, None, None])
    first += 1
    steps[0][1][:] = 0


# How episodes end


def test_a_time_limit_is_a_truncation():
    first, steps = run(walks(), LENGTH)
    for obs, _, terminated, truncated, infos in steps[:-1]:
        assert not (terminated | truncated).any()
        assert "final_obs" not in infos
        assert (obs >= 1).all()
    obs, rewards, terminated, truncated, infos = steps[-1]
    assert truncated.all()
    assert not terminated.any()
    np.testing.assert_allclose(np.stack(infos["final_obs"]), first + LENGTH, rtol=1e-6)
    np.testing.assert_allclose(rewards, first[:, 0] + LENGTH, rtol=1e-6)
    assert (obs < 1).all()
    assert (obs != first).all()


@pytest.mark.parametrize("length", [3, LENGTH])
def test_an_end_for_good_is_a_termination(length: int):
    """Also where the time is up in the same step."""
    first, steps = run(GymVectorEnv(Walk(end=3), ENVS, length), 3)
    obs, _, terminated, truncated, infos = steps[-1]
    assert terminated.all()
    assert not truncated.any()
    np.testing.assert_allclose(np.stack(infos["final_obs"]), first + 3, rtol=1e-6)
    assert (obs < 1).all()


def test_environments_end_one_by_one():
    first, steps = run(walks(end=2.5), 2)
    early = first[:, 0] > 0.5
    assert 0 < early.sum() < ENVS
    _, _, terminated, _, infos = steps[-1]
    arrays_equal(terminated, early)
    for mask in (infos["_final_obs"], infos["_final_info"], infos["final_info"]["_nonfinite"], ~infos["_nonfinite"]):
        arrays_equal(mask, early)
    assert [obs is not None for obs in infos["final_obs"]] == early.tolist()


def test_physics_that_blew_up_is_a_truncation_with_a_flag():
    """Walks that pass 2.5 fall off a cliff, to where nothing is finite; also where that ends them for good."""
    first, steps = run(walks(cliff=2.5, end=2.5), 2)
    fell = first[:, 0] > 0.5
    assert 0 < fell.sum() < ENVS
    obs, rewards, terminated, truncated, infos = steps[-1]
    arrays_equal(truncated, fell)
    assert not terminated.any()
    arrays_equal(infos["final_info"]["nonfinite"], fell)
    arrays_equal(rewards[fell], np.zeros(fell.sum()))
    assert (obs[fell] < 1).all()
    arrays_equal(np.stack(infos["final_obs"][fell]), obs[fell])

    one = GymEnv(Walk(cliff=0), LENGTH)
    one.reset(seed=SEED)
    obs, *outcome = one.step(np.zeros(1))
    assert outcome == [0.0, False, True, {"nonfinite": True}]
    assert obs in one.observation_space


# Seeds and spaces


def test_same_seed_same_bits():
    env = walks()
    runs = [run(env, LENGTH + 1) for _ in range(2)]
    for left, right in zip(*(steps for _, steps in runs), strict=True):
        arrays_equal(left[:4], right[:4])

    starts = [env.reset(seed=seed)[0] for seed in (SEED, None, None, SEED, None, None, SEED + 1)]
    arrays_equal(starts[:3], starts[3:6])
    assert len(np.unique(np.concatenate([*starts[:3], starts[6]]))) == 4 * ENVS


def test_without_a_seed_environments_differ():
    assert (walks().reset()[0] != walks().reset()[0]).all()


@pytest.mark.parametrize("shown", ["state", "dict", "goal"])
def test_spaces_hold_what_is_seen(singles: dict[str, GymEnv], shown: str):
    env = singles[shown]
    shapes = {
        "state": (3,),
        "dict": {"privileged_state": (1,), "state": (1,)},
        "goal": {"achieved_goal": (3,), "desired_goal": (3,), "observation": (3,)},
    }
    seen = [env.reset(seed=SEED)[0]] + [env.step(env.action_space.sample())[0] for _ in range(LENGTH)]
    for obs in seen:
        assert obs in env.observation_space
        assert jax.tree.map(np.shape, obs) == shapes[shown]
        assert all(isinstance(x, np.ndarray) and x.dtype == np.float32 for x in jax.tree.leaves(obs))
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (1 if shown == "dict" else 5,), np.float32)


def test_spaces_hold_batches(arms: GymVectorEnv):
    first, steps = run(arms, LENGTH)
    for obs in [first] + [step[0] for step in steps]:
        assert obs in arms.observation_space
    assert all(obs in arms.single_observation_space for obs in steps[-1][4]["final_obs"])
    _, rewards, *flags, _ = steps[-1]
    assert [x.dtype for x in (rewards, *flags)] == [np.float32, bool, bool]


# Goals


def test_goals_are_points_and_rewards_follow_from_them(kinematic: Reach, singles: dict[str, GymEnv]):
    env = singles["goal"]
    first, _ = env.reset(seed=SEED)
    for _ in range(LENGTH):
        action = env.action_space.sample()
        obs, reward, _, truncated, info = env.step(action)
        there = kinematic.arm.forward(kinematic.arm.to_joints(jax.numpy.asarray(action)))
        np.testing.assert_allclose(obs["achieved_goal"], there, atol=1e-6)
        # Also at the end, where the environment itself has gone on to another goal.
        arrays_equal(obs["desired_goal"], first["desired_goal"])
        arrays_equal(obs["observation"], first["observation"])
        np.testing.assert_allclose(reward, -info["distance"], atol=1e-6)
    assert truncated
    assert (env.reset()[0]["desired_goal"] != first["desired_goal"]).all()


def test_rewards_are_the_computed_ones_to_the_last_bit(singles: dict[str, GymEnv]):
    env = singles["goal"]
    env.reset(seed=SEED)
    for _ in range(10 * LENGTH):
        obs, reward, _, truncated, info = env.step(env.action_space.sample())
        achieved, desired = obs["achieved_goal"], obs["desired_goal"]
        assert reward == env.compute_reward(achieved, desired, info)
        assert reward == env.compute_reward(np.stack([achieved] * 2), np.stack([desired] * 2), info)[1]
        if truncated:
            env.reset()


def test_rewards_of_many_goals_at_once(singles: dict[str, GymEnv]):
    achieved, desired = np.random.default_rng(0).normal(size=(2, 4, 5, 3))
    rewards = singles["goal"].compute_reward(achieved, desired, None)
    np.testing.assert_allclose(rewards, -np.linalg.norm(achieved - desired, axis=-1), rtol=1e-5)
    assert np.isscalar(singles["goal"].compute_reward(achieved[0, 0], desired[0, 0], None))


# Mistakes


def test_what_cannot_be_shown():
    with pytest.raises(UserError, match="Walk is no GoalEnv"):
        GymEnv(Walk(), LENGTH, "goal")
    with pytest.raises(UserError, match="state, dict, goal, not 'pixels'"):
        GymEnv(Walk(), LENGTH, "pixels")


def test_a_step_before_the_reset():
    with pytest.raises(gymnasium.error.ResetNeeded):
        walks().step(np.zeros((ENVS, 1)))


def test_without_gymnasium(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "arm5dof.envs.gym")
    with pytest.raises(ImportError, match=r"pip install 'arm5dof\[gym\]'"):
        importlib.import_module("arm5dof.envs.gym")


# Copies


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_with_the_same_bits(copied: Callable[[Any], Any], kinematic: Reach):
    """In the middle of episodes, those that end on the way included."""
    env = GymVectorEnv(kinematic, 2, LENGTH)
    env.reset(seed=SEED)
    env.step(env.action_space.sample())
    other = copied(env)
    actions = np.linspace(-1, 1, 2 * 5, dtype=np.float32).reshape(2, 5)
    for _ in range(LENGTH - 1):  # The last of which ends the episodes.
        found, expected = other.step(actions), env.step(actions)
        arrays_equal(found[:4], expected[:4])
    arrays_equal(*(np.stack(infos["final_obs"]) for infos in (found[4], expected[4])))
    arrays_equal(other.reset(), env.reset())


def test_single_environments_have_copies(singles: dict[str, GymEnv]):
    for env in (singles["dict"], singles["goal"]):
        env.reset(seed=SEED)
        other, action = pickle.loads(pickle.dumps(env)), np.zeros(env.action_space.shape, np.float32)
        arrays_equal(other.step(action), env.step(action))
        arrays_equal(other.reset()[0], env.reset()[0])


FORKED = """
import os
import gymnasium
from helpers.environments import Walk
from arm5dof.envs.gym import GymEnv
from arm5dof.errors import UserError

if __name__ == "__main__":
    env = GymEnv(Walk(), 5)
    env.reset(seed=0)
    if os.fork() == 0:
        try:
            env.step(env.action_space.sample())
        except UserError as error:
            print(error, flush=True)
        os._exit(0)
    os.wait()
    try:
        gymnasium.vector.AsyncVectorEnv([lambda: GymEnv(Walk(), 5)] * 2, context="fork")
    except (EOFError, ConnectionError):
        pass  # A worker says by itself why it ended.
    several = gymnasium.vector.AsyncVectorEnv([lambda: GymEnv(Walk(), 5)] * 2, context="spawn")
    print(several.reset(seed=0)[0].shape)
    several.close()
"""


def test_a_fork_is_an_error_with_a_remedy(tmp_path: Path):
    (tmp_path / "forks.py").write_text(FORKED)
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), str(root / "tests")])}
    command = [sys.executable, str(tmp_path / "forks.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=200)
    forked, shape = done.stdout.splitlines()
    assert 'context="spawn"' in forked and shape.startswith("(2, "), done.stderr
    assert f"arm5dof.errors.UserError: {forked}" in done.stderr
