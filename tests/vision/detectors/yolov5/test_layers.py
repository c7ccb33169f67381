"""YOLOv5's layers in JAX."""

import numpy as np
import pytest

from arm5dof.vision.detectors.yolov5.layers import Conv


@pytest.mark.parametrize("size, stride, padding", [(6, 2, 2), (1, 1, 0), (3, 1, 1), (3, 2, 1), (1, 2, 0)])
def test_every_way_to_convolve_is_the_same_sum(size, stride, padding):
    random = np.random.default_rng(0)
    x, weight = random.normal(size=(1, 8, 12, 3)), random.normal(size=(size, size, 3, 5))
    bias = random.normal(size=5)
    padded = np.pad(x[0], ((padding, padding), (padding, padding), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), (0, 1))[::stride, ::stride]
    expected = np.einsum("hwcij,ijco->hwo", windows, weight) + bias
    conv = Conv(np.float32(weight), np.float32(bias), (stride, stride), (padding, padding), activated=False)
    np.testing.assert_allclose(conv(np.float32(x))[0], expected, rtol=1e-4, atol=1e-4)
    active = conv.replace(activated=True)(np.float32(x))[0]
    np.testing.assert_allclose(active, expected / (1 + np.exp(-expected)), rtol=1e-4, atol=1e-4)
