"""Each import rule of pyproject.toml is broken once, and must be seen to be."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LINT = "from importlinter.cli import lint_imports_command as lint; lint(['--no-logo', '--no-cache'])"

NO_TASK = "Agent, training, sweeps and command line know no concrete task"

VIOLATIONS = [
    ("Packages import only those below them", "envs/metrics.py", "import arm5dof.training.run"),
    ("Packages import only those below them", "envs/metrics.py", "from arm5dof import Run"),
    ("Packages import only those below them", "errors.py", "import arm5dof.settings"),
    ("Packages import only those below them", "training/policy.py", "import arm5dof.vision.camera"),
    ("Packages import only those below them", "vision/objects.py", "import arm5dof.grasp.scene"),
    ("Packages import only those below them", "new_package.py", "import jax"),
    ("Vision knows no environments and no agents", "vision/camera.py", "import arm5dof.envs.vector"),
    ("Vision knows no environments and no agents", "vision/camera.py", "import arm5dof.ddpg.replay"),
    (NO_TASK, "ddpg/agent.py", "import arm5dof.envs.reach"),
    (
        "Agent, training, sweeps and command line know no concrete task",
        "training/run.py",
        "import arm5dof.envs.reach_pose",
    ),
    (NO_TASK, "cli/solve.py", "import arm5dof.envs.arm_goal"),
    (NO_TASK, "sweeps/spec.py", "import arm5dof.envs.reach"),
    ("Packages import only those below them", "training/run.py", "import arm5dof.sweeps.spec"),
    ("Sweeps know no vision", "sweeps/spec.py", "import arm5dof.vision.camera"),
    ("Nobody imports the command line", "__init__.py", "import arm5dof.cli.parser"),
    ("Only the command line parses arguments", "training/run.py", "import argparse"),
    ("Only the command line opens progress bars", "training/run.py", "import arm5dof.runtime.progress"),
    ("Only progress bars use rich", "cli/main.py", "import rich.table"),
    ("Vision's packages import only those below them", "vision/boxes.py", "import arm5dof.vision.localization"),
    (
        "Vision's packages import only those below them",
        "vision/calibration/views.py",
        "import arm5dof.vision.io.sources",
    ),
    ("Vision's packages import only those below them", "vision/rendering/raster.py", "import arm5dof.vision.detectors"),
    ("Vision's packages import only those below them", "vision/io/sinks.py", "import arm5dof.vision.evaluation.doctor"),
    ("Vision's packages import only those below them", "vision/new_module.py", "import numpy"),
    (
        "Only evaluation and commands import the training of a detector",
        "vision/detectors/tabletop/detector.py",
        "import arm5dof.vision.detectors.tabletop.training.losses",
    ),
    ("Synthetic scenes see only rendering", "vision/synthetic/scenes.py", "import arm5dof.vision.localization.solids"),
    (
        "Input and output see only localization and synthetic scenes",
        "vision/io/sources.py",
        "import arm5dof.vision.detectors.loading",
    ),
]
"""Contract, module and the line that breaks it."""


@pytest.fixture
def package(tmp_path):
    """A copy of the package's source and of the rules."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    source = shutil.ignore_patterns("__pycache__", "*.npz")
    return Path(shutil.copytree(ROOT / "arm5dof", tmp_path / "arm5dof", ignore=source))


def lint(package):
    """The exit status, and the text in one line."""
    done = subprocess.run([sys.executable, "-c", LINT], cwd=package.parent, capture_output=True, text=True)
    return done.returncode, " ".join(done.stdout.split())


def test_the_package_keeps_all_rules(package):
    status, text = lint(package)
    assert status == 0, text
    assert " 0 broken" in text


@pytest.mark.parametrize(("contract", "module", "line"), VIOLATIONS)
def test_a_violation_is_seen(package, contract, module, line):
    # Inside a function, where an import is as good as anywhere.
    with open(package / module, "a", encoding="utf-8") as handle:
        handle.write(f"\n\ndef planted():\n    {line}\n")
    status, text = lint(package)
    assert status == 1, text
    assert f"{contract} BROKEN" in text


def test_every_rule_is_tried():
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert {rule["name"] for rule in rules} == {contract for contract, _, _ in VIOLATIONS}
