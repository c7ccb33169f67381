"""What all tests share: the compilation cache, the arm, two environments, and real data."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from arm5dof.runtime import xla

# JAX and NumPy read these settings when they are imported, so nothing above may import them, and the fixtures below
# import late. Most of the time of tests goes into compiling what then runs once: LLVM need not try hard. Each worker
# has a core to itself: threads of linear algebra would only wait for each other.
FAST = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
os.environ["XLA_FLAGS"] = f"{FAST} {os.environ.get('XLA_FLAGS', '')}".strip()
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
xla.enable_compilation_cache()
gc.set_threshold(100_000, 50, 100)  # Hardly any of the objects that tracing makes are garbage.

if TYPE_CHECKING:
    from arm5dof.arm import Arm
    from arm5dof.envs.reach import Reach

# What runs in the background of a script ignores interrupts, and so does all that it starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("arm5dof", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("arm5dof")


@pytest.fixture(autouse=True, scope="module")
def frozen() -> None:
    """What other modules left stays: to search gigabytes of it takes most of each `gc.collect`."""
    gc.freeze()


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real data that is no part of the project: photographs, calibrations, weights."""
    folder = Path(os.environ.get("ARM5DOF_TEST_DATA") or Path(__file__).parent.parent.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no test data in {folder}: name the folder in ARM5DOF_TEST_DATA")
    return folder


@pytest.fixture(scope="session")
def photographs(test_data: Path) -> list[Path]:
    """OpenCV's sample: 13 of a board of 9x6 inner corners."""
    paths = sorted((test_data / "vision/checkerboard").glob("left*.jpg"))
    assert len(paths) == 13
    return paths


@pytest.fixture(scope="session")
def arm() -> Arm:
    from arm5dof.arm import load_arm

    return load_arm("reach.xml")


@pytest.fixture(scope="session")
def kinematic(arm: Arm) -> Reach:
    """Reach where an action is the pose."""
    from arm5dof.envs.reach import Reach, ReachConfig

    return Reach(ReachConfig(dynamics="kinematic"), arm)


@pytest.fixture(scope="session")
def servo(arm: Arm) -> Reach:
    """Reach in MJX physics, with the observation that holds velocities too."""
    from arm5dof.envs.reach import Reach, ReachConfig

    return Reach(ReachConfig(dynamics="servo", observation="full"), arm)
