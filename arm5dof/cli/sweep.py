"""`arm5dof sweep`."""

from __future__ import annotations

import argparse
from pathlib import Path

from arm5dof.cli.parser import nothing_left, positive
from arm5dof.errors import UserError

HELP = """\
Train many members of one experiment, and put what was measured into one table.

A SWEEP is a TOML file, yours or one that ships. It names an experiment and axes; every combination of their values is a
member, which is a run like any other. Any setting of any task can be an axis:

  base = "kinematic.toml"
  sample_seed = 0                                      # of random axes
  [axes]
  actor_lr = [1e-3, 3e-3]
  critic_lr = { log_uniform = [1e-4, 1e-2], count = 4 }
  noise = { uniform = [0.1, 0.5], count = 3 }
  heads = { range = [2, 8, 2] }                        # 2, 4, 6, 8
  seed = { count = 4 }                                 # 0, 1, 2, 3
  [fixed]
  episodes = 100                                       # another value than the experiment's, for all
  [variants]                                           # optional: named sets of settings, one more axis
  "the recipe" = {}
  "no noise" = { noise = 0, final_noise = 0 }
  [search]                                             # optional: look for the best instead of training all
  method = "tpe"                                       # or "random"
  trials = 50                                          # configurations, each with every seed
  prune = true                                         # end early what falls behind at an evaluation

  arm5dof sweep sweep_smoke.toml                       four members in two minutes, to see that everything works
  arm5dof sweep my_sweep.toml --out DIR                into DIR
  arm5dof sweep my_sweep.toml --out DIR --resume       go on with one that was stopped: only what is missing
  arm5dof sweep --out DIR --resume                     the same, as it was asked for
  arm5dof sweep my_sweep.toml --executor ray           on a Ray cluster, or a local one where there is none
  arm5dof compare DIR runs/reach                       beside other sweeps and runs

It leaves in DIR results.csv and results.parquet (a row for each member and evaluation), summary.md (interquartile means
over seeds with bootstrap intervals), learning.png, axes.png, best.toml, which arm5dof train accepts, best.zip, its
policy, and members/, where each is a run for arm5dof eval, solve and train --resume.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `sweep` to the commands."""
    p = commands.add_parser("sweep", help="train many members of one experiment", description=HELP)
    p.add_argument("sweep", nargs="?", metavar="SWEEP.toml", help="what to train")
    p.add_argument("--out", type=Path, metavar="DIR", help="the sweep's folder; default: runs/<sweep>")
    p.add_argument("--resume", action="store_true", help="go on with the sweep in DIR")
    p.add_argument("--executor", choices=("local", "ray"), default="local", help="who trains; default: this machine")
    p.add_argument("--workers", type=positive, metavar="N", help="members at once; default: one a core, or a GPU")
    p.add_argument("--address", help="of a Ray cluster; default: one that is at hand, or a local one")
    p.add_argument(
        "--log", metavar="NAME", default="", help="curves elsewhere too: tensorboard, wandb, or both by a comma"
    )
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> int | None:
    """`arm5dof sweep`."""
    nothing_left(rest, "sweep")
    from arm5dof.runtime.progress import Bar
    from arm5dof.sweeps import spec
    from arm5dof.sweeps.folder import Sweep
    from arm5dof.sweeps.sweep import sweep
    from arm5dof.training.run import free_folder

    if args.resume and args.out is None:
        raise UserError("--resume goes on with a sweep in its folder: name it with --out DIR")
    if args.address and args.executor != "ray":
        raise UserError("--address is of a Ray cluster: add --executor ray")
    if args.sweep is None and not args.resume:
        raise UserError("which sweep? give a TOML file, such as sweep_smoke.toml (see arm5dof sweep --help)")
    asked = spec.read(args.sweep) if args.sweep is not None else Sweep.open(args.out).spec
    out = args.out or free_folder(Path(args.sweep).stem)
    if out.exists() and not args.resume:
        raise UserError(f"{out} exists: choose another --out, or add --resume to go on with what is in it")
    total = asked.search.trials * len(asked.seeds) if asked.search else len(asked.members)
    try:
        with Bar("sweeping", total, "members") as bar:
            done = sweep(
                asked,
                out,
                executor=args.executor,
                workers=args.workers,
                address=args.address,
                resume=args.resume,
                reporter=bar,
                loggers=args.log or (),
            )
    except KeyboardInterrupt as stop:
        if not (out / "sweep.json").is_file():
            raise
        named = f"{args.sweep} " if args.sweep else ""
        raise type(stop)(f"interrupted; go on with arm5dof sweep {named}--out {out} --resume") from None
    print(done)
    print(f"table, figures and the best: {done.folder}")
    return None
