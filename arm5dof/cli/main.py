"""The command line: `arm5dof train | eval | solve | vision`."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from arm5dof import __version__
from arm5dof.cli import targets_csv, vision
from arm5dof.errors import UserError
from arm5dof.runtime import files, xla

TRAIN_HELP = """\
Train a policy that answers "which joint angles reach this point?".

An EXPERIMENT is a TOML file, yours or one that ships; without one, reach.toml trains the paper's 5-DOF arm in MJX
servo dynamics for the paper's 400 episodes of 160 steps. A run leaves a folder with its configuration, metrics,
checkpoints, figures and report.md. Stop it whenever you like: --resume goes on from the last checkpoint and ends
with the same bits.

  arm5dof train                                     the default experiment, into runs/reach
  arm5dof train kinematic.toml --seed 1 --out DIR   another one, another seed, into DIR
  arm5dof train --arm my_arm.xml --site tool0       your own arm
  arm5dof train --smoke                             a minute on a laptop, to see that everything works
  arm5dof train --resume runs/reach                 go on with a run that was stopped
"""

SOLVE_HELP = """\
Ask a trained policy for joint angles.

  arm5dof solve runs/reach --target 0.15 0.05 0.12          one target, metres in the arm's base frame
  arm5dof solve runs/reach --target 0.1 0 0.2 --target ...  several
  arm5dof solve runs/reach --csv points.csv --out answers.csv

A CSV has a header with x, y and z. Exit status 2 if a target is not reached within --tolerance-mm.
"""

SMOKE = {
    "episodes": "20",
    "num_envs": "20",
    "evaluate_every": "20",
    "checkpoint_every": "20",
    "targets": "500",
    "interim_targets": "500",
    "updates_per_step": "32",
}
"""What `--smoke` sets, unless the command line sets it otherwise."""


class Parser(argparse.ArgumentParser):
    """One clear line for a bad command line, as for all other bad input, and no guessing at shortened options."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "allow_abbrev": False})

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit status: 0, 2 for bad input, 130 when interrupted."""
    xla.enable_compilation_cache()
    try:
        parser = _parser()
        known, rest = parser.parse_known_args(arguments)
        if known.command is None:
            parser.print_help()
            return 0
        return int(known.run(known, rest) or 0)
    except UserError as error:
        print(f"arm5dof: {error}", file=sys.stderr)
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        print(f"arm5dof: {error.strerror or error}{place}; what was complete is kept", file=sys.stderr)
    except KeyboardInterrupt:
        print("arm5dof: interrupted; a training goes on with arm5dof train --resume RUN", file=sys.stderr)
        return 130
    return 2


def train(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof train`."""
    from arm5dof.training import config, run

    experiment, overrides = _experiment_and_overrides(rest)
    if known.resume is not None:
        others = [name for name, value in (("EXPERIMENT", experiment), ("--out", known.out)) if value]
        others += [f"--{name}" for name in overrides] + ["--smoke"] * known.smoke
        if others:
            raise UserError(f"--resume goes on with a run as it was configured; leave out {', '.join(others)}")
        current = run.Run.open(known.resume)
        trainer = None
    else:
        experiment = experiment or "reach.toml"
        given = {name.replace("-", "_").rsplit(".", 1)[-1] for name in overrides}
        smoke = {k: v for k, v in SMOKE.items() if k not in given} if known.smoke else {}
        settings = config.load(experiment, {**smoke, **overrides})
        # What is wrong with the arm or the budget is said before a folder exists.
        trainer = run.make_trainer(settings)
        trainer.check()
        out = known.out or run.free_folder(Path(experiment).stem + ("-smoke" if known.smoke else ""))
        current = run.Run.create(settings, out)
    print(f"run {current.folder} on {run.device()}", file=sys.stderr)
    evaluations = run.train(current, trainer)
    from arm5dof.training.evaluate import table

    print(table({name: evaluations[-1][name] for name in ("one_shot", "refined", "episode")}))
    print(f"figures and report: {current.folder / 'report.md'}")


def evaluate(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof eval`."""
    _nothing_left(rest)
    from arm5dof.runtime.progress import Bar
    from arm5dof.training import evaluate, run

    current = run.Run.open(known.run_folder)
    protocol = current.config.evaluate
    targets = known.targets or protocol.targets
    policy = current.policy()
    with Bar("evaluating", targets, "targets") as bar:
        results, normalised = evaluate.evaluate(policy, targets, protocol.refinements, known.seed, bar.update)
    if known.json:
        print(json.dumps(results))
    else:
        print(evaluate.table(results))
        print(f"\nnormalised accuracy (paper style): {normalised:.2f} %")


def solve(known: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof solve`."""
    _nothing_left(rest)
    targets = _targets(known)
    if known.out is not None and known.out.exists():
        raise UserError(f"{known.out} exists: choose another --out")
    import jax.numpy as jnp
    import numpy as np

    from arm5dof.training import run

    policy = run.Run.open(known.run_folder).policy()
    answer = policy(jnp.asarray(targets, jnp.float32), known.refine)
    q, error = np.asarray(answer.q, float), np.asarray(answer.error, float) * 1e3
    names = [policy.arm.mj_model.joint(int(j)).name for j in policy.arm.joints]
    reached = error <= known.tolerance_mm
    rows: list[dict[str, Any]] = [
        {"target_m": target, "joints_rad": dict(zip(names, map(float, angles), strict=True)), "error_mm": float(miss)}
        for target, angles, miss in zip(targets, q, error, strict=True)
    ]
    if known.json:
        print(json.dumps(rows))
    elif known.csv is None:
        for row in rows:
            target = " ".join(f"{1e3 * v:.1f}" for v in row["target_m"])
            angles = "  ".join(f"{name} {math.degrees(value):.2f}" for name, value in row["joints_rad"].items())
            print(f"{target} mm:  {angles} degrees  error {row['error_mm']:.2f} mm")
    if known.csv is not None and not (known.json and known.out is None):
        text = targets_csv.write(rows, known.tolerance_mm)
        sys.stdout.write(text) if known.out is None else files.write_text(known.out, text)
    if not reached.all():
        worst = int(error.argmax())
        point = ", ".join(f"{v:g}" for v in targets[worst])
        origin = ", ".join(f"{v:g}" for v in policy.arm.origin)
        raise UserError(
            f"{(~reached).sum()} of {len(rows)} targets not reached within {known.tolerance_mm:g} mm: ({point}) m is "
            f"missed by {error[worst]:.1f} mm; the arm reaches {policy.arm.reach:.3f} m from ({origin}) m"
        )
    return 0


def _parser() -> Parser:
    parser = Parser(prog="arm5dof", description="Train and ask vision-guided robot arms in JAX and MJX.")
    parser.add_argument("--version", action="version", version=f"arm5dof {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)

    raw = argparse.RawDescriptionHelpFormatter
    # The experiment is not declared: next to settings that argparse does not know it would swallow their values.
    usage = "arm5dof train [EXPERIMENT.toml] [--SETTING VALUE ...] [--out DIR] [--resume DIR] [--smoke]"
    p = commands.add_parser(
        "train", help="train a policy", usage=usage, description=TRAIN_HELP, formatter_class=raw, add_help=False
    )
    p.add_argument("-h", "--help", action=_TrainHelp, nargs=0, help="show this help, every setting included")
    p.add_argument("--out", type=Path, metavar="DIR", help="the run's folder; default: runs/<experiment>")
    p.add_argument("--resume", type=Path, metavar="DIR", help="go on with the run in this folder")
    p.add_argument("--smoke", action="store_true", help="a short run with small batches")
    p.set_defaults(run=train)

    p = commands.add_parser("eval", help="measure a policy's accuracy", description="Measure a trained policy.")
    p.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    p.add_argument("--targets", type=_positive, metavar="N", help="unseen targets; default: the run's (10,000)")
    p.add_argument("--seed", type=int, default=0, help="of the targets; default 0")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=evaluate)

    p = commands.add_parser("solve", help="ask a policy for joint angles", description=SOLVE_HELP, formatter_class=raw)
    p.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    p.add_argument("--target", type=float, nargs=3, action="append", metavar=("X", "Y", "Z"), help="metres; repeatable")
    p.add_argument("--csv", type=Path, metavar="IN.csv", help="many targets")
    p.add_argument("--out", type=Path, metavar="OUT.csv", help="with --csv: where the answers go; default: printed")
    p.add_argument("--refine", type=_natural, default=10, metavar="N", help="ask again N times; default 10")
    p.add_argument("--tolerance-mm", type=float, default=20.0, metavar="MM", help="what counts as reached; default 20")
    p.add_argument("--json", action="store_true", help="print a JSON list")
    p.set_defaults(run=solve)

    vision.declare(
        commands.add_parser("vision", help="cameras: calibrate, pose, detect, locate", description="What the arm sees.")
    )
    return parser


class _TrainHelp(argparse.Action):
    """Help that lists every setting. Importing the settings takes JAX, so only help pays for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from arm5dof.training import config

        section = None
        for f in config.fields():
            if f.section != section:
                section = f.section
                group = parser.add_argument_group(f"settings [{section}]")
            choices = f" One of {', '.join(f.choices)}." if f.choices else ""
            text = f"{f.help}{choices} (default {f.default})"
            group.add_argument(f"--{f.name.replace('_', '-')}", metavar="VALUE", help=text.replace("%", "%%"))
        parser.print_help()
        parser.exit()


def _experiment_and_overrides(rest: list[str]) -> tuple[str | None, dict[str, str]]:
    """An experiment's name, and `--field value` or `--field=value` pairs, in any order."""
    experiment, overrides = None, {}
    words = iter(rest)
    for word in words:
        if not word.startswith("--"):
            if experiment is not None:
                raise UserError(f"unexpected argument {word!r} (see arm5dof train --help)")
            experiment = word
            continue
        name, has_value, value = word[2:].partition("=")
        if not has_value:
            value = next(words, "")
            if not value or value.startswith("--"):
                from arm5dof.training import config

                config.find(name)  # If there is no such setting, that is what to say.
                raise UserError(f"--{name} needs a value")
        overrides[name] = value
    return experiment, overrides


def _nothing_left(rest: list[str]) -> None:
    if rest:
        raise UserError(f"unexpected argument {rest[0]!r} (see --help)")


def _targets(known: argparse.Namespace) -> list[list[float]]:
    """Targets (n, 3) in metres from the command line or a CSV, all finite."""
    if (known.csv is None) == (known.target is None):
        raise UserError("give either --target X Y Z (metres) or --csv FILE")
    targets = known.target if known.csv is None else targets_csv.read(known.csv)
    for i, target in enumerate(targets, 1):
        if not all(map(math.isfinite, target)):
            raise UserError(f"target {i} is not finite: {' '.join(map(str, target))}")
    return targets


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive whole number")
    return value


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value
