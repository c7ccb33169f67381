"""`arm5dof vision eval`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.vision.evaluation.detection import Result

HELP = """\
Measure the detector of tabletop objects on random scenes that it has not seen in training, with other textures and
lights: mean average precision as COCO defines it, by pycocotools, frames a second, and how well objects are located
from its boxes while cameras are known only as well as calibration tells: by the table's plane, by a depth image, by two
views. Each states a covariance; the share of true positions inside the ellipsoids that should hold 68 and 95 % of them
tells whether it is right.

  arm5dof vision eval                                        what ships, on 1,000 scenes
  arm5dof vision eval --weights runs/detector/weights.npz    your own training
  arm5dof vision eval --scenes 100 --seed 7 --json
  arm5dof vision eval --tta                                  with test-time augmentation

Scenes are rendered with OpenGL where that works (see arm5dof vision doctor), otherwise in software.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `eval` to the vision commands."""
    p = commands.add_parser("eval", help="measure the detector that ships", description=HELP)
    p.add_argument("--weights", type=Path, metavar="FILE", help="what arm5dof vision train wrote; default: what ships")
    p.add_argument("--scenes", type=int, default=1000, metavar="N", help="default 1000")
    p.add_argument("--seed", type=int, default=1, metavar="S", help="of the scenes; default 1")
    p.add_argument("--back-end", default="auto", choices=("auto", "gl", "software"), help="what renders; default auto")
    p.add_argument("--tta", action="store_true", help="test-time augmentation: slower, more exact")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision eval`."""
    nothing_left(rest, "vision eval")
    for name, least in (("scenes", 1), ("seed", 0)):
        if getattr(args, name) < least:
            raise UserError(f"--{name} is {least} or more, not {getattr(args, name)}")

    from arm5dof.runtime import files
    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.evaluation.detection import evaluate

    with Bar("evaluating", args.scenes, "scenes") as bar:
        result = evaluate(args.weights, args.scenes, args.seed, args.back_end, args.tta, bar.update)
    print(files.to_json(result.as_json()) if args.json else precision_and_positions(result))


def precision_and_positions(result: Result) -> str:
    """A table of average precision by class, and one of errors by method of localization."""
    precision = result.precision
    width = max(len(name) for name in precision.by_class)
    classes = (
        f"{name:{width}}  {'none there' if value is None else f'{value:8.3f}'}"
        for name, value in precision.by_class.items()
    )
    methods = (
        f"{name.replace('_', ' '):{width}}  {a.median_mm:6.2f} mm {a.p95_mm:6.2f} mm {a.placed:8.1%}"
        f"   {a.covered['68']:.0f} % and {a.covered['95']:.0f} %"
        for name, a in result.positions.items()
    )
    return "\n".join(
        [
            f"{'class':{width}}  mAP50-95",
            *classes,
            "",
            f"{'located by':{width}}  {'median':>9} {'p95':>9} {'located':>8}   inside 68 and 95 %",
            *methods,
            "",
            f"mAP50 {precision.map50:.3f}, mAP50-95 {precision.map50_95:.3f}, {result.frames_per_s:.0f} frames/s; "
            f"box edge error {result.edge_px:.2f} pixels",
        ]
    )
