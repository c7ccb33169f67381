"""`arm5dof grasp`: from a camera's image to a lifted object."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.joints import by_unit, for_people
from arm5dof.cli.parser import natural, nothing_left, positive
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.grasp.evaluation import Program
    from arm5dof.grasp.perception import Perception
    from arm5dof.grasp.scene import TabletopScene
    from arm5dof.grasp.score import Trial
    from arm5dof.grasp.video import Recorder

HELP = """\
See, decide, grasp, place: pick objects by their class from random scenes on a table, in MuJoCo's physics, from a
camera's image alone.

  arm5dof grasp                                     one scene, a random class that is there
  arm5dof grasp --pick "red cube" --bin "red cube" --video grasp.mp4
  arm5dof grasp --pick ball --place 0.15 -0.1       put it down there, metres in the arm's base frame
  arm5dof grasp --scenes 1000 --seed 3 --json       how often it works, and where requests are lost
  arm5dof grasp --task sort.toml                    several picks and places: [[step]] with pick = a class or "any",
                                                    and bin = a name or "class", place = [x, y], or on = a class
  arm5dof grasp --scenes 1000 --eyes truth          the same, had the camera seen everything right; "boxes": had the
                                                    detector found everything
  arm5dof grasp --scenes 1000 --pick absent         what it says where the class is not there
  arm5dof grasp --arm arm7_gripper.xml              another arm that ships
  arm5dof grasp --arm mine.xml --policy runs/mine   another arm: a policy trained by
                                                    arm5dof train reach_pose.toml --arm mine.xml --site grasp
  arm5dof grasp --image photo.jpg --camera posed.yml --pick can
                                                    joint angles for a real photograph, nothing moves

With --json and --scenes: {"success_percent", "wrong_object_percent", "scenes", "in_sight", "reachable",
"reachable_percent", "unreachable_told", "failures"}; success is of the requests that the arm can reach and of which the
camera sees half or more. Exit status 1 if a single request was not done, such as for a class that is not there, and 2
for bad input.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `grasp` to the commands."""
    p = commands.add_parser("grasp", help="pick objects by class from a camera's image", description=HELP)
    p.add_argument("--pick", metavar="CLASS", help="what to pick; default: a random class that is there")
    where = p.add_mutually_exclusive_group()
    where.add_argument("--place", type=float, nargs=2, metavar=("X", "Y"), help="where to put it, metres")
    where.add_argument(
        "--bin", metavar="NAME", help='the bin to put it in, named after a class; "class": that of its own'
    )
    p.add_argument("--task", type=Path, metavar="FILE", help="steps in TOML, instead of --pick, --place and --bin")
    p.add_argument("--arm", default="arm5.xml", metavar="FILE", help="MJCF with a gripper; default arm5.xml")
    p.add_argument("--policy", type=Path, metavar="RUN", help="a run's folder or a policy's file; default: what ships")
    p.add_argument(
        "--radii", type=float, nargs=2, metavar=("NEAR", "FAR"), help="where objects lie, metres from the axis"
    )
    p.add_argument("--scenes", type=positive, default=1, metavar="N", help="how many scenes; default 1")
    p.add_argument("--seed", type=natural, default=0, metavar="S", help="of the scenes; default 0")
    p.add_argument(
        "--eyes", choices=("camera", "boxes", "truth"), default="camera", help="what is seen; default camera"
    )
    p.add_argument("--video", type=Path, metavar="OUT.mp4", help="record the first scene")
    p.add_argument("--image", type=Path, metavar="PHOTO", help="plan for a photograph, with --camera and --pick")
    p.add_argument("--camera", type=Path, metavar="POSED.yml", help="the camera that took it, with its pose")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof grasp`."""
    nothing_left(rest, "grasp")
    if (args.image is None) != (args.camera is None):
        raise UserError("--image and --camera go together")
    if args.image is not None and (args.bin is not None or args.video is not None):
        raise UserError("nothing moves for an --image, and it has no bins: leave out --bin and --video")
    if args.video is not None:
        from arm5dof.cli.vision.options import writable

        writable(args.video, (".mp4",))
    if args.task is not None and (args.pick or args.place or args.bin or args.image):
        raise UserError("--task says what to pick and where to put it: leave out --pick, --place, --bin and --image")
    from arm5dof.grasp.shipped import ARMS, shipped

    policy = args.policy or shipped(args.arm).policy
    radii = tuple(args.radii) if args.radii else ARMS.get(args.arm, ARMS["arm5.xml"]).radii
    if args.image is not None:
        return _photograph(args, policy, radii)
    from arm5dof.grasp.evaluation import Program, Setting, evaluate
    from arm5dof.grasp.score import Score, table
    from arm5dof.runtime import files
    from arm5dof.runtime.progress import Bar

    place = tuple(args.place) if args.place else None
    setting = Setting(policy, args.arm, radii, args.seed, args.eyes, args.pick, place, args.bin)
    if args.task is not None:
        from arm5dof.grasp.jobs import read_job

        setting = replace(setting, job=tuple(read_job(args.task)))
    if args.scenes == 1 or args.video is not None:
        trial = _watched(Program(setting), args.video, quiet=args.json)
    if args.scenes > 1:
        with Bar("grasping", args.scenes, "scenes") as bar:
            score = evaluate(setting, args.scenes, bar.update)
        print(files.to_json(score.as_json()) if args.json else table(score))
        return 0
    if args.json:
        print(files.to_json(Score((trial,)).as_json()))
    elif trial.success and trial.reachable:
        print(f"{trial.asked}: done")
    else:
        print(f"{trial.asked}: not done, {trial.said or 'lost by ' + trial.lost}")
    return 0 if trial.success and trial.reachable else 1


def _watched(program: Program, video: Path | None, quiet: bool) -> Trial:
    """One trial, told as it goes, and recorded."""
    from arm5dof.grasp.evaluation import Observer

    class Teller(Observer):
        def stage(self, words: str) -> None:
            if not quiet:
                print(words)

    if video is None:
        return program.trial(0, lambda *_: Teller())
    from arm5dof.grasp.video import Recorder
    from arm5dof.runtime import files

    with files.replacing(video) as temporary:
        recorders: list[Recorder] = []

        def watch(scene: TabletopScene, perception: Perception) -> Recorder:
            recorders.append(Recorder(temporary, scene, perception))
            return recorders[0]

        trial = program.trial(0, watch)
        recorders[0].close()
    if not quiet:
        print(f"video: {video}")
    return trial


def _photograph(args: argparse.Namespace, policy: Path, radii: tuple[float, float]) -> int:
    """Plan for a photograph, and print what an arm would be told."""
    from arm5dof.arm import load_arm
    from arm5dof.cli.vision.options import say_untagged
    from arm5dof.grasp.grasper import Grasper
    from arm5dof.grasp.gripper import SITE
    from arm5dof.grasp.perception import CameraPerception, detectors
    from arm5dof.grasp.planner import Planner
    from arm5dof.grasp.robot import DryRun
    from arm5dof.grasp.world import World
    from arm5dof.runtime import files
    from arm5dof.training.policy_file import load_policy
    from arm5dof.vision import images
    from arm5dof.vision.camera import Camera

    if args.pick is None:
        raise UserError("--image wants --pick CLASS: what is to be picked")
    camera = Camera.load(args.camera)
    quick, thorough = (CameraPerception(detector, camera) for detector in detectors())
    say_untagged([args.image])
    image = images.read(args.image, upright=False)
    arm = load_arm(args.arm, SITE)
    planner = Planner(load_policy(policy), arm)
    rest = World(arm).rest(camera, radii)
    robot = DryRun(arm, rest, image=image)
    grasper = Grasper(robot, quick, planner, rest, second_look=thorough)
    outcome = grasper.pick(args.pick)
    if outcome.success and args.place:
        import numpy as np

        outcome = grasper.place(np.array(args.place))
    if not outcome.success:
        raise UserError(f"{args.image}: {outcome.reason}")
    commands = [
        {
            "time_s": round(one.time, 3),
            **by_unit(arm.joint_names, arm.slides, one.joints),
            "opening_m": one.opening,
        }
        for one in robot.commands
    ]
    if args.json:
        print(files.to_json(commands))
    else:
        print("  time  opening  " + "  ".join(f"{name:>12}" for name in arm.joint_names) + "  (degrees, slides mm)")
        for one in robot.commands:
            pairs = zip(arm.slides, map(float, one.joints), strict=True)
            shown = "  ".join(f"{for_people(*pair)[0]:12.2f}" for pair in pairs)
            print(f"{one.time:5.2f} s {1e3 * one.opening:5.1f} mm  {shown}")
    return 0
