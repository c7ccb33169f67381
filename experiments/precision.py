"""How exact the models are: the closed forms against MuJoCo, MJX against C MuJoCo, and how well the servos hold.

python experiments/precision.py        a minute or two; into experiments/results/precision.md
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.kinematics import forward, inverse
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.runtime import files

POSES, ENVS, STEPS = 1_000_000, 256, 160
RESULTS = Path(__file__).parent / "results"


def closed_forms(arm: Arm) -> dict[str, str]:
    """Table 1 against MuJoCo's site, and there and back through the inverse, in float64."""
    theta = np.random.default_rng(0).uniform(-np.pi, np.pi, (POSES, 5))
    data = mujoco.MjData(arm.mj_model)
    site = np.empty((POSES, 3))
    for i in range(POSES):
        data.qpos[arm.qpos] = theta[i]
        mujoco.mj_kinematics(arm.mj_model, data)
        site[i] = data.site_xpos[arm.site]

    @jax.jit
    def errors(theta: jax.Array, site: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        position, pitch = forward(theta).position, theta[:, 2:].sum(-1)
        found = inverse(position, pitch).theta
        back = jnp.linalg.norm(forward(found).position - position[:, None], axis=-1).max()
        # Joints 1 and 2 share an axis: their sum counts.
        joints = lambda t: jnp.concatenate([t[..., :2].sum(-1, keepdims=True), t[..., 2:]], -1)
        apart = joints(found) - joints(theta)[:, None]
        nearest = jnp.abs((apart + jnp.pi) % (2 * jnp.pi) - jnp.pi).max(-1).min(-1)
        return jnp.linalg.norm(position - site, axis=-1).max(), back, nearest.max()

    with jax.enable_x64(True):
        chunks = [errors(theta[i : i + 100_000], site[i : i + 100_000]) for i in range(0, POSES, 100_000)]
    against, back, joints = np.max(np.array(chunks), axis=0)
    return {
        f"forward model against MuJoCo's `ee`, {POSES} poses, float64": f"{against:.1e} m",
        f"forward, inverse (all branches), forward, {POSES} poses, float64": f"{back:.1e} m",
        "joints recovered by the nearest branch, theta_1 + theta_2 counted as one": f"{joints:.1e} rad",
    }


def physics(arm: Arm) -> dict[str, str]:
    """The servo environment in MJX and the same actions in C MuJoCo."""
    env = Reach(ReachConfig(dynamics="servo"), arm)
    q = arm.sample(jax.random.key(0), (ENVS,))
    action = jax.random.uniform(jax.random.key(1), (STEPS, ENVS, arm.dof), minval=-1.0, maxval=1.0)

    @jax.jit
    def rollout(q: jax.Array, action: jax.Array) -> jax.Array:
        state = jax.vmap(env.start)(q, arm.forward(q))

        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, state.data.qpos[:, arm.qpos]

        return jax.lax.scan(step, state, action)[1]

    ours = np.asarray(rollout(q, action))
    told = np.asarray(arm.to_ctrl(arm.to_joints(action)), float)
    data, worst, left = mujoco.MjData(arm.mj_model), 0.0, 0.0
    for i in range(ENVS):
        mujoco.mj_resetData(arm.mj_model, data)
        data.qpos[arm.qpos] = q[i]
        for t in range(STEPS):
            before = data.qpos[arm.qpos].copy()
            data.ctrl[arm.actuators] = told[t, i]
            mujoco.mj_step(arm.mj_model, data, nstep=env.config.substeps)
            after = data.qpos[arm.qpos]
            worst = max(worst, np.abs(ours[t, i] - after).max())
            left = max(left, np.abs(after - told[t, i]).max() / np.abs(before - told[t, i]).max())
    return {
        f"MJX against C MuJoCo, {ENVS} environments, {STEPS} control steps, joint angles": f"{worst:.1e} rad",
        f"way left after a control step of {env.config.substeps} physics steps": f"{100 * left:.2f} %",
    }


def servos(arm: Arm) -> dict[str, str]:
    """How far the end effector hangs below where it was sent, after four seconds, in random poses."""
    data, worst = mujoco.MjData(arm.mj_model), 0.0
    for q in np.asarray(arm.sample(jax.random.key(2), (100,)), float):
        mujoco.mj_resetData(arm.mj_model, data)
        data.qpos[arm.qpos] = q
        mujoco.mj_kinematics(arm.mj_model, data)
        sent = data.site_xpos[arm.site].copy()
        data.ctrl[arm.actuators] = arm.to_ctrl(q)
        mujoco.mj_step(arm.mj_model, data, nstep=200)
        worst = max(worst, np.linalg.norm(data.site_xpos[arm.site] - sent))
    return {"steady error of the servos at the end effector, 100 poses": f"{1e3 * worst:.4f} mm"}


def main() -> None:
    arm = load_arm("reach.xml")
    found = closed_forms(arm) | physics(arm) | servos(arm)
    lines = ["# Precision", "", "Largest errors found. Command: `python experiments/precision.py`.", "", "| | |"]
    lines += ["| --- | ---: |", *(f"| {name} | {value} |" for name, value in found.items())]
    text = "\n".join(lines) + "\n"
    print(text)
    files.write_text(RESULTS / "precision.md", text)


if __name__ == "__main__":
    main()
