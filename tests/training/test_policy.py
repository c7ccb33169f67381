"""A policy called from Python: what it takes, what it gives, and what it says of mistakes."""

import copy
import pickle
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.errors import said

from arm5dof.arm import Arm
from arm5dof.ddpg import DDPG, DDPGConfig
from arm5dof.envs import State, Task, VectorEnv
from arm5dof.envs.inverse_kinematics import candidates, solve
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.envs.reach_pose import ReachPose, ReachPoseConfig
from arm5dof.grasp.shipped import shipped
from arm5dof.settings import settings, static
from arm5dof.training.config import load_config
from arm5dof.training.policy import AT_ONCE, Policy
from arm5dof.training.policy_file import load_policy

SMALL = load_config("kinematic.toml", actor_width=16, actor_depth=1, critic_width=8, critic_depth=1, heads=3).ddpg
PLAIN = DDPGConfig(actor_width=16, actor_depth=1, critic_width=8, critic_depth=1)


@settings
class IdleConfig:
    """A task in which nothing happens."""

    episode_length: int = static(default=3)


class Idle(Task):
    """It has no goals."""

    Config: ClassVar[type] = IdleConfig
    action_size = 1

    def reset(self, key: jax.Array) -> State:
        zero = jnp.zeros(())
        return State(zero, {"state": jnp.zeros(2), "privileged_state": jnp.zeros(2)}, zero, zero, {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        return state


def untrained(env: Task) -> Policy:
    """A policy that has learnt nothing."""
    agent = DDPG(env, SMALL, num_envs=2, episode_length=env.episode_length, total_steps=1)
    return Policy(env, agent, SMALL, jax.jit(agent.init)(SMALL, jax.random.key(0)).networks)


@pytest.fixture(scope="module")
def policy(kinematic: Reach) -> Policy:
    return untrained(kinematic)


@pytest.fixture(scope="module")
def pointing(arm: Arm) -> Policy:
    return untrained(ReachPose(ReachPoseConfig(dynamics="kinematic"), arm))


def test_one_goal_is_answered_as_the_first_of_many(policy: Policy):
    one, many = policy.solve([0.15, 0.05, 0.12], corrections=2), policy.solve([[0.15, 0.05, 0.12]], corrections=2)
    assert one.q.shape == (5,) and one.outcome.shape == (3,) and one.errors["distance"].shape == ()
    assert many.q.shape == (1, 5) and many.outcome.shape == (1, 3) and many.errors["distance"].shape == (1,)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[0]), one, many)
    by_name = policy.solve(target=np.array([0.15, 0.05, 0.12]), corrections=2)
    jax.tree.map(np.testing.assert_array_equal, one, by_name)


@pytest.mark.parametrize(
    "target",
    [
        *([], [[]], np.zeros((0, 3))),
        *([0.1, 0.2], [[0.1, 0.2]], [[0.1, 0.2, 0.3], [0.1]], np.zeros((1, 1, 3))),
        *(0.1, "here", None, [["x", "y", "z"]]),
    ],
    ids=repr,
)
def test_what_is_no_target_is_told_what_one_is(policy: Policy, target):
    assert said(lambda: policy.solve(target)).startswith("target takes 3 numbers (x, y, z), or rows of them, not ")


def test_many_goals_are_answered_as_few(policy: Policy):
    """In blocks, on all cores."""
    goals = np.asarray(policy.env.arm.forward(policy.env.arm.sample(jax.random.key(0), (2 * AT_ONCE + 7,))))
    few = np.r_[0:20, AT_ONCE - 10 : AT_ONCE + 10, -20:0]
    expected, found = policy.solve(goals[few]), policy.solve(goals)
    for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        assert len(other) == len(goals)
        np.testing.assert_allclose(np.asarray(other)[few], one, atol=1e-5)


def test_solve_says_what_it_takes(policy: Policy):
    point = [0.1, 0.1, 0.1]
    assert said(lambda: policy.solve([0.1, float("nan"), 0.1])) == "target 1 is not finite: 0.1 nan 0.1"
    assert said(lambda: policy.solve([point, [0.1, 0, -np.inf]])) == "target 2 is not finite: 0.1 0.0 -inf"
    assert said(lambda: policy.solve([point, [0, 0, 1e308]])) == "target 2 is too large to compute with: 0.0 0.0 1e+308"
    takes = "solve takes target (x, y, z) for this task, each once, not "
    assert said(lambda: policy.solve(taget=point)) == f"{takes}taget"
    assert said(lambda: policy.solve(point, approach=point)) == f"{takes}target, approach"
    assert said(lambda: policy.solve(point, target=point)) == f"{takes}target, target"
    assert said(lambda: policy.solve()) == f"{takes}nothing"
    for wrong in (-1, 1.5, "2"):
        said_of = said(lambda wrong=wrong: policy.solve(point, corrections=wrong))
        assert said_of == f"corrections = {wrong!r}: it should be a whole number from 0 to 10000"


def test_a_goal_of_several_inputs_takes_as_many_of_each(pointing: Policy):
    points, axes = [[0.15, 0.05, 0.12], [0.1, -0.1, 0.2]], [[0, 0, -1], [1.0, 0, 0]]
    answer = pointing.solve(points, approach=axes)
    assert answer.q.shape == (2, 5) and answer.outcome.directions.shape == (2, 1, 3)
    assert {name: error.shape for name, error in answer.errors.items()} == {"distance": (2,), "angle": (2,)}
    one = pointing.solve(points[1], axes[1])
    assert one.q.shape == (5,) and one.outcome.directions.shape == (1, 3)
    np.testing.assert_allclose(one.q, answer.q[1], atol=1e-6)
    assert pointing.solve(points[:1], approach=axes[0]).q.shape == (1, 5)
    takes = "solve takes target (x, y, z) and approach (ax, ay, az) for this task, each once, not target"
    assert said(lambda: pointing.solve(points)) == takes
    assert (
        said(lambda: pointing.solve(points, approach=axes[:1])) == "solve takes as many of each of target and approach"
    )
    assert (
        said(lambda: pointing.solve(points, approach=axes[0])) == "solve takes as many of each of target and approach"
    )
    assert "approach takes 3 numbers (ax, ay, az)" in said(lambda: pointing.solve(points[0], approach=[1, 0, 0, 0]))


def test_a_policy_without_a_forward_model_only_acts():
    env = Idle(IdleConfig())
    agent = DDPG(env, PLAIN, num_envs=2, episode_length=3, total_steps=1)
    policy = Policy(env, agent, PLAIN, jax.jit(agent.init)(PLAIN, jax.random.key(0)).networks)
    assert policy(env.reset(jax.random.key(0)).obs).shape == (1,)
    assert said(lambda: policy.solve([0.1, 0.1, 0.1])) == "the task Idle has no forward model: its policy only acts"
    assert "solve" not in repr(policy)


def test_a_policy_takes_one_observation_or_many(policy: Policy):
    obs = jax.jit(jax.vmap(policy.env.reset))(jax.random.split(jax.random.key(1), 7)).obs
    one = jax.tree.map(lambda x: x[3], obs)
    act, branch = jax.jit(policy), jax.jit(policy.branch)
    actions, branches = act(obs), branch(obs)
    assert actions.shape == (7, 5) and branches.shape == (7,)
    assert policy(one).shape == act(one).shape == (5,) and branch(one).shape == ()
    np.testing.assert_allclose(policy(one), actions[3], atol=1e-6)
    np.testing.assert_allclose(act(one), actions[3], atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(policy))(obs), actions, atol=1e-6)
    other = (branches + 1) % 3
    np.testing.assert_allclose(act(one, other[3]), act(obs, other)[3], atol=1e-6)
    assert np.abs(act(one, other[3]) - actions[3]).max() > 1e-3
    np.testing.assert_array_equal(act(jax.tree.map(np.asarray, obs)), actions)


def test_answers_are_those_of_all_heads(policy: Policy):
    obs = jax.jit(jax.vmap(policy.env.reset))(jax.random.split(jax.random.key(1), 7)).obs
    answers = policy.answers(obs)
    assert answers.shape == (7, 3, 5)
    for head in range(3):
        np.testing.assert_allclose(answers[:, head], policy(obs, jnp.full(7, head)), atol=1e-6)
    np.testing.assert_allclose(policy.answers(jax.tree.map(lambda x: x[3], obs)), answers[3], atol=1e-6)


def test_the_forward_model_chooses_among_the_answers(policy: Policy):
    """The one that plain C MuJoCo finds nearest to the goal."""
    arm, goals = policy.env.arm, jax.vmap(policy.env.sample_goal)(jax.random.split(jax.random.key(4), 50))
    answers = np.asarray(policy.answers(jax.vmap(policy.env.question)(goals)))
    data, nearest = mujoco.MjData(arm.mj_model), []
    for actions, goal in zip(answers, goals, strict=True):
        away = []
        for action in actions:
            data.qpos[arm.qpos] = arm.to_joints(action)
            mujoco.mj_kinematics(arm.mj_model, data)
            away.append(np.linalg.norm(data.site_xpos[arm.site] - goal))
        nearest.append(min(away))
    np.testing.assert_allclose(policy.solve(goals).errors["distance"], nearest, atol=1e-6)


@pytest.mark.parametrize("followed", [2, 3])
def test_corrections_follow_several_branches(arm: Arm, followed: int):
    """The best of what each branch comes to when it is followed alone."""
    env = Reach(ReachConfig(dynamics="kinematic", branches=followed), arm)
    policy, single = untrained(env), Reach(ReachConfig(dynamics="kinematic"), arm)
    goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(4), 50))
    answers = policy.answers(jax.vmap(env.question)(goals))
    away = jax.vmap(jax.vmap(lambda a, goal: -env.goal_reward(env.outcome(a), goal, a)[0], (0, None)))(answers, goals)
    order = np.argsort(away, axis=1)

    class Alone:
        """A policy of one head."""

        def __init__(self, rank: int) -> None:
            self.rank = rank

        def __call__(self, obs, branch=None):
            return policy(obs, order[:, self.rank])

        def answers(self, obs):
            return policy(obs, order[:, self.rank])[:, None]

    alone = lambda rank: candidates(single, Alone(rank), goals, 3, 1).answer.errors["distance"][0]
    errors = np.stack([alone(rank) for rank in range(followed)])
    found = jax.tree.map(lambda x: x[0], candidates(env, policy, goals, 3, followed).answer)
    best = candidates(env, policy, goals, 3, followed).answer.errors["distance"]
    np.testing.assert_allclose(best, errors, atol=1e-6)
    assert (errors.argmin(0) > 0).any()
    every = policy.solve(np.asarray(goals), corrections=3, candidates=True)
    assert every.q.shape == (50, followed, 5)
    np.testing.assert_allclose(every.errors["distance"], errors.T, atol=1e-6)
    np.testing.assert_allclose(env.arm.forward(found.q), found.outcome, atol=1e-6)
    first = policy.solve(np.asarray(goals))
    np.testing.assert_allclose(
        first.errors["distance"], solve(single, policy, goals, 0).answer.errors["distance"], atol=1e-6
    )


def test_a_policy_says_what_it_acts_on(policy: Policy):
    state, privileged = jnp.zeros((4, 3)), jnp.zeros((4, 11))
    takes = "a policy acts on observations, a dictionary of privileged_state (11,) and state (3,), not "
    assert said(lambda: policy([0.1, 0.1, 0.1])) == f"{takes}list; for goals use solve"
    assert said(lambda: policy({"state": state})) == f"{takes}state; for goals use solve"
    assert said(lambda: policy({})).startswith(takes)
    for wrong in (
        {"state": state[:, :2], "privileged_state": privileged},
        {"state": state, "privileged_state": privileged[:, :10]},
        {"state": state[0], "privileged_state": privileged},
        {"state": state[:2], "privileged_state": privileged},
        {"state": state[None], "privileged_state": privileged[None]},
        {"state": 3.0, "privileged_state": privileged},
    ):
        for call in (policy, policy.branch, jax.jit(policy)):
            text = said(lambda call=call, wrong=wrong: call(wrong))
            assert text.startswith("this policy acts on privileged_state (11,) and state (3,), or (n, size) for n ")
            assert f"state {np.shape(wrong['state'])}" in text


def test_a_policy_shows_itself_as_a_table(policy: Policy):
    text, html = repr(policy), policy._repr_html_()
    for word in ("Policy", "Reach", "3 heads", "target (x, y, z)"):
        assert word in text and word in html


@pytest.fixture(scope="module")
def trained() -> Policy:
    return load_policy(shipped("arm5.xml").policy)


DOWN = np.array([0.0, 0.0, -1.0])


def test_every_answer_is_the_nearest_to_itself(trained: Policy):
    point = [0.16, 0.06, 0.03]
    every = trained.solve_all(point, DOWN)
    met = np.asarray(every.errors["distance"]) < 1e-3
    poses = np.asarray(every.q)[met & (np.asarray(every.errors["angle"]) < np.deg2rad(0.5))]
    assert len(poses) > 1 and np.abs(poses[0] - poses[1]).max() >= 0.05
    for pose in poses:
        np.testing.assert_allclose(trained.solve(point, DOWN, corrections=10, near=pose).q, pose, atol=0.05)


@pytest.mark.parametrize("which", ["policy", "trained"])
def test_joints_follow_a_line_without_a_jump(which: str, request: pytest.FixtureRequest):
    """Also where the policy has learnt nothing, so that none of its own answers serves."""
    policy: Policy = request.getfixturevalue(which)
    line = np.array([0.13, -0.1, 0.08]) + np.linspace(0, 1, 40)[:, None] * [0.03, 0.06, -0.04]
    more = {"approach": np.tile(DOWN, (40, 1))} if which == "trained" else {}
    path = policy.path(line, **more)
    assert np.asarray(path.errors["distance"]).max() < 1e-3 and not path.jumps.any()
    assert np.abs(np.diff(path.q, axis=0)).max() < 0.5
    data, arm = mujoco.MjData(policy.env.arm.mj_model), policy.env.arm
    for q, point in zip(np.asarray(path.q), line, strict=True):
        assert (q >= arm.lower - 1e-6).all() and (q <= arm.upper + 1e-6).all()
        data.qpos[arm.qpos] = q
        mujoco.mj_kinematics(arm.mj_model, data)
        np.testing.assert_allclose(data.site_xpos[arm.site], point, atol=1.1e-3)
    other = np.asarray(policy.path(line[::-1], start=path.q[-1], **more).q)
    np.testing.assert_allclose(other[0], path.q[-1], atol=0.05)


def test_a_path_says_where_a_joint_jumps(policy: Policy):
    """There is no way from one side of the arm to the other in one step."""
    path = policy.path([[0.2, 0.1, 0.1], [0.2, 0.099, 0.1], [-0.2, -0.1, 0.2]])
    np.testing.assert_array_equal(path.jumps, [False, False, True])


def test_near_and_path_say_what_they_take(policy: Policy):
    point = [0.15, 0.05, 0.12]
    joints = "theta_1, theta_2, theta_3, theta_4, theta_5"
    assert said(lambda: policy.solve(point, near=[0, 0])) == (
        f"near takes 5 numbers ({joints}), or rows of them, not an array of shape (2,)"
    )
    assert said(lambda: policy.solve([point] * 3, near=np.zeros((2, 5)))) == (
        "near takes one pose, or one for each of 3 goals, not 2"
    )
    assert said(lambda: policy.solve(point, near=np.zeros(5), candidates=True)) == (
        "solve takes near or candidates, not both"
    )
    assert said(lambda: policy.path(point)).startswith("path takes the goals of a line")
    assert said(lambda: policy.path([point])).startswith("path takes the goals of a line")
    assert said(lambda: policy.path([point] * 2, start=np.zeros((2, 5)))) == ("start takes one pose, not 2")
    assert said(lambda: policy.solve_all([point])) == "solve_all takes one goal"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_copy_answers_with_the_same_bits(policy: Policy, copied: Callable[[Policy], Policy]):
    goals = [[0.15, 0.05, 0.12], [-0.1, 0.1, 0.2]]
    other = copied(policy)
    assert other.env is not policy.env
    np.testing.assert_array_equal(other.solve(goals).q, policy.solve(goals).q)
    vector, keys = VectorEnv(other.env, 5), jax.random.split(jax.random.key(0), 2)
    jax.tree.map(
        np.testing.assert_array_equal, copied(vector).reset(keys).obs, VectorEnv(policy.env, 5).reset(keys).obs
    )
