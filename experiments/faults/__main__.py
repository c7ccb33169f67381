"""What may go wrong from outside, tried: nothing is lost, nothing wrong is answered, and a refusal is one line.

    python experiments/faults                               all sections
    python experiments/faults --only fuzz --only nan        some: fuzz, paths, environment, signals, nan, disk
    python experiments/faults --only fuzz:mjcf,urdf         some readers
    python experiments/faults --only fuzz --inputs 300      fewer inputs
    python experiments/faults --again mjcf:17 --work DIR    one input, which is left in DIR/w0/in, and its command

The same seed gives the same inputs and moments. A section of the whole size takes its place in results/faults.md. What
is read of damaged inputs is kept in DIR: the same command with the same --work reads those that are missing, and
what was a fault once more.
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

import disk
import fuzz
import interrupted
import places
import trainings
from readers import READERS

from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar

INPUTS = 10_000
RESULTS = Path(__file__).parents[1] / "results" / "faults.md"
HEAD = "# Faults from outside\n\nCommand: `python experiments/faults`.\n"
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
    parser.add_argument("--inputs", type=int, default=INPUTS, metavar="N", help="of the section fuzz")
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
    for section, parts in only.items():
        found = _fuzz(args, parts, work) if section == "fuzz" else _cases(args, section, work)
        found = ["", *found, "", f"Seed {args.seed}, {_machine()}."]
        print(f"## {TITLES[section]}", *found, sep="\n")
        if section != "fuzz" or (args.inputs >= INPUTS and not parts):
            _keep(TITLES[section], "\n".join(found))


def _machine() -> str:
    return f"{platform.machine()} CPU, {os.cpu_count()} cores, {'root' if os.getuid() == 0 else 'no root'}"


def _keep(title: str, text: str) -> None:
    """Put a section in its place among the results."""
    before = RESULTS.read_text() if RESULTS.exists() else ""
    kept = dict(part.split("\n", 1) for part in before.split("\n## ")[1:]) | {title: text + "\n"}
    every = [f"\n## {name}\n{kept[name].rstrip()}\n" for name in TITLES.values() if name in kept]
    files.write_text(RESULTS, HEAD + "".join(every))


def _fuzz(args: argparse.Namespace, parts: str, work: Path) -> list[str]:
    only = parts.split(",") if parts else []
    kept = work / f"outcomes-{args.seed}.jsonl"
    before = [fuzz.Outcome(*json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    planned = fuzz.plan(args.inputs, only)
    known = {(o.reader, o.number): o for o in before if o.kind not in fuzz.FAULTS}
    waiting = [task for task in planned if task not in known]
    with Bar("reading", len(waiting), "inputs") as bar, open(kept, "a") as file:
        faults = 0
        for i, outcome in enumerate(fuzz.campaign(waiting, args.seed, args.workers, work)):
            known[outcome.reader, outcome.number] = outcome
            print(json.dumps(outcome), file=file, flush=True)
            if outcome.kind in fuzz.FAULTS:
                faults += 1
                bar.say(f"{outcome.reader}:{outcome.number} {outcome.kind}: {outcome.told[-900:]}")
            bar.update(i + 1, f"{faults} faults")
    outcomes = [known[task] for task in planned]
    mended = {(o.reader, o.number) for o in before if o.kind in fuzz.FAULTS} & set(planned)
    told = f"{len(outcomes)} inputs, {sum(o.seconds for o in outcomes):.0f} s of a processor"
    told += f"; {len(mended)} were faults at first, and were read again" if mended else ""
    return [f"{told}.", "", fuzz.table(outcomes)]


def _cases(args: argparse.Namespace, section: str, work: Path) -> list[str]:
    cases: list[trainings.Case] = []
    started = time.monotonic()
    with Bar(section, None, "cases") as bar:
        say: Callable[[int, int], None] = lambda done, total: setattr(bar, "total", total)
        for case in _section(args, section, work, say):
            cases.append(case)
            if not case.good:
                bar.say(f"{case.name!r}: {case.told}")
            bar.update(len(cases), f"{sum(not c.good for c in cases)} faults")
    good = sum(case.good for case in cases)
    told = [case.told.replace(f"{work}/", "") for case in cases]
    rows = [
        f"| {_cell(case.name, 60)} | {'yes' if case.good else '**NO**'} | {_cell(text, 300)} |"
        for case, text in zip(cases, told, strict=True)
    ]
    took = time.monotonic() - started
    return [
        f"{good} of {len(cases)} as they must be; {took:.0f} s.",
        "",
        "| what | right | how |",
        "| --- | --- | --- |",
        *rows,
    ]


def _section(
    args: argparse.Namespace, section: str, work: Path, say: Callable[[int, int], None]
) -> Iterator[trainings.Case]:
    match section:
        case "paths":
            return places.paths(work, fuzz.prepare(work), say)
        case "environment":
            return places.environments(work, fuzz.prepare(work), say)
        case "signals":
            return interrupted.signals(work, args.seed, say)
        case "nan":
            return interrupted.nan(work, say)
        case _:
            return disk.disk(work, say)


def _cell(text: str, longest: int) -> str:
    """Text in a table's cell, whatever it holds."""
    shown = ascii(text)[1:-1].replace("`", "'").replace("|", "\\|")
    return f"`{shown[:longest] + '...' if len(shown) > longest else shown}`"


if __name__ == "__main__":
    main()
