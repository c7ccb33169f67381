"""Hand-eye calibration beside OpenCV's five methods, on drawn poses.

    python experiments/hand_eye.py OTHER_PYTHON        a few minutes; into experiments/results/hand_eye.md

OTHER_PYTHON is the interpreter of an environment with `opencv-python-headless<5`, which alone has `calibrateHandEye`. A
camera of 640 x 480 pixels on the hand sees a board of 9 x 6 corners from 15 poses; its corners are off by 0.2 pixels
along each axis, and the hand by the noise of the row about and along each axis. All methods get the same poses.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from arm5dof.runtime import files
from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.extrinsics import board_spread
from arm5dof.vision.calibration.hand_eye import eye_in_hand
from arm5dof.vision.calibration.views import board_pose
from arm5dof.vision.camera import Camera

TRIALS, POSES, CORNER_STD = 200, 15, 0.2
NOISE = {"perfect": (0.0, 0.0), "0.2 degrees, 1 mm": (0.2, 1.0), "0.5 degrees, 2 mm": (0.5, 2.0)}
METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
BOARD = Checkerboard(9, 6, 0.025)
CAMERA = Camera(
    np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.zeros(5), np.eye(3), np.zeros(3), 640, 480, False
)
RESULTS = Path(__file__).parent / "results"

OPENCV = f"""
import sys
import cv2
import numpy as np
given, found = np.load(sys.argv[1]), []
for hands, boards in zip(given["hands"], given["boards"]):
    parts = hands[:, :3, :3], hands[:, :3, 3], boards[:, :3, :3], boards[:, :3, 3]
    solve = lambda name: cv2.calibrateHandEye(*map(list, parts), method=getattr(cv2, "CALIB_HAND_EYE_" + name))
    found.append([np.c_[solve(name)] for name in {METHODS}])
np.savez(sys.argv[2], found=found, version=cv2.__version__)
"""


def pose(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A pose (4, 4) of a rotation vector and a shift."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return matrix


def trial(rng: np.random.Generator, degrees: float, millimetres: float) -> tuple[np.ndarray, np.ndarray, list[Corners]]:
    """The camera's pose on the hand, the hand's poses as it tells them, and what the camera sees."""
    camera = pose(Rotation.random(rng=rng).as_rotvec(), rng.uniform(-0.08, 0.08, 3))
    board = pose(Rotation.random(rng=rng).as_rotvec(), rng.uniform(-0.4, 0.4, 3))
    hands, seen = [], list[Corners]()
    while len(seen) < POSES:
        away = rng.uniform(0.3, 0.6)
        aside = rng.uniform(-0.25, 0.25, 2) * away
        there = pose(np.deg2rad(rng.uniform(-35, 35, 3)), np.array([*aside, away]))
        there = there @ pose(np.zeros(3), np.array([-0.1, -0.0625, 0]))
        pixels = cv2.projectPoints(BOARD.points, cv2.Rodrigues(there[:3, :3])[0], there[:3, 3], *CAMERA.opencv)[0][:, 0]
        if (pixels < 5).any() or (pixels > (634, 474)).any():
            continue
        pixels += CORNER_STD * rng.normal(size=pixels.shape)
        seen.append(Corners(BOARD.points, pixels.astype(np.float32)))
        error = pose(np.deg2rad(degrees) * rng.normal(size=3), 1e-3 * millimetres * rng.normal(size=3))
        hands.append(board @ np.linalg.inv(camera @ there) @ error)
    return camera, np.array(hands), seen


def row(name: str, python: str) -> tuple[str, str]:
    """One line of the table, and OpenCV's version."""
    drawn = [trial(np.random.default_rng(seed), *NOISE[name]) for seed in range(TRIALS)]
    cameras, hands = (np.array([one[k] for one in drawn]) for k in (0, 1))
    boards = np.array([[board_pose(CAMERA, corners) for corners in seen] for *_, seen in drawn])
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(given, hands=hands, boards=boards)
        subprocess.run([python, "-c", OPENCV, given, found], check=True)
        answer = np.load(found)
    poses = dict(zip(METHODS, answer["found"].swapaxes(0, 1), strict=True))
    spreads = [
        [board_spread(CAMERA, *both) for both in zip(d[2], b, strict=True)] for d, b in zip(drawn, boards, strict=True)
    ]
    ours = [eye_in_hand(*one) for one in zip(hands, boards, spreads, strict=True)]
    poses["ours"] = np.array([one.camera for one in ours])
    errors = {key: 1e3 * np.linalg.norm(each[:, :3, 3] - cameras[:, :3, 3], axis=1) for key, each in poses.items()}
    cells = " | ".join(f"{np.median(each):.3f} ({each.mean():.3f})" for each in errors.values())
    degrees, metres = np.median([one.noise[1:] for one in ours], axis=0)
    left_out = sum(len(one.outliers) for one in ours)
    return f"| {name} | {cells} | {np.rad2deg(degrees):.2f}, {1e3 * metres:.2f} | {left_out} |", str(answer["version"])


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python experiments/hand_eye.py OTHER_PYTHON")
    rows, versions = zip(*(row(name, sys.argv[1]) for name in NOISE), strict=True)
    lines = [
        "# Hand-eye calibration",
        "",
        f"How far the camera's place on the hand is off, mm: median (mean) of {TRIALS} drawn trials of {POSES} poses, "
        f"corners off by {CORNER_STD} pixels.",
        f"Beside OpenCV {versions[0]}'s five methods. The hand's noise is that about and along each axis; ours "
        "estimates it.",
        "Command: `python experiments/hand_eye.py OTHER_PYTHON`.",
        "",
        f"| hand's noise | {' | '.join(name.capitalize() for name in METHODS)} | ours | noise estimated: degrees, mm | "
        "poses left out |",
        f"| --- |{' ---: |' * (len(METHODS) + 3)}",
        *rows,
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    files.write_text(RESULTS / "hand_eye.md", text)


if __name__ == "__main__":
    main()
