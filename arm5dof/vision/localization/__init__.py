"""From boxes in images to points in the arm's base frame. Cheap to import: what takes JAX is imported where it is
used."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from arm5dof.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.localization.common import Localization, Solids, Workspace


def locate(
    detections: Detections | Sequence[Detections],
    cameras: Camera | Sequence[Camera],
    solids: Solids,
    *,
    depth: np.ndarray | None = None,
    matches: np.ndarray | None = None,
    table_height: float = 0.0,
    box_std: float = 1.0,
    depth_std: float = 2e-3,
    workspace: Workspace | None = None,
) -> Localization:
    """Where detected objects of known height are.

    The method follows from what is given: two or more cameras triangulate (`multi_view.by_views`); one camera with a
    depth image compares what that shows with what a solid would show (`depth.by_depth`); one camera alone takes the
    objects to stand on the table (`table_plane.by_plane`).

    Args:
        detections: What was detected in the image of the camera, or in each camera's image of the same moment.
        cameras: The camera that took it, or as many cameras as there are `detections`; with extrinsics.
        solids: What is known of each class of objects, by its name: a `Solid`, or the half height of a block in metres.
        depth: The camera's depth image, (h, w), metres along the optical axis; zero or not finite where missing.
        matches: Which detections are of one object, (n, v) rows of the detections of v cameras; two cameras' are
            matched by class and by lines of sight if it is left out.
        table_height: Of the table in the base frame, metres. Several cameras need no table.
        box_std: Standard deviation of each edge of a box, pixels.
        depth_std: Standard deviation of the error that all depths of an object share, metres.
        workspace: Says which positions count.

    Returns:
        A position and its covariance for each detection, base frame, or why there is none. With `matches`, for each of
        them; otherwise for each detection of the first camera.

    Raises:
        UserError: A camera has no extrinsics, the depth image is not of the camera's size or comes with several
            cameras, `box_std` is not above zero, or more than two cameras come without `matches`.

    Example:
        >>> import numpy as np
        >>> from arm5dof.vision.camera import Camera
        >>> from arm5dof.vision.detections import Detections
        >>> matrix = np.array([[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
        >>> down = np.diag([1.0, -1.0, -1.0])  # 0.6 m above the table, looking down.
        >>> camera = Camera(matrix, np.zeros(5), down, np.array([0.2, 0, 0.6]), width=640, height=480)
        >>> cup = Detections([[300, 220, 340, 260]], [0.9], [0], ("cup",))
        >>> found = locate(cup, camera, {"cup": 0.045})
        >>> (found.position.round(3) + 0.0).tolist(), found.failure
        ([[0.2, 0.0, 0.045]], ('',))
    """
    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections

    views = [detections] if isinstance(detections, Detections) else list(detections)
    seen_by = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if len(seen_by) != 1 or len(views) != 1 or matches is not None:
        from arm5dof.vision.localization.multi_view import by_views

        if depth is not None:
            raise UserError("a depth image goes with one camera: leave it out, or the other cameras")
        return by_views(views, seen_by, solids, matches, box_std=box_std, workspace=workspace)
    if depth is not None:
        from arm5dof.vision.localization.depth import by_depth

        return by_depth(
            views[0],
            depth,
            seen_by[0],
            solids,
            table_height=table_height,
            box_std=box_std,
            depth_std=depth_std,
            workspace=workspace,
        )
    from arm5dof.vision.localization.table_plane import by_plane

    return by_plane(views[0], seen_by[0], solids, table_height=table_height, box_std=box_std, workspace=workspace)
