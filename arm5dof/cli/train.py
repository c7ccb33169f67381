"""`arm5dof train`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import DivergedError, UserError

if TYPE_CHECKING:
    from arm5dof.training.config import Config

HELP = """\
Train a policy.

An EXPERIMENT is a TOML file, yours or one that ships; without one, reach.toml trains the paper's 5-DOF arm in MJX
servo dynamics for the paper's 400 episodes of 160 steps, to answer "which joint angles reach this point?". A run leaves
a folder with its configuration, its robot, metrics, checkpoints, a figure and report.md. Stop it whenever you like:
--resume goes on from the last checkpoint and ends with the same bits.

  arm5dof train                                     the default experiment, into runs/reach
  arm5dof train kinematic.toml --seed 1 --out DIR   another one, another seed, into DIR
  arm5dof train reach_pose.toml                     points and directions: which way the tool points
  arm5dof train --arm my_arm.xml                    your own arm; arm5dof arm my_arm.xml shows how it is read
  arm5dof train --arm my_arm.xml --tool "hand 0 0 0.1"   with the end effector 0.1 m along z from a body
  arm5dof train --arm rover.xml --base chassis      an arm on a base that stands still
  arm5dof train my.toml                             your own task: [env] task = "my_module:MyTask"
  arm5dof train --smoke                             a minute on a laptop, to see that everything works
  arm5dof train --resume runs/reach                 go on with a run that was stopped
  arm5dof train --resume runs/reach --episodes 800  a longer budget for it
  arm5dof train --log tensorboard                   curves in runs/reach/tensorboard too; tensorboard --logdir runs
  arm5dof train my.toml --help                      the settings of that experiment's task

A resumed run may have other episodes, evaluate_every, checkpoint_every, targets, interim_targets, and
correction, branches, restarts and refinements; every other setting is as it was. More episodes stretch what
falls over the training: 400 of 400 become 400 of 800, and step sizes, noise and the share of random actions
rise again to where they stand half-way.

Exit status 1 if the policy reaches nothing at all, 2 for bad input.
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


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `train` to the commands."""
    # The experiment is not declared: next to settings that argparse does not know it would swallow their values.
    usage = "arm5dof train [EXPERIMENT.toml] [--SETTING VALUE ...] [--out DIR] [--resume DIR] [--smoke] [--log NAME]"
    p = commands.add_parser("train", help="train a policy", usage=usage, description=HELP, add_help=False)
    # Help lists the settings, and importing those takes JAX, so only help pays for it.
    p.add_argument("-h", "--help", action="store_true", help="show this help, every setting included")
    p.add_argument("--out", type=Path, metavar="DIR", help="the run's folder; default: runs/<experiment>")
    p.add_argument("--tool", metavar="NAME [X Y Z]", help="the same as --site: a place on a body or geom, metres")
    p.add_argument("--resume", type=Path, metavar="DIR", help="go on with the run in this folder")
    p.add_argument("--smoke", action="store_true", help="a short run with small batches")
    p.add_argument(
        "--log",
        action="append",
        metavar="NAME",
        help="where the curves go besides metrics.csv: tensorboard, wandb (offline: WANDB_MODE=offline), or both with "
        "a comma between; each is an extra: pip install 'arm5dof[tensorboard]'",
    )
    p.set_defaults(run=run, parser=p)


def run(args: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof train`. Returns the exit status, 1 for a policy that is of no use."""
    experiment, texts = _experiment_and_settings(rest)
    if args.tool is not None:
        if "site" in texts:
            raise UserError("--tool and --site say the same: give one")
        texts["site"] = args.tool
    if args.help:
        _print_help(args.parser, experiment or "reach.toml")
        args.parser.exit()
    from arm5dof.runtime.progress import Bar
    from arm5dof.training import loop
    from arm5dof.training import run as runs
    from arm5dof.training.checkpoint import silence_abandoned_writes
    from arm5dof.training.evaluate import tables
    from arm5dof.training.loggers import make_loggers

    silence_abandoned_writes()

    loggers = make_loggers(",".join(args.log)) if args.log else []
    if args.resume is not None:
        others = [name for name, value in (("EXPERIMENT", experiment), ("--out", args.out)) if value]
        others += ["--smoke"] * args.smoke
        if others:
            raise UserError(f"--resume goes on with a run as it was configured; leave out {', '.join(others)}")
        current = runs.Run.open(args.resume)
        _check_options(current.config, texts)
        current = current.extended(**texts) if texts else current
        trainer = None
    else:
        experiment = experiment or "reach.toml"
        out = args.out or runs.free_folder(Path(experiment).stem + ("-smoke" if args.smoke else ""))
        if out.exists():
            raise UserError(f"{out} exists: choose another --out, or go on with it by --resume {out}")
        settings = _configure(experiment, texts, args.smoke)
        # What is wrong with the robot or the budget is said before a folder exists.
        trainer = loop.make_trainer(settings)
        current = runs.Run.create(settings, out, trainer.env)
        print(trainer.env.about, end="\n" if trainer.env.about else "", file=sys.stderr)
    print(f"run {current.folder} on {runs.device()}", file=sys.stderr)
    try:
        with Bar("training", current.config.train.episodes, "episodes") as bar:
            loop.resume(current, bar, trainer, loggers)
    except UserError as error:
        if args.resume is None and current.has_checkpoint:
            raise UserError(f"{error}; go on with arm5dof train --resume {current.folder}") from None
        raise
    except DivergedError as error:
        more = f"; the last checkpoint is kept in {current.folder}" if current.has_checkpoint else ""
        raise DivergedError(f"the training diverged: {error}: try a smaller actor_lr or critic_lr{more}") from None
    except KeyboardInterrupt as stop:
        if not current.has_checkpoint:
            raise type(stop)("interrupted before the first checkpoint") from None
        raise type(stop)(f"interrupted; go on with arm5dof train --resume {current.folder}") from None
    print(tables(current.env.metrics, current.evaluations[-1]))
    print(f"figure and report: {current.folder / 'report.md'}")
    if failure := current.env.failure(current.evaluations[-1]):
        print(f"arm5dof: {failure}", file=sys.stderr)
    return int(bool(failure))


def _configure(experiment: str, texts: dict[str, str], smoke: bool) -> Config:
    """The configuration that a command line asks for."""
    from arm5dof.training import config

    found = config.load_config(experiment)
    given = _check_options(found, texts)
    short = {name: value for name, value in SMOKE.items() if smoke and name not in given}
    return config.override(found, {**short, **texts})


def _check_options(found: Config, texts: dict[str, str]) -> set[str]:
    """The names of the settings that a command line gives. Raises `UserError`, in its terms, for an unknown one or one
    without a value."""
    from arm5dof.training import config

    fields = config.fields(found)
    try:
        given = {config.find(name, fields).name for name in texts}
    except config.UnknownSettingError as error:
        hint = f"did you mean --{error.nearest.replace('_', '-')}?" if error.nearest else "see arm5dof train --help"
        raise UserError(f"unknown option --{error.name}: {hint}") from None
    for name, value in texts.items():
        if not value:
            raise UserError(f"--{name} needs a value")
    return given


def _experiment_and_settings(rest: list[str]) -> tuple[str | None, dict[str, str]]:
    """An experiment's name, and `--setting value` or `--setting=value` pairs, in any order; the text is empty where
    the value is missing."""
    experiment, texts = None, {}
    words = list(reversed(rest))
    while words:
        word = words.pop()
        if not word.startswith("--"):
            if experiment is not None:
                raise UserError(f"unexpected argument {word!r} (see arm5dof train --help)")
            experiment = word
            continue
        name, has_value, value = word[2:].partition("=")
        if not has_value and words and not words[-1].startswith("--"):
            value = words.pop()
        texts[name] = value
    return experiment, texts


def _print_help(parser: argparse.ArgumentParser, experiment: str) -> None:
    """Help that lists every setting of an experiment's task."""
    from arm5dof.training import config

    section = None
    for f in config.fields(config.load_config(experiment)):
        if f.section != section:
            section = f.section
            group = parser.add_argument_group(f"settings [{section}]")
        choices = f" One of {', '.join(f.choices)}." if f.choices else ""
        text = f"{f.help}{choices} (default {f.value})"
        group.add_argument(f"--{f.name.replace('_', '-')}", metavar="VALUE", help=text.replace("%", "%%"))
    parser.print_help()
