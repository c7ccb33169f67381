"""Inverse kinematics by other solvers, for positions of an arm's end effector; `answers.py` holds ours against them.

    pip install mink daqp                                            steps by quadratic programs, one after the other
    pip install pytracik                                             TRAC-IK
    pip install git+https://github.com/chungmin99/pyroki             least squares in JAX, in batches

Each starts at the home pose, and again from up to `RESTARTS` random ones where that fails.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

CLOSE, ENOUGH = 1e-3, 1e-4
"""Metres: what counts as met, and where an iteration may stop."""
RESTARTS, STEPS, LINE_STEPS = 3, 50, 20


class Solver(Protocol):
    """Another inverse kinematics for one arm."""

    title: str

    def __call__(self, poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Joint positions (n, dof) for positions of the end effector, `goals` (n, 3) metres; that of poses (n, dof)
        which they come from is for solvers that want an orientation too."""
        ...


class Mink:
    """mink: differential inverse kinematics by quadratic programs with joint limits."""

    def __init__(self, arm: Any) -> None:
        import mink

        self.mink, self.arm, self.model = mink, arm, arm.mj_model
        self.title = f"mink {version('mink')}"
        site = mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_SITE, arm.site)
        self.task = mink.FrameTask(site, frame_type="site", position_cost=1.0, orientation_cost=0.0, lm_damping=1e-6)
        self.configuration, self.limits = mink.Configuration(self.model), [mink.ConfigurationLimit(self.model)]

    def __call__(self, poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return np.array([self._restarted(goal) for goal in goals])

    def follow(self, line: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (n, dof) and errors (n,) along a line of points (n, 3), each begun where the one before
        ended, the first at a given pose."""
        found, q = [], first
        for point in line:
            q, error = self._solve(q, point, LINE_STEPS)
            found.append((q, error))
        return np.array([q for q, _ in found]), np.array([error for _, error in found])

    def _restarted(self, goal: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(0)
        for attempt in range(1 + RESTARTS):
            start = rng.uniform(self.arm.lower, self.arm.upper) if attempt else self.arm.home
            q, error = self._solve(start, goal, STEPS)
            if error <= CLOSE:
                break
        return q

    def _solve(self, start: np.ndarray, goal: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
        q = self.model.qpos0.copy()
        q[self.arm.qpos] = start
        self.configuration.update(q)
        self.task.set_target(self.mink.SE3.from_translation(goal))
        for _ in range(steps):
            velocity = self.mink.solve_ik(
                self.configuration, [self.task], 1.0, solver="daqp", damping=1e-6, limits=self.limits
            )
            self.configuration.integrate_inplace(velocity, 1.0)
            error = float(np.linalg.norm(self.task.compute_error(self.configuration)[:3]))
            if error <= ENOUGH:
                break
        return self.configuration.q[self.arm.qpos].copy(), error


class Pyroki:
    """PyRoki: Levenberg-Marquardt with soft joint limits, a whole batch at once."""

    title = "PyRoki"

    def __init__(self, arm: Any) -> None:
        import jaxlie
        import jaxls
        import pyroki
        import yourdfpy

        self.arm = arm
        with tempfile.TemporaryDirectory() as folder:
            robot = pyroki.Robot.from_urdf(yourdfpy.URDF.load(write_urdf(arm, Path(folder))))
        tip = jnp.array(robot.links.names.index("tip"))
        variable = robot.joint_var_cls(0)

        def solve(start: jax.Array, goal: jax.Array) -> jax.Array:
            target = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), goal)
            costs = [
                pyroki.costs.pose_cost_analytic_jac(robot, variable, target, tip, pos_weight=50.0, ori_weight=0.0),
                pyroki.costs.limit_cost(robot, variable, weight=100.0),
            ]
            found = (
                jaxls.LeastSquaresProblem(costs, [variable])
                .analyze()
                .solve(
                    initial_vals=jaxls.VarValues.make([variable.with_value(start)]),
                    verbose=False,
                    linear_solver="dense_cholesky",
                    trust_region=jaxls.TrustRegionConfig(lambda_initial=1.0),
                )
            )
            return found[variable]

        self.solve: Callable[..., jax.Array] = jax.jit(jax.vmap(solve))
        self.forward = jax.jit(arm.forward)

    def __call__(self, poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
        rng, q = np.random.default_rng(0), np.tile(self.arm.home, (len(goals), 1))
        q = np.array(self.solve(jnp.asarray(q), jnp.asarray(goals)))
        for _ in range(RESTARTS):
            missed = np.flatnonzero(np.linalg.norm(np.asarray(self.forward(q)) - goals, axis=1) > CLOSE)
            if not len(missed):
                break
            rows = np.resize(missed, 1 << (len(missed) - 1).bit_length())  # Few shapes, so few compilations.
            starts = rng.uniform(self.arm.lower, self.arm.upper, (len(rows), self.arm.dof))
            q[rows] = self.solve(jnp.asarray(starts), jnp.asarray(goals[rows]))
        return q


class TracIK:
    """TRAC-IK. Its Python interface takes no position without an orientation, so it is told that of a pose there."""

    title = "TRAC-IK, whole pose"

    def __init__(self, arm: Any) -> None:
        from trac_ik import TracIK as Peer

        self.arm = arm
        with tempfile.TemporaryDirectory() as folder:
            self.peer = Peer("base", "tip", str(write_urdf(arm, Path(folder))))

    def __call__(self, poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return np.array([self._restarted(pose) for pose in np.asarray(poses, float)])

    def _restarted(self, pose: np.ndarray) -> np.ndarray:
        rng, (position, rotation) = np.random.default_rng(0), self.peer.fk(pose)
        for attempt in range(1 + RESTARTS):
            start = rng.uniform(self.arm.lower, self.arm.upper) if attempt else self.arm.home
            if (q := self.peer.ik(position, rotation, np.asarray(start, float))) is not None:
                return np.asarray(q)
        return np.asarray(self.arm.home)


SOLVERS: tuple[type, ...] = (Mink, Pyroki, TracIK)


def write_urdf(arm: Any, folder: Path) -> Path:
    """The chain to the end effector as URDF, from `base` (the world) to `tip`, its frames parallel to the world's where
    all joints are at zero. Returns the file."""
    data = mujoco.MjData(arm.mj_model)
    data.qpos[arm.qpos] = 0
    mujoco.mj_kinematics(arm.mj_model, data)
    place = lambda to, before: " ".join(f"{x:.9f}" for x in to - before)
    parts, before, parent = ['<link name="base"/>'], np.zeros(3), "base"
    for k, joint in enumerate(arm.joints):
        anchor, axis, name = data.xanchor[joint], data.xaxis[joint], f"link{k}"
        kind, limits = "prismatic" if arm.slides[k] else "revolute", arm.stops[k]
        if not np.isfinite(limits).all():
            kind, limits = "continuous", (-np.pi, np.pi)
        parts.append(
            f"<link name='{name}'/><joint name='joint{k}' type='{kind}'><parent link='{parent}'/>"
            f"<child link='{name}'/><origin xyz='{place(anchor, before)}' rpy='0 0 0'/>"
            f"<axis xyz='{place(axis, np.zeros(3))}'/>"
            f"<limit lower='{limits[0]:.9f}' upper='{limits[1]:.9f}' effort='1' velocity='1'/></joint>"
        )
        before, parent = anchor.copy(), name
    parts.append(
        f"<link name='tip'/><joint name='fixed' type='fixed'><parent link='{parent}'/><child link='tip'/>"
        f"<origin xyz='{place(data.site_xpos[arm.site], before)}' rpy='0 0 0'/></joint>"
    )
    file = folder / "arm.urdf"
    file.write_text(f"<robot name='arm'>{''.join(parts)}</robot>")
    return file
