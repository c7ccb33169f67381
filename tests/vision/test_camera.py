"""Cameras against OpenCV's own projection and against what MuJoCo's rays hit."""

import cv2
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from arm5dof.errors import UserError
from arm5dof.vision.camera import Camera

WIDTH, HEIGHT = 640, 480
SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def random_camera(rng, coefficients):
    """Distortion such as lenses have: the corners of the image move by up to some 60 pixels."""
    scale = np.array([0.25, 0.08, 2e-3, 2e-3, 0.03, 0.1, 0.03, 0.01])[:coefficients]
    focal = rng.uniform(450, 900)
    rotation, _ = cv2.Rodrigues(rng.uniform(-2, 2, 3))
    return Camera(
        matrix=np.array([[focal, 0, rng.uniform(300, 340)], [0, focal * rng.uniform(0.95, 1.05), 240], [0, 0, 1]]),
        distortion=scale * rng.uniform(-1, 1, coefficients),
        rotation=rotation,
        position=rng.uniform(-1, 1, 3),
        width=WIDTH,
        height=HEIGHT,
    )


def points_in_view(rng, camera, n=50):
    """Points (n, 3) of the base frame, 0.1 to 3 m deep, that an undistorted image would show."""
    depth = rng.uniform(0.1, 3, n)
    ideal = np.c_[rng.uniform(0, WIDTH, n), rng.uniform(0, HEIGHT, n), np.ones(n)]
    return depth[:, None] * (ideal @ np.linalg.inv(camera.matrix).T) @ camera.rotation.T + camera.position, depth


@given(SEEDS, st.sampled_from([4, 5, 8]))
def test_projects_and_undistorts_as_opencv_does(seed, coefficients):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, coefficients)
    points, depth = points_in_view(rng, camera)
    turn, _ = cv2.Rodrigues(camera.rotation.T)
    shift = -camera.rotation.T @ camera.position
    expected, _ = cv2.projectPoints(points, turn, shift, camera.matrix, camera.distortion)
    pixels = camera.project(points)
    assert pixels.dtype == jnp.float64
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-8)
    np.testing.assert_allclose(camera.to_camera(points)[:, 2], depth, atol=1e-12)

    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    expected = cv2.undistortPoints(expected, camera.matrix, camera.distortion, P=camera.matrix, criteria=exact)
    np.testing.assert_allclose(camera.undistort(pixels), expected[:, 0], atol=1e-5)


@given(SEEDS, st.sampled_from([4, 5, 8]))
def test_back_projection_undoes_projection(seed, coefficients):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, coefficients)
    points, depth = points_in_view(rng, camera)
    pixels = camera.project(points)
    np.testing.assert_allclose(camera.back_project(pixels, depth), points, atol=1e-6)
    rays = np.asarray(camera.rays(pixels))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    away = points - camera.position
    np.testing.assert_allclose(rays, away / np.linalg.norm(away, axis=-1, keepdims=True), atol=1e-6)


def test_float32_is_good_to_a_tenth_of_a_millimetre():
    rng = np.random.default_rng(0)
    camera = random_camera(rng, 5)
    points, depth = points_in_view(rng, camera)
    with jax.enable_x64(False):
        pixels = camera.project(points)
        again = camera.back_project(pixels, depth)
    assert pixels.dtype == jnp.float32
    np.testing.assert_allclose(again, points, atol=1e-4)


def test_batches_jit_and_cameras_under_vmap():
    rng = np.random.default_rng(1)
    cameras = [random_camera(rng, 5) for _ in range(3)]
    points, depth = points_in_view(rng, cameras[0], 24)
    grid = points.reshape(2, 3, 4, 3)
    pixels = jax.jit(Camera.project)(cameras[0], grid)
    assert pixels.shape == (2, 3, 4, 2)
    np.testing.assert_allclose(pixels.reshape(-1, 2), cameras[0].project(points), atol=1e-9)
    assert cameras[0].back_project(pixels, depth.reshape(2, 3, 4)).shape == grid.shape
    assert cameras[0].rays(pixels[0, 0, 0]).shape == (3,)

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    together = jax.vmap(Camera.project, (0, None))(stacked, points)
    for camera, one in zip(cameras, together, strict=True):
        np.testing.assert_allclose(one, camera.project(points), atol=1e-9)


def test_gradients_are_those_of_finite_differences():
    rng = np.random.default_rng(2)
    camera = random_camera(rng, 8)
    points, depth = points_in_view(rng, camera, 5)
    pixels = np.array(camera.project(points))
    check_grads(camera.project, (points,), order=1, modes=("rev",), rtol=1e-4)
    check_grads(lambda p: camera.back_project(p, depth), (pixels,), order=1, modes=("rev",), rtol=1e-4)
    lens = lambda d: camera.replace(distortion=d).rays(pixels)
    check_grads(lens, (camera.distortion,), order=1, modes=("rev",), rtol=1e-4)


def test_what_cannot_be_seen_is_nan():
    camera = random_camera(np.random.default_rng(3), 5)
    behind = camera.position - camera.rotation[:, 2]
    assert np.isnan(camera.project(behind)).all() and np.isnan(camera.project(camera.position)).all()
    front = np.array(camera.position + camera.rotation[:, 2])
    gradient = jax.grad(lambda p: jnp.nansum(camera.project(p)))(np.stack([front, behind]))
    assert np.isfinite(gradient).all() and gradient[0].any()
    # k1 = -0.3 alone reaches no further than 0.70 from the center of the image plane at depth 1.
    barrel = camera.replace(distortion=np.array([-0.3, 0, 0, 0]))
    focal, center = camera.matrix[0, 0], camera.matrix[:2, 2]
    assert np.isfinite(barrel.rays(center + np.array([0.69 * focal, 0]))).all()
    for beyond in (0.71, 1, 1.7, 3):
        assert np.isnan(barrel.rays(center + np.array([beyond * focal, 0]))).all()
        assert np.isnan(barrel.undistort(center + np.array([beyond * focal, 0]))).all()


@given(SEEDS, st.sampled_from([4, 5, 8]))
def test_perturbed_cameras_are_as_opencv_and_scipy_make_them(seed, coefficients):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, coefficients)
    lens, turn, shift = rng.normal(size=4), 0.01 * rng.normal(size=3), 0.01 * rng.normal(size=3)
    bent = 0.01 * rng.normal(size=coefficients)
    other = camera.perturbed(np.concatenate([lens, bent, turn, shift]))
    points, _ = points_in_view(rng, camera)
    matrix = camera.matrix + np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 0]])
    rotation = camera.rotation @ Rotation.from_rotvec(turn).as_matrix()
    position = camera.position + camera.rotation @ shift
    to_camera, _ = cv2.Rodrigues(rotation.T)
    expected, _ = cv2.projectPoints(points, to_camera, -rotation.T @ position, matrix, camera.distortion + bent)
    np.testing.assert_allclose(other.project(points), expected[:, 0], atol=0.02)
    # What the turn leaves out is of the third order.
    np.testing.assert_allclose(other.rotation, rotation, atol=np.linalg.norm(turn) ** 3)
    np.testing.assert_allclose(other.position, position, atol=1e-12)


@pytest.mark.parametrize("count", [0, 3, 6, 12, 14])
def test_other_numbers_of_coefficients_are_refused(count):
    with pytest.raises(UserError, match=f"^{count} distortion coefficients: give 4, 5 or 8"):
        random_camera(np.random.default_rng(0), 5).replace(distortion=np.zeros(count))


SCENE = """
<mujoco>
  <worldbody>
    <camera name="eye" pos="0.5 -0.3 0.7" xyaxes="0.6 0.8 0.05 -0.5 0.3 0.9" fovy="52"/>
    <body name="moves" pos="0.1 0.2 0.3"><joint type="hinge" axis="0 0 1"/><geom size="0.01"/>
      <camera name="hand" pos="0.1 0 0" euler="20 130 40" fovy="70"/></body>
    <camera name="sensor" pos="0 0 1" sensorsize="0.004 0.003" focal="0.005 0.005" resolution="640 480"/>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("name", ["eye", "hand"])
def test_mujoco_rays_hit_the_geom_whose_center_is_projected(name):
    """Small balls at random pixels and depths: MuJoCo's ray through each ball's pixel meets that ball, at its depth.

    Which pixels is settled by MuJoCo's own frustum: half the image's height is tan(fovy / 2) at depth 1."""
    rng = np.random.default_rng(4)
    spec = mujoco.MjSpec.from_string(SCENE)
    bare = spec.compile()
    data = mujoco.MjData(bare)
    data.qpos[0] = 0.7
    mujoco.mj_forward(bare, data)
    place, frame = data.camera(name).xpos, data.camera(name).xmat.reshape(3, 3)
    half = np.tan(np.deg2rad(bare.camera(name).fovy[0]) / 2)
    right, up = rng.uniform(-1, 1, (2, 40)) * [[WIDTH / HEIGHT], [1]]
    depth = rng.uniform(0.3, 2, 40)
    centers = place + depth[:, None] * (np.c_[half * right, half * up, -np.ones(40)] @ frame.T)
    for center in centers:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], pos=center)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.7
    mujoco.mj_forward(model, data)
    camera = Camera.from_mujoco(model, name, WIDTH, HEIGHT, data)

    pixels = np.array(camera.project(centers))
    expected = np.c_[(WIDTH - 1) / 2 + right * HEIGHT / 2, (HEIGHT - 1) / 2 - up * HEIGHT / 2]
    np.testing.assert_allclose(pixels, expected, atol=1e-8)
    balls = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 0]
    assert len(balls) == 40
    hits = 0
    for ball, ray, center in zip(balls, np.array(camera.rays(pixels)), centers, strict=True):
        hit = np.array([-1], np.int32)
        distance = mujoco.mj_ray(model, data, camera.position, ray, None, 1, -1, hit)
        if hit[0] != ball:  # Something nearer is in the way, and only then.
            assert 0 < distance < np.linalg.norm(center - camera.position) - 2e-3
            continue
        assert distance == pytest.approx(np.linalg.norm(center - camera.position) - 1e-3, abs=1e-6)
        hits += 1
    assert hits > 35
    # Without data the model is at rest, where the camera on the moving body stands elsewhere.
    moved = np.linalg.norm(Camera.from_mujoco(model, name, WIDTH, HEIGHT).position - camera.position)
    assert moved == 0 if name == "eye" else moved > 0.05


def test_mujoco_cameras_by_sensor_size_and_by_name():
    model = mujoco.MjModel.from_xml_string(SCENE)
    camera = Camera.from_mujoco(model, "sensor", WIDTH, HEIGHT)
    # 0.005 m focal length over 0.004 / 640 m pixels.
    np.testing.assert_allclose(np.diag(camera.matrix), [800, 800, 1])
    fovy = model.camera("sensor").fovy[0]
    assert HEIGHT / (2 * np.tan(np.deg2rad(fovy) / 2)) == pytest.approx(camera.matrix[1, 1], rel=1e-6)
    with pytest.raises(UserError, match="no camera 'nose'; it has: eye, sensor, hand"):
        Camera.from_mujoco(model, "nose", WIDTH, HEIGHT)


def test_opencvs_own_file(test_data):
    camera = Camera.load(test_data / "vision/checkerboard/left_intrinsics.yml")
    assert (camera.width, camera.height, camera.has_extrinsics) == (640, 480, False)
    assert camera.matrix[0, 0] == 535.91573396163199 and camera.distortion[4] == 0.23839153080878486
    assert (camera.rotation == np.eye(3)).all() and not camera.position.any()


@pytest.mark.parametrize("coefficients", [4, 5, 8])
def test_files_lose_nothing(coefficients, tmp_path):
    camera = random_camera(np.random.default_rng(5), coefficients)
    camera.save(tmp_path / "camera.yml", {"avg_reprojection_error": 0.2, "board": "9x6"})
    again = Camera.load(tmp_path / "camera.yml")
    jax.tree.map(np.testing.assert_array_equal, camera, again)
    assert again.has_extrinsics and again.covariance is None
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("image_width").real() == WIDTH
    assert (storage.getNode("camera_matrix").mat() == camera.matrix).all()
    assert (storage.getNode("distortion_coefficients").mat().ravel() == camera.distortion).all()
    camera.replace(has_extrinsics=False).save(tmp_path / "bare.yml")
    assert not Camera.load(tmp_path / "bare.yml").has_extrinsics


def test_files_keep_the_covariance_and_the_pose_on_a_hand(tmp_path):
    rng = np.random.default_rng(6)
    camera = random_camera(rng, 5)
    factor = rng.normal(size=(15, 15)) * np.array([*[0.5] * 4, *[0.01] * 5, *[1e-4] * 6])
    known = camera.replace(covariance=factor.T @ factor)
    known.save(tmp_path / "known.yml")
    np.testing.assert_array_equal(Camera.load(tmp_path / "known.yml").covariance, known.covariance)

    notes = {"hand_rotation": camera.rotation, "hand_position": camera.position.reshape(3, 1)}
    known.replace(has_extrinsics=False).save(tmp_path / "hand.yml", notes)
    assert not Camera.load(tmp_path / "hand.yml").has_extrinsics
    hand = np.eye(4)
    hand[:3, :3], hand[:3, 3] = Rotation.from_rotvec([0.3, -1, 2]).as_matrix(), [0.2, 0.1, 0.3]
    posed = Camera.load(tmp_path / "hand.yml", hand)
    assert posed.has_extrinsics and (posed.covariance == known.covariance).all()
    np.testing.assert_allclose(posed.rotation, hand[:3, :3] @ camera.rotation, atol=1e-15)
    np.testing.assert_allclose(posed.position, hand[:3, :3] @ camera.position + hand[:3, 3], atol=1e-15)
    with pytest.raises(UserError, match="has no hand_rotation: this camera was not calibrated on a hand"):
        Camera.load(tmp_path / "known.yml", hand)


def test_files_that_are_no_cameras_are_one_line(tmp_path):
    path = tmp_path / "camera.yml"

    def said():
        with pytest.raises(UserError) as caught:
            Camera.load(path)
        return str(caught.value)

    for content in (b"", b"hello", b"%YAML:1.0\n---\nx: [1", b"\xff\xfe\x00", b"\x89PNG"):
        path.write_bytes(content)
        assert "is no camera file" in said()

    matrix = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]])
    good = {
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": matrix,
        "distortion_coefficients": np.zeros(5),
        "camera_rotation": np.eye(3),
        "camera_position": np.zeros(3),
    }

    def write(**changes):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in {**good, **changes}.items():
            if value is not None:
                storage.write(name, value)
        storage.release()

    write()
    assert (Camera.load(path).matrix == matrix).all()
    whole = path.read_text()
    for line, other in (("rows: 3", "rows: 2"), ("rows: 3", "# 3"), ("cols: 3", "cols: 4"), ("500., 0.", "500.")):
        path.write_text(whole.replace(line, other, 1))  # OpenCV would write beyond its memory.
        assert "has no camera_matrix of the right size" in said()
    for changes, expected in [
        ({"camera_matrix": None}, "no camera_matrix"),
        ({"camera_matrix": 3.0}, "no camera_matrix"),
        ({"camera_matrix": matrix[:2]}, "no camera_matrix"),
        ({"camera_matrix": -matrix}, "not of the form"),
        ({"camera_matrix": matrix.T}, "not of the form"),
        ({"camera_matrix": matrix * np.nan}, "not finite"),
        ({"image_width": 0}, "no image_width"),
        ({"image_height": "wide"}, "no image_height"),
        ({"image_height": 4.5}, "no image_height"),
        ({"distortion_coefficients": np.zeros(6)}, "6 distortion_coefficients: give 4, 5 or 8"),
        ({"camera_rotation": np.diag([1, 1, -1.0])}, "no rotation matrix"),
        ({"camera_rotation": 1.001 * np.eye(3)}, "no rotation matrix"),
        ({"camera_position": None}, "no camera_position"),
        ({"camera_covariance": np.eye(14)}, "no camera_covariance"),
        ({"camera_covariance": -np.eye(15)}, "no covariance matrix"),
        ({"camera_covariance": np.tri(15)}, "no covariance matrix"),
    ]:
        write(**changes)
        assert expected in said()
    with pytest.raises(FileNotFoundError):
        Camera.load(tmp_path / "absent.yml")
