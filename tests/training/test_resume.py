"""A run killed with SIGKILL at any moment resumes and ends with the bits of the run that was never killed."""

import random
import signal
import subprocess
import sys
import time

import jax
import numpy as np

from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import fixed
from arm5dof.training.run import Run

SETTINGS = (
    "--episodes 24 --num-envs 4 --evaluate-every 12 --checkpoint-every 4 --batch-size 64 --actor-width 32 --heads 2 "
    "--updates-per-step 4 --targets 100 --interim-targets 100 --replay-capacity 8192 --seed 5"
)
KILLS = 5


def command(*arguments):
    return [sys.executable, "-m", "arm5dof", "train", *map(str, arguments)]


def final_state(folder):
    """Every array of the last checkpoint: networks, optimizers, replay, environments, keys, counters."""
    run = Run.open(folder)
    trainer = run.trainer()
    state = Checkpoints(folder / "checkpoints", fixed(run.config)).restore(trainer.like)
    assert int(state.steps) == trainer.total_steps
    raw = lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(k): np.asarray(raw(v)) for k, v in jax.tree_util.tree_leaves_with_path(state)}


def rows(folder):
    """How many epochs a run has put on record."""
    path = folder / "metrics.csv"
    return len(path.read_text().splitlines()) - 1 if path.exists() else -1


def kill_after(words, folder, epochs, delay):
    """Start or resume a run and kill it `delay` seconds after that many epochs; -1 means while it is still starting."""
    process = subprocess.Popen(command(*words))
    while process.poll() is None and (not folder.exists() or rows(folder) < epochs):
        time.sleep(0.005)
    time.sleep(delay)
    process.kill()
    return process.wait()


def test_kill_and_resume_ends_with_the_same_bits(tmp_path):
    """One run, killed again and again: while it starts, on its way, and after it was resumed."""
    reference, folder = tmp_path / "reference", tmp_path / "killed"
    subprocess.run(command("kinematic.toml", *SETTINGS.split(), "--out", reference), check=True)
    expected = final_state(reference)

    moments = random.Random(0)
    later = sorted(moments.randrange(rows(reference) - 5) for _ in range(KILLS - 1))
    words = ("kinematic.toml", *SETTINGS.split(), "--out", folder)
    for epochs in (-1, *later):
        assert kill_after(words, folder, epochs, moments.uniform(0, 0.3)) == -signal.SIGKILL
        words = ("--resume", folder)
    subprocess.run(command("--resume", folder), check=True)
    found = final_state(folder)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)
    assert rows(folder) == rows(reference)
