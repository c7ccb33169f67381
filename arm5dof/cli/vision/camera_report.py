"""Where a camera is, as commands that find it print it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from arm5dof.vision.camera import Camera


def as_json(camera: Camera) -> dict[str, Any]:
    """For programs: its position in metres, its rotation as a matrix, and standard deviations of a turn about its own
    axes (degrees) and a shift along them (metres), null if unknown."""
    import numpy as np

    deviations = None
    if camera.covariance is not None:
        turn, shift = np.split(np.sqrt(np.diag(np.asarray(camera.covariance))[-6:]), 2)
        deviations = {"turn_deg": np.rad2deg(turn).tolist(), "shift_m": shift.tolist()}
    position, rotation = np.asarray(camera.position), np.asarray(camera.rotation)
    return {"position_m": position.tolist(), "rotation": rotation.tolist(), "deviations": deviations}


def pose_table(camera: Camera, frame: str = "base") -> str:
    """The same for people."""
    said = as_json(camera)

    def spread(name: str, factor: float, unit: str) -> str:
        if said["deviations"] is None:
            return ""
        return "  +- " + " ".join(f"{factor * v:.2f}" for v in said["deviations"][name]) + f" {unit}"

    position = " ".join(f"{1e3 * v:.1f}" for v in said["position_m"])
    looks = " ".join(f"{row[2]:.4f}" for row in said["rotation"])
    width = max(len(position) + 3, len(looks))
    lines = [
        f"the camera in the {frame} frame, +- standard deviations along and about the camera's own axes",
        f"stands at  {f'{position} mm':{width}}{spread('shift_m', 1e3, 'mm')}",
        f"looks to   {looks:{width}}{spread('turn_deg', 1, 'degrees')}",
    ]
    if said["deviations"] is None:
        lines.append("how well is unknown: the camera file has no covariance; vision calibrate writes one")
    return "\n".join(lines)
