"""arm5dof: massively parallel training of vision-guided robot arms in JAX and MJX.

The names below are imported when they are first used: importing the package costs nothing and changes nothing.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False
if TYPE_CHECKING:  # Importing typing takes longer than all else that is done here.
    from typing import Any

__version__ = "0.2.0.dev0"

_HOMES = {
    "Arm": "arm5dof.arm",
    "Camera": "arm5dof.vision.camera",
    "Config": "arm5dof.training.config",
    "Detections": "arm5dof.vision.detections",
    "Grasper": "arm5dof.grasp.grasper",
    "Policy": "arm5dof.training.policy",
    "Run": "arm5dof.training.run",
    "Sweep": "arm5dof.sweeps.folder",
    "Task": "arm5dof.envs",
    "compare": "arm5dof.sweeps.compare",
    "load_arm": "arm5dof.arm",
    "load_config": "arm5dof.training.config",
    "load_detector": "arm5dof.vision.detectors.loading",
    "load_policy": "arm5dof.training.policy_file",
    "locate": "arm5dof.vision.localization",
    "make_env": "arm5dof.training.config",
    "resume": "arm5dof.training.loop",
    "sweep": "arm5dof.sweeps.sweep",
    "train": "arm5dof.training.loop",
}

__all__ = list(_HOMES)

if TYPE_CHECKING:
    from arm5dof.arm import Arm as Arm
    from arm5dof.arm import load_arm as load_arm
    from arm5dof.envs import Task as Task
    from arm5dof.grasp.grasper import Grasper as Grasper
    from arm5dof.sweeps.compare import compare as compare
    from arm5dof.sweeps.folder import Sweep as Sweep
    from arm5dof.sweeps.sweep import sweep as sweep
    from arm5dof.training.config import Config as Config
    from arm5dof.training.config import load_config as load_config
    from arm5dof.training.config import make_env as make_env
    from arm5dof.training.loop import resume as resume
    from arm5dof.training.loop import train as train
    from arm5dof.training.policy import Policy as Policy
    from arm5dof.training.policy_file import load_policy as load_policy
    from arm5dof.training.run import Run as Run
    from arm5dof.vision.camera import Camera as Camera
    from arm5dof.vision.detections import Detections as Detections
    from arm5dof.vision.detectors.loading import load_detector as load_detector
    from arm5dof.vision.localization import locate as locate


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
