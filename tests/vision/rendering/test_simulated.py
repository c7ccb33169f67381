"""The simulated camera against rays that MuJoCo casts, its own OpenGL pictures, and our camera model."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.camera import Camera
from arm5dof.vision.rendering import opengl
from arm5dof.vision.rendering.simulated import simulated_camera

WIDTH, HEIGHT = 160, 120

ROOM = """
<mujoco>
  <statistic extent="1"/>
  <visual><map znear="0.02" zfar="30"/><quality offsamples="0" shadowsize="2048" numquads="8"/></visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2="0 0 .1" width="64" height="64"/>
    <texture name="flat" type="2d" builtin="checker" rgb1=".8 .7 .6" rgb2=".6 .6 .5" width="64" height="64"/>
    <texture name="cube" type="cube" builtin="gradient" rgb1="1 1 .5" rgb2=".2 .2 .6" width="64" height="64"/>
    <material name="flat" texture="flat" texrepeat="5 3"/>
    <material name="uniform" texture="flat" texrepeat="5 3" texuniform="true" specular=".8" shininess=".7"/>
    <material name="cube" texture="cube" emission=".2"/>
    <mesh name="wedge" vertex="0 0 0  .2 0 0  0 .2 0  0 0 .2"/>
  </asset>
  <worldbody>
    <light pos=".4 -.5 1.5" dir="-.2 .3 -1" cutoff="60" exponent="3" diffuse=".5 .5 .4" specular=".4 .4 .4"/>
    <light type="directional" dir=".3 .2 -1" diffuse=".3 .3 .4" castshadow="false"/>
    <geom type="plane" size="4 3 .05" pos="0 0 -.4" material="uniform"/>
    <geom type="box" size=".5 .4 .02" pos="0 0 -.02" material="flat"/>
    <geom type="box" size=".05 .03 .04" pos=".2 .1 .04" euler="0 0 30" material="cube"/>
    <geom type="sphere" size=".05" pos="-.1 .15 .05" rgba=".9 .1 .1 1"/>
    <geom type="capsule" size=".02 .06" pos="-.2 -.1 .1" euler="70 0 20" rgba=".1 .7 .1 1"/>
    <geom type="cylinder" size=".03 .05" pos=".05 -.1 .05" euler="10 5 0" rgba=".2 .3 .9 1"/>
    <geom type="ellipsoid" size=".07 .03 .02" pos=".1 .25 .03" euler="0 0 50" material="cube"/>
    <geom type="mesh" mesh="wedge" pos="-.25 .1 0" rgba=".8 .8 .2 1"/>
    <geom type="box" size="2 .3 .1" pos="0 -1 -.3" rgba=".5 .5 .5 1"/>
    <camera name="view" pos=".1 -.9 .5" xyaxes="1 .1 0 -.05 .5 .85" fovy="45"/>
    <camera name="sensor" pos=".3 -.5 .9" xyaxes="1 .3 0 -.2 .7 .6" focal=".004 .005" sensorsize=".004 .003"
            resolution="160 120"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def room():
    model = mujoco.MjModel.from_xml_string(ROOM)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(scope="module")
def needs_gl():
    if opengl.working_library() is None:
        pytest.skip(f"no OpenGL works here: { ({name: opengl.problem(name) for name in opengl.candidates()}) }")


def cast(model, data, camera):
    """Depth (h, w) and geom ids (h, w) by `mj_multiRay`, in the directions that our camera model gives."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1)
    rays = np.asarray(camera.rays(pixels), float).reshape(-1, 3)
    ids, distance = np.empty(len(rays), np.int32), np.empty(len(rays))
    every = np.ones(6, np.uint8)
    mujoco.mj_multiRay(model, data, camera.position, rays.ravel(), every, 1, -1, ids, distance, None, len(rays), 1e3)
    depth = np.where(ids >= 0, distance * (rays @ camera.rotation[:, 2]), np.inf)
    return depth.reshape(pixels.shape[:2]), ids.reshape(pixels.shape[:2])


@pytest.mark.parametrize("name", ["view", "sensor"])
@pytest.mark.parametrize("back_end", ["software", "gl"])
def test_depth_and_segmentation_are_what_rays_meet(room, name, back_end, request):
    if back_end == "gl":
        request.getfixturevalue("needs_gl")
    model, data = room
    simulated = simulated_camera(model, name, WIDTH, HEIGHT, back_end)
    depth, ids = simulated.depth(data), simulated.segmentation(data)
    expected, geoms = cast(model, data, Camera.from_mujoco(model, name, WIDTH, HEIGHT, data))
    assert depth.dtype == np.float32 and ids.dtype == np.int32
    assert set(np.unique(geoms)) == set(np.unique(ids))
    same = ids == geoms  # Round things are polygons in a picture, so a few pixels on their edges differ.
    assert same.mean() > 0.995
    np.testing.assert_array_equal(np.isinf(depth), ids == -1)
    solid = same & (ids >= 0)
    error = np.abs(depth[solid] - expected[solid])
    assert np.median(error) < 1e-5 and np.quantile(error, 0.99) < 1e-3 and error.max() < 0.01


@pytest.mark.parametrize("name", ["view", "sensor"])
def test_software_draws_what_opengl_draws(room, name, needs_gl):
    model, data = room
    ours, theirs = (simulated_camera(model, name, WIDTH, HEIGHT, b) for b in ("software", "gl"))
    assert (ours.segmentation(data) == theirs.segmentation(data)).mean() > 0.999
    error = np.abs(ours.rgb(data).astype(int) - theirs.rgb(data))
    # Where they differ it is at the edges of shadows, where OpenGL has steps, and where textures are fine.
    assert error.mean() < 2 and (error.max(-1) > 16).mean() < 0.03


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_small_objects_are_seen_where_the_camera_model_projects_them(seed):
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    points = rng.uniform([-0.3, -0.3, -0.2], [0.3, 0.3, 0.2], (5, 3))
    for point in points:
        spec.worldbody.add_geom(size=[0.01, 0, 0], pos=point)
    quaternion = rng.normal(size=4) * [1, 0.1, 0.1, 0.1]
    spec.worldbody.add_camera(name="camera", pos=[0, 0, 1.2], quat=quaternion, fovy=rng.uniform(35, 60))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ids = simulated_camera(model, "camera", 640, 480, "software").segmentation(data)
    projected = np.asarray(Camera.from_mujoco(model, "camera", 640, 480, data).project(points))
    for geom, (u, v) in enumerate(projected):
        rows, columns = np.nonzero(ids == geom)
        inside = 12 < u < 627 and 12 < v < 467
        if inside and np.count_nonzero(ids == geom) > 40 and not _touches(ids, geom):
            np.testing.assert_allclose([columns.mean(), rows.mean()], [u, v], atol=0.3)


def _touches(ids, geom):
    """Whether the outline of a geom borders on another one's."""
    mask = ids == geom
    grown = np.zeros_like(mask)
    for axis in (0, 1):
        for shift in (-1, 1):
            grown |= np.roll(mask, shift, axis)
    return (grown & (ids != geom) & (ids >= 0)).any()


def test_the_same_scene_gives_the_same_bits(room):
    model, data = room
    first, again = (simulated_camera(model, "view", WIDTH, HEIGHT, "software") for _ in range(2))
    np.testing.assert_array_equal(first.rgb(data), again.rgb(data))
    np.testing.assert_array_equal(first.rgb(data), first.rgb(data))


def test_an_empty_scene_is_dark_and_infinitely_far():
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><camera name="c"/></worldbody></mujoco>')
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = simulated_camera(model, "c", 8, 6, "software")
    assert not camera.rgb(data).any() and np.isinf(camera.depth(data)).all()
    assert (camera.segmentation(data) == -1).all()


def test_shadows_fall_where_the_light_is_hidden(room):
    """In a picture by one lamp, the points of the table that are dark are those from which it cannot be seen."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    spec.worldbody.add_light(pos=[0.3, 0.2, 1], dir=[-0.3, -0.2, -1], cutoff=80, exponent=0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.5, 0.01], pos=[0, 0, -0.01])
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.08, 0.03], pos=[0, 0, 0.1])
    spec.worldbody.add_camera(name="camera", pos=[-0.6, 0, 0.6], xyaxes=[0, -1, 0, 0.7, 0, 0.7])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    simulated = simulated_camera(model, "camera", WIDTH, HEIGHT, "software")
    camera = Camera.from_mujoco(model, "camera", WIDTH, HEIGHT, data)
    table = simulated.segmentation(data) == 0
    rows, columns = np.nonzero(table)
    points = np.asarray(camera.back_project(np.c_[columns, rows], simulated.depth(data)[table]), float)
    lamp = data.light_xpos[0].copy()
    hit = np.zeros(1, np.int32)
    hidden = []
    for point in points:
        mujoco.mj_ray(model, data, lamp, point - lamp, None, 1, -1, hit)
        hidden.append(hit[0] == 1)
    dark = simulated.rgb(data)[table].max(-1) < 40
    assert 300 < np.sum(hidden) < 0.3 * len(points)
    assert (dark == hidden).mean() > 0.99


@pytest.mark.parametrize(
    "arguments, says",
    [
        (("nobody",), "no camera 'nobody'; it has: view, sensor"),
        (("view", 0, 10), "at least one pixel"),
        (("view", 10, 10, "vulkan"), "no back end 'vulkan'"),
    ],
)
def test_bad_requests_are_refused(room, arguments, says):
    with pytest.raises(UserError, match=says):
        simulated_camera(room[0], *arguments)


def test_what_software_cannot_draw_is_named():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><hfield name="h" nrow="4" ncol="4" size="1 1 1 1"/></asset><worldbody>'
        '<geom type="hfield" hfield="h"/><camera name="c" pos="0 0 3"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.raises(UserError, match="draws no hfield"):
        simulated_camera(model, "c", 8, 6, "software").rgb(data)


def in_another_process(program, **environment):
    clean = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    root = str(files.PACKAGE.parent)
    return subprocess.run(
        [sys.executable, "-c", program],
        env={**clean, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_broken_opengl_is_noticed_in_another_process_and_software_draws(tmp_path):
    """A libEGL that ends the process when it is loaded: `auto` must survive it."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("import os; os._exit(7)\n")
    program = (
        "import mujoco\n"
        "from arm5dof.vision.rendering import opengl\n"
        "from arm5dof.vision.rendering.simulated import simulated_camera\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><camera name=\"c\"/></worldbody></mujoco>')\n"
        "print(type(simulated_camera(model, 'c', 8, 6)).__name__, opengl.problem('egl'))\n"
    )
    path = os.pathsep.join([str(files.PACKAGE.parent), str(tmp_path)])
    done = in_another_process(program, PYTHONPATH=path, DISPLAY="")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[0] == "SoftwareRenderer"
    assert "status 7" in done.stdout
