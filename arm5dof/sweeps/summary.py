"""What a sweep says: configurations compared over their seeds, as `rliable` recommends (Agarwal et al. 2021): the
interquartile mean, which neither one lucky nor one unlucky seed moves, with bootstrap confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from arm5dof.envs.metrics import Metric
from arm5dof.runtime.tables import Table
from arm5dof.sweeps.spec import SEED
from arm5dof.sweeps.worker import DONE
from arm5dof.training.config import Config, make_env

RESAMPLES = 2000
CONFIDENCE = 0.95


class Headline(NamedTuple):
    """By what members are judged."""

    name: str
    metric: Metric

    @staticmethod
    def of(config: Config) -> Headline:
        """That of a configuration's task."""
        env = make_env(config)
        return Headline(env.headline, env.metrics[env.headline])

    @property
    def label(self) -> str:
        """With its unit, and which way is better."""
        unit = f", {self.metric.unit}" if self.metric.unit else ""
        return f"{self.name}{unit}, {'higher' if self.metric.higher_is_better else 'lower'} is better"


class Estimate(NamedTuple):
    """An interquartile mean and its confidence interval; NaN where one value has none."""

    value: float
    low: float
    high: float


class Line(NamedTuple):
    """One configuration over its seeds."""

    settings: dict[str, Any]
    """What varies, without the seed."""
    seeds: int
    """How many came to their end."""
    lost: int
    """How many did not: failed, diverged, pruned, or not yet."""
    headline: Estimate
    best: str | None
    """The name of its best member."""


def estimate(values: Iterable[float], seed: int = 0) -> Estimate:
    """The interquartile mean of some values and its 95 % bootstrap interval (percentile), drawn from `seed`."""
    found = np.asarray(list(values), float)
    if found.size == 0:
        return Estimate(math.nan, math.nan, math.nan)
    value = float(stats.trim_mean(found, 0.25))
    if found.size < 2:
        return Estimate(value, math.nan, math.nan)
    trimmed = lambda sample, axis: stats.trim_mean(sample, 0.25, axis=axis)
    interval = stats.bootstrap(
        (found,),
        trimmed,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def summarise(rows: Iterable[Mapping[str, Any]], higher: bool, names: Iterable[str], seed: int = 0) -> list[Line]:
    """Configurations from the best to the worst; those that lost members come after those that lost none.

    Args:
        rows: The sweep's table.
        higher: Whether a higher headline is better.
        names: The settings that vary.
        seed: Of the bootstrap.
    """
    names = [name for name in names if name != SEED]
    last: dict[str, Mapping[str, Any]] = {str(row["member"]): row for row in rows}  # A member's rows are in order.
    found: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in last.values():
        found.setdefault(tuple(row[name] for name in names), []).append(row)
    lines = []
    for values, alike in found.items():
        measured = (row for row in alike if row["status"] == DONE and _is_number(row.get("headline")))
        done = sorted(measured, key=lambda row: row["headline"], reverse=higher)
        of = estimate([row["headline"] for row in done], seed)
        settings = dict(zip(names, values, strict=True))
        lines.append(Line(settings, len(done), len(alike) - len(done), of, str(done[0]["member"]) if done else None))
    sign = -1 if higher else 1
    return sorted(lines, key=lambda line: (line.lost > 0, not line.seeds, sign * line.headline.value))


def _is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def curve(rows: Iterable[Mapping[str, Any]], seed: int = 0) -> tuple[list[int], list[Estimate]]:
    """How the headline went with episodes, over the members that these rows are of."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if _is_number(row.get("headline")):
            found.setdefault(int(row["episodes"]), []).append(float(row["headline"]))
    episodes = sorted(found)
    return episodes, [estimate(found[n], seed) for n in episodes]


def short(name: str) -> str:
    """A setting without its section, as people say it."""
    return name.partition(".")[2] or name


def spelled(value: Any) -> str:
    """A setting's value in few digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def spelled_estimate(found: Estimate) -> str:
    """With its interval, if there is one."""
    if math.isnan(found.value):
        return "-"
    interval = "" if math.isnan(found.low) else f" [{found.low:.4g}, {found.high:.4g}]"
    return f"{found.value:.4g}{interval}"


def table(title: str, lines: list[Line], headline: Headline) -> Table:
    """Lines as people read them."""
    names = list(lines[0].settings) if lines else []
    rows = [
        [
            *(spelled(line.settings[name]) for name in names),
            str(line.seeds) + (f" of {line.seeds + line.lost}" if line.lost else ""),
            spelled_estimate(line.headline),
            line.best or "-",
        ]
        for line in lines
    ]
    header = [*map(short, names), "seeds", headline.label, "best member"]
    return Table(title, header, rows)
