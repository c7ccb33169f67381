"""Dataclasses of settings: frozen, validated, and pytrees whose numbers can be traced.

A field declared with `static` shapes the program (sizes, names, switches); every other field is a leaf, so a
population of settings is one `jax.vmap`. Ranges are `annotated_types` constraints, descriptions the docstrings under
the fields; pydantic checks the former and turns the latter into `--help`.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from typing import Any, TypeVar, dataclass_transform

import jax
import pydantic

from arm5dof.errors import UserError

T = TypeVar("T")


def static(*, default: Any, may_change: bool = False) -> Any:
    """A field that is part of the compiled program rather than one of its inputs. One that `may_change` can have
    another value when a run is resumed; all others are as they were when its networks were made."""
    return dataclasses.field(default=default, metadata={"static": True, "may_change": may_change})


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def settings(cls: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass whose constructor validates strictly, and a pytree.

    The constructor raises `UserError`, one line, for the first value that is not of its field's type or range. Traced
    numbers and arrays pass for numbers.

    >>> from arm5dof.settings import settings, static
    >>> @settings
    ... class Config:
    ...     gravity: float = 9.81
    ...     episode_length: int = static(default=200)
    >>> Config(episode_length="long")
    Traceback (most recent call last):
    arm5dof.errors.UserError: episode_length = 'long': input should be a valid integer
    """
    cls.__pydantic_config__ = pydantic.ConfigDict(use_attribute_docstrings=True)  # type: ignore[attr-defined]
    cls.__post_init__ = _validate  # type: ignore[attr-defined]
    made = dataclasses.dataclass(frozen=True)(cls)
    names = [f.name for f in dataclasses.fields(made)]  # type: ignore[arg-type]
    fixed = [f.name for f in dataclasses.fields(made) if f.metadata.get("static")]  # type: ignore[arg-type]
    leaves = [name for name in names if name not in fixed]
    keys = [jax.tree_util.GetAttrKey(name) for name in leaves]

    def flatten(config: T) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(config, name) for name in leaves], tuple(getattr(config, name) for name in fixed)

    def flatten_with_keys(config: T) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        values, shape = flatten(config)
        return list(zip(keys, values, strict=True)), shape

    def unflatten(shape: tuple[Any, ...], values: Any) -> T:
        config = object.__new__(made)  # Without validation: JAX puts all sorts of things into pytrees.
        for name, value in (*zip(leaves, values, strict=True), *zip(fixed, shape, strict=True)):
            object.__setattr__(config, name, value)
        return config

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    return made


def _validate(config: Any) -> None:
    """Check a new instance's values, and convert them to the types of their fields."""
    given = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}  # TOML has no tuples.
    fixed = {f.name for f in dataclasses.fields(config) if f.metadata.get("static")}
    plain = {name: v for name, v in values.items() if name in fixed or not _is_array(v)}
    try:
        checked = _validator(type(config))(**plain)  # type: ignore[arg-type]
    except pydantic.ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, fault["loc"]))
        raise UserError(f"{where} = {fault['input']!r}: {fault['msg'][0].lower()}{fault['msg'][1:]}") from None
    for name in plain:
        object.__setattr__(config, name, getattr(checked, name))


def _is_array(value: Any) -> bool:
    """Whether it is an array or a traced number, or holds one."""
    if isinstance(value, (bool, int, float, str)):  # NumPy's numbers are both.
        return False
    return any(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(value))


@functools.cache
def _validator(cls: type) -> type[pydantic.BaseModel]:
    hints = typing.get_type_hints(cls, include_extras=True)
    strict = pydantic.ConfigDict(strict=True, allow_inf_nan=False, protected_namespaces=())
    fields: dict[str, Any] = {f.name: (hints[f.name], f.default) for f in dataclasses.fields(cls)}
    return pydantic.create_model(cls.__name__, __config__=strict, **fields)
