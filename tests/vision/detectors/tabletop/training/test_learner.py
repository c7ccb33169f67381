"""The networks learn a few examples by heart, and the same seed trains the same bits."""

from functools import partial

import jax
import numpy as np
import pytest

from arm5dof.vision.boxes import iou
from arm5dof.vision.detectors.tabletop.networks import Proposer, Refiner, cell_centers
from arm5dof.vision.detectors.tabletop.training.crop_batches import Candidates, crop_batch, label_proposals
from arm5dof.vision.detectors.tabletop.training.learner import Learner
from arm5dof.vision.detectors.tabletop.training.losses import proposer_losses, refiner_losses
from arm5dof.vision.detectors.tabletop.training.training_set import render_training_set
from arm5dof.vision.detectors.tabletop.training.window_batches import WINDOW, window_batch
from arm5dof.vision.objects import CLASS_NAMES

BACKGROUND = np.float32([[5, 5, 40, 40], [600, 440, 635, 475], [5, 440, 40, 475]])


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Eight scenes."""
    return render_training_set(tmp_path_factory.mktemp("images"), 8, 0, workers=1)


@pytest.fixture(scope="module")
def learner():
    """Of the proposer: compiled once."""
    loss = partial(proposer_losses, centers=cell_centers(WINDOW, WINDOW))
    return Learner(Proposer(training=True), loss, (np.zeros((1, WINDOW, WINDOW, 3), np.uint8),), 100, 0)


def test_the_proposer_learns_two_windows_by_heart(small, learner):
    (windows,), (labels,) = window_batch(small, (0,), 2)
    for _ in range(100):
        parts = learner.step((windows,), (labels,))
    assert sum(float(value) for value in parts.values()) < 0.7
    boxes, logits = jax.jit(Proposer(False).apply)({"params": learner.weights()}, windows)
    fits = [
        np.max(iou(boxes[i], box)[logits[i] > -1], initial=0)
        for i in range(2)
        for box in labels.boxes[i][labels.found[i]]
    ]
    assert len(fits) > 3 and np.median(fits) > 0.7


def test_the_refiner_learns_some_crops_by_heart(small):
    some = [label_proposals(small, scene, BACKGROUND, np.full(len(BACKGROUND), 0.5)) for scene in range(8)]
    names = ("scene", "boxes", "targets", "class_id", "objectness")
    found = Candidates(*(np.concatenate([getattr(one, name) for one in some]) for name in names))
    given, (wanted, class_id) = crop_batch(small, found, (0,), 8)
    learner = Learner(Refiner(len(CLASS_NAMES), training=True), refiner_losses, given, 400, 0)
    for _ in range(400):
        parts = learner.step(given, (wanted, class_id))
    assert sum(float(value) for value in parts.values()) < 0.5
    boxes, logits = jax.jit(Refiner(len(CLASS_NAMES), False).apply)({"params": learner.weights()}, *given)
    is_object = class_id >= 0
    assert is_object.sum() == 4 and (np.asarray(logits).argmax(1) == class_id)[is_object].all()
    assert (np.asarray(logits)[~is_object] < 0).all() and np.median(iou(boxes, wanted)[is_object]) > 0.8


def test_the_same_seed_trains_the_same_bits(small, learner):
    ends = []
    for seed in (3, 3, 4):
        learner.restart(seed)
        for step in range(3):
            learner.step(*window_batch(small, (0, step), 2))
        ends.append(np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(jax.device_get(learner.weights()))]))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])
