"""What may go wrong from outside, tried: nothing is lost, nothing wrong is answered, and a refusal is one line.

    python experiments/faults                               all sections, into results/faults.md
    python experiments/faults --only fuzz --only nan        some: fuzz, paths, environment, signals, nan, disk
    python experiments/faults --only fuzz:mjcf,urdf         some readers
    python experiments/faults --only fuzz --inputs 300      fewer inputs
    python experiments/faults --again mjcf:17 --work DIR    one input, which is left in DIR/w0/in, and its command

The same seed gives the same inputs and moments. Each section is written to DIR/SECTION.md, and a run of everything to
results/faults.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import fuzz
import trainings
from readers import READERS

from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar

RESULTS = Path(__file__).parents[1] / "results" / "faults.md"
TITLES = {
    "fuzz": "Damaged inputs",
    "paths": "Awkward paths",
    "environment": "The environment",
    "signals": "Killed and ended",
    "nan": "NaN in 1 % of the environments for a whole training",
    "disk": "No room, no permission, files of another run",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="SECTION[:READER,...]")
    parser.add_argument("--inputs", type=int, default=10_000, metavar="N", help="of the section fuzz")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=xla.cores(), help="of the section fuzz")
    parser.add_argument("--work", type=Path, metavar="DIR", help="where it happens; default: a temporary folder")
    parser.add_argument("--again", metavar="READER:NUMBER", help="repeat one input")
    args = parser.parse_args()
    for word in args.only:
        section, _, part = word.partition(":")
        if section not in TITLES or any(name not in READERS for name in part.split(",") if part):
            parser.error(f"{word}: sections are {', '.join(TITLES)}; readers {', '.join(READERS)}")
    with tempfile.TemporaryDirectory(prefix="faults-") as temporary:
        work = (args.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        if args.again:
            reader, _, number = args.again.rpartition(":")
            print(fuzz.again(reader, int(number), args.seed, work))
            print("arm5dof", *json.loads((work / "w0" / "words").read_text()))
            return
        run(args, work)


def run(args: argparse.Namespace, work: Path) -> None:
    """Try the sections that are asked for, and keep what was found."""
    only = dict(word.partition(":")[::2] for word in args.only) or dict.fromkeys(TITLES, "")
    lines = ["# Faults from outside", ""]
    where = f"{platform.machine()} CPU, {os.cpu_count()} cores, {'root' if os.getuid() == 0 else 'no root'}"
    lines += [f"Command: `python experiments/faults`, seed {args.seed}. {where}."]
    for section, parts in only.items():
        started = time.monotonic()
        found = _fuzz(args, parts, work) if section == "fuzz" else _cases(args, section, work)
        found = [f"## {TITLES[section]}", "", *found, "", f"{time.monotonic() - started:.0f} s."]
        files.write_text(work / f"{section}.md", "\n".join(found) + "\n")
        print("\n".join(found))
        lines += ["", *found]
    if not args.only:
        files.write_text(RESULTS, "\n".join(lines) + "\n")


def _fuzz(args: argparse.Namespace, parts: str, work: Path) -> list[str]:
    only = parts.split(",") if parts else []
    outcomes: list[fuzz.Outcome] = []
    with Bar("reading", len(fuzz.plan(args.inputs, only)), "inputs") as bar:
        for outcome in fuzz.campaign(args.inputs, only, args.seed, args.workers, work):
            outcomes.append(outcome)
            if outcome.kind in fuzz.FAULTS:
                bar.say(f"{outcome.reader}:{outcome.number} {outcome.kind}: {outcome.told[-900:]}")
            bar.update(len(outcomes), f"{sum(o.kind in fuzz.FAULTS for o in outcomes)} faults")
    files.write_text(work / "outcomes.json", json.dumps(outcomes))
    return [f"Seed {args.seed}, {len(outcomes)} inputs.", "", fuzz.table(outcomes)]


def _cases(args: argparse.Namespace, section: str, work: Path) -> list[str]:
    cases: list[trainings.Case] = []
    with Bar(section, None, "cases") as bar:
        say: Callable[[int, int], None] = lambda done, total: setattr(bar, "total", total)
        for case in _section(args, section, work, say):
            cases.append(case)
            if not case.good:
                bar.say(f"{case.name!r}: {case.told}")
            bar.update(len(cases), f"{sum(not c.good for c in cases)} faults")
    good = sum(case.good for case in cases)
    rows = [f"| {_cell(c.name)} | {'yes' if c.good else '**NO**'} | {_cell(c.told)} |" for c in cases]
    return [f"{good} of {len(cases)} as they must be.", "", "| what | right | how |", "| --- | --- | --- |", *rows]


def _section(
    args: argparse.Namespace, section: str, work: Path, say: Callable[[int, int], None]
) -> Iterator[trainings.Case]:
    if section in ("paths", "environment"):
        tried = trainings.paths if section == "paths" else trainings.environments
        return tried(work, fuzz.prepare(work), say)
    if section == "signals":
        return trainings.signals(work, args.seed, say)
    return (trainings.nan if section == "nan" else trainings.disk)(work, say)


def _cell(text: str) -> str:
    """Text in a table's cell, whatever it holds."""
    shown = ascii(text)[1:-1].replace("`", "'").replace("|", "\\|")
    return f"`{shown[:60] + '...' if len(shown) > 400 else shown}`"


if __name__ == "__main__":
    main()
