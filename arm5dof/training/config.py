"""The whole configuration of a run: TOML in, TOML out, every field overridable by name."""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w
from pydantic import TypeAdapter, ValidationError

from arm5dof.ddpg import DDPGConfig
from arm5dof.envs import ReachConfig
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.settings import settings
from arm5dof.training.evaluate import EvaluateConfig
from arm5dof.training.trainer import TrainConfig


@settings
class Config:
    """A run: the task, the agent, the budget and the accuracy protocol."""

    env: ReachConfig = ReachConfig()
    ddpg: DDPGConfig = DDPGConfig()
    train: TrainConfig = TrainConfig()
    evaluate: EvaluateConfig = EvaluateConfig()


class Field(NamedTuple):
    """One setting, as people name it."""

    section: str
    name: str
    default: Any
    help: str
    choices: list[str] | None


ADAPTER = TypeAdapter(Config)


def fields() -> Iterator[Field]:
    """Every setting with its documentation, in the order of declaration. Names are unique across sections."""
    schema = ADAPTER.json_schema()
    for section, reference in schema["properties"].items():
        name = (reference.get("$ref") or reference["allOf"][0]["$ref"]).rsplit("/", 1)[-1]
        for key, value in schema["$defs"][name]["properties"].items():
            yield Field(section, key, value["default"], " ".join(value["description"].split()), value.get("enum"))


def build(values: Mapping[str, Any], source: str) -> Config:
    """Validate nested settings. Raises `UserError` naming the first fault, and the nearest valid name for a bad key."""
    try:
        return ADAPTER.validate_json(json.dumps(values))
    except ValidationError as error:
        raise UserError(f"{source}: {_explain(error.errors()[0])}") from None
    except (TypeError, ValueError) as error:
        raise UserError(f"{source}: {error}") from None


def load(experiment: str | Path, overrides: Mapping[str, str] | None = None) -> Config:
    """Read an experiment (a path, or the name of one that ships) and override fields, given as text by name.

    A name may be `batch_size`, `batch-size` or `ddpg.batch_size`. Raises `UserError` on anything amiss.
    """
    path = files.find("experiments", experiment)
    if path is None:
        known = ", ".join(files.shipped("experiments", ".toml"))
        raise UserError(f"no experiment {str(experiment)!r}: give a TOML file, or one of those shipped: {known}")
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise UserError(f"{path} is not valid TOML: {error}") from None
    if not overrides:
        return build(values, str(path))
    build(values, str(path))  # So that a fault of the file is not blamed on the command line.
    for name, text in overrides.items():
        known_field = find(name)
        values.setdefault(known_field.section, {})[known_field.name] = _parse(text, known_field.default)
    return build(values, "command line")


def find(name: str) -> Field:
    """The setting of that name. Raises `UserError` naming the nearest one if there is none."""
    wanted = name.replace("-", "_")
    known = {key: f for f in fields() for key in (f.name, f"{f.section}.{f.name}")}
    if wanted not in known:
        near = difflib.get_close_matches(wanted, known, n=1)
        hint = f"did you mean --{near[0].replace('_', '-')}?" if near else "see arm5dof train --help"
        raise UserError(f"unknown option --{name}: {hint}")
    return known[wanted]


def dumps(config: Config) -> str:
    """The configuration as TOML, every field spelled out."""
    return tomli_w.dumps(dataclasses.asdict(config))


def _parse(text: str, default: Any) -> Any:
    """A command line's text as the TOML value it spells; strings need no quotes there."""
    if isinstance(default, str):
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _explain(fault: Any) -> str:
    path = [str(part) for part in fault["loc"]]
    where = ".".join(path)
    if fault["type"] == "unexpected_keyword_argument":
        table: dict[str, list[str]] = {}
        for f in fields():
            table.setdefault(f.section, []).append(f.name)
        valid = list(table) if len(path) == 1 else table[path[0]]
        near = difflib.get_close_matches(path[-1], valid, n=1)
        return f"unknown key {where!r}: " + (f"did you mean {near[0]!r}?" if near else f"valid are {', '.join(valid)}")
    return f"{where} = {fault['input']!r}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
