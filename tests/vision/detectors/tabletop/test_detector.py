"""The detector that ships: its detections are in the image's pixels, one an object, and more with augmentation."""

import jax
import numpy as np
import pytest
from helpers.tabletop_weights import weights_of, zeros

from arm5dof.errors import UserError
from arm5dof.vision.boxes import iou
from arm5dof.vision.detectors.loading import load_detector
from arm5dof.vision.detectors.tabletop import detector as tabletop_detector
from arm5dof.vision.detectors.tabletop.detector import (
    MAX_PROPOSALS,
    PROPOSER_WEIGHT,
    TabletopDetector,
    propose,
    propose_in_windows,
    refine,
)
from arm5dof.vision.detectors.tabletop.weights import save_weights
from arm5dof.vision.synthetic.samples import render_samples

GREY = np.full((480, 640, 3), 100, np.uint8)


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """A detector that finds something of the first class round every cell, 32 pixels wide."""
    path = tmp_path_factory.mktemp("weights") / "wide.npz"
    save_weights(path, weights_of(16, 3.0, 2.0), ("cube", "ball", "ring"))
    return path


@pytest.mark.parametrize("width, height, scale, left", [(640, 480, 1, 0), (1280, 960, 2, 0), (480, 640, 4 / 3, 140)])
def test_detections_are_in_the_image_s_own_pixels(tmp_path, width, height, scale, left):
    """Of a detector that finds something in every cell of the first row, 12 pixels wide."""
    save_weights(tmp_path / "narrow.npz", weights_of(6, 3.0, 2.0), ("cube", "ball", "ring"))
    found = TabletopDetector(tmp_path / "narrow.npz")(np.zeros((height, width, 3), np.uint8))
    assert found.class_names == ("cube", "ball", "ring") and set(found.class_id) == {0}
    expected = (1 + np.exp(-3)) ** -PROPOSER_WEIGHT * (1 + np.exp(-2)) ** (PROPOSER_WEIGHT - 1)
    np.testing.assert_allclose(found.confidence, expected, rtol=1e-3)
    assert (found.xyxy >= 0).all() and (found.xyxy <= [width, height, width, height]).all()
    whole = found.xyxy[(found.xyxy[:, 0] > 0) & (found.xyxy[:, 2] < width)] / scale
    assert len(whole) > 5
    np.testing.assert_allclose(whole[:, 2:] - whole[:, :2], 12, atol=0.1)
    middles = whole[:, :2] + 6 + [left, 0]
    np.testing.assert_allclose((middles - 8) / 16, np.round((middles - 8) / 16), atol=0.02)


def test_overlapping_boxes_are_one_object(wide):
    detector = TabletopDetector(wide)
    proposals, likely = propose(detector._params["proposer"], GREY)
    np.testing.assert_allclose(likely, 1 / (1 + np.exp(-3)), rtol=1e-3)
    boxes = detector(GREY).xyxy
    fit = np.asarray(iou(boxes[:, None], boxes)) - np.eye(len(boxes))
    assert 10 < len(boxes) <= len(proposals) <= MAX_PROPOSALS and fit.max() < 0.601
    assert len(TabletopDetector(wide, confidence=0.95)(GREY)) == 0
    assert len(TabletopDetector(wide, iou=0.1)(GREY)) < len(boxes)


def test_mirrored_crops_are_crops_of_the_mirror_image():
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda x: random.normal(0, 0.1, x.shape), zeros("refiner"))
    picture = random.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    low = random.uniform(20, 400, (5, 2))
    boxes = np.concatenate([low, low + random.uniform(10, 60, (5, 2))], axis=1)

    def mirror(boxes):
        boxes = boxes.copy()
        boxes[:, [0, 2]] = 640 - boxes[:, [2, 0]]
        return boxes

    there, logits = refine(params, picture, boxes, mirrored=True)
    mirrored, same = refine(params, np.ascontiguousarray(picture[:, ::-1]), mirror(boxes))
    # OpenCV places pixels to a thirty-second.
    np.testing.assert_allclose(there, mirror(mirrored), atol=0.2)
    np.testing.assert_allclose(logits, same, atol=0.05)


def test_an_image_without_proposals_has_no_detections(tmp_path):
    save_weights(tmp_path / "none.npz", weights_of(16, -9.0, 2.0), ("cube", "ball", "ring"))
    assert len(TabletopDetector(tmp_path / "none.npz")(GREY)) == 0


@pytest.mark.parametrize(
    "image", [GREY[..., 0], np.dstack([GREY, GREY[..., :1]]), GREY.astype(np.uint16) * 257, GREY / 255]
)
def test_images_are_converted(wide, image):
    np.testing.assert_allclose(TabletopDetector(wide)(image).xyxy, TabletopDetector(wide)(GREY).xyxy, atol=1e-3)


@pytest.mark.parametrize(
    "image", [np.zeros((0, 4, 3), np.uint8), GREY.astype(int), np.full((4, 4), np.nan), GREY[0, 0]]
)
def test_what_is_no_image_is_refused(wide, image):
    with pytest.raises(UserError):
        TabletopDetector(wide)(image)


def test_augmentation_finds_no_less_and_its_boxes_fit_better():
    """In scenes of training's kind, but not among those that the weights were learnt from."""
    detectors = [load_detector(confidence=0.1, tta=tta) for tta in (False, True)]
    fits: list[list[float]] = [[], []]
    for sample in render_samples(6, 3, "training", "software", 2):
        for detector, fit in zip(detectors, fits, strict=True):
            overlaps = iou(sample.truth.xyxy[sample.truth.counts][:, None], detector(sample.image).xyxy)
            fit += np.max(overlaps, axis=1, initial=0).tolist()
    once, thrice = np.array(fits)
    assert len(once) > 10 and np.sum(thrice > 0.5) >= np.sum(once > 0.5) > 0.9 * len(once)
    assert np.median(thrice) > np.median(once) > 0.9


def test_windows_propose_what_the_whole_image_does_and_more(monkeypatch):
    """Where one may look at all that is proposed."""
    monkeypatch.setattr(tabletop_detector, "MAX_PROPOSALS", 400)
    params = load_detector()._params["proposer"]
    more = 0
    for sample in render_samples(7, 3, "evaluation", "software", 2):
        whole, _ = propose(params, sample.image)
        boxes, objectness = propose_in_windows(params, sample.image)
        assert (np.diff(objectness) <= 0).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all() and boxes.min() > -30 and boxes.max() < 670
        # One that overlaps is as good.
        assert (iou(whole[:, None], boxes).max(1) > 0.6).all()
        more += len(boxes) - len(whole)
    assert more > 0


def test_windows_show_where_things_are(monkeypatch):
    """A proposer that finds one box, in the middle of what it is shown."""
    middle = lambda params, image: (
        np.array([[0.4, 0.4, 0.6, 0.6]]) * np.tile([image.shape[1], image.shape[0]], 2),
        np.array([0.5]),
    )
    monkeypatch.setattr(tabletop_detector, "propose", middle)
    boxes, _ = propose_in_windows({}, np.zeros((480, 640, 3), np.uint8))
    centers = sorted(map(tuple, ((boxes[:, :2] + boxes[:, 2:]) / 2).round(1)))
    assert centers == [(213.0, 160.0), (213.0, 320.0), (320.0, 240.0), (427.0, 160.0), (427.0, 320.0)]


def test_only_augmentation_refines_the_unlikely(tmp_path):
    """Between the two thresholds is 0.03."""
    save_weights(tmp_path / "weak.npz", weights_of(16, np.log(0.03 / 0.97), 2.0), ("cube", "ball", "ring"))
    quick, tta = (TabletopDetector(tmp_path / "weak.npz", 0.1, tta=tta) for tta in (False, True))
    assert len(quick(GREY)) == 0 < len(tta(GREY))
