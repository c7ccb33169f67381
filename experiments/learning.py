"""How quickly the policy learns: every budget, and what each ingredient of the recipe is worth.

    python experiments/learning.py budgets                    five seeds of most rows, into experiments/results/
    python experiments/learning.py ablations --seeds 3
    python experiments/learning.py poses                      positions and directions (reach_pose)
    python experiments/learning.py budgets --rows 25 --seeds 1   only rows with "25" in their name; nothing is written

All rows are judged on 10,000 unseen targets at the end of training. Runs are left in runs/learning/ and resumed if they
are there already; the rows that Table 2 has, too, are taken from experiments/results/ (table2.py).
"""

from __future__ import annotations

import argparse
import json
import platform
import re
from pathlib import Path

import numpy as np

from arm5dof import Run, load_config
from arm5dof.runtime import files, xla
from arm5dof.training.config import override
from arm5dof.training.run import resume

RESULTS = Path(__file__).parent / "results"

STATE = "--critic-input state --critic-width 128 --critic-depth 3"
"""A critic that sees joint angles and action, and has to learn the arm's kinematics itself."""

BUDGETS = {
    "25 episodes, kinematic": "kinematic.toml --episodes 25 --num-envs 25",
    "100 episodes, kinematic": "kinematic.toml --episodes 100",
    "400 episodes, kinematic": "table2_kinematic.json",
    "100 episodes, servo": "reach.toml --episodes 100",
    "400 episodes, servo": "table2_reach.json",
    "25 episodes, kinematic, state critic": f"kinematic.toml --episodes 25 --num-envs 25 {STATE}",
    "100 episodes, kinematic, state critic": f"kinematic.toml --episodes 100 {STATE}",
    "400 episodes, kinematic, state critic": f"kinematic.toml {STATE}",
    "400 episodes, kinematic, seven joints": "kinematic.toml --arm arm7.xml",
}

BASE = "kinematic.toml --episodes 100"
SHORT = "kinematic.toml --episodes 25 --num-envs 25"
ABLATIONS = {
    "the recipe": BASE,
    "no random actions": f"{BASE} --random-action-prob 0",
    "no relabelling in hindsight": f"{BASE} --her-ratio 0",
    "all goals relabelled": f"{BASE} --her-ratio 1",
    "critic without focus": f"{BASE} --critic-error-weight 0",
    "scalar critic": f"{BASE} --critic-form scalar",
    "scalar critic of width 128, depth 3": f"{BASE} --critic-form scalar --critic-width 128 --critic-depth 3",
    "state critic": f"{BASE} {STATE}",
    "one head": f"{BASE} --heads 1",
    "four heads": f"{BASE} --heads 4",
    "sixteen heads": f"{BASE} --heads 16",
    "constant step size": f"{BASE} --final-lr 1",
    "Adam's usual memory of 0.999": f"{BASE} --adam-b2 0.999",
    "batch 256": f"{BASE} --batch-size 256",
    "a quarter of the updates, batch 256": f"{BASE} --batch-size 256 --updates-per-step 16",
    "discount 0.9": f"{BASE} --discount 0.9",
    "actor of width 64": f"{BASE} --actor-width 64",
    "actor of width 256": f"{BASE} --actor-width 256",
    "layer norm": f"{BASE} --layer-norm true",
    "relu": f"{BASE} --activation relu",
    "constant noise of 0.5": f"{BASE} --final-noise 0.5",
    "no noise": f"{BASE} --noise 0 --final-noise 0",
    "the paper's observations": f"{BASE} --observation paper",
    "25 episodes": SHORT,
    "25 episodes, Adam's usual memory of 0.999": f"{SHORT} --adam-b2 0.999",
    "25 episodes, all goals relabelled": f"{SHORT} --her-ratio 1",
}

POSES = {"five joints, approach": "reach_pose.toml", "seven joints, rotation": "reach_pose7.toml"}

SEEDS = {"100 episodes, kinematic": 10, "seven joints, rotation": 1}
"""Rows with a number of seeds of their own: where a lottery would show, and where each takes nine minutes."""

TABLES = {"budgets": BUDGETS, "ablations": ABLATIONS, "poses": POSES}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--rows", default="", help="only rows with this in their name; the table is not written")
    arguments = parser.parse_args()
    xla.enable_compilation_cache()
    rows = {name: line for name, line in TABLES[arguments.table].items() if arguments.rows in name}
    seeds = {name: SEEDS.get(name, arguments.seeds) for name in rows}
    found = {name: [train(name, line, seed) for seed in range(seeds[name])] for name, line in rows.items()}
    text = (poses if arguments.table == "poses" else markdown)(arguments.table, found, arguments.seeds)
    print(text)
    if not arguments.rows:
        files.write_text(RESULTS / f"learning_{arguments.table}.json", json.dumps(found, indent=1) + "\n")
        files.write_text(RESULTS / f"learning_{arguments.table}.md", text)


def train(name: str, line: str, seed: int) -> dict:
    """The last evaluation of one run, trained now or before. `line` is what `arm5dof train` would be given, or a file
    of Table 2's results."""
    if line.endswith(".json"):
        return json.loads((RESULTS / line).read_text())[seed][-1]
    experiment, *options = line.split()
    overrides = {option[2:]: value for option, value in zip(options[::2], options[1::2], strict=True)}
    settings = load_config(experiment, **{**overrides, "seed": seed})
    settings = override(settings, {"evaluate_every": settings.train.episodes})
    folder = Path("runs") / "learning" / re.sub(r"\W+", "-", f"{name}-{seed}")
    opened = Run.open(folder) if folder.exists() else Run.create(settings, folder)
    if opened.config != settings:
        raise SystemExit(f"{folder} is of another version of this experiment: move it away")
    return resume(opened).evaluations[-1]


def heading(title: str, seeds: int) -> list[str]:
    """What every table begins with."""
    return [
        f"# Learning: {title}, 10,000 unseen targets",
        "",
        f"Command: `python experiments/learning.py {title} --seeds {seeds}`. {platform.machine()} CPU.",
        "Shares are the mean over seeds; in brackets the worst seed.",
        "",
    ]


def poses(title: str, found: dict[str, list[dict]], seeds: int) -> str:
    """Mean errors of one answer, and the shares of goals that are met in both position and direction."""
    lines = [
        *heading(title, seeds),
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


def markdown(title: str, found: dict[str, list[dict]], seeds: int) -> str:
    """Each row's worst and mean share of targets within a distance, and its mean median, over seeds."""
    lines = [
        *heading(title, seeds),
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
