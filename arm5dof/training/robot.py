"""The robot that a run keeps in its folder: compiled, which only the same MuJoCo reads, and as MJCF with its assets,
which newer ones read too, to the six digits that MuJoCo writes."""

from __future__ import annotations

import gzip
import hashlib
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np

from arm5dof.envs import Task
from arm5dof.errors import UserError

COMPILED, MJCF = "model.mjb.gz", "model.zip"


def keep(folder: Path, env: Task) -> dict[str, str]:
    """Write a task's MuJoCo model into a folder, if it has one. Returns the files' digests by name."""
    if env.mj_model is None:
        return {}
    buffer = np.empty(mujoco.mj_sizeModel(env.mj_model), np.uint8)
    mujoco.mj_saveModel(env.mj_model, None, buffer)
    (folder / COMPILED).write_bytes(gzip.compress(buffer.tobytes(), 3, mtime=0))
    if env.mj_spec is not None:
        _with_assets(env.mj_spec).to_zip(str(folder / MJCF))
    return {name: _digest(folder / name) for name in (COMPILED, MJCF) if (folder / name).exists()}


def kept(folder: Path, version: str, digests: Mapping[str, str]) -> mujoco.MjModel | None:
    """The model in a run's folder, or None if it has none.

    Args:
        folder: The run's folder.
        version: The version of MuJoCo that wrote it.
        digests: What `keep` returned.

    Raises:
        UserError: It is damaged, or this MuJoCo cannot read it.
    """
    if not digests:
        return None
    same = version == metadata.version("mujoco")
    path = folder / (COMPILED if same else MJCF)
    unreadable = f"{folder} keeps its robot as MuJoCo {version} has it: install that version"
    if not same and MJCF not in digests:
        raise UserError(unreadable)
    if not path.is_file() or _digest(path) != digests.get(path.name):
        raise UserError(f"{path}, the run's robot, is missing or damaged: take it from a copy of the run")
    if same:
        return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": gzip.decompress(path.read_bytes())})
    warnings.warn(
        f"{folder} was made with MuJoCo {version}: its robot is compiled anew from MJCF, whose numbers have six digits",
        stacklevel=2,
    )
    try:
        return mujoco.MjSpec.from_zip(str(path)).compile()
    except ValueError as error:
        raise UserError(f"{unreadable} ({error})") from None


def _with_assets(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A copy of a model's description that holds the files which it names: `to_zip` leaves them where they are."""
    named = [(spec.meshdir, asset.file) for asset in (*spec.meshes, *spec.hfields, *spec.skins)]
    named += [(spec.texturedir, name) for asset in spec.textures for name in (asset.file, *asset.cubefiles)]
    paths = {str(Path(*parts)): Path(spec.modelfiledir, *parts) for parts in named}
    whole = spec.copy()
    whole.assets = {**spec.assets, **{name: path.read_bytes() for name, path in paths.items() if path.is_file()}}
    return whole


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
