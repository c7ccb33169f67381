"""Whether calibration knows how well it knows a camera, and whether it notices a second one.

python experiments/calibration.py --photographs DIR      ten minutes; into experiments/results/calibration.md

DIR holds `left01.jpg` to `left14.jpg` of OpenCV's samples/data: 13 photographs of a board of 9x6 corners.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance
from arm5dof.vision.calibration.fit import Calibration, fit
from arm5dof.vision.calibration.intrinsics import calibrate
from arm5dof.vision.calibration.views import BoardView, BoardViews, board_pose, find_views

RESULTS = Path(__file__).parent / "results"
BOARD, SIZE = Checkerboard(9, 6, 0.025), (640, 480)
LENS = np.array([[700, 0, 321.5], [0, 705, 236], [0, 0, 1.0]]), np.array([-0.2, 0.05, 1e-3, -5e-4, 0])
TRUE = np.array([700, 705, 321.5, 236, *LENS[1]])
SPLITS, SETS, MIXED, VIEWS = 100, 100, 20, 13
APART = 0.02, 0.01
"""By what share fx and cx of a second camera are larger."""
SCALE = 24
"""Pixels a square of the drawing."""

Deviations = Callable[[Calibration, list[BoardView]], np.ndarray]


def independent(result: Calibration, views: list[BoardView]) -> np.ndarray:
    """OpenCV's deviations."""
    return result.deviations


def ours(result: Calibration, views: list[BoardView]) -> np.ndarray:
    """Those that the project states."""
    seen = [view.corners for view in views]
    camera = add_intrinsics_covariance(result.camera, seen, [board_pose(result.camera, corners) for corners in seen])
    return np.sqrt(np.diag(np.asarray(camera.covariance))[:-6])


def draw_views(seed: int, name: str, wider: float = 1.0) -> list[BoardView]:
    """Corners found in `VIEWS` drawn photographs, through a lens whose fx and cx are so many times those of `LENS`,
    with a noise of two gray levels."""
    rng, matrix = np.random.default_rng(seed), LENS[0] * [[wider, 1, wider], [1, 1, 1], [1, 1, 1]]
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(0) % 2 * 255
    drawing = np.pad(np.kron(squares, np.ones((SCALE, SCALE))).astype(np.uint8), SCALE, constant_values=255)
    # Two points a pixel along each axis: edges are as soft as a sensor's.
    grid = np.stack(np.meshgrid(*((np.arange(2 * side) + 0.5) / 2 - 0.5 for side in SIZE)), -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(grid, matrix, LENS[1]).astype(np.float32)
    views: list[BoardView] = []
    while len(views) < VIEWS:
        turn, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(-1, 1)]))
        shift = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.4, 0.6)]) - turn @ [0.1, 0.0625, 0]
        to_board = np.linalg.inv(np.c_[turn[:, :2], shift])
        to_drawing = np.array([[SCALE / BOARD.square, 0, 2 * SCALE - 0.5], [0, SCALE / BOARD.square, 2 * SCALE - 0.5]])
        place = cv2.perspectiveTransform(rays, np.vstack([to_drawing, [0, 0, 1]]) @ to_board)
        place = place.reshape(2 * SIZE[1], 2 * SIZE[0], 2)
        image = cv2.remap(drawing, place, None, cv2.INTER_LINEAR, borderValue=200)
        image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) + 2 * rng.normal(size=SIZE[::-1])
        corners = BOARD.find(np.clip(image, 0, 255).astype(np.uint8))
        if corners is not None:
            views.append(BoardView(f"{name}-{len(views)}", corners))
    return views


def half_splits(views: list[BoardView], deviations: Deviations, coefficients: int) -> np.ndarray:
    """Root mean square over random half-splits of the halves' difference in every intrinsic, over its deviation."""
    rng, z = np.random.default_rng(0), []
    for _ in range(SPLITS):
        order = rng.permutation(len(views))
        halves = [[views[i] for i in half] for half in np.array_split(order, 2)]
        results = [fit(half, SIZE, coefficients) for half in halves]
        stated = [deviations(result, half) for result, half in zip(results, halves, strict=True)]
        z.append((results[0].intrinsics - results[1].intrinsics) / np.hypot(*stated))
    return np.sqrt(np.square(z).mean(0))


def against_truth(sets: list[list[BoardView]], deviations: Deviations) -> np.ndarray:
    """The same of what is off the true intrinsics, over sets of drawn views."""
    z = []
    for views in sets:
        result = fit(views, SIZE)
        z.append((result.intrinsics - TRUE) / deviations(result, views))
    return np.sqrt(np.square(z).mean(0))


def named(views: list[BoardView]) -> set[str]:
    """The photographs that are said to be of another camera, none if the set is taken for one camera's."""
    try:
        calibrate(BoardViews(views, [], SIZE))
    except UserError as error:
        message = str(error)
        if "do not fit the others (" in message:
            return set(message.split("(")[1].split(")")[0].split(", "))
    return set()


def one_camera(sets: list[list[BoardView]]) -> Iterator[str]:
    """Rows of a table: how many sets of one camera are refused."""
    twice = [[*a, *b] for a, b in zip(sets[::2], sets[1::2], strict=True)]
    for each in (sets, twice):
        refused = sum(bool(named(views)) for views in each)
        yield f"| one camera, {len(each[0])} views | {len(each)} | {refused} | - |"


def two_cameras(first: list[list[BoardView]], second: list[list[BoardView]], apart: str) -> Iterator[str]:
    """Rows of a table: how many sets are refused as two cameras', and of how many the smaller part is named."""
    for ours_, theirs in ((13, 13), (7, 6), (13, 5)):
        refused, right = 0, 0
        for a, b in zip(first, second, strict=False):
            parts = [a[:ours_], b[:theirs]]
            found = named([*parts[0], *parts[1]])
            refused += bool(found)
            right += found in [{view.name for view in part} for part in parts if len(part) <= (ours_ + theirs) / 2]
        yield f"| two cameras {apart} apart, {ours_} + {theirs} views | {len(second)} | {refused} | {right} |"


def z_row(name: str, stated: str, z: np.ndarray) -> str:
    return f"| {name} | {stated} | " + " | ".join(f"{value:.2f}" for value in z) + " |" + " - |" * (9 - len(z))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, required=True, metavar="DIR", help="OpenCV's left*.jpg")
    real = find_views(sorted(parser.parse_args().photographs.glob("left*.jpg")), BOARD).found
    sets = [(f"a{i}", 1.0) for i in range(SETS)]
    sets += [(f"b{i}", 1 + apart) for apart in APART for i in range(MIXED)]
    with multiprocessing.get_context("spawn").Pool() as pool:
        drawn = pool.starmap(draw_views, [(seed, *each) for seed, each in enumerate(sets)])
    first = drawn[:SETS]
    others = {apart: drawn[SETS + MIXED * i :][:MIXED] for i, apart in enumerate(APART)}
    lines = [
        "# Calibration",
        "",
        "Command: `python experiments/calibration.py --photographs DIR`, with OpenCV's `left*.jpg` in `DIR`.",
        "",
        "Root mean square of z. Of halves: the difference between two halves' estimates over the root of their summed",
        f"squared deviations, {SPLITS} random half-splits. Of drawn photographs: what is off the true camera over the",
        f"deviation, {SETS} sets of {VIEWS}. *Independent* deviations are OpenCV's, *stated* are ours.",
        "",
        f"| photographs | deviations | {' | '.join(fit(first[0], SIZE).names)} |",
        "| --- | --- |" + " ---: |" * 9,
    ]
    for count in (5, 4):
        for stated, deviations in (("independent", independent), ("stated", ours)):
            name = f"halves of {len(real)} real, {count} coefficients"
            lines.append(z_row(name, stated, half_splits(real, deviations, count)))
    for stated, deviations in (("independent", independent), ("stated", ours)):
        lines.append(z_row(f"{VIEWS} drawn, 5 coefficients", stated, against_truth(first, deviations)))
    lines += [
        "",
        "Sets of drawn photographs, a second camera with larger fx and cx. *Named* are those of which exactly the",
        "photographs of the smaller part are named, of either where they are equal.",
        "",
        "| photographs | sets | refused | named |",
        "| --- | ---: | ---: | ---: |",
        *one_camera(first),
        *(row for apart, second in others.items() for row in two_cameras(first, second, f"{100 * apart:g} %")),
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    files.write_text(RESULTS / "calibration.md", text)


if __name__ == "__main__":
    main()
