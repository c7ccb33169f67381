"""What the refiner learns from."""

import numpy as np

from arm5dof.vision.detectors.tabletop.training.crop_batches import label_proposals
from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet


def test_what_proposals_are_of():
    """Of the object that they overlap; of background; or of what is hidden, or half beside something, and left out."""
    boxes = np.array([[10, 10, 30, 30], [100, 100, 120, 120]])
    nothing = np.empty((0, 4, 4, 3), np.uint8)
    data = TrainingSet(
        nothing, nothing[..., 0], np.array([1, 1]), boxes, np.array([4, 6]), np.array([0.9, 0.3]), np.array([400, 400])
    )
    given = np.array([[12, 10, 32, 30], [98, 100, 120, 121], [23, 10, 43, 30], [19, 10, 40, 30], [200, 200, 220, 220]])
    found = label_proposals(data, 1, given, np.full(len(given), 0.5))
    np.testing.assert_array_equal(found.boxes, [given[0], given[2], given[4], boxes[0]])
    np.testing.assert_array_equal(found.targets, [boxes[0], given[2], given[4], boxes[0]])
    np.testing.assert_array_equal(found.class_id, [4, -1, -1, 4])
    assert set(found.scene) == {1}
    nothing = label_proposals(data, 0, given, np.full(len(given), 0.5))
    assert set(nothing.class_id) == {-1} and len(nothing.boxes) == 5
