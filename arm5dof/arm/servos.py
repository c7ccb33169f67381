"""What an arm's position servos make of commands, in C MuJoCo, for many arms at once. Contacts are off."""

from __future__ import annotations

import copy
from functools import cached_property
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from arm5dof.arm.arm import Arm
from arm5dof.runtime import models, xla

STILL = 1e-3
"""Radians (metres) a second: slower joints are at rest."""
CHUNK = 24
"""Physics steps between looks at who is at rest. Even, since the least that a stiff servo can do is to and fro."""
SPEED = 2.0
"""Radians (metres) a second at which commands move. A servo that is told to be far away at once is at the limit of its
force, where simulated ones lose their damping: light joints then spin or tremble for ever."""
MOST_S = 5.0
"""Seconds after a command's move after which an arm counts as it is, at rest or not."""
LOST = 1e3
"""Radians (metres): where a joint is farther away than that, the physics has blown up."""
MOVES, SHARE, TOLERANCE = 10, 0.8, 0.01


class Servos:
    """The position servos of an arm each of whose joints has one.

    >>> import numpy as np
    >>> from arm5dof import load_arm
    >>> arm = load_arm("reach.xml")
    >>> servos = Servos(arm)
    >>> servos.settle_steps
    3
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

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and copies: without threads."""
        return {name: value for name, value in vars(self).items() if name not in ("_pool", "_data")}

    def rest(
        self, qpos: np.ndarray, qvel: np.ndarray, act: np.ndarray, before: np.ndarray, ctrl: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate arms until they are at rest, or for `MOST_S` after their commands are. One that is told what it was
        told before, when it came to rest, stays as it is.

        Args:
            qpos: Positions, (..., nq), any leading axes.
            qvel: Velocities, (..., nv).
            act: Actuators' states, (..., na).
            before: What the actuators were told last, (..., nu).
            ctrl: What they are told now, (..., nu): commands move there at `SPEED`.

        Returns:
            Positions, velocities and actuators' states then, not finite where the physics blew up.
        """
        lead = qpos.shape[:-1]
        states = np.tile(self._row, (int(np.prod(lead)), 1))
        for part, values in ((self._qpos, qpos), (self._qvel, qvel), (self._act, act)):
            states[:, part] = values.reshape(len(states), -1)
        told, was = (values.reshape(len(states), -1).astype(float) for values in (ctrl, before))
        moving, done = np.flatnonzero((told != was).any(-1)), 0
        ramp = self._ramp(was, told)
        with models.overheard():  # Physics that blows up is an answer here.
            while len(moving) and done < ramp[moving].max() + self.most:
                states[moving], still = self._advance(states[moving], was[moving], told[moving], ramp[moving], done)
                done += CHUNK
                moving = moving[~still]
        qpos, qvel, act = (states[:, part].reshape(*lead, -1) for part in (self._qpos, self._qvel, self._act))
        return qpos, qvel, act

    @cached_property
    def settle_steps(self) -> int | None:
        """Physics steps after which a command at once from one random pose to another is carried out to within 1 % of
        the largest joint's way, for eight of ten; None if the arm does not come to rest."""
        states, was, told = self._moves()
        asked = np.abs((told - was)[:, self.arm.actuators] / self.arm.servo[:, 0]).max(-1, keepdims=True)
        way = np.empty((MOVES, 0, self.arm.dof))
        moving = np.ones(MOVES, bool)
        with models.overheard():  # Physics that blows up is an answer here.
            while moving.sum() > (1 - SHARE) * MOVES:
                if way.shape[1] >= self.most:
                    return None
                followed = self._follow(states, np.repeat(told[:, None], CHUNK, 1))
                moving = ~self._still(states, followed[:, -1])
                states = followed[:, -1]
                way = np.concatenate([way, followed[:, :, self._qpos][:, :, self.arm.qpos]], axis=1)
        if not np.isfinite(way).all():
            return None
        far = np.abs(way - way[:, -1:]).max(-1) > TOLERANCE * asked
        # The last step that is still far, counted from 1, and one more.
        steps = np.sort([np.flatnonzero(row)[-1] + 2 if row.any() else 1 for row in far])
        return int(steps[int(SHARE * MOVES) - 1])

    @cached_property
    def rest_seconds(self) -> float | None:
        """Seconds from the end of a command's move, at `SPEED` from one random pose to another, until the arm is at
        rest, for eight of ten; None if it does not come to rest, NaN if its physics blows up in more than two."""
        states, was, told = self._moves()
        ramp, done, ends = self._ramp(was, told), 0, np.full(MOVES, np.inf)
        with models.overheard():  # Physics that blows up is an answer here.
            while done < ramp.max() + self.most and not np.isfinite(ends).all():
                states, still = self._advance(states, was, told, ramp, done)
                done += CHUNK
                ends = np.where(still & np.isinf(ends), np.maximum(done - ramp, 0) * self.model.opt.timestep, ends)
        blown_up = ~np.isfinite(states).all(-1)
        if blown_up.sum() > (1 - SHARE) * MOVES:
            return float("nan")
        ends[blown_up] = np.inf
        worst = float(np.sort(ends)[int(SHARE * MOVES) - 1])
        return worst if np.isfinite(worst) else None

    def hold(self, q: np.ndarray) -> np.ndarray:
        """What to tell all actuators for the arm's joints to be at some positions, (n, dof) to (n, nu)."""
        told = np.tile(self.ctrl, (len(q), 1))
        told[:, self.arm.actuators] = self.arm.servo[:, 0] * q + self.arm.servo[:, 1]
        return told

    def _moves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arms at rest in random poses, what holds them there, and what brings them to others."""
        starts, ends = np.random.default_rng(0).uniform(self.arm.lower, self.arm.upper, (2, MOVES, self.arm.dof))
        states = np.tile(self._row, (MOVES, 1))
        states[:, self._qpos][:, self.arm.qpos] = starts
        return states, self.hold(starts), self.hold(ends)

    def _ramp(self, before: np.ndarray, told: np.ndarray) -> np.ndarray:
        """Steps that commands take to their ends, (n,)."""
        way = np.abs((told - before)[:, self.arm.actuators] / self.arm.servo[:, 0]).max(-1)
        return np.ceil(way / (SPEED * self.model.opt.timestep))

    def _advance(
        self, states: np.ndarray, before: np.ndarray, told: np.ndarray, ramp: np.ndarray, done: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states (n, size) some steps later, when so many are done, and which arms are at rest then."""
        share = np.minimum((done + 1 + np.arange(CHUNK)) / np.maximum(ramp, 1)[:, None], 1)[..., None]
        after = self._follow(states, before[:, None] + share * (told - before)[:, None])[:, -1]
        after[~(np.abs(after[:, self._qpos][:, self.arm.qpos]) < LOST).all(-1)] = np.nan
        return after, self._still(states, after) & (done + CHUNK > ramp + CHUNK)

    def _follow(self, states: np.ndarray, control: np.ndarray) -> np.ndarray:
        """The states (n, steps, size) that lead on from some (n, size) by commands (n, steps, nu)."""
        return self._pool.rollout(self.model, self._data, states, control)[0]

    def _still(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Which arms are where they were `CHUNK` steps before, (n,), or have blown up."""
        qpos = (after - before)[:, self._qpos][:, self.arm.qpos]
        return ~(np.abs(qpos).max(-1) > STILL * CHUNK * self.model.opt.timestep)

    @cached_property
    def _pool(self) -> Rollout:
        return Rollout(nthread=xla.cores())

    @cached_property
    def _data(self) -> list[mujoco.MjData]:
        """One for each thread."""
        return [mujoco.MjData(self.model) for _ in range(xla.cores())]
