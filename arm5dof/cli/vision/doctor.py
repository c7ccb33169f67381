"""`arm5dof vision doctor`. Everything that takes MuJoCo, OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left

if TYPE_CHECKING:
    from arm5dof.vision.evaluation.doctor import Finding

HELP = """\
Say what works here: what can render simulated images, and which detectors run. Each line was tried: images are rendered
and compared, networks are run. Where something does not work the line below says what to do.

Nothing needs OpenGL. Software renders the same, more slowly, and is used where OpenGL does not work.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `doctor` to the vision commands."""
    p = commands.add_parser("doctor", help="what works on this machine", description=HELP)
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision doctor`."""
    nothing_left(rest, "vision doctor")
    broken = _broken_choice()

    from arm5dof.vision.evaluation import doctor
    from arm5dof.vision.opencv import quiet

    report: dict[str, list[Finding]] = {}
    with quiet():
        for title, findings in (("rendering", doctor.rendering(broken)), ("detectors", doctor.detectors())):
            report[title] = []
            if not args.json:
                print(title)
            for finding in findings:
                report[title].append(finding)
                if not args.json:
                    _show(finding)
    if args.json:
        print(json.dumps({title: [asdict(f) for f in findings] for title, findings in report.items()}))


def _broken_choice() -> str | None:
    """What MUJOCO_GL says if that keeps MuJoCo from being imported; it is then forgotten, so that we can go on."""
    import subprocess

    if "MUJOCO_GL" not in os.environ:
        return None
    tried = subprocess.run([sys.executable, "-c", "import mujoco"], capture_output=True, check=False)
    return os.environ.pop("MUJOCO_GL") if tried.returncode else None


def _show(finding: Finding) -> None:
    print(f"  {finding.what:22}  {'works' if finding.works else 'no':6} {finding.detail}", flush=True)
    if finding.remedy:
        print(f"  {'':22}         -> {finding.remedy}", flush=True)
