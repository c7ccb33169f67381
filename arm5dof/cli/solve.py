"""`arm5dof solve`: how a goal is stated, and in which units answers are off, is the task's to say."""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.cli.joints import by_unit
from arm5dof.cli.parser import Parser, natural, nothing_left
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.envs import ForwardModel
    from arm5dof.envs.inverse_kinematics import Answer
    from arm5dof.envs.metrics import Error
    from arm5dof.envs.paths import Path as Line
    from arm5dof.training.policy import Policy

REST = "\0"
"""What no column of a CSV is called."""

HELP = """\
Ask a trained policy for joint angles.

  arm5dof solve runs/reach --target 0.15 0.05 0.12          one target, metres in the world frame of the MJCF
  arm5dof solve runs/reach --target 0.1 0 0.2 --target ...  several
  arm5dof solve runs/reach --csv points.csv --out answers.csv
  arm5dof solve runs/reach --csv line.csv --path            points of a line, along which no joint is to jump
  arm5dof solve runs/reach --help                           how a goal is stated to this run's policy

A CSV has a header with x, y and z, and whatever else the run's task wants to know. Joint positions are radians, and
metres for slides, in JSON, CSV and --near, degrees and millimetres otherwise. Exit status 2 if a target is not reached
within the tolerances, or a joint jumps along a --path.
"""

Inputs = dict[str, Any]
"""What people state of n goals: rows of numbers by the names of the task's goal inputs."""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `solve` to the commands."""
    usage = "arm5dof solve RUN (--target X Y Z ... | --csv IN.csv [--out OUT.csv]) [options]"
    p = commands.add_parser(
        "solve",
        help="ask a policy for joint angles",
        usage=usage,
        description=HELP,
        add_help=False,
    )
    # RUN is not declared: beside targets, which only the run's task knows, it would swallow their numbers.
    p.add_argument("-h", "--help", action="store_true", help="show this help, with RUN that of its task")
    p.add_argument("--csv", type=Path, metavar="IN.csv", help="many targets")
    p.add_argument("--out", type=Path, metavar="OUT.csv", help="with --csv: where the answers go; default: printed")
    p.add_argument("--refine", type=natural, default=10, metavar="N", help="correct the target N times; default 10")
    p.add_argument("--path", action="store_true", help="the targets are a line: keep one branch along it")
    p.add_argument("--all", action="store_true", help="every distinct answer that reaches a target, the best first")
    p.add_argument("--json", action="store_true", help="print a JSON list")
    p.set_defaults(run=run, parser=p)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof solve`."""
    folder, rest = _run_folder(rest)
    if folder is None:
        if args.help:
            args.parser.print_help()
            args.parser.exit()
        raise UserError("name the run whose policy is to answer: arm5dof solve RUN --target X Y Z")
    if args.out is not None and args.out.exists():
        raise UserError(f"{args.out} exists: choose another --out")
    if args.path and args.all:
        raise UserError("--path wants one answer to each target: leave out --all")

    from arm5dof.runtime import files
    from arm5dof.training.policy import forward_model
    from arm5dof.training.run import Run

    opened = Run.open(folder)
    model = forward_model(opened.env)
    units = model.components
    if args.help:
        _declare_goal(args.parser, model, units)
        args.parser.print_help()
        args.parser.exit()
    parser = Parser(prog="arm5dof solve", add_help=False)
    _declare_goal(parser, model, units)
    more, rest = parser.parse_known_args(rest)
    nothing_left(rest, "solve")
    inputs = _inputs(args.csv, vars(more), model)
    tolerances = {name: getattr(more, f"tolerance_{unit.unit}") for name, unit in units.items()}

    if args.all and more.near is not None:
        raise UserError("--all gives every answer: leave out --near")
    policy = opened.policy()
    answer: Answer | Line
    jumps: list[int] = []
    if args.all:
        inputs, answer = _every(policy, inputs, args.refine, tolerances)
    elif args.path:
        answer = policy.path(start=more.near, corrections=args.refine, **inputs)
        jumps = answer.jumps.nonzero()[0].tolist()
    else:
        answer = policy.solve(near=more.near, corrections=args.refine, **inputs)
    errors = {name: [unit.scale * float(v) for v in answer.errors[name]] for name, unit in units.items()}
    reached = [all(errors[name][i] <= tolerances[name] for name in units) for i in range(len(answer.q))]
    rows: list[dict[str, Any]] = [
        {
            **{_key(name): values[i] for name, values in inputs.items()},
            **by_unit(model.joint_names, model.slides, answer.q[i]),
            **{f"error_{units[name].unit}": values[i] for name, values in errors.items()},
        }
        for i in range(len(answer.q))
    ]
    if args.json:
        print(files.to_json(rows))
    elif args.csv is None:
        print("\n".join(_line(row, inputs, units) for row in rows))
    if args.csv is not None and not (args.json and args.out is None):
        text = _csv(rows, inputs, reached, model, units)
        sys.stdout.write(text) if args.out is None else files.write_text(args.out, text)
    if jumps:
        point = ", ".join(f"{v:g}" for v in next(iter(inputs.values()))[jumps[0]])
        raise UserError(
            f"{len(jumps)} jumps of a joint on the path, the first to ({point}) m: no branch that the policy "
            "knows serves the whole line; divide it there, or give points that lie nearer to each other"
        )
    if not all(reached):
        name = next(name for name in units if not all(error <= tolerances[name] for error in errors[name]))
        worst = max(range(len(rows)), key=lambda i: errors[name][i])
        point = ", ".join(f"{v:g}" for v in next(iter(inputs.values()))[worst])
        limits = " and ".join(f"{tolerances[name]:g} {unit.unit}" for name, unit in units.items())
        raise UserError(
            f"{reached.count(False)} of {len(rows)} targets not reached within {limits}: ({point}) m is missed by "
            f"{errors[name][worst]:.1f} {units[name].unit}; {model.workspace}"
        )


def _every(policy: Policy, inputs: Inputs, refine: int, tolerances: Mapping[str, float]) -> tuple[Inputs, Answer]:
    """Every distinct answer that reaches its goal, or the best where none does, and the goals of all answers."""
    import jax
    import numpy as np

    units = policy.forward_model.components
    stated: Inputs = {name: [] for name in inputs}
    answers = []
    for goal in zip(*inputs.values(), strict=True):
        every = policy.solve_all(corrections=refine, **dict(zip(inputs, goal, strict=True)))
        met = np.all([np.asarray(every.errors[n]) * units[n].scale <= tolerances[n] for n in units], axis=0)
        rows = np.flatnonzero(met) if met.any() else np.array([0])
        answers.append(jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], every))
        for name, values in zip(inputs, goal, strict=True):
            stated[name] += [values] * len(rows)
    return stated, jax.tree.map(lambda *parts: np.concatenate(parts), *answers)


def _run_folder(rest: list[str]) -> tuple[Path | None, list[str]]:
    """The run, which is the one word that is neither an option nor a number, or else a folder named first; and the
    other words."""
    if rest and not rest[0].startswith("--") and Path(rest[0]).is_dir():
        return Path(rest[0]), rest[1:]
    words = [word for word in rest if not word.startswith("--") and not _is_number(word)]
    nothing_left(words[1:], "solve")
    return (Path(words[0]) if words else None), [word for word in rest if word not in words]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _declare_goal(parser: argparse.ArgumentParser, model: ForwardModel, units: Mapping[str, Error]) -> None:
    """Add the options by which a goal of the task is stated, and the tolerances of its errors."""
    group = parser.add_argument_group("goals of this run's task")
    for name, parts in model.goal_inputs.items():
        metavar = tuple(part.upper() for part in parts)
        group.add_argument(
            f"--{name}", type=float, nargs=len(parts), action="append", metavar=metavar, help="repeatable"
        )
    for unit in units.values():
        default = unit.tolerance
        option, about = f"--tolerance-{unit.unit}", f"what counts as reached; default {default:g}"
        group.add_argument(option, type=float, default=default, metavar=unit.unit.upper(), help=about)
    joints = model.joint_names
    about = f"where the joints are ({', '.join(joints)}): the nearest answer, or with --path the start"
    group.add_argument("--near", type=float, nargs=len(joints), metavar="Q", help=about)


def _inputs(path: Path | None, given: Mapping[str, Any], model: ForwardModel) -> Inputs:
    """What the command line or a CSV states of the goals."""
    names = list(model.goal_inputs)
    options = " ".join(f"--{name} {' '.join(model.goal_inputs[name]).upper()}" for name in names)
    stated = {name: given[name] for name in names if given[name] is not None}
    if (path is None) != bool(stated):
        raise UserError(f"give either {options} (metres) or --csv FILE")
    if path is not None:
        return _read_csv(path, model)
    if len(stated) != len(names) or len({len(rows) for rows in stated.values()}) > 1:
        raise UserError(f"give {options} for each goal")
    return stated


def _read_csv(path: Path, model: ForwardModel) -> Inputs:
    """Goals from the columns of a file. Raises `UserError` on anything else."""
    columns = [part for parts in model.goal_inputs.values() for part in parts]
    wanted = f"{', '.join(columns[:-1])} and {columns[-1]}"
    inputs: Inputs = {name: [] for name in model.goal_inputs}
    try:
        with open(path, newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle, restkey=REST)
            if not set(columns) <= set(reader.fieldnames or ()):
                raise UserError(f"{path} needs a header with {wanted} (metres)")
            for row in reader:
                if any(row.get(REST, ())):  # A decimal comma, or columns that have moved.
                    raise UserError(f"{path}, line {reader.line_num}: more values than columns")
                try:
                    for name, parts in model.goal_inputs.items():
                        inputs[name].append([float(row[part]) for part in parts])
                except (TypeError, ValueError):
                    raise UserError(f"{path}, line {reader.line_num}: {wanted} must be numbers") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is not a CSV file: {error}") from None
    if not inputs[next(iter(inputs))]:
        raise UserError(f"{path} holds no targets")
    return inputs


def _csv(
    rows: list[dict[str, Any]], inputs: Inputs, reached: list[bool], model: ForwardModel, units: Mapping[str, Error]
) -> str:
    """The text of a file with a row for each answer: goal, joint positions in radians (metres for slides), errors and
    whether it counts."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    errors = [f"error_{unit.unit}" for unit in units.values()]
    writer.writerow(
        [*(p for parts in model.goal_inputs.values() for p in parts), *model.joint_names, *errors, "reached"]
    )
    for row, counts in zip(rows, reached, strict=True):
        goal = [value for name in inputs for value in row[_key(name)]]
        joints = row["joints_rad"] | row.get("joints_m", {})
        positions = [f"{joints[name]:.7f}" for name in model.joint_names]
        writer.writerow([*goal, *positions, *(f"{row[error]:.4f}" for error in errors), int(counts)])
    return text.getvalue()


def _line(row: Mapping[str, Any], inputs: Inputs, units: Mapping[str, Error]) -> str:
    """An answer for people."""
    goal = " ".join(f"{1e3 * v:.1f}" for v in row["target_m"]) + " mm"
    goal += "".join(f", {name} {' '.join(f'{v:g}' for v in row[name])}" for name in inputs if name != "target")
    angles = [f"{name} {math.degrees(value):.2f}" for name, value in row["joints_rad"].items()]
    slides = [f"{name} {1e3 * value:.2f}" for name, value in row.get("joints_m", {}).items()]
    joints = [f"{'  '.join(of_unit)} {unit}" for of_unit, unit in ((angles, "degrees"), (slides, "mm")) if of_unit]
    errors = "  ".join(f"{row[f'error_{unit.unit}']:.2f} {unit.unit}" for unit in units.values())
    return f"{goal}:  {'  '.join(joints)}  error {errors}"


def _key(name: str) -> str:
    return "target_m" if name == "target" else name
