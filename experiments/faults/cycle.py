"""Lists of commands one after the other in one process, each list until a command is refused. Each command leaves a
line of JSON: the number of its list, its status, what it printed and what it said."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import traceback


def main() -> None:
    results, lists = os.dup(1), json.loads(sys.stdin.read())
    over: set[int] = set()
    for number, words in [(number, words) for number, commands in enumerate(lists) for words in commands]:
        if number in over:
            continue
        with tempfile.TemporaryFile(dir="/dev/shm") as printed, tempfile.TemporaryFile(dir="/dev/shm") as said:
            kept = os.dup(1), os.dup(2)
            os.dup2(printed.fileno(), 1)
            os.dup2(said.fileno(), 2)
            try:
                from arm5dof.cli.main import main as run

                status = run(words)
            except SystemExit as end:
                status = end.code
            except BaseException:
                status = traceback.format_exc()
            sys.stdout.flush()
            sys.stderr.flush()
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            texts = []
            for file in (printed, said):
                file.seek(0)
                texts.append(file.read().decode(errors="replace"))
        os.write(results, (json.dumps([number, status, *texts]) + "\n").encode())
        if status not in (0, 1):
            over.add(number)


main()
