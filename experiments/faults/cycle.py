"""Commands one after the other in one process, until one is refused. Each leaves a line of JSON: its status, what it
printed and what it said."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import traceback


def main() -> None:
    results, commands = os.dup(1), json.loads(sys.stdin.read())
    for words in commands:
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
        os.write(results, (json.dumps([status, *texts]) + "\n").encode())
        if status not in (0, 1):
            break


main()
