"""`VectorEnv`: time limits, automatic reset, and physics that blows up."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import Bandit, Walk

from arm5dof.envs import State, VectorEnv
from arm5dof.envs.reach import Reach

ENVS, LENGTH = 16, 5


# Most of these tests' time is compilation; less optimised, it takes half.
quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})


def bits(tree: Any) -> Any:
    """A pytree as numpy arrays, random keys as the numbers they are made of."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return jax.tree.map(lambda x: np.asarray(jax.random.key_data(x) if is_key(x) else x), tree)


class Episodes:
    """A vectorised environment with `reset` and `step` jitted."""

    def __init__(self, env, length: int = LENGTH, envs: int = ENVS) -> None:
        self.env, self.envs = env, envs
        vector = VectorEnv(env, length)
        self.reset, self.step = quick_jit(vector.reset), quick_jit(vector.step)
        self.bare_step = quick_jit(jax.vmap(env.step))

    def run(self, steps: int, seed: int = 0) -> list[State]:
        """The first state and those after each step of random actions."""
        states = [self.reset(jax.random.split(jax.random.key(seed), self.envs))]
        for t in range(steps):
            states.append(self.step(states[-1], self.action(t)))
        return states

    def action(self, t: int) -> jax.Array:
        return jax.random.uniform(jax.random.key(1000 + t), (self.envs, self.env.action_size), minval=-1, maxval=1)


@pytest.fixture(scope="module")
def reach(kinematic: Reach) -> Episodes:
    return Episodes(kinematic)


@pytest.fixture(scope="module")
def episodes(reach: Episodes) -> list[State]:
    """Three episodes of the kinematic arm."""
    return reach.run(3 * LENGTH)


@pytest.fixture(scope="module")
def physics(servo: Reach) -> Episodes:
    return Episodes(servo, length=100, envs=8)


def flags(states: list[State], name: str) -> np.ndarray:
    """One of the flags after each step, (steps, envs)."""
    return np.array([s.done if name == "done" else s.info[name] for s in states[1:]])


# Time limit and reset


def test_truncation_falls_exactly_on_the_episodes_length(episodes: list[State]):
    over = np.zeros((3 * LENGTH, ENVS))
    over[LENGTH - 1 :: LENGTH] = 1
    np.testing.assert_array_equal(flags(episodes, "truncation"), over)
    np.testing.assert_array_equal(flags(episodes, "done"), over)
    assert not flags(episodes, "nonfinite").any()
    np.testing.assert_array_equal(flags(episodes, "steps")[:, 0], np.tile([1, 2, 3, 4, 0], 3))


def test_every_reset_draws_a_fresh_goal(episodes: list[State]):
    goals = np.array([s.info["goal"] for s in episodes])
    for t in range(1, len(goals)):
        changed = (goals[t] != goals[t - 1]).any(-1)
        assert changed.all() if t % LENGTH == 0 else not changed.any()
    # Fresh in every environment and every episode, poses too.
    starts = episodes[::LENGTH]
    for values in ([s.info["goal"] for s in starts], [s.data.qpos for s in starts]):
        rows = np.concatenate(values)
        assert len(np.unique(rows, axis=0)) == len(starts) * ENVS


def test_goals_go_on_changing_in_one_step_episodes():
    vector = Episodes(Bandit(), length=1, envs=4)
    seen = np.array([s.obs["state"][:, 0] for s in vector.run(50)])
    assert len(np.unique(seen)) == seen.size


def test_the_marker_moves_with_the_goal(kinematic: Reach, episodes: list[State]):
    marker = kinematic.arm.mj_model.body("target").mocapid[0]
    for state in episodes:
        np.testing.assert_array_equal(state.data.mocap_pos[:, marker], state.info["goal"])


def test_the_terminal_observation_is_kept(reach: Episodes, episodes: list[State]):
    """`next_obs` and `reward` are the bare environment's, also where `obs` is already the next episode's."""
    for t, (before, after) in enumerate(pairwise(episodes)):
        reached = reach.bare_step(before, reach.action(t))
        for name, value in reached.obs.items():
            np.testing.assert_allclose(after.info["next_obs"][name], value, atol=1e-6)
            same = np.isclose(after.obs[name], value, atol=1e-6).all()
            assert same != bool(after.info["truncation"].any())
        np.testing.assert_allclose(after.reward, reached.reward, atol=1e-6)
        np.testing.assert_allclose(after.metrics["distance"], -after.reward, atol=1e-6)


def test_obs_after_a_reset_belongs_to_the_new_goal(kinematic: Reach, episodes: list[State]):
    for state in episodes:
        target = (state.info["goal"] - kinematic.arm.origin) / kinematic.arm.reach
        np.testing.assert_allclose(state.obs["state"], target, atol=1e-6)
        q = kinematic.arm.to_action(state.data.qpos[:, kinematic.arm.qpos])
        np.testing.assert_allclose(state.obs["privileged_state"][:, : kinematic.arm.dof], q, atol=1e-6)


def test_a_termination_is_no_truncation():
    """Walks end for good once past 3; their time is up after 5 steps."""
    states = Episodes(Walk(end=3)).run(3)
    assert (states[3].done == 1).all()
    assert (states[3].info["truncation"] == 0).all()
    np.testing.assert_allclose(states[3].info["next_obs"]["state"], states[0].obs["state"] + 3)
    assert (states[3].obs["state"] < 1).all()
    assert (states[3].info["steps"] == 0).all()


def test_a_termination_on_the_last_step_is_a_termination():
    states = Episodes(Walk(end=3), length=3).run(3)
    assert (states[3].done == 1).all()
    assert (states[3].info["truncation"] == 0).all()


def test_environments_end_one_by_one():
    """Each starts over on its own: those that begin beyond 0.5 pass the end one step earlier."""
    states = Episodes(Walk(end=2.5)).run(3)
    early = np.asarray(states[0].obs["state"][:, 0]) > 0.5
    assert 0 < early.sum() < ENVS
    np.testing.assert_array_equal(states[2].done, early)
    np.testing.assert_array_equal(states[3].done[~early], 1)
    np.testing.assert_array_equal(states[3].done[early], 0)


def test_same_keys_same_bits(reach: Episodes, episodes: list[State]):
    again = reach.run(LENGTH + 1)[-1]
    jax.tree.map(np.testing.assert_array_equal, bits(again), bits(episodes[LENGTH + 1]))


# Physics that blows up


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_reset_and_counted(poison: float):
    """Walks that pass 2.5 fall off a cliff."""
    states = Episodes(Walk(cliff=2.5, poison=poison)).run(2)
    fell = np.asarray(states[0].obs["state"][:, 0]) > 0.5
    assert 0 < fell.sum() < ENVS
    np.testing.assert_array_equal(states[1].info["nonfinite"], 0)
    last = states[2]
    np.testing.assert_array_equal(last.info["nonfinite"], fell)
    np.testing.assert_array_equal(last.done, fell)
    assert not last.info["truncation"].any()
    np.testing.assert_array_equal(last.reward[fell], 0)
    assert (last.obs["state"][fell] < 1).all()
    for values in (last.obs["state"], last.info["next_obs"]["state"], last.reward):
        assert np.isfinite(values).all()


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_nan_in_one_arm_leaves_the_others_alone(physics: Episodes, field: str):
    """The arm that blew up is reset and counted; every other has the very bits of a run in which nothing happened."""
    healthy = physics.run(2)[-1]
    victim = 3
    poisoned = getattr(healthy.data, field).at[victim, 1].set(jnp.nan)
    sick = healthy.replace(data=healthy.data.replace(**{field: poisoned}))
    sound = np.arange(physics.envs) != victim

    after, reference = (bits(physics.step(state, physics.action(2))) for state in (sick, healthy))
    np.testing.assert_array_equal(after.info["nonfinite"], ~sound)
    np.testing.assert_array_equal(after.done, ~sound)
    assert (after.info["steps"][victim], after.info["truncation"][victim], after.reward[victim]) == (0, 0, 0)
    assert (after.info["goal"][victim] != healthy.info["goal"][victim]).any()
    for leaf in jax.tree.leaves(after):
        assert np.isfinite(leaf).all()
    for left, right in zip(jax.tree.leaves(after), jax.tree.leaves(reference), strict=True):
        np.testing.assert_array_equal(left[sound], right[sound])


def test_an_arm_that_blew_up_lives_on(physics: Episodes):
    state = physics.run(1)[-1]
    state = state.replace(data=state.data.replace(qpos=jnp.full_like(state.data.qpos, jnp.nan)))
    state = physics.step(state, physics.action(1))
    assert (state.info["nonfinite"] == 1).all()
    for t in range(2, 5):
        state = physics.step(state, physics.action(t))
        assert (state.info["nonfinite"] == 0).all()
        assert (state.reward < 0).all()
    np.testing.assert_array_equal(state.info["steps"], 3)
