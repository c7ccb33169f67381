"""What a user installs: the wheel carries the models and experiments, and needs no torch."""

import os
import re
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import arm5dof
from arm5dof.runtime import files

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    return next(out.glob("*.whl"))


def test_models_and_experiments_are_found_from_an_installed_wheel(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    code = (
        "import arm5dof; from arm5dof import load_arm, load_config;"
        "from arm5dof.runtime import files;"
        "print(arm5dof.__file__, load_arm(load_config('reach.toml').env.arm).dof, *files.shipped('mjcf', '.xml'))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [
        str(tmp_path / "site" / "arm5dof" / "__init__.py"),
        "5",
        "arm5.xml",
        "arm7.xml",
        "arm7_gripper.xml",
        "reach.xml",
    ]


def test_wheel_carries_all_experiments_and_neither_results_nor_test_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert not [name for name in names if name.endswith((".pt", ".onnx", ".jpg"))]
    assert "arm5dof/py.typed" in names
    experiments = {path.name for path in (ROOT / "experiments").glob("*.toml")}
    assert {Path(name).name for name in names if "/experiments/" in name} == experiments
    (weights,) = [info for info in zipfile.ZipFile(wheel).infolist() if info.filename.endswith(".npz")]
    assert weights.file_size <= 2_000_000
    policies = [info for info in zipfile.ZipFile(wheel).infolist() if "/grasp/policies/" in info.filename]
    assert policies and all(info.file_size <= 1_000_000 for info in policies)
    trained = sum(info.compress_size for info in (weights, *policies))
    assert wheel.stat().st_size - trained < 500_000


def test_one_version_is_told_everywhere(wheel):
    """A version under way ends in .dev0 and is "unreleased"; the citation names the newest that is out."""
    history = re.findall(r"^## \[(.+)\] - (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    released = [(version, date) for version, date in history if date != "unreleased"]
    assert arm5dof.__version__ == (history[0][0] if history[0] in released else f"{history[0][0]}.dev0")
    citation = (ROOT / "CITATION.cff").read_text()
    assert "\nversion: {}\ndate-released: {}\n".format(*released[0]) in citation
    assert wheel.name.startswith(f"arm5dof-{arm5dof.__version__}-")


def test_no_torch_at_run_time():
    """Neither asked for nor brought along by what is."""
    seen, todo = set(), ["arm5dof"]
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        for text in metadata.requires(name) or []:
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                todo.append(requirement.name.lower().replace("_", "-"))
    assert "jax" in seen and "torch" not in seen


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "report.md"
    files.write_text(path, "old")
    with pytest.raises(RuntimeError), files.replacing(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
