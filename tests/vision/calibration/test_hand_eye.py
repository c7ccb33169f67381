"""Hand-eye calibration against poses made with scipy, and against what no estimator can better."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from arm5dof.errors import UserError
from arm5dof.vision.calibration import robot_world
from arm5dof.vision.calibration.hand_eye import EQUAL_SPREAD, eye_in_hand, eye_to_hand

SEEDS = st.integers(0, 2**32 - 1)
EQUAL = np.array([EQUAL_SPREAD] * 15)


def pose(rotation, position):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    return matrix


def scene(rng, n=15, tilt=40):
    """A camera on the hand, a board, and n poses of both (n, 4, 4): the camera sees the board at 0.25 to 0.5 m,
    turned by up to `tilt` degrees about each axis."""
    camera = pose(Rotation.random(rng=rng), rng.uniform(-0.08, 0.08, 3))
    board = pose(Rotation.random(rng=rng), rng.uniform(-0.3, 0.3, 3))
    turns = Rotation.from_rotvec(np.deg2rad(rng.uniform(-tilt, tilt, (n, 3))))
    seen = np.array([pose(t, [*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.25, 0.5)]) for t in turns])
    return camera, board, board @ np.linalg.inv(camera @ seen), seen


def perturbed(poses, turns_deg, shifts_mm):
    """Poses (n, 4, 4) with rotation vectors and shifts (n, 3) added."""
    result = poses.copy()
    result[:, :3, :3] = Rotation.from_rotvec(np.deg2rad(turns_deg)).as_matrix() @ poses[:, :3, :3]
    result[:, :3, 3] += 1e-3 * shifts_mm
    return result


def directions(rng, n):
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def errors(found, true):
    """Millimetres and degrees."""
    turn = Rotation.from_matrix(found[:3, :3].T @ true[:3, :3]).magnitude()
    return 1e3 * np.linalg.norm(found[:3, 3] - true[:3, 3]), np.rad2deg(turn)


@settings(max_examples=10)
@given(SEEDS, st.integers(4, 20), st.sampled_from([25, 60, 170]))
def test_exact_poses_give_the_exact_answer(seed, n, tilt):
    camera, board, hands, seen = scene(np.random.default_rng(seed), n, tilt)
    result = eye_in_hand(hands, seen)
    np.testing.assert_allclose(result.camera, camera, atol=1e-9)
    np.testing.assert_allclose(result.board, board, atol=1e-9)
    assert result.rotation_deg < 1e-6 and result.translation_m < 1e-9


@settings(max_examples=5)
@given(SEEDS)
def test_a_camera_beside_the_arm(seed):
    """The hand carries the board: its pose is base <- camera <- board <- hand."""
    rng = np.random.default_rng(seed)
    camera, board, _, seen = scene(rng)
    result = eye_to_hand(camera @ seen @ np.linalg.inv(board), seen)
    np.testing.assert_allclose(result.camera, camera, atol=1e-9)
    np.testing.assert_allclose(result.board, board, atol=1e-9)


@pytest.mark.parametrize("noisy", ["board", "hand"])
def test_fifteen_noisy_poses_give_the_camera_to_a_millimetre(noisy):
    """Every pose is off by 0.2 degrees about a random axis and by 1 mm in a random direction."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        camera, _, hands, seen = scene(rng)
        turns, shifts = 0.2 * directions(rng, 15), directions(rng, 15)
        if noisy == "board":
            seen = perturbed(seen, turns, shifts)
        else:
            hands = perturbed(hands, turns, shifts)
        found.append(errors(robot_world.solve(hands, seen, EQUAL, on_hand=True).x, camera))
    millimetres, degrees = np.median(found, axis=0)
    assert millimetres <= 1 and degrees <= 0.1


def test_nobody_could_do_better():
    """With Gaussian noise of 0.2 degrees and 1 mm along each axis the errors are those of the Cramer-Rao bound, from a
    Jacobian by finite differences; and the deviations that are reported say how large they are."""
    found, bound, scores = [], [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        camera, board, hands, seen = scene(rng)
        noise = rng.normal(size=(2, 15, 3))
        result = robot_world.solve(hands, perturbed(seen, 0.2 * noise[0], noise[1]), EQUAL, on_hand=True)
        found.append(errors(result.x, camera))

        def measured(step, hands=hands, camera=camera, board=board, seen=seen):
            moves = [pose(Rotation.from_rotvec(np.deg2rad(s[:3])), 1e-3 * s[3:]) for s in (step[:6], step[6:])]
            explained = np.linalg.inv(hands @ camera @ moves[0]) @ board @ moves[1]
            turn = Rotation.from_matrix(explained[:, :3, :3] @ seen[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
            return np.c_[np.rad2deg(turn) / 0.2, 1e3 * (explained[:, :3, 3] - seen[:, :3, 3])].ravel()

        jacobian = np.array([(measured(s) - measured(-s)) / 2e-3 for s in 1e-3 * np.eye(12)]).T
        least = np.linalg.inv(jacobian.T @ jacobian)[:6, :6]
        draws = rng.multivariate_normal(np.zeros(6), least, 50)
        bound.append([np.linalg.norm(draws[:, 3:], axis=1), np.linalg.norm(draws[:, :3], axis=1)])
        turn = Rotation.from_matrix(camera[:3, :3].T @ result.x[:3, :3]).as_rotvec()
        shift = camera[:3, :3].T @ (result.x[:3, 3] - camera[:3, 3])
        scores.append(np.r_[turn, shift] / np.sqrt(np.diag(result.covariance))[:6])
    best = np.median(np.array(bound), axis=(0, 2))
    np.testing.assert_allclose(np.median(found, axis=0), best, rtol=0.12)
    np.testing.assert_allclose(np.sqrt(np.square(scores).mean(0)), 1, atol=0.2)


def test_degenerate_motions_are_refused():
    rng = np.random.default_rng(0)
    camera, board, hands, seen = scene(rng)
    with pytest.raises(UserError, match="3 poses: hand-eye calibration takes 4"):
        eye_in_hand(hands[:3], seen[:3])
    with pytest.raises(UserError, match="15 poses of the hand and 14 of the board"):
        eye_in_hand(hands, seen[:14])

    axis = np.array([0.6, 0, 0.8])
    for turns in (rng.uniform(-1, 1, (15, 1)) * axis, np.zeros((15, 3))):
        parallel = np.array([pose(Rotation.from_rotvec(t), rng.uniform(-0.2, 0.2, 3)) for t in turns])
        looks = np.linalg.inv(parallel @ camera) @ board
        shaken = perturbed(looks, 0.2 * directions(rng, 15), directions(rng, 15))
        for function, arms in ((eye_in_hand, parallel), (eye_to_hand, np.linalg.inv(parallel))):
            for boards in (looks, shaken):
                with pytest.raises(UserError, match="about parallel axes only") as caught:
                    function(arms, boards)
                assert "\n" not in str(caught.value)


def test_poses_that_cannot_be_are_refused():
    _, _, hands, seen = scene(np.random.default_rng(1))
    for wrong_hands, wrong_seen in ((hands, seen[::-1]), (hands, np.linalg.inv(seen))):
        with pytest.raises(UserError, match="contradict each other"):
            eye_in_hand(wrong_hands, wrong_seen)
    millimetres = hands.copy()
    millimetres[:, :3, 3] *= 1000
    with pytest.raises(UserError, match=r"pose 1 of the hand is \d+ m away: give metres"):
        eye_in_hand(millimetres, seen)
    for far in (4294967296.0, 1e300):  # A digit too many in one cell.
        away = hands.copy()
        away[2, 1, 3] = far
        with pytest.raises(UserError, match=r"pose 3 of the hand is \S+ m away: give metres"):
            eye_in_hand(away, seen)
    for change in (np.diag([1, 1, -1, 1.0]), np.diag([2, 1, 1, 1.0]), np.full((4, 4), np.nan)):
        broken = hands.copy()
        broken[2] = broken[2] @ change
        with pytest.raises(UserError, match=r"pose 3 of the hand is no|the hand's poses are not finite"):
            eye_in_hand(broken, seen)
    with pytest.raises(UserError, match="shape"):
        eye_in_hand(hands[:, :3], seen)


NOISE = [(0, 0), (0.2, 1), (0.5, 2)]
"""Of the hand, about and along each axis: degrees and millimetres."""


def shaken(rng, hands, degrees, millimetres):
    turns = degrees * rng.normal(size=(len(hands), 3))
    return perturbed(hands, turns, millimetres * rng.normal(size=(len(hands), 3)))


@pytest.mark.parametrize("noise", NOISE, ids=str)
def test_the_other_mount_is_suggested(noise):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        camera, board, hands, seen = scene(rng, 8)
        with pytest.raises(UserError, match=r"contradict .* if the camera is on the hand \(eye in hand\)"):
            eye_to_hand(shaken(rng, hands, *noise), seen)
        held = shaken(rng, camera @ seen @ np.linalg.inv(board), *noise)
        with pytest.raises(UserError, match=r"contradict .* if the camera is beside the arm \(eye to hand\)"):
            eye_in_hand(held, seen)


@pytest.mark.parametrize("noise", NOISE, ids=str)
@pytest.mark.parametrize("n", [6, 15])
def test_the_wrong_pose_is_named_and_left_out(noise, n):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        _, _, hands, seen = scene(rng, n)
        hands = shaken(rng, hands, *noise)
        right = eye_in_hand(hands, seen)
        assert not right.outliers
        wrong = hands.copy()
        wrong[seed, :3, 3] += [0.1, -0.05, 0]
        wrong[seed, :3, :3] = wrong[seed, :3, :3] @ Rotation.from_rotvec([0, 0.2, 0]).as_matrix()
        found = eye_in_hand(wrong, seen)
        assert list(found.outliers) == [seed] and found.outliers[seed][0] > 3
        rest = np.arange(n) != seed
        np.testing.assert_allclose(found.camera, eye_in_hand(hands[rest], seen[rest]).camera, atol=1e-4)
        if n == 15:
            wrong = hands.copy()
            wrong[[4, 5]] = wrong[[5, 4]]
            assert list(eye_in_hand(wrong, seen).outliers) == [4, 5]


def test_the_noise_of_the_hand_is_estimated():
    estimates = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        _, _, hands, seen = scene(rng)
        tiny = np.diag(np.square([1e-4] * 3 + [1e-4] * 3))
        estimates.append(eye_in_hand(shaken(rng, hands, 0.3, 2), seen, [tiny] * 15).noise[1:])
    np.testing.assert_allclose(np.median(estimates, axis=0), [np.deg2rad(0.3), 2e-3], rtol=0.15)
