"""Programs of a policy: traced once for all policies of one form, in a process and, where that is known to be enough,
on disk."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar

import jax

from arm5dof.ddpg import DDPG
from arm5dof.runtime.programs import Program

if TYPE_CHECKING:
    from arm5dof.training.policy import Policy

T = TypeVar("T")
Options = Callable[[], Mapping[str, Any]]


def of_policy(compiler_options: Options = dict) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Decorates what `jax.jit` would: a function of a policy and of pytrees of arrays; what it is given by name is
    static. The options are asked for when the first policy is there, since they start JAX."""

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        @wraps(function)
        def call(policy: Policy, *arrays: Any, **static: Hashable) -> T:
            leaves, form = jax.tree.flatten((policy, *arrays))
            types = tuple(map(jax.typeof, leaves))
            return _compiled(function, compiler_options, form, types, tuple(static.items()))(leaves)

        return call

    return decorate


@lru_cache(maxsize=16)
def _compiled(
    function: Callable[..., Any], options: Options, form: Any, types: Any, static: tuple[tuple[str, Hashable], ...]
) -> Any:
    def program(leaves: list[jax.Array]) -> Any:
        return function(*jax.tree.unflatten(form, leaves), **dict(static))

    program.__name__ = function.__name__.strip("_")
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in types]
    policy, *arrays = jax.tree.unflatten(form, shapes)
    task = policy.env.fingerprint
    known = task is not None and type(policy.agent) is DDPG
    identity = (*task, jax.tree.structure((policy.config, policy.networks, arrays)), static) if known else None
    return Program(program, (shapes,), identity).jit(compiler_options=dict(options()))
