"""What a sweep is asked for: a TOML file that names a base experiment and axes, and the members that follow from it.

base = "kinematic.toml"
sample_seed = 0                                      # of random axes

[axes]                                               # every combination is a member
actor_lr = [1e-3, 3e-3]
critic_lr = { log_uniform = [1e-4, 1e-2], count = 4 }
noise = { uniform = [0.1, 0.5], count = 3 }
heads = { range = [2, 8, 2] }                        # 2, 4, 6, 8
seed = { count = 4 }                                 # 0, 1, 2, 3

[fixed]                                              # other settings than the base's, for all
episodes = 100

[search]                                             # instead of every combination
method = "tpe"
trials = 50
"""

from __future__ import annotations

import itertools
import json
import math
import sys
import tomllib
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tomli_w
from annotated_types import Ge

from arm5dof.errors import UserError, nearest_hint
from arm5dof.runtime import files
from arm5dof.settings import settings, static
from arm5dof.training import config
from arm5dof.training.config import SECTIONS, Config

SEED = "train.seed"
VARIANT = "variant"
TABLES = ("base", "sample_seed", "axes", "variants", "fixed", "search")
MOST = 100_000
"""Members: more are a mistake."""


@settings
class Search:
    """How to look for the best configuration instead of training every one."""

    method: Literal["random", "tpe"] = static(default="tpe")
    """random: independent samples; tpe: the tree-structured Parzen estimator, which learns from the trials before."""
    trials: Annotated[int, Ge(1)] = static(default=20)
    """Configurations to try, each with every seed."""
    prune: bool = static(default=True)
    """Whether trials that fall behind end at an evaluation, by asynchronous successive halving."""


@dataclass(frozen=True)
class Axis:
    """The values of one setting: some, or an interval to sample from where `values` is empty."""

    values: tuple[Any, ...]
    low: float = 0.0
    high: float = 0.0
    log: bool = False


class Member(NamedTuple):
    """One run of a sweep."""

    name: str
    settings: dict[str, Any]
    """The settings by which members differ, by full name, the seed included; and the name of the `variant`."""
    config: Config


@dataclass(frozen=True)
class Spec:
    """A sweep, checked: every one of its configurations can be built."""

    base: Config
    axes: dict[str, Axis]
    """By full name of the setting, such as `ddpg.actor_lr`, in the order in which settings are declared: TOML keeps
    none, and members are numbered by it."""
    variants: dict[str, dict[str, Any]]
    """Sets of settings by full name, by the names that are the values of the axis `variant`."""
    search: Search | None
    sample_seed: int
    source: Mapping[str, Any]
    """The tables of the TOML file that say all this."""

    @cached_property
    def members(self) -> list[Member]:
        """Every combination of the axes' values, the last axis varying first; none where there is a search."""
        if self.search:
            return []
        names, count = list(self.axes), math.prod(len(axis.values) for axis in self.axes.values())
        width = max(4, len(str(count - 1)))
        combinations = itertools.product(*(axis.values for axis in self.axes.values()))
        return [
            self.member(f"m{number:0{width}}", dict(zip(names, values, strict=True)))
            for number, values in enumerate(combinations)
        ]

    def member(self, name: str, values: Mapping[str, Any]) -> Member:
        """A member with some values of the axes. Raises `UserError` for a value that its setting cannot have."""
        given = {name: value for name, value in values.items() if name != VARIANT}
        changed = config.override(self.base, {**self.variants.get(values.get(VARIANT, ""), {}), **given})
        flat = {**changed.flat(), VARIANT: values.get(VARIANT)}
        return Member(name, {key: flat[key] for key in dict.fromkeys([*self.axes, SEED])}, changed)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds that every configuration is trained with."""
        return self.axes[SEED].values if SEED in self.axes else (self.base.train.seed,)

    def dumps(self) -> str:
        """The sweep as TOML that depends on no other file."""
        complete = tomllib.loads(config.dumps(self.base))
        return tomli_w.dumps({**{k: v for k, v in self.source.items() if k != "fixed"}, "base": complete})

    def same_as(self, other: Spec) -> bool:
        """Whether results of one are results of the other. A search may go on for more trials."""
        return self._identity == other._identity

    @property
    def _identity(self) -> object:
        search = self.search and replace(self.search, trials=1)
        return self.base, self.axes, self.variants, list(self.variants), self.sample_seed, search


def read(path: str | Path) -> Spec:
    """The sweep of a TOML file, or of one that ships.

    Raises:
        UserError: There is no such file, or it asks for what cannot be trained; the first fault.
    """
    found = files.find("experiments", path)
    if found is None:
        names = ", ".join(name for name in files.shipped("experiments", ".toml") if name.startswith("sweep_"))
        raise UserError(f"no sweep {str(path)!r}: give a TOML file, or one of those shipped: {names}")
    values = files.read_toml(found)
    try:
        return parse(values, found.parent)
    except UserError as error:
        raise UserError(f"{found}: {error}") from None


def parse(values: Mapping[str, Any], folder: Path | None = None) -> Spec:
    """A sweep from nested values, as TOML has them.

    Args:
        values: What the file says: see this module's text. `base` may be a `Config`, or sections of settings.
        folder: Where the base experiment may lie, besides the usual places.

    Raises:
        UserError: The first fault.
    """
    for table in values:
        if table not in TABLES:
            raise UserError(f"unknown table {table!r} of a sweep: {nearest_hint(table, TABLES)}")
    given, fixed = (_flat(name, values.get(name, {})) for name in ("axes", "fixed"))
    stated = values.get("variants", {})
    if not isinstance(stated, Mapping) or not all(isinstance(v, Mapping) for v in stated.values()):
        raise UserError('variants: it should be a table [variants] of "NAME" = { SETTING = VALUE }')
    if "base" not in values or not (given or stated):
        raise UserError('a sweep names its base experiment, base = "NAME.toml", and has [axes] with one at least')
    sample_seed = values.get("sample_seed")
    if sample_seed is not None and (type(sample_seed) is not int or sample_seed < 0):
        raise UserError(f"sample_seed = {sample_seed!r}: it should be a whole number, 0 or more")
    base = _base(values["base"], folder)
    named = _by_full_name(base, fixed, "[fixed]")
    base = config.override(base, named)
    variants = {name: _by_full_name(base, _flat(name, v), f"variant {name!r}") for name, v in stated.items()}
    search = _search(values.get("search"))
    axes: dict[str, Axis] = {}
    for name, said in given.items():
        (full,) = _by_full_name(base, {name: None}, "[axes]")
        others = {**dict.fromkeys(axes, "another axis"), **dict.fromkeys(named, "fixed")}
        others |= {key: f"set by variant {v!r}" for v, changed in variants.items() for key in changed}
        if full in others:
            raise UserError(f"{full} is set twice: it is an axis, and {others[full]}")
        axes[full] = _axis(name, full, said, sample_seed, search)
    if sample_seed is None and search is not None:
        raise UserError("a search is random: say sample_seed = 0, so that it can be repeated")
    count = math.prod(len(axis.values) or 1 for axis in axes.values())
    if search is None and count > MOST:
        raise UserError(f"{count} members are more than {MOST}: choose fewer values, or a [search]")
    source = {**{k: v for k, v in values.items() if k not in ("base", "axes")}, "axes": dict(given)}
    axes = {name: axes[name] for name in base.flat() if name in axes}
    if variants:
        axes = {VARIANT: Axis(tuple(variants)), **axes}
    made = Spec(base, axes, variants, search, sample_seed or 0, source)
    for full, axis in axes.items():  # Values are checked one by one: errors name them, and a search has no members.
        _check_values(made, full, axis)
    _ = made.members
    return made


def _flat(table: str, values: Any) -> dict[str, Any]:
    """A table's entries; `ddpg.noise` without quotes is a table in TOML."""
    if not isinstance(values, Mapping):
        raise UserError(f"{table} = {values!r}: it should be a table [{table}]")
    found: dict[str, Any] = {}
    for name, value in values.items():
        nested = value if name in SECTIONS and isinstance(value, Mapping) else None
        found.update({name: value} if nested is None else {f"{name}.{key}": v for key, v in nested.items()})
    return found


def _base(given: Any, folder: Path | None) -> Config:
    if isinstance(given, Config):
        return given
    if isinstance(given, Mapping):
        return config.build(given, "base", folder, fill=True)
    if not isinstance(given, str):
        raise UserError(f"base = {given!r}: it should be the name of an experiment")
    beside = folder / given if folder is not None else None
    return config.load_config(beside if beside is not None and beside.is_file() else given)


def _by_full_name(base: Config, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Raises `UserError` for what is no setting, and for the same setting twice."""
    known, found = config.fields(base), dict[str, Any]()
    for name, value in values.items():
        field = config.find(name, known)
        full = f"{field.section}.{field.name}"
        if full in found:
            raise UserError(f"{full} is set twice in {where}")
        found[full] = value
    return found


def _search(given: Any) -> Search | None:
    if given is None:
        return None
    found: Search = config.build_section("search", Search, _flat("search", given))
    return found


def _axis(name: str, full: str, said: Any, sample_seed: int | None, search: Search | None) -> Axis:
    """The values that an axis asks for."""
    if isinstance(said, (list, tuple)):
        values = tuple(tuple(v) if isinstance(v, list) else v for v in said)
        return _nonempty(name, values)
    wanted = f"axis {name!r}: give a list, or one of log_uniform, uniform, range = [from, to, step], count"
    if not isinstance(said, Mapping):
        raise UserError(wanted)
    kinds = [kind for kind in ("log_uniform", "uniform", "range") if kind in said]
    if set(said) - {*kinds, "count"} or len(kinds) > 1 or ("range" in kinds and "count" in said) or not said:
        raise UserError(wanted)
    count = said.get("count")
    if count is not None and (not isinstance(count, int) or isinstance(count, bool) or count < 0):
        raise UserError(f"axis {name!r}: count = {count!r} should be a whole number")
    if count is not None and count > MOST:
        raise UserError(f"axis {name!r}: count = {count} is more than {MOST}")
    if not kinds:
        if full != SEED:
            raise UserError(f"axis {name!r}: a count alone is for seeds; say log_uniform, uniform or range")
        return _nonempty(name, tuple(range(int(count or 0))))
    numbers = said[kinds[0]]
    if kinds == ["range"]:
        return _nonempty(name, tuple(_steps(name, numbers)))
    low, high = _numbers(name, kinds[0], numbers, 2)
    log = kinds == ["log_uniform"]
    if not low < high or (log and low <= 0):
        raise UserError(f"axis {name!r}: {kinds[0]} = {numbers!r} should be [low, high]{', above 0' * log}")
    if search:
        return Axis((), low, high, log)
    if count is None:
        raise UserError(f"axis {name!r}: say how many values, {kinds[0]} = {numbers!r}, count = 4")
    if sample_seed is None:
        raise UserError(f"axis {name!r} is random: say sample_seed = 0, so that it can be repeated")
    # Of each axis by its name: another axis more does not change its values.
    rng = np.random.default_rng([sample_seed, zlib.crc32(full.encode())])
    share = np.sort(rng.uniform(size=count))
    drawn = low * (high / low) ** share if log else low + (high - low) * share
    return _nonempty(name, tuple(map(float, drawn)))


def _steps(name: str, said: Any) -> Iterator[float | int]:
    start, stop, step = _numbers(name, "range", said, 3)
    if step == 0:
        raise UserError(f"axis {name!r}: range = {said!r} has a step of 0")
    last = (stop - start) / step
    if not last < MOST:
        raise UserError(f"axis {name!r}: range = {said!r} has more than {MOST} values")
    return (start + i * step for i in range(max(math.floor(max(last, -1.0) + 1e-9) + 1, 0)))


def _numbers(name: str, kind: str, said: Any, count: int) -> list[Any]:
    good = isinstance(said, (list, tuple)) and len(said) == count
    if not good or any(type(v) not in (int, float) or not abs(v) <= sys.float_info.max for v in said):
        raise UserError(f"axis {name!r}: {kind} = {said!r} should be {count} numbers")
    return list(said)


def _nonempty(name: str, values: tuple[Any, ...]) -> Axis:
    if not values:
        raise UserError(f"axis {name!r} is empty: the sweep has no members")
    return Axis(values)


def _check_values(made: Spec, full: str, axis: Axis) -> None:
    values: Iterable[Any] = axis.values or (axis.low, axis.high)
    found = [made.member("", {full: value}).settings[full] for value in values]
    for number, value in enumerate(found):
        if value in found[:number]:
            raise UserError(f"axis {full!r} has {json.dumps(value, default=str)} twice")
