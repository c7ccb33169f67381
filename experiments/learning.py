"""How quickly the policy learns: every budget, and what each ingredient of the recipe is worth.

    python experiments/learning.py budgets      sweep_budgets.toml and sweep_ten_seeds.toml, into experiments/results/
    python experiments/learning.py ablations    sweep_ablations.toml
    python experiments/learning.py poses        sweep_poses.toml, sweep_poses7.toml: positions, directions (reach_pose)

All rows are judged on 10,000 unseen targets at the end of training. The sweeps are left in runs/learning/, and go on if
they are there already: `arm5dof sweep experiments/sweep_budgets.toml --out runs/learning/sweep_budgets` does the same.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path

import numpy as np

from arm5dof import sweep
from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar
from arm5dof.sweeps import spec

HERE = Path(__file__).parent
TABLES = {
    "budgets": ("sweep_budgets", "sweep_ten_seeds"),
    "ablations": ("sweep_ablations",),
    "poses": ("sweep_poses", "sweep_poses7"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    table = parser.parse_args().table
    xla.enable_compilation_cache()
    found = {variant: evaluations for name in TABLES[table] for variant, evaluations in trained(name).items()}
    text = (poses if table == "poses" else markdown)(table, found)
    print(text)
    files.write_text(HERE / "results" / f"learning_{table}.json", json.dumps(found, indent=1) + "\n")
    files.write_text(HERE / "results" / f"learning_{table}.md", text)


def trained(name: str) -> dict[str, list[dict]]:
    """The last evaluation of each member of a sweep, by its variant."""
    asked = spec.read(HERE / f"{name}.toml")
    with Bar(name, len(asked.members), "members") as bar:
        done = sweep(asked, Path("runs") / "learning" / name, resume=True, reporter=bar)
    runs, found = done.runs, dict[str, list[dict]]()
    for member in done.members:
        found.setdefault(member.settings["variant"], []).append(runs[member.name].evaluations[-1])
    return found


def heading(title: str) -> list[str]:
    """What every table begins with."""
    return [
        f"# Learning: {title}, 10,000 unseen targets",
        "",
        f"Command: `python experiments/learning.py {title}`. {platform.machine()} CPU.",
        "Shares are the mean over seeds; in brackets the worst seed.",
        "",
    ]


def poses(title: str, found: dict[str, list[dict]]) -> str:
    """Mean errors of one answer, and the shares of goals that are met in both position and direction."""
    lines = [
        *heading(title),
        "| | seeds | transitions | updates | one answer, mean error | <= 5 mm and 3 deg "
        "| corrected: <= 1 mm and 0.5 deg |",
        "| --- |" + " ---: |" * 6,
    ]
    for name, evaluations in found.items():
        first = evaluations[0]
        mm, deg = (
            scale * np.mean([e["means"][key] for e in evaluations])
            for key, scale in (("one_shot", 1e3), ("one_shot_angle", 180 / np.pi))
        )
        shares = [np.array([e[f"{kind}_within"]["percent"] for e in evaluations]) for kind in ("one_shot", "refined")]
        cells = " | ".join(f"{share.mean():.2f} % ({share.min():.2f})" for share in shares)
        counts = f"{len(evaluations)} | {first['env_steps']} | {first['updates']}"
        lines.append(f"| {name} | {counts} | {mm:.2f} mm, {deg:.2f} deg | {cells} |")
    return "\n".join(lines) + "\n"


def markdown(title: str, found: dict[str, list[dict]]) -> str:
    """Each row's worst and mean share of targets within a distance, and its mean median, over seeds."""
    lines = [
        *heading(title),
        "| | seeds | transitions | updates | | median | <= 1 mm | <= 5 mm | <= 10 mm |",
        "| --- | ---: | ---: | ---: | --- |" + " ---: |" * 4,
    ]
    for name, evaluations in found.items():
        first = evaluations[0]
        for kind in ("one_shot", "refined", "episode"):
            label = " | | | "
            if kind == "one_shot":
                label = f"{name} | {len(evaluations)} | {first['env_steps']} | {first['updates']}"
            median = np.mean([e[kind]["median_mm"] for e in evaluations])
            shares = [np.array([e[kind]["within"][limit] for e in evaluations]) for limit in ("1", "5", "10")]
            cells = " | ".join(f"{share.mean():.2f} % ({share.min():.2f})" for share in shares)
            lines.append(f"| {label} | {kind} | {median:.2f} mm | {cells} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
