"""Pictures of random scenes, and what the detector learns from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.vision.detectors.tabletop.training import training_set
from arm5dof.vision.detectors.tabletop.training.training_set import MOST, WINDOW, TrainingSet, batch, render
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH, shoot, shots


def test_pictures_are_the_same_wherever_they_are_drawn():
    first = shoot(2, 5, "training", "software")
    *_, shot = shots(3, 5, "training", "software", workers=1)
    np.testing.assert_array_equal(shot.picture, first.picture)
    np.testing.assert_array_equal(shot.truth.xyxy, first.truth.xyxy)
    np.testing.assert_allclose(shot.camera.matrix, first.camera.matrix)


def test_owners_are_the_truth_s_things():
    seen = 0
    for number in range(5):
        shot = shoot(number, 0, "evaluation", "software")
        assert shot.picture.shape == (HEIGHT, WIDTH, 3) and shot.picture.dtype == np.uint8
        assert shot.owner.max() == len(shot.truth)
        for i, box in enumerate(shot.truth.xyxy, 1):
            y, x = np.nonzero(shot.owner == i)
            np.testing.assert_array_equal(box, [x.min(), y.min(), x.max() + 1, y.max() + 1])
            seen += 1
    assert seen > 5


def test_rendering_into_files(tmp_path):
    done = []
    data = render(tmp_path, 3, 0, done.append, workers=1)
    assert done == [1, 2, 3] and data.pictures.shape == (3, HEIGHT, WIDTH, 3)
    for scene in range(3):
        shot = shoot(scene, 0, "training", "software")
        mine = np.s_[data.first(scene) : data.first(scene + 1)]
        np.testing.assert_array_equal(data.pictures[scene], shot.picture)
        np.testing.assert_array_equal(data.owners[scene], shot.owner)
        np.testing.assert_array_equal(data.boxes[mine], shot.truth.xyxy)
        np.testing.assert_array_equal(data.class_id[mine], shot.truth.class_id)
    assert (data.area > 0).all() and np.isfinite(data.area).all()


def test_scenes_with_nothing_to_find_are_refused(tmp_path, monkeypatch):
    empty = next(n for n in range(100) if not len(shoot(n, 0, "training", "software").truth))
    monkeypatch.setattr(training_set, "shots", lambda *_: [shoot(empty, 0, "training", "software")])
    with pytest.raises(UserError, match="nothing to find"):
        render(tmp_path, 1, 0)


@pytest.fixture(scope="module")
def squares():
    """Two bright things on black, one of them half hidden by nothing but its own number of pixels."""
    pictures, owners = np.zeros((2, HEIGHT, WIDTH, 3), np.uint8), np.zeros((2, HEIGHT, WIDTH), np.uint8)
    boxes = np.array([[300, 200, 330, 224], [100, 400, 120, 440]])
    for picture, owner, (left, top, right, bottom) in zip(pictures, owners, boxes, strict=True):
        picture[top:bottom, left:right], owner[top:bottom, left:right] = 200, 1
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return TrainingSet(pictures, owners, np.array([0, 1]), boxes, np.array([3, 5]), np.array([1.0, 1.0]), area)


@given(seed=st.integers(0, 10_000))
def test_boxes_surround_what_windows_show(squares, seed):
    (pictures,), (labels,) = batch(squares, (seed,), 4)
    assert pictures.shape == (4, WINDOW, WINDOW, 3) and pictures.dtype == np.uint8
    for i, picture in enumerate(pictures):
        there = labels.found[i] | labels.ignored[i]
        assert labels.boxes[i].shape == (MOST, 4) and not (labels.found[i] & labels.ignored[i]).any()
        boxes = labels.boxes[i][there]
        assert (boxes[:, :2] >= 0).all() and (boxes <= WINDOW).all() and (boxes[:, 2:] > boxes[:, :2]).all()
        bright = np.zeros(picture.shape[:2], bool)
        for left, top, right, bottom in np.round(boxes).astype(int):
            bright[top:bottom, left:right] = True
        # Noise, blur and rounding blur the edges, never the middles.
        shown = picture.min(-1) > 45
        assert (shown != bright).sum() <= 2 * (boxes[:, 2:] - boxes[:, :2]).sum() + 2


def test_what_is_mostly_outside_is_ignored(squares):
    ignored = found = 0
    for seed in range(60):
        _, (labels,) = batch(squares, (seed,), 8)
        ignored, found = ignored + labels.ignored.sum(), found + labels.found.sum()
    assert 0 < ignored < found


def test_the_same_seed_gives_the_same_bits(squares):
    (one, (labels,)), (same, (others,)), (other, _) = (batch(squares, seed, 3) for seed in ((1, 2), (1, 2), (1, 3)))
    np.testing.assert_array_equal(one, same)
    for a, b in zip(labels, others, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one, other)
