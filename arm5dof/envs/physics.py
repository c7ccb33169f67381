"""Physics: the state that a MuJoCo simulation goes on from, and MJX's step of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from arm5dof.errors import UserError

if TYPE_CHECKING:
    from mujoco import mjx


class Physics(struct.PyTreeNode):
    """What an environment keeps of `mjx.Data`, by the same names and in float32: all else follows from it within a
    step, or stays as the model has it."""

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    ctrl: jax.Array
    mocap_pos: jax.Array
    mocap_quat: jax.Array

    @staticmethod
    def at_rest(model: mujoco.MjModel) -> Physics:
        """The model's initial state."""
        data = mujoco.MjData(model)
        return Physics(**{name: jnp.asarray(getattr(data, name), jnp.float32) for name in FIELDS})

    @staticmethod
    def check(model: mujoco.MjModel, mjx_model: mjx.Model) -> None:
        """Raise `UserError` if MJX has the model but cannot step it."""
        try:
            jax.eval_shape(lambda: Physics.at_rest(model).step(mjx_model))
        except Exception as error:  # MJX raises whatever its own code runs into.
            elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
            change = 'set <option cone="pyramidal"/>' if elliptic else "change it"
            said = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise UserError(f"MJX cannot step this model ({said}): {change}, or use kinematic dynamics") from error

    def step(self, model: mjx.Model) -> Physics:
        """One step of `mjx.step`."""
        from arm5dof.runtime.mjx import mjx  # Half a second to import, and no other dynamics needs it.

        data = mjx.make_data(model).replace(**{name: getattr(self, name) for name in FIELDS})
        data = mjx.step(model, data)
        return Physics(**{name: getattr(data, name) for name in FIELDS})


FIELDS = tuple(Physics.__dataclass_fields__)
