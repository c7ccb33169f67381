"""Evaluation: a policy measured by its task, on a stream of random numbers that training never touches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import jax
import numpy as np
from annotated_types import Ge

from arm5dof.envs import Task
from arm5dof.envs.metrics import Metric, Summary
from arm5dof.errors import UserError
from arm5dof.runtime import forks
from arm5dof.runtime.tables import Table
from arm5dof.settings import settings, static
from arm5dof.training.policy import Policy
from arm5dof.training.policy_program import of_policy

CHUNK = 1000
"""Samples in one device call: what the progress bar moves by, and no more memory than a training batch."""


@settings
class EvaluateConfig:
    """The accuracy protocol."""

    targets: Annotated[int, Ge(1)] = static(default=10_000, may_change=True)
    """Unseen targets (episodes, where a task has no targets) in the final evaluation."""
    interim_targets: Annotated[int, Ge(1)] = static(default=2_000, may_change=True)
    """The same in the evaluations on the way."""


Results = dict[str, Summary]
"""A summary for each of the task's metrics, and under `means` the mean of all that was measured, in SI units."""


def evaluate(
    policy: Policy, targets: int, seed: int = 0, progress: Callable[[int], object] | None = None
) -> dict[str, Any]:
    """Measure a policy.

    Args:
        policy: The policy, with its task.
        targets: How many unseen targets, or episodes.
        seed: Of the targets.
        progress: Told the number of targets done, now and then.

    Returns:
        By name of the task's metrics what was measured, summarised as the metric says; `means`, the mean of every array
        measured, in SI units; and `counts`, of how many targets, of what was measured on fewer than all.
    """
    forks.check()
    key = _stream(seed)
    chunk = min(CHUNK, targets)
    parts: dict[str, list[np.ndarray]] = {}
    for done in range(0, targets, chunk):
        measured = _measure(policy, jax.random.fold_in(key, done), n=chunk)
        for name, values in measured.items():
            parts.setdefault(name, []).append(np.asarray(values)[: targets - done])
        if progress:
            progress(min(done + chunk, targets))
    return _summarised(policy.env, {name: np.concatenate(values) for name, values in parts.items()})


def evaluate_together(policies: Policy, targets: int, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Measure several policies of one task in one program, each on the targets that `evaluate` draws from its seed.

    Args:
        policies: A policy whose leaves have a leading axis, one entry for each.
        targets: How many unseen targets, or episodes, for each.
        seeds: Of the targets of each.

    Returns:
        What `evaluate` returns, for each.
    """
    keys = jax.numpy.stack([_stream(seed) for seed in seeds])
    chunk = min(CHUNK, targets)
    parts: dict[str, list[np.ndarray]] = {}
    for done in range(0, targets, chunk):
        folded = jax.vmap(jax.random.fold_in, (0, None))(keys, done)
        for name, values in _measure_together(policies, folded, n=chunk).items():
            parts.setdefault(name, []).append(np.asarray(values)[:, : targets - done])
    found = {name: np.concatenate(values, axis=1) for name, values in parts.items()}
    return [_summarised(policies.env, {k: v[i] for k, v in found.items()}) for i in range(len(seeds))]


def _stream(seed: int) -> jax.Array:
    """Random numbers that training never touches."""
    if not 0 <= seed < 2**32:
        raise UserError(f"a seed is a whole number from 0 to 4294967295, not {seed}")
    return jax.random.fold_in(jax.random.key(seed), 0xE7A1)


def _summarised(env: Task, found: Mapping[str, np.ndarray]) -> dict[str, Any]:
    # JAX returns dictionaries sorted; people read them in the task's order.
    results: dict[str, Any] = {name: m.summary(found[name]) for name, m in env.metrics.items() if name in found}
    counts = {name: len(values) for name, values in found.items()}
    return {
        **results,
        "means": {name: float(values.mean()) for name, values in found.items()},
        "counts": {name: count for name, count in counts.items() if count < max(counts.values())},
    }


def tables(metrics: Mapping[str, Metric], results: Mapping[str, Any]) -> str:
    """Results as Markdown tables, one for metrics that have the same columns."""
    by_header: dict[tuple[str, ...], list[list[str]]] = {}
    for name, metric in metrics.items():
        if name in results:
            cells = metric.cells(results[name])
            count = results.get("counts", {}).get(name)
            title = f"{name}, {count} of these" if count else name
            by_header.setdefault(tuple(cells), []).append([title, *cells.values()])
    return "\n\n".join(Table("", ("", *header), rows).markdown() for header, rows in by_header.items())


@of_policy()
def _measure(policy: Policy, key: jax.Array, n: int) -> dict[str, jax.Array]:
    return policy.env.evaluate(policy, key, n)


@of_policy()
def _measure_together(policies: Policy, keys: jax.Array, n: int) -> dict[str, jax.Array]:
    return jax.vmap(lambda policy, key: policy.env.evaluate(policy, key, n))(policies, keys)
