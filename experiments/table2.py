"""The paper's Table 2, measured: experiments over several seeds, each cell on 10,000 unseen targets.

    python experiments/table2.py                    both experiments, five seeds, into experiments/results/
    python experiments/table2.py --seeds 1 reach    one seed of one experiment

Runs are left in runs/table2/ and resumed if they are there already; the table is made from all that are finished.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path

import numpy as np
from figures import PAPER_TABLE_2

from arm5dof import Run, load_config, make_env
from arm5dof.runtime import files, xla
from arm5dof.training.loop import resume

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiments", nargs="*", default=["kinematic", "reach"])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    xla.enable_compilation_cache()
    for name in arguments.experiments:
        evaluations = [train(name, seed) for seed in range(arguments.seeds)]
        headline = make_env(load_config(f"{name}.toml")).headline
        RESULTS.mkdir(exist_ok=True)
        files.write_text(RESULTS / f"table2_{name}.json", json.dumps(evaluations, indent=1) + "\n")
        files.write_text(RESULTS / f"table2_{name}.md", markdown(name, headline, evaluations))


def train(name: str, seed: int) -> list[dict]:
    """The evaluations of one run, trained now or before."""
    folder = Path("runs") / "table2" / f"{name}-{seed}"
    settings = load_config(f"{name}.toml", seed=seed, interim_targets=10_000)
    return resume(Run.open(folder) if folder.exists() else Run.create(settings, folder)).evaluations


def markdown(name: str, headline: str, evaluations: list[list[dict]]) -> str:
    """Minimum, maximum and mean over seeds beside the paper's."""
    episodes = [e["episodes"] for e in evaluations[0]]
    within = np.array([[e[headline]["within"]["10"] for e in seed] for seed in evaluations])
    targets = ", ".join(str(e["targets"]) for e in evaluations[0])
    lines = [
        f"# Table 2, `experiments/{name}.toml`, {len(evaluations)} seeds",
        "",
        f"Share of unseen targets within 10 mm (`{headline}`), {targets} of them. "
        f"{platform.machine()} CPU. Command: `python experiments/table2.py {name}`.",
        "",
        "| accuracy | " + " | ".join(f"{e} episodes" for e in episodes) + " |",
        "| --- |" + " ---: |" * len(episodes),
    ]
    for row, reduce in (("Min", np.min), ("Max", np.max), ("Mean", np.mean)):
        ours = " | ".join(f"**{value:.2f} %**" for value in reduce(within, axis=0))
        paper = " | ".join(f"{PAPER_TABLE_2[row][e]:g} %" for e in episodes)
        lines += [f"| {row}, ours | {ours} |", f"| {row}, paper | {paper} |"]
    lines += [
        "",
        "After the last episode, seed by seed:",
        "",
        "| seed | | median | p95 | <= 1 mm | <= 5 mm | <= 10 mm |",
    ]
    lines += ["| ---: | --- |" + " ---: |" * 5]
    for seed, found in enumerate(evaluations):
        for kind in ("one_shot", "refined", "episode"):
            a = found[-1][kind]
            shares = " | ".join(f"{a['within'][limit]:.2f} %" for limit in ("1", "5", "10"))
            lines.append(f"| {seed} | {kind} | {a['median_mm']:.2f} mm | {a['p95_mm']:.2f} mm | {shares} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
