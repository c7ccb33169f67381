"""What an arm's position servos make of commands, in C MuJoCo, for many arms at once. Contacts are off."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import pairwise

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from arm5dof.arm.arm import Arm
from arm5dof.runtime import xla

STILL = 2e-4
"""Radians (metres) a second: slower joints are at rest."""
CHUNK = 25
"""Physics steps between looks at who is at rest."""
MOST_S = 8.0
"""Seconds of simulated time after which an arm counts as it is, at rest or not."""
MOVES, SHARE, TOLERANCE = 10, 0.8, 0.01


class Servos:
    """The position servos of an arm each of whose joints has one.

    >>> import numpy as np
    >>> from arm5dof import load_arm
    >>> arm = load_arm("reach.xml")
    >>> servos = Servos(arm)
    >>> servos.settle_steps
    4
    """

    def __init__(self, arm: Arm) -> None:
        self.arm, self.model = arm, copy.copy(arm.free_model)
        # Physics that blows up is to be seen, rather than set back to the model's initial state.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.most = int(np.ceil(MOST_S / self.model.opt.timestep))
        initial = mujoco.MjData(self.model)
        self._row = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(self.model, initial, self._row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.ctrl = initial.ctrl.copy()
        # FULLPHYSICS begins with these, in this order.
        ends = np.cumsum([1, self.model.nq, self.model.nv, self.model.na])
        self._qpos, self._qvel, self._act = (slice(a, b) for a, b in pairwise(ends))

    def rest(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray, before: np.ndarray, ctrl: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate arms until they are at rest, or for `MOST_S`. One that is told what it was told before, when it came
        to rest, stays as it is.

        Args:
            qpos: Positions, (..., nq), any leading axes.
            qvel: Velocities, (..., nv).
            act: Actuators' states, (..., na).
            before: What the actuators were told last, (..., nu).
            ctrl: What they are told now, (..., nu).

        Returns:
            Positions, velocities and actuators' states then, not finite where the physics blew up.
        """
        lead = qpos.shape[:-1]
        states = np.tile(self._row, (int(np.prod(lead)), 1))
        for part, values in ((self._qpos, qpos), (self._qvel, qvel), (self._act, act)):
            states[:, part] = values.reshape(len(states), -1)
        told, was = (values.reshape(len(states), -1).astype(float) for values in (ctrl, before))
        moving = np.flatnonzero((told != was).any(-1))
        with _without_warnings():
            for _ in range(0, self.most, CHUNK):
                if not len(moving):
                    break
                states[moving] = self._follow(states[moving], told[moving], CHUNK)[:, -1]
                moving = moving[self._moves(states[moving])]
        qpos, qvel, act = (states[:, part].reshape(*lead, -1) for part in (self._qpos, self._qvel, self._act))
        return qpos, qvel, act

    @cached_property
    def settle_steps(self) -> int | None:
        """Physics steps after which a move from one random pose to another is done to within 1 % of the largest
        joint's way, for eight of ten moves; None if the arm does not come to rest."""
        ends = np.random.default_rng(0).uniform(self.arm.lower, self.arm.upper, (MOVES, 2, self.arm.dof))
        states, told = np.tile(self._row, (MOVES, 1)), np.tile(self.ctrl, (MOVES, 1))
        states[:, self._qpos][:, self.arm.qpos] = ends[:, 0]
        told[:, self.arm.actuators] = self.arm.servo[:, 0] * ends[:, 1] + self.arm.servo[:, 1]
        way = np.empty((MOVES, 0, self.arm.dof))
        with _without_warnings():
            while self._moves(states).sum() > (1 - SHARE) * MOVES or not way.shape[1]:
                if way.shape[1] >= self.most:
                    return None
                followed = self._follow(states, told, CHUNK)
                states = followed[:, -1]
                way = np.concatenate([way, followed[:, :, self._qpos][:, :, self.arm.qpos]], axis=1)
        if not np.isfinite(way).all():
            return None
        far = np.abs(way - way[:, -1:]).max(-1) > TOLERANCE * np.abs(ends[:, 1] - ends[:, 0]).max(-1, keepdims=True)
        # The last step that is still far, counted from 1, and one more.
        steps = np.sort([np.flatnonzero(row)[-1] + 2 if row.any() else 1 for row in far])
        return int(steps[int(SHARE * MOVES) - 1])

    def _follow(self, states: np.ndarray, told: np.ndarray, steps: int) -> np.ndarray:
        """The states (n, steps, size) that lead on from some (n, size), the actuators told one thing (n, nu)."""
        control = np.broadcast_to(told[:, None], (len(told), steps, told.shape[1]))
        return self._pool.rollout(self.model, self._data, states, control)[0]

    def _moves(self, states: np.ndarray) -> np.ndarray:
        """Which arms are not at rest yet (n,), but for those whose physics blew up."""
        speed = np.abs(states[:, self._qvel][:, self.arm.dofs]).max(-1)
        return np.isfinite(speed) & (speed > STILL)

    @cached_property
    def _pool(self) -> Rollout:
        return Rollout(nthread=xla.cores())

    @cached_property
    def _data(self) -> list[mujoco.MjData]:
        """One for each thread."""
        return [mujoco.MjData(self.model) for _ in range(xla.cores())]


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Physics that blows up is an answer here: nothing on stderr, and no MUJOCO_LOG.TXT in the user's folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
