"""Every notebook runs from top to bottom."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))

SAID = {
    "01_quickstart": ("corrections=10: median 0.0", "mm at most", "degrees off"),
    "02_environment": ("servo: observations", "truncated 1, new goal: True", "carts that stop within 5 cm: 100 %"),
    "03_sweep": ("16 rows of", "best: m00", "nothing is done twice: True"),
    "04_vision": ("views, RMS 0.0", "mm from where it is", "off by"),
    "05_grasp": ("stage='done'", "is seen"),
}
"""What shows that a notebook came to its end, and that what it taught was learnt."""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path):
    cells = json.loads(path.read_text())["cells"]
    assert all(not cell["outputs"] for cell in cells if cell["cell_type"] == "code")
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(words in done.stdout for words in SAID[path.stem])
