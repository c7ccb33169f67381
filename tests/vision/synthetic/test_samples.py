"""Images of random scenes, wherever they are rendered, and which pixel shows which object."""

import numpy as np

from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH, render_sample, render_samples


def test_images_are_the_same_wherever_they_are_drawn():
    first = render_sample(2, 5, "training", "software")
    *_, sample = render_samples(3, 5, "training", "software", workers=1)
    np.testing.assert_array_equal(sample.image, first.image)
    np.testing.assert_array_equal(sample.truth.xyxy, first.truth.xyxy)
    np.testing.assert_allclose(sample.camera.matrix, first.camera.matrix)


def test_instances_are_the_truth_s_objects():
    seen = 0
    for number in range(5):
        sample = render_sample(number, 0, "evaluation", "software")
        assert sample.image.shape == (HEIGHT, WIDTH, 3) and sample.image.dtype == np.uint8
        assert sample.instances.max() == len(sample.truth)
        for i, box in enumerate(sample.truth.xyxy, 1):
            y, x = np.nonzero(sample.instances == i)
            np.testing.assert_array_equal(box, [x.min(), y.min(), x.max() + 1, y.max() + 1])
            seen += 1
    assert seen > 5
