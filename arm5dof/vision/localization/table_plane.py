"""Where objects stand on the table, from one image."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import (
    ELONGATION_STD,
    SKEW_STD,
    box_center,
    camera_errors,
    fit_box,
    independent,
    propagate,
)
from arm5dof.vision.localization.common import (
    MAX_RMS,
    NOTHING_SEEN,
    Localization,
    ObjectBatch,
    Solids,
    Workspace,
    batched,
    check_inputs,
    cut_edges,
    detection_problems,
    size_problems,
)

MIN_SINE = np.sin(np.deg2rad(5))
"""Lines of sight must meet the table at 5 degrees: at less, a pixel is worth centimetres."""


def by_plane(
    detections: Detections,
    camera: Camera,
    solids: Solids,
    *,
    table_height: float = 0.0,
    box_std: float = 1.0,
    workspace: Workspace | None = None,
    cut: bool = False,
) -> Localization:
    """Where objects of known height stand on a table, from one image.

    Args:
        detections: What was detected in the image.
        camera: What took it, with extrinsics.
        solids: What is known of the classes, by name.
        table_height: Of the table in the base frame, metres.
        box_std: Standard deviation of each edge of a box, pixels.
        workspace: Says which positions count.
        cut: Locate what one edge of the picture cuts off too: by the three others of its box, and by its being about
            as deep as it is wide, which the covariance allows for.

    Returns:
        A position and its covariance for each detection, base frame, or why there is none.

    Raises:
        UserError: The camera has no extrinsics, or `box_std` is not above zero.
    """
    check_inputs(camera, box_std)
    objects = ObjectBatch.of(detections.xyxy, detections.data["class_name"], solids)
    if cut:
        objects = objects.replace(known=~cut_edges(detections.xyxy, camera))
    position, covariance, rms, sine = batched(_by_plane, objects, camera, table_height, box_std)
    problems = [
        *detection_problems(detections, camera, solids, int(cut)),
        (np.isnan(sine), NOTHING_SEEN),
        (sine < MIN_SINE, "the line of sight does not meet the table"),
        (~(rms < MAX_RMS * box_std), "nothing of the height of {name} on the table explains its box"),
        *size_problems(detections.xyxy, detections.data["class_name"], camera, solids, position),
    ]
    return Localization.of(detections, position, covariance, problems, workspace)


@jax.jit
def _by_plane(objects: ObjectBatch, camera: Camera, table_height: float, box_std: float) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), reprojection errors (n,) in pixels, and sines (n,) as of `on_plane`."""

    def one(seen: ObjectBatch) -> tuple[jax.Array, ...]:
        start, sine = on_plane(camera, seen.boxes, table_height + seen.half_height)

        known = None if seen.known is None else seen.known[None]

        def estimate(
            box: jax.Array, error: jax.Array, half_height: jax.Array, skew: jax.Array, *unlike: jax.Array
        ) -> tuple[jax.Array, Any]:
            cameras, elongation = [camera.perturbed(error)], unlike[0][0] if unlike else 0.0
            fit = fit_box(
                cameras, box[None], half_height[0], seen.form, start, table_height, box_std, known, elongation, skew
            )
            return fit.center, (fit.center, fit.reprojection_rms)

        inputs = [
            independent(seen.boxes, box_std),
            camera_errors(camera),
            independent(seen.half_height[None], seen.std),
            independent(jnp.zeros(1), SKEW_STD),
        ]
        if known is not None:
            inputs.append(independent(jnp.zeros(1), ELONGATION_STD))
        covariance, (center, rms) = propagate(estimate, inputs)
        return center, covariance, rms, sine

    return jax.vmap(one)(objects)


def on_plane(camera: Camera, box: Array, height: Array) -> tuple[jax.Array, jax.Array]:
    """Where the line of sight through the center of a box (4,) meets the horizontal plane at a height in the base
    frame, (3,), metres, and the sine of the angle between them: negative if it leads away, NaN if there is none."""
    ray, away = camera.rays(box_center(box)), height - camera.position[2]
    return jnp.asarray(camera.position) + ray * away / ray[2], ray[2] * jnp.sign(away)
