"""What is measured of a policy, and how people read it: many values in SI units, a summary, and one number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

Summary = dict[str, Any]


class Metric(Protocol):
    """How values (n,) in SI units are summarised."""

    @property
    def unit(self) -> str:
        """What people read it in."""
        ...

    @property
    def scale(self) -> float:
        """Of that unit, what 1 in SI units is."""
        ...

    @property
    def higher_is_better(self) -> bool: ...

    def summary(self, values: np.ndarray) -> Summary:
        """For JSON."""
        ...

    def number(self, summary: Summary) -> float:
        """The one number by which runs are compared, in the unit."""
        ...

    def cells(self, summary: Summary) -> dict[str, str]:
        """Columns of a table by their headers."""
        ...

    def text(self, summary: Summary) -> str:
        """In a few words."""
        ...


@dataclass(frozen=True)
class Error:
    """How far something is off: median, 95th percentile and the shares within some limits, in the unit."""

    unit: str = "mm"
    scale: float = 1e3
    within: tuple[float, ...] = (1, 5, 10, 20)
    higher_is_better: bool = False

    @property
    def tolerance(self) -> float:
        """What counts as reached, unless people say otherwise, in the unit."""
        return self.within[-1]

    @property
    def close(self) -> float:
        """What counts as met where one answer is preferred to another for something else than its error, SI."""
        return self.within[0] / self.scale

    def summary(self, values: np.ndarray) -> Summary:
        found = values * self.scale
        return {
            f"median_{self.unit}": float(np.median(found)),
            f"p95_{self.unit}": float(np.percentile(found, 95)),
            "within": {f"{limit:g}": float(100 * (found <= limit).mean()) for limit in self.within},
        }

    def number(self, summary: Summary) -> float:
        return float(summary[f"median_{self.unit}"])

    def cells(self, summary: Summary) -> dict[str, str]:
        shares = {f"<= {limit} {self.unit}": f"{share:.2f} %" for limit, share in summary["within"].items()}
        median, p95 = (f"{summary[f'{name}_{self.unit}']:.2f} {self.unit}" for name in ("median", "p95"))
        return {"median": median, "95th percentile": p95, **shares}

    def text(self, summary: Summary) -> str:
        limit = f"{self.within[len(self.within) // 2]:g}"
        return (
            f"{summary['within'][limit]:.2f} % within {limit} {self.unit}, "
            f"median {summary[f'median_{self.unit}']:.2f} {self.unit}"
        )


@dataclass(frozen=True)
class Share:
    """How many of the values are true, in percent; `label` says what is true of them."""

    label: str
    unit: str = "%"
    scale: float = 100.0
    higher_is_better: bool = True

    def summary(self, values: np.ndarray) -> Summary:
        return {"percent": float(100 * values.mean())}

    def number(self, summary: Summary) -> float:
        return float(summary["percent"])

    def cells(self, summary: Summary) -> dict[str, str]:
        return {"of all": f"{summary['percent']:.2f} %", "are": self.label}

    def text(self, summary: Summary) -> str:
        return f"{summary['percent']:.2f} % {self.label}"


@dataclass(frozen=True)
class Score:
    """What is better the higher it is, such as a return: mean, least and most."""

    unit: str = ""
    scale: float = 1.0
    higher_is_better: bool = True

    def summary(self, values: np.ndarray) -> Summary:
        found = values * self.scale
        return {"mean": float(found.mean()), "min": float(found.min()), "max": float(found.max())}

    def number(self, summary: Summary) -> float:
        return float(summary["mean"])

    def cells(self, summary: Summary) -> dict[str, str]:
        return {name: f"{value:.2f} {self.unit}".rstrip() for name, value in summary.items()}

    def text(self, summary: Summary) -> str:
        return f"mean {summary['mean']:.2f} {self.unit}".rstrip()
