"""The worker of `fuzz`: it reads one input after another by the command line's own `main`, and tells what came."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import time
import traceback
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import readers

BAR = re.compile(r"[a-z][a-z :]*: \d+/\d+ ")
"""A line of a progress bar."""
FOREIGN = re.compile(r"WARN|libpng|JPEG|TIFF|Warning:|[Ee]rror\b")
"""What is said by libraries that have not been asked."""


def work(folder: Path, sound: Path, seed: int, asks: int, answers: int) -> None:
    """Read inputs until nobody asks for more."""
    from arm5dof.cli import main as cli

    readers.shorten()
    _keep_policies()
    said = os.open(folder / "said", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 2)
    out = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    for line in os.fdopen(asks):
        reader, number = json.loads(line)
        for file in (1, 2):
            os.ftruncate(file, 0)
            os.lseek(file, 0, os.SEEK_SET)
        started = time.process_time()
        kind, told = _one(cli.main, folder, sound, seed, reader, number)
        os.write(answers, (json.dumps([kind, time.process_time() - started, told]) + "\n").encode())


def _one(main: Any, folder: Path, sound: Path, seed: int, reader: str, number: int) -> tuple[str, str]:
    how, rng = readers.READERS[reader], np.random.default_rng([seed, zlib.crc32(reader.encode()), number])
    given, outputs = folder / "in", folder / "out"
    for place in (given, outputs):
        shutil.rmtree(place, ignore_errors=True)
    outputs.mkdir()
    shutil.copytree(readers.pick(rng, sorted((sound / reader).iterdir())), given)
    if how.damaged:
        readers.damage(rng, given, how.damaged, sound)
    words = how.command(given, outputs / "out", rng)
    before = _digests(given)
    canary = folder.parent / readers.CANARY
    (folder / "words").write_text(json.dumps(words))
    status: Any = None
    try:
        status = main(words)
    except readers.Began:
        status = 0
    except SystemExit as end:
        status = end.code
    except BaseException:
        return "traceback", traceback.format_exc()[-1500:]
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    printed, said = ((folder / name).read_text(errors="replace") for name in ("printed", "said"))
    if canary.exists():
        canary.unlink()
        return "pickle", said
    if "Traceback" in said:
        return "traceback", said[-1500:]
    after = _digests(given)
    if changed := [name for name in before if after.get(name) != before[name] and (how.kept or name not in after)]:
        return "lost", f"{words}: {changed}"
    if status == 2 and how.damaged and reader != "targets" and (left := [path.name for path in outputs.iterdir()]):
        return "litter", f"{words}: {left}: {said}"
    strange = [line for line in said.splitlines() if not line.startswith("arm5dof: ") and not BAR.match(line)]
    strange = [line for line in strange if status == 2 or FOREIGN.search(line)]
    if status not in (0, 1, 2) or strange or (status == 2 and "arm5dof: " not in said):
        return "unclear", f"{words}: status {status}, said: {' / '.join(strange) or said}"
    if status == 0 and "--json" in words and printed.strip() and "--help" not in words and "-h" not in words:
        try:
            json.loads(printed, parse_constant=_refuse)
        except ValueError:
            return "not JSON", printed[:500]
    return ("refused" if status == 2 else "answered"), said[-300:]


def _refuse(word: str) -> float:
    raise ValueError(word)


def _digests(folder: Path) -> dict[str, str]:
    """What is in a folder's files, by name."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != ".lock":
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _keep_policies() -> None:
    """A policy of a sound run is restored once, not for every file of targets."""
    from arm5dof.training.run import Run

    made: dict[str, Any] = {}
    restore = Run.policy

    def policy(run: Run) -> Any:
        key = json.dumps(_digests(run.folder))
        if key not in made:
            found = restore(run)
            if len(made) > 3:
                return found
            made[key] = found
        return made[key]

    Run.policy = policy  # type: ignore[method-assign]


if __name__ == "__main__":
    where, seeds, seed_text, asked, answered = sys.argv[1:]
    work(Path(where), Path(seeds), int(seed_text), int(asked), int(answered))
