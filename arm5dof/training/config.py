"""The whole configuration of a run: TOML in, TOML out, every field overridable by name."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import tomli_w
from pydantic import TypeAdapter

from arm5dof.ddpg import DDPGConfig
from arm5dof.envs import Task
from arm5dof.errors import UserError, nearest, nearest_hint
from arm5dof.runtime import files
from arm5dof.training.evaluate import EvaluateConfig
from arm5dof.training.trainer import TrainConfig


@dataclass(frozen=True)
class Config:
    """A run: the task and its settings, the agent, the budget and the accuracy protocol.

    >>> from arm5dof import load_config
    >>> config = load_config("kinematic.toml", seed=3)
    >>> config.task, config.train.seed, config.flat()["ddpg.heads"]
    ('reach', 3, 8)
    """

    task: str
    """The name of a task that ships, or `package.module:Class`."""
    env: Any
    ddpg: DDPGConfig
    train: TrainConfig
    evaluate: EvaluateConfig

    def flat(self) -> dict[str, Any]:
        """Every setting by its full name, such as `ddpg.batch_size`."""
        return {
            "env.task": self.task,
            **{
                f"{section}.{f.name}": getattr(getattr(self, section), f.name)
                for section in SECTIONS
                for f in dataclasses.fields(getattr(self, section))
            },
        }


SECTIONS = ("env", "ddpg", "train", "evaluate")


def fixed(config: Config) -> dict[str, Any]:
    """The settings that shape a run's networks and what they have learnt, by full name."""
    others = may_change(config)
    return {name: value for name, value in config.flat().items() if name not in others}


def may_change(config: Config) -> dict[str, Any]:
    """The settings that may change before a run is resumed, by full name."""
    return {
        f"{section}.{f.name}": getattr(getattr(config, section), f.name)
        for section in SECTIONS
        for f in dataclasses.fields(getattr(config, section))
        if f.metadata.get("may_change")
    }


class Field(NamedTuple):
    """One setting, as people name it."""

    section: str
    name: str
    value: Any
    help: str
    choices: list[str] | None


def load_config(experiment: str | Path = "reach.toml", /, **overrides: Any) -> Config:
    """Read an experiment and override its settings.

    What a file leaves open is as in the TOML file of its task, `NAME.toml` for a task that ships.

    Args:
        experiment: A TOML file, or the name of one that ships.
        overrides: Values by name: `batch_size=128`, or with its section where a name is not unique:
            `**{"ddpg.batch_size": 128}`. Text is read as on a command line, a tuple as
            `mark="0.1, 0.2"`.

    Raises:
        UserError: There is no such file or setting, or a value is not of its type and range.

    >>> from arm5dof import load_config
    >>> config = load_config("kinematic.toml", episodes=100)
    >>> config.train.episodes, config.env.dynamics
    (100, 'kinematic')
    >>> load_config(batch_sise=3)
    Traceback (most recent call last):
    arm5dof.training.config.UnknownSettingError: unknown setting 'batch_sise': did you mean 'batch_size'?
    """
    path = files.find("experiments", experiment)
    if path is None:
        names = ", ".join(shipped_experiments())
        raise UserError(f"no experiment {str(experiment)!r}: give a TOML file, or one of those shipped: {names}")
    values = files.read_toml(path)
    if "axes" in values or "variants" in values:
        raise UserError(f"{path} is a sweep, not an experiment: run it with arm5dof sweep {path}")
    return override(build(values, str(path), path.parent, fill=True), overrides)


def override(config: Config, values: Mapping[str, Any]) -> Config:
    """A configuration with other values of some settings, by name, as `load_config` takes them."""
    known, given = fields(config), dict[str, dict[str, Any]]()
    for name, value in values.items():
        found = find(name, known)
        given.setdefault(found.section, {})[found.name] = _parse(value, found.value)
    now = {section: getattr(config, section) for section in given}
    changed = {name: build_section(name, type(now[name]), {**vars(now[name]), **given[name]}) for name in given}
    return dataclasses.replace(config, **changed)


def build(values: Mapping[str, Any], source: str = "", folder: Path | None = None, fill: bool = False) -> Config:
    """A configuration from nested settings, as TOML has them.

    Args:
        values: Settings by section and name; `values["env"]["task"]` is the task.
        source: Where they are from, for errors.
        folder: Where a user's own task may be imported from, besides the usual places.
        fill: Take what they leave open from the TOML file of a task that ships, rather than from the sections' classes.

    Raises:
        UserError: The first fault, and for an unknown key the nearest valid one.
    """
    try:
        for section, given in values.items():
            if section not in SECTIONS:
                raise UserError(f"unknown section {section!r}: {nearest_hint(section, SECTIONS)}")
            if not isinstance(given, Mapping):
                raise UserError(f"{section} = {given!r}: it should be a section [{section}]")
        task = values.get("env", {}).get("task", "reach")
        classes = {"env": task_class(task, folder).Config, "ddpg": DDPGConfig, "train": TrainConfig}
        classes["evaluate"] = EvaluateConfig
        path = files.shipped_file("experiments", f"{task}.toml") if fill and ":" not in task else None
        shipped = {} if path is None else files.read_toml(path)
        merged = {section: {**shipped.get(section, {}), **values.get(section, {})} for section in SECTIONS}
        merged["env"].pop("task", None)
        return Config(task, **{name: build_section(name, classes[name], merged[name]) for name in SECTIONS})
    except UserError as error:
        raise UserError(f"{source}: {error}" if source else str(error)) from None


def dumps(config: Config, left_open: Collection[str] = ()) -> str:
    """The configuration as TOML, every field spelled out but those of the full names `left_open`."""
    sections: dict[str, dict[str, Any]] = {name: {} for name in SECTIONS}
    for full_name, value in config.flat().items():
        section, _, name = full_name.partition(".")
        if full_name not in left_open:
            sections[section][name] = value
    return tomli_w.dumps(sections)


def task_class(task: str, folder: Path | None = None) -> type[Task]:
    """The class of a task: for `reach_pose` `ReachPose` of `arm5dof.envs.reach_pose`, or a user's `module:Class`.

    Raises:
        UserError: There is none of that name, or it is no task.
    """
    module, _, name = task.partition(":") if isinstance(task, str) else ("", "", "")
    shipped = not name
    if shipped:
        name = "".join(word.capitalize() for word in module.split("_"))
        if not module.isidentifier() or importlib.util.find_spec(f"arm5dof.envs.{module}") is None:
            raise UserError(
                f"no task {task!r}: it is one of those shipped ({', '.join(shipped_tasks())}), or package.module:Class"
            )
        module = f"arm5dof.envs.{module}"
    try:
        found: Any = getattr(_import(module, folder), name, None)
    except Exception as error:  # The user's own code, which may raise anything.
        reason = f"{type(error).__name__}: {error}"
        raise UserError(
            f"cannot import task {task!r} ({reason}): put its folder on PYTHONPATH, or start from there"
        ) from error
    if folder is not None and not shipped:
        _check_origin(module.partition(".")[0], folder)
    is_task = isinstance(found, type) and issubclass(found, Task)
    if not is_task or not dataclasses.is_dataclass(getattr(found, "Config", None)):
        raise UserError(f"{task!r} is no task: it takes a class that inherits from arm5dof.Task and has a Config")
    return found


def shipped_experiments() -> list[str]:
    """Names of the experiments that ship. Sweeps lie beside them, and their names say so."""
    return [name for name in files.shipped("experiments", ".toml") if not name.startswith("sweep_")]


def shipped_tasks() -> list[str]:
    """Names of the tasks that ship: those with a module and a TOML file of the same name."""
    names = [name.removesuffix(".toml") for name in shipped_experiments()]
    return [name for name in names if importlib.util.find_spec(f"arm5dof.envs.{name}")]


def make_env(config: Config, mj_model: mujoco.MjModel | None = None) -> Task:
    """The environment that a configuration describes.

    Args:
        config: The configuration.
        mj_model: The compiled model to use instead of the file that the task's settings name.

    Raises:
        UserError: The task cannot be made from these settings.

    >>> from arm5dof import load_config, make_env
    >>> make_env(load_config("kinematic.toml")).action_size
    5
    """
    cls: Any = task_class(config.task)
    return cls(config.env) if mj_model is None else cls(config.env, mj_model)


def fields(config: Config) -> list[Field]:
    """Every setting of a configuration with its documentation, in the order of declaration."""
    return [
        Field(section, name, getattr(settings, name), *described)
        for section, settings in ((section, getattr(config, section)) for section in SECTIONS)
        for name, described in _descriptions(settings.__class__).items()
    ]


def find(name: str, known: list[Field]) -> Field:
    """The setting of a name, `batch_size` or `ddpg.batch_size`.

    Raises:
        UnknownSettingError: There is none.
        UserError: There are several: it gives their full names.
    """
    wanted = name.replace("-", "_")
    matching = [f for f in known if wanted in (f.name, f"{f.section}.{f.name}")]
    if len(matching) > 1:
        raise UserError(f"{name!r} is {' or '.join(f'{f.section}.{f.name}' for f in matching)}: name the section too")
    if not matching:
        names = [key for f in known for key in (f.name, f"{f.section}.{f.name}")]
        raise UnknownSettingError(name, nearest(wanted, names))
    return matching[0]


class UnknownSettingError(UserError):
    """No setting has that name; `nearest` is the valid one that is most like it, if any is."""

    def __init__(self, name: str, nearest: str | None) -> None:
        hint = f"did you mean {nearest!r}?" if nearest else "`Config.flat()` lists the valid ones"
        super().__init__(f"unknown setting {name!r}: {hint}")
        self.name, self.nearest = name, nearest


def build_section(name: str, cls: Any, values: Mapping[str, Any]) -> Any:
    """The settings of a section, by its name and class. Raises `UserError` for an unknown key or a wrong value."""
    names = [f.name for f in dataclasses.fields(cls)]
    for key in values:
        if key not in names:
            raise UserError(f"unknown key '{name}.{key}': {nearest_hint(key, names)}")
    try:
        return cls(**values)
    except UserError as error:
        raise UserError(f"{name}.{error}") from None


def _import(module: str, folder: Path | None) -> Any:
    """Import a module, if need be from `folder` or the working directory."""
    for place in (folder, Path.cwd()):
        if place is not None and str(place.resolve()) not in sys.path:
            sys.path.append(str(place.resolve()))
    importlib.invalidate_caches()
    return importlib.import_module(module)


def _check_origin(module: str, folder: Path) -> None:
    """Raise `UserError` if a folder has an imported module of its own that is not the one imported."""
    own, used = PathFinder.find_spec(module, [str(folder)]), getattr(sys.modules[module], "__file__", None)
    if own and own.has_location and Path(str(used)).resolve() != Path(str(own.origin)).resolve():
        raise UserError(
            f"module {module!r} is {used} here and not {own.origin}: rename one of them, or use a process for each"
        )


@functools.cache
def _descriptions(cls: type) -> dict[str, tuple[str, list[str] | None]]:
    """What is said of each field, and its choices if it has some."""
    described: dict[str, tuple[str, list[str] | None]] = {}
    for base in reversed(cls.__mro__):  # A field is described where it is declared.
        for name, schema in (
            TypeAdapter(base).json_schema()["properties"] if "__pydantic_config__" in base.__dict__ else {}
        ).items():
            if "description" in schema or name not in described:
                described[name] = " ".join(schema.get("description", "").split()), schema.get("enum")
    return described


def _parse(value: Any, default: Any) -> Any:
    """A command line's text as the value that it spells, `0.1, 0.2` for a tuple; what is no text, or is to be some,
    stays."""
    if not isinstance(value, str) or isinstance(default, str):
        return value
    if isinstance(default, tuple):
        parts = value.strip("()[] ").removesuffix(",").split(",")
        examples = [*default, *default[-1:] * len(parts)] or [None] * len(parts)
        return tuple(_parse(part.strip(), example) for part, example in zip(parts, examples, strict=False))
    if isinstance(default, bool):
        return {"true": True, "false": False}.get(value.lower(), value)
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(value)
    return value
