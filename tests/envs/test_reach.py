"""The reaching environment against C MuJoCo and against its own documentation."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.serial import serial_arm

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.kinematics import inverse
from arm5dof.envs import GoalEnv, State
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.errors import UserError

ENVS, STEPS = 256, 160
KINDS = ("goal", "paper", "full")


@cache
def reset(env: Reach):
    return jax.jit(jax.vmap(env.reset))


@cache
def start(env: Reach):
    return jax.jit(jax.vmap(env.start))


@cache
def step(env: Reach):
    return jax.jit(jax.vmap(env.step))


@pytest.fixture(scope="module", params=KINDS)
def seeing(request: pytest.FixtureRequest, arm: Arm) -> Reach:
    """A kinematic environment for each kind of observation."""
    return Reach(ReachConfig(dynamics="kinematic", observation=request.param), arm)


def poses(arm: Arm, count: int, seed: int = 0) -> jax.Array:
    return arm.sample(jax.random.key(seed), (count,))


def goals(arm: Arm, count: int, seed: int = 100) -> jax.Array:
    return arm.forward(poses(arm, count, seed))


def actions(env: Reach, shape: tuple[int, ...], seed: int = 200) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (*shape, env.action_size), minval=-1, maxval=1)


def placed(arm: Arm, q: np.ndarray, qvel: np.ndarray | float = 0.0) -> mujoco.MjData:
    """C MuJoCo's data for one pose."""
    data = mujoco.MjData(arm.mj_model)
    data.qpos[arm.qpos] = q
    data.qvel[arm.dofs] = qvel
    mujoco.mj_kinematics(arm.mj_model, data)
    return data


def documented(env: Reach, data: mujoco.MjData, goal: np.ndarray) -> dict[str, np.ndarray]:
    """The observation that the documentation promises, from C MuJoCo's data."""
    arm = env.arm

    def unit(points: np.ndarray) -> np.ndarray:
        return (points - arm.origin) / arm.reach

    q = (data.qpos[arm.qpos] - (arm.lower + arm.upper) / 2) / ((arm.upper - arm.lower) / 2)
    end_effector, target, joints = unit(data.site_xpos[arm.site]), unit(goal), unit(data.xanchor[arm.joints])
    paper = [joints.ravel(), (target - joints).ravel()]
    moved = data.qvel[arm.dofs] * env.config.substeps * arm.mj_model.opt.timestep
    state = {"goal": [target], "paper": paper, "full": [*paper, q, moved, end_effector, target]}
    return {
        "state": np.concatenate(state[env.config.observation]),
        "privileged_state": np.concatenate([q, end_effector, target]),
    }


def assert_same_obs(found, expected, atol: float = 2e-6) -> None:
    assert found.keys() == expected.keys()
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], atol=atol, rtol=0, err_msg=name)


# Physics


def in_c(arm: Arm, q: np.ndarray, targets: np.ndarray, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions and velocities (steps, envs, dof) after each control step in C MuJoCo."""
    data = mujoco.MjData(arm.mj_model)
    qpos, qvel = np.empty(targets.shape), np.empty(targets.shape)
    for i in range(len(q)):
        mujoco.mj_resetData(arm.mj_model, data)
        data.qpos[arm.qpos] = q[i]
        for t in range(len(targets)):
            data.ctrl[arm.actuators] = targets[t, i]
            mujoco.mj_step(arm.mj_model, data, nstep=substeps)
            qpos[t, i], qvel[t, i] = data.qpos[arm.qpos], data.qvel[arm.dofs]
    return qpos, qvel


def test_mjx_moves_as_c_mujoco_does(servo: Reach):
    """256 environments, an episode each, the same random actions: every joint within 1e-3 rad at every step."""
    arm = servo.arm
    q, goal, action = poses(arm, ENVS), goals(arm, ENVS), actions(servo, (STEPS, ENVS))
    targets = np.asarray(arm.to_joints(action), float)
    qpos, qvel = in_c(arm, np.asarray(q, float), targets, servo.config.substeps)

    state = start(servo)(q, goal)
    for t in range(STEPS):
        state = step(servo)(state, action[t])
        assert np.abs(state.data.qpos[:, arm.qpos] - qpos[t]).max() < 1e-3, t
        if t % 40 == 1:
            for i in range(8):
                data = placed(arm, qpos[t, i], qvel[t, i])
                found = jax.tree.map(lambda x, i=i: x[i], state.obs)
                assert_same_obs(found, documented(servo, data, goal[i]), atol=5e-3)
                distance = np.linalg.norm(data.site_xpos[arm.site] - goal[i])
                assert state.reward[i] == pytest.approx(-distance, abs=3e-4)
                assert state.metrics["distance"][i] == -state.reward[i]
    # Random targets a quarter of a turn apart: the arms did move, and fast.
    assert np.abs(np.diff(qpos, axis=0)).mean() > 0.5
    assert (state.done == 0).all()


def test_a_servo_step_all_but_reaches_its_target(servo: Reach):
    q, action = poses(servo.arm, ENVS), actions(servo, (ENVS,))
    target = servo.arm.to_joints(action)
    state = step(servo)(start(servo)(q, goals(servo.arm, ENVS)), action)
    left = np.abs(state.data.qpos[:, servo.arm.qpos] - target).max(1) / np.abs(target - q).max(1)
    assert left.max() < 0.01


def test_actions_are_clipped(servo: Reach, kinematic: Reach):
    for env in (servo, kinematic):
        state = start(env)(poses(env.arm, ENVS), goals(env.arm, ENVS))
        action = 3 * actions(env, (ENVS,))
        wild, clipped = step(env)(state, action), step(env)(state, jnp.clip(action, -1, 1))
        np.testing.assert_array_equal(wild.data.qpos, clipped.data.qpos)


def test_a_kinematic_step_is_the_commanded_pose(kinematic: Reach):
    arm = kinematic.arm
    action, goal = actions(kinematic, (ENVS,)), goals(arm, ENVS)
    state = step(kinematic)(start(kinematic)(poses(arm, ENVS), goal), action)
    target = jax.jit(arm.to_joints)(action)
    np.testing.assert_array_equal(state.data.qpos[:, arm.qpos], target)
    for i in range(0, ENVS, 16):
        position = placed(arm, np.asarray(target[i], float)).site_xpos[arm.site]
        np.testing.assert_allclose(arm.forward(state.data.qpos[i, arm.qpos]), position, atol=1e-6)
        assert state.reward[i] == pytest.approx(-np.linalg.norm(position - goal[i]), abs=1e-6)


def test_fingers_stay_where_they_are(kinematic: Reach):
    state = start(kinematic)(poses(kinematic.arm, ENVS), goals(kinematic.arm, ENVS))
    state = step(kinematic)(state, actions(kinematic, (ENVS,)))
    np.testing.assert_array_equal(state.data.qpos[:, 5:], np.zeros((ENVS, 2)))


# Observations


def test_observations_are_as_documented(seeing: Reach):
    arm = seeing.arm
    q, goal = poses(arm, ENVS), goals(arm, ENVS)
    obs = jax.device_get(start(seeing)(q, goal).obs)
    for i in range(ENVS):
        expected = documented(seeing, placed(arm, np.asarray(q[i], float)), np.asarray(goal[i], float))
        assert_same_obs(jax.tree.map(lambda x, i=i: x[i], obs), expected)


def test_observations_are_dimensionless(seeing: Reach):
    """Of the order of one, whatever the arm's size."""
    obs = start(seeing)(poses(seeing.arm, ENVS), goals(seeing.arm, ENVS)).obs
    for values in obs.values():
        assert np.abs(values).max() <= 2
        assert np.abs(values).max() > 0.9


@pytest.mark.parametrize("moved", [False, True])
def test_replace_goal_gives_the_observation_of_another_goal(seeing: Reach, moved: bool):
    arm = seeing.arm
    q, goal, other = poses(arm, ENVS), goals(arm, ENVS), goals(arm, ENVS, seed=101)
    state = start(seeing)(q, goal)
    if moved:
        action = actions(seeing, (ENVS,))
        state, q = step(seeing)(state, action), arm.to_joints(action)
    relabelled = jax.vmap(seeing.replace_goal)(state.obs, other)
    assert_same_obs(relabelled, start(seeing)(q, other).obs, atol=1e-6)
    assert np.abs(relabelled["state"] - state.obs["state"]).max() > 0.1


def test_relabel_keeps_velocities(servo: Reach):
    arm = servo.arm
    state = step(servo)(start(servo)(poses(arm, ENVS), goals(arm, ENVS)), actions(servo, (ENVS,)))
    relabelled = jax.vmap(servo.replace_goal)(state.obs, goals(arm, ENVS, seed=101))
    moved = slice(6 * arm.dof + arm.dof, 6 * arm.dof + 2 * arm.dof)
    assert np.abs(state.obs["state"][:, moved]).max() > 1e-3
    np.testing.assert_array_equal(relabelled["state"][:, moved], state.obs["state"][:, moved])


def test_achieved_is_the_end_effector(seeing: Reach):
    arm = seeing.arm
    q = poses(arm, ENVS)
    obs = start(seeing)(q, goals(arm, ENVS)).obs
    np.testing.assert_allclose(jax.vmap(seeing.achieved)(obs), arm.forward(q), atol=1e-6)


def test_goal_reward_is_eq_7(kinematic: Reach):
    a, b = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 100, 3))
    by_hand = -np.sqrt(((a - b) ** 2).sum(1))
    np.testing.assert_allclose(
        jax.vmap(lambda a, b: kinematic.goal_reward(a, b, jnp.zeros(5))[0])(jnp.array(a), jnp.array(b)),
        by_hand,
        atol=1e-7,
    )
    assert kinematic.goal_reward(jnp.ones(3), jnp.ones(3), jnp.zeros(5)) == (0, 0)


def test_outcome_foresees_where_an_action_leads(seeing: Reach):
    """What the critic is shown of an action agrees with the observation after taking it."""
    arm = seeing.arm
    state, action = start(seeing)(poses(arm, ENVS), goals(arm, ENVS)), actions(seeing, (ENVS,))
    foreseen = jax.vmap(seeing.critic_input)(state.obs, action)
    seen = step(seeing)(state, action).obs["privileged_state"]
    assert foreseen.shape == (ENVS, arm.dof + 9)
    np.testing.assert_allclose(foreseen[:, : arm.dof + 6], seen, atol=2e-6)
    offset = seen[:, arm.dof : arm.dof + 3] - seen[:, -3:]
    np.testing.assert_allclose(foreseen[:, -3:], offset, atol=3e-6)


def test_reach_knows_its_goals(kinematic: Reach):
    assert isinstance(kinematic, GoalEnv)
    assert kinematic.action_size == 5


# Goals


def test_every_goal_can_be_reached(kinematic: Reach):
    """The closed-form inverse, kept inside the joint limits, has an answer to every one of 8,192 goals."""
    arm = kinematic.arm
    found = jax.jit(jax.vmap(kinematic.sample_goal))(jax.random.split(jax.random.key(5), 8192))
    assert inverse(found, limits=np.stack([arm.lower, arm.upper], axis=1)).valid.any(-1).all()
    # They fill the space: left and right, near and far, high and low.
    low, high = np.quantile(found, [0.02, 0.98], axis=0)
    assert (high - low > [0.25, 0.3, 0.3]).all()


def test_different_keys_give_different_goals_and_poses(kinematic: Reach):
    state = reset(kinematic)(jax.random.split(jax.random.key(0), ENVS))
    for points in (state.info["goal"], state.data.qpos):
        assert len(np.unique(np.asarray(points), axis=0)) == ENVS
    # The goal is drawn apart from the pose: the arm does not start on it.
    assert np.median(state.metrics["distance"]) > 0.1
    assert np.abs(np.corrcoef(state.data.qpos[:, 0], np.arctan2(*state.info["goal"][:, 1::-1].T))[0, 1]) < 0.3


def test_the_marker_shows_the_goal(servo: Reach):
    arm = servo.arm
    marker = arm.mj_model.body("target").mocapid[0]
    goal = goals(arm, ENVS)
    state = start(servo)(poses(arm, ENVS), goal)
    np.testing.assert_array_equal(state.data.mocap_pos[:, marker], goal)
    state = step(servo)(state, actions(servo, (ENVS,)))
    np.testing.assert_array_equal(state.data.mocap_pos[:, marker], goal)
    np.testing.assert_array_equal(state.info["goal"], goal)


# Purity


def test_same_key_same_bits(servo: Reach):
    arm = servo.arm

    def episode() -> State:
        state = start(servo)(poses(arm, ENVS), goals(arm, ENVS))
        for t in range(3):
            state = step(servo)(state, actions(servo, (ENVS,), seed=t))
        return state

    first, second = episode(), episode()
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_reset_is_a_function_of_its_key(kinematic: Reach):
    first, other, again = (reset(kinematic)(jax.random.split(jax.random.key(seed), ENVS)) for seed in (3, 4, 3))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert (first.data.qpos[:, 0] != other.data.qpos[:, 0]).all()


def test_step_keeps_the_state_it_was_given(kinematic: Reach):
    state = start(kinematic)(poses(kinematic.arm, ENVS), goals(kinematic.arm, ENVS))
    before = jax.tree.map(np.array, state)
    after = step(kinematic)(state, actions(kinematic, (ENVS,)))
    jax.tree.map(np.testing.assert_array_equal, before, state)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)


# Other arms


def test_an_arm_without_servos_is_posed_or_gets_some():
    spec = serial_arm(3, seed=0)
    spec.delete(list(spec.actuators)[1])
    arm = load_arm(spec)
    with pytest.raises(UserError, match=r"joint 'joint_1' has no position actuator.*dynamics = .kinematic."):
        Reach(ReachConfig(dynamics="servo", servo="model"), arm)
    assert Reach(ReachConfig(dynamics="kinematic"), arm).action_size == 3
    env = Reach(ReachConfig(dynamics="servo"), arm)
    assert "servos computed for 'joint_1' (driven by none)" in env.about and (env.arm.actuators >= 0).all()


def test_seven_joints_without_a_marker():
    arm = load_arm("arm7.xml")
    env = Reach(ReachConfig(dynamics="kinematic", observation="full"), arm)
    state = reset(env)(jax.random.split(jax.random.key(0), 8))
    assert state.obs["state"].shape == (8, 6 * 7 + 2 * 7 + 6)
    for i in range(8):
        data = placed(arm, np.asarray(state.data.qpos[i, arm.qpos], float))
        expected = documented(env, data, np.asarray(state.info["goal"][i], float))
        assert_same_obs(jax.tree.map(lambda x, i=i: x[i], state.obs), expected)


# Joints without limits


SPINNING = """<mujoco><compiler angle="radian"/>{option}<worldbody><body>
    <joint name="spin"/><geom size=".1" contype="0" conaffinity="0"/>
    <body pos="0 0 .3"><joint name="bend" axis="0 1 0" range="-1 2"/><geom size=".1" contype="0" conaffinity="0"/>
    <site name="ee" pos="0 0 .2"/></body></body></worldbody>
    <actuator><position joint="spin"/><position joint="bend"/></actuator></mujoco>"""


def test_networks_see_joints_without_limits_modulo_a_turn():
    arm = load_arm(mujoco.MjSpec.from_string(SPINNING.format(option="")))
    env = Reach(ReachConfig(dynamics="kinematic", observation="full"), arm)
    goal = jnp.array([0.1, 0.0, 0.4])
    here, round_about = (env.start(jnp.array([angle, 0.5]), goal) for angle in (0.7, 0.7 - 2 * np.pi))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), here.obs, round_about.obs)
    np.testing.assert_allclose(here.obs["privileged_state"][:3], [0.0, np.cos(0.7), np.sin(0.7)], atol=1e-6)
    np.testing.assert_allclose(env.achieved(here.obs), arm.forward(jnp.array([0.7, 0.5])), atol=1e-6)
    other = jnp.array([0.0, 0.2, 0.3])
    jax.tree.map(np.testing.assert_array_equal, env.replace_goal(here.obs, other), env.start(here.data.qpos, other).obs)
    shown = env.critic_input(here.obs, jnp.array([0.7 / np.pi, 0.0]))
    np.testing.assert_allclose(shown[:3], here.obs["privileged_state"][:3], atol=1e-6)
    q = arm.sample(jax.random.key(0), (1000,))[:, 0]
    assert q.min() < -3.1 and q.max() > 3.1


def test_what_mjx_trips_over_is_said_before_it_is_trained():
    for option, words in (
        ("", None),
        ('cone="elliptic"', r'MJX cannot step .*set <option cone="pyramidal"/>'),
    ):
        option = f'<option timestep="0.02" integrator="implicitfast" {option}/>'
        quick = SPINNING.format(option=option).replace("<position", '<position kp="1000" kv="20"')
        arm = load_arm(mujoco.MjSpec.from_string(quick))
        env = Reach(ReachConfig(dynamics="servo", servo="model"), arm)
        if words is None:
            env.check()
        else:
            with pytest.raises(UserError, match=words):
                env.check()
