"""What the networks are asked, as losses."""

import numpy as np
import pytest

from arm5dof.vision.detectors.tabletop.networks import cell_centers
from arm5dof.vision.detectors.tabletop.training.assignment import Labels
from arm5dof.vision.detectors.tabletop.training.losses import proposer_losses, refiner_losses


def test_hidden_objects_are_no_one_s_mistake():
    """A cell in the box of one may say what it likes; the same cell is wrong where there is nothing."""
    centers = cell_centers(96, 96)
    labels = Labels(np.float32([[20, 20, 60, 60]]), np.zeros(1, bool), np.ones(1, bool))
    boxes = np.float32(np.concatenate([centers - 10, centers + 10], 1))
    sure = np.where(((centers > 20) & (centers < 60)).all(1), 5, -20).astype(np.float32)
    assert float(proposer_losses(boxes, sure, labels, centers).classification) < 1e-3
    assert float(proposer_losses(boxes, sure, labels._replace(ignored=np.zeros(1, bool)), centers).classification) > 50


def test_what_the_refiner_is_asked():
    """An object's box, and a score as high as its own box fits; of background, no score of any class, and no box."""
    wanted, close = np.float32([0.2, 0.2, 0.8, 0.8]), np.float32([0.2, 0.2, 0.8, 0.74])
    fit = 0.9
    right = np.float32([-20, np.log(fit / (1 - fit)), -20])
    parts = refiner_losses(close, right, wanted, np.int32(1))
    entropy = -fit * np.log(fit) - (1 - fit) * np.log(1 - fit)
    np.testing.assert_allclose(parts.classification, entropy, rtol=1e-5)
    np.testing.assert_allclose(parts.localisation, 1 - fit, rtol=1e-5)
    assert float(parts.closeness) > 0 and float(
        refiner_losses(wanted, right, wanted, np.int32(1)).localisation
    ) == pytest.approx(0)
    for other in (0, 2):
        assert float(refiner_losses(close, right, wanted, np.int32(other)).classification) > 10
    nothing = refiner_losses(close, np.full(3, np.float32(-20)), wanted, np.int32(-1))
    np.testing.assert_allclose(nothing, 0, atol=1e-6)
