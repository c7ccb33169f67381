"""Dataclasses of settings: frozen, validated, and pytrees whose numbers can be traced.

A field declared with `static` shapes the program (sizes, names, switches); every other field is a leaf, so a
population of settings is one `jax.vmap`. Ranges are `annotated_types` constraints, descriptions the docstrings under
the fields; pydantic checks the former and turns the latter into `--help`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
from pydantic import ConfigDict

T = TypeVar("T")


def static(*, default: Any) -> Any:
    """A field that is part of the compiled program rather than one of its inputs."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def settings(cls: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass that pydantic validates strictly and JAX sees as a pytree."""
    cls.__pydantic_config__ = ConfigDict(  # type: ignore[attr-defined]
        extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))
