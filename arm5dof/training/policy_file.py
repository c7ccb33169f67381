"""A policy in one small file, to be passed on: a zip of its settings, its networks and the robot's MJCF."""

from __future__ import annotations

import io
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from arm5dof.ddpg import Networks
from arm5dof.errors import UserError
from arm5dof.runtime import files, models
from arm5dof.training import config, robot
from arm5dof.training.checkpoint import named, rebuild
from arm5dof.training.policy import Policy
from arm5dof.training.run import Run
from arm5dof.training.trainer import Trainer

SETTINGS, NETWORKS, ROBOT = "config.toml", "networks.npz", "robot.zip"


def save_policy(run: Run, path: str | Path) -> None:
    """Write the newest policy of a run to a file that does not exist yet.

    Args:
        run: The run, of a task that ships.
        path: Where to.

    Raises:
        UserError: The file exists, or the run has no checkpoint, no robot as MJCF or a task that does not ship.
    """
    path, folder = Path(path), run.folder
    if path.exists():
        raise UserError(f"{path} exists: choose another name")
    if ":" in run.config.task:
        raise UserError(
            f"the task {run.config.task} does not ship: its policy stays with its code, in its run's folder"
        )
    if not (folder / robot.MJCF).is_file():
        raise UserError(f"{folder} keeps no MJCF of its robot: train from a file")
    networks = run.policy().networks
    leaves: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in named(_asked(networks)).items()}
    arrays = io.BytesIO()
    np.savez_compressed(arrays, **leaves)
    with files.replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (
            (SETTINGS, config.dumps(run.config).encode()),
            (NETWORKS, arrays.getvalue()),
            (ROBOT, (folder / robot.MJCF).read_bytes()),
        ):
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)


def load_policy(path: str | Path) -> Policy:
    """The policy of a run's folder, or of a file that `save_policy` wrote.

    Args:
        path: The folder or the file.

    Raises:
        UserError: It is neither, or damaged.

    >>> import arm5dof
    >>> from pathlib import Path
    >>> policy = arm5dof.load_policy(Path(arm5dof.__file__).parent / "grasp" / "policies" / "arm5.zip")
    >>> type(policy.env).__name__, policy.env.config.site
    ('ReachPose', 'grasp')
    """
    path = Path(path)
    if path.is_dir():
        return Run.open(path).policy()
    if not path.is_file():
        raise UserError(f"no policy {str(path)!r}: give a run's folder, or a file that arm5dof export wrote")
    try:
        with zipfile.ZipFile(path) as archive:
            values = tomllib.loads(archive.read(SETTINGS).decode())
            if ":" in str(values["env"]["task"]):  # Nobody's code is run because a file says so.
                raise ValueError("its task does not ship")
            settings = config.build(values)
            with models.reading():
                spec = mujoco.MjSpec.from_zip(io.BytesIO(archive.read(ROBOT)))
            with np.load(io.BytesIO(archive.read(NETWORKS)), allow_pickle=False) as arrays:
                leaves = dict(arrays)
        made = Trainer(config.make_env(settings, spec.compile()), settings)
        like = made.like.networks
        wanted = {name: (leaf.shape, leaf.dtype) for name, leaf in named(_asked(like)).items()}
        if wanted != {name: (leaf.shape, leaf.dtype) for name, leaf in leaves.items()}:
            raise ValueError("its networks are not those of its settings")
        actor, critic = rebuild(_asked(like), leaves)
    except Exception as error:  # zipfile, zlib, NumPy and MuJoCo raise many types for a bad file.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{path} is no policy, or damaged ({reason}): export it anew") from None
    return Policy(made.env, made.agent, settings.ddpg, Networks(actor, critic, actor, critic))


def _asked(networks: Networks) -> tuple[object, object]:
    """What answers: the target networks only learn."""
    return networks.actor, networks.critic
