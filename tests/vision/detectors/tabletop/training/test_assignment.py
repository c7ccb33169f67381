"""Which cells are assigned to which object."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision.boxes import iou
from arm5dof.vision.detectors.tabletop.networks import cell_centers
from arm5dof.vision.detectors.tabletop.training.assignment import MAX_CELLS, MIN_BOX_SIZE, Labels, assign

SEEDS = st.integers(0, 2**32 - 1)


def scene(random, objects, rows=9):
    """Labels of some objects, in rows of which some say nothing, and what the cells of an image of 96 x 96 say."""
    middle, half = random.uniform(5, 91, (rows, 2)), random.uniform(3, 20, (rows, 2))
    boxes = np.float32(np.concatenate([middle - half, middle + half], 1))
    role = random.permutation(np.r_[np.ones(objects), np.zeros(rows - objects)]).astype(bool)
    hidden = role & (random.random(rows) < 0.2)
    labels = Labels(boxes, role & ~hidden, hidden)
    centers = cell_centers(96, 96)
    predicted = np.float32(np.concatenate([centers - random.uniform(0, 25, centers.shape),
                                           centers + random.uniform(0, 25, centers.shape)], 1))  # fmt: skip
    return centers, predicted, np.float32(random.random(len(centers))), labels


assigned = jax.jit(assign)


@given(SEEDS, st.integers(0, 9))
def test_each_object_has_some_of_the_cells_in_its_box(seed, objects):
    centers, boxes, scores, labels = scene(np.random.default_rng(seed), objects)
    targets = jax.device_get(assigned(centers, boxes, scores, labels))
    claimed = targets.scores > 0
    assert (targets.scores >= 0).all() and (targets.scores <= 1).all() and targets.scored[claimed].all()

    fit = np.asarray(iou(labels.boxes[:, None], boxes))
    apart = np.asarray(iou(labels.boxes[:, None], labels.boxes)) - np.eye(len(labels.boxes))
    for i, box in enumerate(labels.boxes):
        mine = claimed & (targets.boxes == box).all(1)
        if not labels.found[i]:
            assert not mine.any()
            continue
        assert mine.sum() <= MAX_CELLS
        reach = np.maximum(box[2:] - box[:2], MIN_BOX_SIZE) / 2 + 1e-3
        assert (np.abs(centers[mine] - (box[:2] + box[2:]) / 2) < reach).all()
        if mine.any():  # The best of them is asked for exactly what its box is worth.
            np.testing.assert_allclose(targets.scores[mine].max(), fit[i, mine].max(), rtol=1e-5)
        inside = (np.abs(centers - (box[:2] + box[2:]) / 2) < reach).all(1)
        if apart[i][labels.found].max(initial=0) == 0 and fit[i, inside].max() > 0.05:
            assert mine.any()


@given(SEEDS, st.integers(1, 9))
def test_the_order_of_objects_does_not_matter(seed, objects):
    random = np.random.default_rng(seed)
    centers, boxes, scores, labels = scene(random, objects)
    order = random.permutation(len(labels.boxes))
    one = assigned(centers, boxes, scores, labels)
    other = assigned(centers, boxes, scores, Labels(*(rows[order] for rows in labels)))
    np.testing.assert_allclose(one.scores, other.scores, atol=1e-6)
    np.testing.assert_array_equal(one.scored, other.scored)
