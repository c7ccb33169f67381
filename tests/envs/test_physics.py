"""The state of the physics: enough to go on from."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arm5dof.arm import Arm, load_arm
from arm5dof.envs.physics import FIELDS, Physics
from arm5dof.errors import UserError
from arm5dof.runtime.mjx import mjx

MOVING = """
<mujoco>
  <worldbody>
    <body name="target" mocap="true" pos="0.1 0.2 0.3"/>
    <body pos="0.3 0 0.3">
      <joint name="turn" axis="0 0 1" range="-1 1" limited="true" damping="0.1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0"/>
      <site name="ee" pos="0.2 0 0"/>
    </body>
    <body pos="0 0 0.5"><freejoint/><geom size="0.03"/></body>
  </worldbody>
  <actuator>
    <position joint="turn" kp="50" timeconst="0.1" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
  <option{option}/>
</mujoco>
"""


def moving(option: str = "") -> Arm:
    """An arm whose actuator has a state of its own, and a ball that falls."""
    return load_arm(mujoco.MjSpec.from_string(MOVING.replace("{option}", option)))


def test_at_rest_is_as_mjx_has_it():
    model = moving().mj_model
    data = mjx.make_data(model)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(Physics.at_rest(model), name), getattr(data, name))


def test_nothing_is_lost_between_steps():
    """Each step leads where it does when all of `mjx.Data` is carried along, through actuator states."""
    arm = moving()
    ctrl = jnp.linspace(-1, 1, 300)

    def carried(data: mjx.Data, ctrl: jax.Array) -> tuple[mjx.Data, Physics]:
        data = mjx.step(arm.mjx_model, data.replace(ctrl=jnp.full(1, ctrl)))
        return data, Physics(**{name: getattr(data, name) for name in FIELDS})

    whole = jax.jit(lambda: jax.lax.scan(carried, mjx.make_data(arm.mjx_model), ctrl)[1])()
    before, after = (jax.tree.map(lambda x, part=part: x[part], whole) for part in (slice(0, -1), slice(1, None)))
    step = jax.jit(jax.vmap(lambda state, ctrl: state.replace(ctrl=jnp.full(1, ctrl)).step(arm.mjx_model)))
    found = step(before, ctrl[1:])
    for name in FIELDS:
        scale = np.abs(getattr(after, name)).max()
        np.testing.assert_allclose(getattr(found, name), getattr(after, name), atol=1e-5 * scale, rtol=0, err_msg=name)
    assert np.ptp(after.act) > 0.1
    assert np.ptp(after.qpos[:, 0]) > 0.1
    assert after.qpos[-1, 3] < 0.1


def test_what_mjx_cannot_simulate_is_said():
    arm = moving(' integrator="implicit"')
    assert np.isfinite(arm.forward(jnp.zeros(1))).all()
    with pytest.raises(UserError, match="MJX cannot simulate this model"):
        _ = arm.mjx_model
