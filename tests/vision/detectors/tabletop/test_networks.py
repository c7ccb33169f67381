"""The tabletop detector's two networks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.tabletop_weights import NETWORKS, inputs, zeros

from arm5dof.vision.detectors.tabletop.networks import (
    INITIAL_DISTANCE,
    STRIDE,
    Proposer,
    fold_batch_norm,
    space_to_depth,
    upsample,
)


def test_patches_are_a_strided_convolution():
    random = np.random.default_rng(0)
    x, kernel = random.normal(size=(2, 8, 12, 3)).astype(np.float32), random.normal(size=(4, 4, 3, 5))
    expected = jax.lax.conv_general_dilated(
        x, np.float32(kernel), (4, 4), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    np.testing.assert_allclose(space_to_depth(x, 4) @ np.float32(kernel.reshape(48, 5)), expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(upsample(jnp.asarray(x)), x.repeat(2, 1).repeat(2, 2))


@pytest.mark.parametrize("name", NETWORKS)
def test_folding_changes_nothing(name):
    make, random = NETWORKS[name], np.random.default_rng(0)
    given = inputs(name, 2, random)
    like = jax.eval_shape(make().init, jax.random.key(0), *given)
    variables = jax.tree.map(lambda x: random.normal(0, 0.15, x.shape).astype(np.float32), like)
    variables["batch_stats"] = jax.tree.map(lambda x: np.abs(x) + 0.5, variables["batch_stats"])
    folded = fold_batch_norm(variables["params"], variables["batch_stats"])
    expected = jax.jit(make().apply)(variables, *given)
    found = jax.jit(make(False).apply)({"params": folded}, *given)
    assert float(jnp.std(expected[1])) > 0.01
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


def test_boxes_are_as_far_from_their_cells_as_the_network_says():
    params = zeros("proposer")
    params["edges"]["bias"] = (np.float32([4, 6, 8, 10]) - INITIAL_DISTANCE) / STRIDE
    boxes, logits = jax.jit(Proposer(False).apply)({"params": params}, np.zeros((1, 64, 96, 3), np.uint8))
    assert boxes.shape == (1, 8 * 12, 4) and logits.shape == (1, 8 * 12)
    expected = [(x - 4, y - 6, x + 8, y + 10) for y in range(4, 64, 8) for x in range(4, 96, 8)]
    np.testing.assert_allclose(boxes[0], expected, atol=1e-5)
