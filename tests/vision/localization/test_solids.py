"""Boxes around solids, against OpenCV's projection."""

import numpy as np
import pytest
from helpers.tabletop import box_around, camera_at, over_the_table, random_lens

from arm5dof.errors import UserError
from arm5dof.vision.localization.solids import FORMS, Solid, solid_box


@pytest.mark.parametrize("skew", [0.0, -0.6])
@pytest.mark.parametrize("form", FORMS)
def test_boxes_surround_the_points_of_a_solid_as_opencv_projects_them(form, skew):
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 2 * np.pi, 721)
    levels = {"block": [(-1, 1), (1, 1)], "cone": [(-1, 1), (1, 0)]}.get(
        form, [(np.sin(a), np.cos(a)) for a in np.linspace(-np.pi / 2, np.pi / 2, 361)]
    )
    for coefficients in (4, 5, 8):
        camera = camera_at(over_the_table(rng), random_lens(rng, coefficients))
        center, radii, half_height = np.array([0.2, 0.08, 0.02]), np.array([0.015, 0.03]), 0.02
        x = np.append(camera.rotation[:2, 0], 0) / np.linalg.norm(camera.rotation[:2, 0])
        y = np.array([-x[1], x[0], 0])
        deep = skew * np.cos(angles) + np.sqrt(1 - skew**2) * np.sin(angles)
        ring = radii[0] * np.cos(angles)[:, None] * x + radii[1] * deep[:, None] * y
        points = np.concatenate([center + width * ring + [0, 0, half_height * level] for level, width in levels])
        found = solid_box(camera, center, radii, half_height, FORMS[form], skew)
        np.testing.assert_allclose(found, box_around(camera, points), atol=0.05)


def test_solids_that_cannot_be_are_refused():
    for half_height in (0, -1, np.nan, np.inf):
        with pytest.raises(UserError, match="give metres above zero"):
            Solid(half_height)
    with pytest.raises(UserError, match="no form 'cube': choose from block, ball, cone"):
        Solid(0.01, "cube")
