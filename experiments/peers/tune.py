"""A random search over one peer's settings, so that it is compared at its best.

    python experiments/peers/tune.py sbx-TD3 --peers-python PATH [--trials 20] [--minutes 4] [--first gamma=0.9 ...]

Every trial trains for so many minutes, or to 95.5 % within 10 mm. They are listed, best first, in
experiments/results/peers/tuning-NAME.md; a list that is there already grows. `--first` is tried before any random one.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results" / "peers"

COMMON = {
    "learning_rate": [3e-4, 1e-3, 3e-3],
    "batch_size": [64, 128, 256],
    "num_envs": [16, 64, 256],
    "activation": ["relu", "gelu", "tanh"],
}
WIDTHS = [(64, 64), (128, 128), (128, 128, 128), (256, 256)]
SBX = {
    **COMMON,
    "gamma": [0.0, 0.0, 0.9, 0.99],
    "gradient_steps": [16, 64, 256],
    "actor": [list(w) for w in WIDTHS],
    "critic": [list(w) for w in WIDTHS],
    "layer_norm": [False, True],
    "hindsight": [0, 1, 4],
    "decay_updates": [0, 100_000, 200_000],
}
NOISE = {"noise": [0.1, 0.3, 0.5, 1.0]}
REJAX = {**COMMON, "gamma": [0.0, 0.0, 0.9, 0.99], "num_epochs": [16, 64, 256], "layers": WIDTHS}
REJAX |= {"buffer_size": [16_384, 65_536], "reward_scale": [1.0, 10.0, 100.0]}
BRAX = {**COMMON, "discounting": [0.0, 0.0, 0.9], "grad_updates_per_step": [16, 64, 256], "layers": WIDTHS}
SPACES = {
    "sbx-DDPG": {**SBX, **NOISE},
    "sbx-TD3": {**SBX, **NOISE, "policy_delay": [1, 2]},
    "sbx-SAC": {**SBX, "ent_coef": ["auto_0.01", "auto_0.001", "auto_0.0001"]},
    "rejax-TD3": {**REJAX, "exploration_noise": [0.1, 0.3, 0.5, 1.0], "policy_delay": [1, 2]},
    "rejax-SAC": REJAX,
    "brax-SAC": {**BRAX, "reward_scaling": [10.0, 100.0, 1000.0]},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=SPACES)
    parser.add_argument("--peers-python", default=sys.executable, help="the interpreter of the peers' environment")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=4)
    parser.add_argument("--seed", type=int, default=0, help="of the search")
    parser.add_argument("--first", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    log = RESULTS / f"tuning-{arguments.name}.jsonl"
    draw = random.Random(arguments.seed)
    for trial in range(arguments.trials):
        chosen = [f"{name}={draw.choice(values)}" for name, values in SPACES[arguments.name].items()]
        if trial == 0 and arguments.first is not None:
            chosen = arguments.first
        with open(log, "a") as handle:
            handle.write(json.dumps({**attempt(arguments, chosen), "settings": chosen}) + "\n")
        found = sorted((json.loads(line) for line in log.read_text().splitlines()), key=quality)
        (RESULTS / f"tuning-{arguments.name}.md").write_text(markdown(arguments.name, found))


def attempt(arguments: argparse.Namespace, chosen: list[str]) -> dict:
    """Train once: the last line of the learning curve, the best share, or nothing of either if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "curve.csv"
        command = [arguments.peers_python, HERE / "peer.py", arguments.name, "--out", out, "--set", *chosen]
        subprocess.run([*command, "--minutes", str(arguments.minutes)], check=False)
        if not out.exists():
            return {"minutes": arguments.minutes, "seconds": None, "transitions": None, "within_10mm": 0.0}
        with open(out, newline="") as handle:
            rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(handle)]
    best = max(rows, key=lambda row: row["within_10mm"])
    return {"minutes": arguments.minutes, **best}


def quality(trial: dict) -> tuple:
    """The best first: the quicker one of those that got there, the more exact one of those that did not."""
    there = trial["within_10mm"] >= 95.5
    return (0, trial["seconds"]) if there else (1, -trial["within_10mm"])


def markdown(name: str, found: list[dict]) -> str:
    lines = [f"# {name}: {len(found)} trials, best first", ""]
    lines += [
        "| best share within 10 mm | after | transitions | budget | settings |",
        "| ---: | ---: | ---: | ---: | --- |",
    ]
    for trial in found:
        settings = f"{trial['minutes']:g} min | `{' '.join(trial['settings'])}`"
        if trial["seconds"] is None:
            lines.append(f"| failed | | | {settings} |")
        else:
            share, after = f"{trial['within_10mm']:.2f} %", f"{trial['seconds']:.0f} s"
            lines.append(f"| {share} | {after} | {trial['transitions']:.0f} | {settings} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
