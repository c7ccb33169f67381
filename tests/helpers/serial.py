"""Random serial arms."""

from __future__ import annotations

import mujoco
import numpy as np

HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE


def serial_arm(dof: int, seed: int, slides: bool = False, finger: bool = False) -> mujoco.MjSpec:
    """A random serial arm with `dof` limited joints and a site `ee` at its tip.

    Everything that MJCF leaves open is drawn at random: offsets, orientations, axes, anchors off the body's origin,
    reference positions, bodies without a joint and bodies with two. With `slides` at least one joint slides. With
    `finger` a joint that does not move `ee` comes first in `qpos` and another hangs on the last link.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    sliding = set(rng.choice(dof, rng.integers(1, max(2, dof)), replace=False)) if slides else set()

    body = spec.worldbody
    if finger:
        _finger(body.add_body(name="stand", pos=rng.normal(size=3)), "stand")
    for k in range(dof):
        if k == 0 or rng.random() < 0.8:
            if rng.random() < 0.25:
                body = _link(body, f"spacer_{k}", rng)
            body = _link(body, f"link_{k}", rng)
        middle, half = rng.uniform(-0.5, 0.5), rng.uniform(0.2, 2.5)
        body.add_joint(
            name=f"joint_{k}",
            type=SLIDE if k in sliding else HINGE,
            axis=_unit(rng, 3),
            pos=rng.uniform(-0.1, 0.1, 3),
            range=[middle - half, middle + half],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            ref=rng.uniform(-1, 1) if rng.random() < 0.5 else 0.0,
        )
        actuator = spec.add_actuator(
            name=f"servo_{k}", target=f"joint_{k}", trntype=mujoco.mjtTrn.mjTRN_JOINT, inheritrange=1.0
        )
        actuator.set_to_position(kp=100.0, kv=2.0)
    if finger:
        _finger(body.add_body(name="hand", pos=rng.normal(size=3)), "finger")
    body.add_site(name="ee", pos=rng.uniform(-0.1, 0.1, 3), quat=_unit(rng, 4))
    return spec


def _link(parent: mujoco.MjsBody, name: str, rng: np.random.Generator) -> mujoco.MjsBody:
    body = parent.add_body(name=name, pos=rng.uniform(-0.3, 0.3, 3), quat=_unit(rng, 4))
    body.add_geom(size=[0.02, 0, 0], mass=0.1)
    return body


def _finger(body: mujoco.MjsBody, name: str) -> None:
    body.add_geom(size=[0.01, 0, 0], mass=0.01)
    body.add_joint(name=name, type=SLIDE, axis=[0, 1, 0], range=[0, 0.03])


def _unit(rng: np.random.Generator, size: int) -> np.ndarray:
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)
