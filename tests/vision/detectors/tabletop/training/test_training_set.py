"""Scenes rendered into files."""

import numpy as np
import pytest

from arm5dof.errors import UserError
from arm5dof.vision.detectors.tabletop.training import training_set
from arm5dof.vision.detectors.tabletop.training.training_set import render_training_set
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH, render_sample


def test_rendering_into_files(tmp_path):
    done = []
    data = render_training_set(tmp_path, 3, 0, done.append, workers=1)
    assert done == [1, 2, 3] and data.images.shape == (3, HEIGHT, WIDTH, 3)
    for scene in range(3):
        sample = render_sample(scene, 0, "training", "software")
        mine = np.s_[data.first(scene) : data.first(scene + 1)]
        np.testing.assert_array_equal(data.images[scene], sample.image)
        np.testing.assert_array_equal(data.instances[scene], sample.instances)
        np.testing.assert_array_equal(data.boxes[mine], sample.truth.xyxy)
        np.testing.assert_array_equal(data.class_id[mine], sample.truth.class_id)
    assert (data.area > 0).all() and np.isfinite(data.area).all()


def test_scenes_with_nothing_to_find_are_refused(tmp_path, monkeypatch):
    empty = next(n for n in range(100) if not len(render_sample(n, 0, "training", "software").truth))
    monkeypatch.setattr(training_set, "render_samples", lambda *_: [render_sample(empty, 0, "training", "software")])
    with pytest.raises(UserError, match="nothing to find"):
        render_training_set(tmp_path, 1, 0)
