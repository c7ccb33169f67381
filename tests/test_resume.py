"""A run killed with SIGKILL at any moment resumes and ends with the bits of the run that was never killed."""

import os
import random
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from arm5dof.checkpoint import Checkpoints
from arm5dof.run import Run, make_trainer

SETTINGS = [
    "--episodes",
    "24",
    "--num-envs",
    "4",
    "--evaluate-every",
    "12",
    "--checkpoint-every",
    "4",
    "--batch-size",
    "64",
    "--width",
    "32",
    "--heads",
    "2",
    "--updates-per-step",
    "4",
    "--targets",
    "200",
    "--interim-targets",
    "100",
    "--replay-capacity",
    "8192",
    "--seed",
    "5",
]
KILLS = 5


def command(*arguments):
    return [sys.executable, "-m", "arm5dof", "train", *map(str, arguments)]


def final_state(folder):
    """Every array of the last checkpoint: networks, optimisers, replay, environments, keys, counters."""
    run = Run.open(folder)
    trainer = make_trainer(run.config)
    state = Checkpoints(folder / "checkpoints").restore(trainer.like)
    assert int(state.steps) == trainer.total_steps
    raw = lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(k): np.asarray(raw(v)) for k, v in jax.tree_util.tree_leaves_with_path(state)}


@pytest.mark.parametrize("experiment", ["kinematic.toml"])
def test_kill_and_resume_ends_with_the_same_bits(experiment, tmp_path):
    reference = tmp_path / "reference"
    subprocess.run(command(experiment, *SETTINGS, "--out", tmp_path / "warm"), check=True)  # Fills the program cache.
    started = time.monotonic()
    subprocess.run(command(experiment, *SETTINGS, "--out", reference), check=True)
    duration = time.monotonic() - started
    expected = final_state(reference)

    moments = random.Random(0)
    for attempt in range(KILLS):
        folder = tmp_path / f"killed-{attempt}"
        process = subprocess.Popen(command(experiment, *SETTINGS, "--out", folder))
        time.sleep(duration * moments.uniform(0.3, 0.95))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        again = ("--resume", folder) if folder.exists() else (experiment, *SETTINGS, "--out", folder)
        subprocess.run(command(*again), check=True)
        found = final_state(folder)
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], value, err_msg=f"{name}, attempt {attempt}")
        assert (folder / "metrics.csv").read_text().count("\n") == (reference / "metrics.csv").read_text().count("\n")
