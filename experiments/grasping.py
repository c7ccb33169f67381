"""How often grasping works, from pixels and with ground truth, under disturbances, and where requests are lost.

python experiments/grasping.py                    every row, `SCENES` scenes each: results/
python experiments/grasping.py --scenes 50        quicker; nothing is written
python experiments/grasping.py --rows "from pixels" "ground truth"
python experiments/grasping.py --figure docs/grasp.png
python experiments/grasping.py --speed            milliseconds from an image to a motion, on an idle machine
python experiments/grasping.py --closed-form      what the policy solves of the grasps that Table 1's closed form solves
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from arm5dof.arm import load_arm
from arm5dof.arm.kinematics import inverse
from arm5dof.grasp.driver import CLEARANCE
from arm5dof.grasp.evaluation import Program, Setting, evaluate
from arm5dof.grasp.grasper import Grasper
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.jobs import Step
from arm5dof.grasp.planner import CORRECTIONS
from arm5dof.grasp.robot import SimulatedRobot
from arm5dof.grasp.scene import Disturbance
from arm5dof.grasp.score import LOST
from arm5dof.grasp.shipped import ARMS
from arm5dof.grasp.world import World
from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar
from arm5dof.training.policy_file import load_policy
from arm5dof.vision.io.annotate import annotate
from arm5dof.vision.objects import CATALOGUE
from arm5dof.vision.synthetic.scenes import MAX_OBJECTS

RESULTS = Path(__file__).parent / "results"
SEED = 2026
"""Of no scene that anything was chosen by."""


def setting(arm: str) -> Setting:
    """What ships for an arm."""
    return Setting(ARMS[arm].policy, arm, ARMS[arm].radii, SEED)


PAPER, SEVEN = setting("arm5.xml"), setting("arm7_gripper.xml")
TURNED = tuple(np.deg2rad(1) * np.array([0.6, -0.8, 0.0]))
BEYOND = (0.31, 0.36)
"""Where the paper's arm cannot grasp, metres from its axis."""
ROWS = {
    "from pixels": PAPER,
    "true boxes": replace(PAPER, eyes="boxes"),
    "ground truth": replace(PAPER, eyes="truth"),
    "from pixels, into the bin of its class": replace(PAPER, bin="class"),
    "from pixels, to a free place on the table": replace(PAPER, place="free"),
    "six objects sorted into bins, from pixels": replace(
        PAPER, job=(Step("any", bin="class"),), count=(MAX_OBJECTS, MAX_OBJECTS)
    ),
    "a class that is not there": replace(PAPER, pick="absent"),
    "objects out of reach": replace(PAPER, radii=BEYOND),
    "seven joints, from pixels": SEVEN,
    "seven joints, ground truth": replace(SEVEN, eyes="truth"),
    "camera moved 5 mm and 1 degree": replace(
        PAPER, disturbance=Disturbance(camera_shift=(0.003, -0.004, 0.0), camera_turn=TURNED)
    ),
    "light halved": replace(PAPER, disturbance=Disturbance(light=0.5)),
    "friction halved": replace(PAPER, disturbance=Disturbance(friction=0.5)),
    "mass doubled": replace(PAPER, disturbance=Disturbance(mass=2.0)),
}
SCENES = 1000
"""Of every row, half a second to three seconds each on two cores."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, help="of every row; nothing is written unless --rows names some")
    parser.add_argument("--rows", nargs="+", choices=ROWS, help="only these; others stay in the results as they are")
    parser.add_argument("--figure", type=Path, help="only draw one grasp, before and after")
    parser.add_argument("--speed", action="store_true", help="only time one decision")
    parser.add_argument("--closed-form", action="store_true", help="only compare the policy with the closed form")
    arguments = parser.parse_args()
    xla.enable_compilation_cache()
    if arguments.speed:
        speed()
        return
    if arguments.closed_form:
        closed_form()
        return
    if arguments.figure:
        figure(arguments.figure)
        return
    path = RESULTS / "grasping.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    for name in arguments.rows or ROWS:
        scenes = arguments.scenes or SCENES
        with Bar(name, scenes, "scenes") as bar:
            found[name] = evaluate(ROWS[name], scenes, bar.update).as_json()
        print(name, json.dumps(found[name]))
        if arguments.scenes is None or arguments.rows:
            files.write_text(path, json.dumps(found, indent=1) + "\n")
            files.write_text(RESULTS / "grasping.md", markdown(found))
            budget(found)


def speed() -> None:
    """From an image to a motion that is checked: medians over scenes, after a warm-up."""
    program, seen, planned = Program(PAPER), [], []
    for number in range(25):
        scene = program.scene(number)
        robot, (eyes, _) = SimulatedRobot(scene), program.perceptions(scene)
        image = robot.image()
        start = time.perf_counter()
        objects = [one for one in eyes(image) if one.position is not None]
        looked = time.perf_counter()
        if not objects:
            continue
        world = World(program.planner.arm, scene.bins.values(), objects)
        way = program.planner.approach(world, robot.joints(), objects[0].position, CLEARANCE, 0.04, 0)
        if number >= 5 and not isinstance(way, str):
            seen.append(1e3 * (looked - start))
            planned.append(1e3 * (time.perf_counter() - looked))
    text = (
        "# One grasp, from an image to a motion that is checked\n\n"
        f"Command: `python experiments/grasping.py --speed`. {platform.machine()} CPU, {len(seen)} scenes.\n\n"
        f"Medians: detect and locate {np.median(seen):.1f} ms, plan {np.median(planned):.1f} ms, together "
        f"{np.median(np.add(seen, planned)):.1f} (95th percentile {np.percentile(np.add(seen, planned), 95):.1f} ms).\n"
    )
    print(text)
    files.write_text(RESULTS / "grasping_speed.md", text)


def closed_form(count: int = 10_000) -> None:
    """Random objects, the tool straight down at their centers and `CLEARANCE` above: both at once, as a grasp needs."""
    arm, wrist, rng = load_arm("arm5.xml", SITE), load_arm("arm5.xml"), np.random.default_rng(SEED)
    (near, far), azimuth = PAPER.radii, np.deg2rad(rng.uniform(-100, 100, count))
    radius = np.sqrt(rng.uniform(near**2, far**2, count))
    height = rng.choice([one.half_height for one in CATALOGUE], count)
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], -1)
    up = np.array([0.0, 0.0, 1.0])
    points = np.stack([points, points + CLEARANCE * up], 1)
    tool = np.linalg.norm(np.asarray(arm.pose(arm.home)[0]) - np.asarray(wrist.pose(arm.home)[0]))
    with jax.enable_x64(True):
        limits = jnp.asarray(np.stack([arm.lower, arm.upper], 1))
        above = jnp.asarray(points + tool * up)  # Where the end of Table 1's chain is then.
        valid = jax.jit(inverse)(above, jnp.full(above.shape[:2], -np.pi / 2), limits).valid
    closed = np.asarray(valid).any(-1).all(-1)
    down = np.tile(-up, (2 * count, 1))
    answer = load_policy(PAPER.policy).solve(points.reshape(-1, 3), down, corrections=CORRECTIONS, candidates=True)
    good = (answer.errors["distance"] <= 0.002) & (answer.errors["angle"] <= np.deg2rad(2))
    solved = np.asarray(good).any(1).reshape(count, 2).all(1)
    text = (
        "# The policy against the closed form\n\n"
        f"Command: `python experiments/grasping.py --closed-form`. {count:,} random objects where scenes have them,\n"
        f"the tool straight down at them and {1e3 * CLEARANCE:.0f} mm above. The closed form of Table 1 solves both of "
        f"{closed.sum():,};\nof those the policy solves {100 * solved[closed].mean():.2f} % within 2 mm and 2 degrees, "
        f"and {solved[~closed].sum():,} of the others.\n"
    )
    print(text)
    files.write_text(RESULTS / "grasping_closed_form.md", text)


def figure(path: Path) -> None:
    """What the camera sees of one scene, what is detected in it, and the object lifted."""
    program = Program(PAPER)
    scene = program.scene(7)
    robot, (eyes, _) = SimulatedRobot(scene), program.perceptions(scene)
    before = robot.image()
    grasper = Grasper(robot, eyes, program.planner, robot.joints(), scene.bins.values())
    seen = annotate(before, program.detectors[0](before))
    name = next(one.name for one in grasper.look() if one.position is not None)
    print(name, grasper.pick(name))
    with files.replacing(path) as temporary:
        cv2.imwrite(str(temporary), np.hstack([seen, robot.image()])[..., ::-1])


def markdown(found: dict[str, dict]) -> str:
    """A row for each setting."""
    lines = [
        "# Grasping: one object of a random class that is there, lifted by 5 cm and held for 2 s",
        "",
        f"Command: `python experiments/grasping.py`, rows of not {SCENES:,} scenes with `--scenes N --rows ROW`;",
        f"seed {SEED}, {platform.machine()} CPU. Success is of the requests that the arm can reach and of which the",
        "camera sees half or more; in brackets, of all that it can reach, by the middle of an object or by its end.",
        "Told: requests that cannot be met and ended with the arm at rest, the gripper empty and a reason.",
        "",
        "| | scenes | success | another object lifted | lost by | told |",
        "| --- | ---: | ---: | ---: | --- | ---: |",
    ]
    for name in ROWS:
        if name in found:
            one = found[name]
            lost = ", ".join(f"{where} {count}" for where, count in one["failures"].items()) or "nothing"
            seen = f"{one['success_percent']:.2f} % " if one["in_sight"] else ""
            share = f"{seen}({one['reachable_percent']:.2f})" if one["reachable"] else ""
            hopeless = one["scenes"] - one["reachable"]
            told = f"{one['unreachable_told']} of {hopeless}" if hopeless else ""
            wrong = f"{one['wrong_object_percent']:.2f} %"
            lines.append(f"| {name} | {one['scenes']} | {share} | {wrong} | {lost if share else ''} | {told} |")
    return "\n".join(lines) + "\n"


def budget(found: dict[str, dict]) -> None:
    """Where requests are lost, the program's eyes replaced stage by stage by the truth."""
    rows = [name for name in ("from pixels", "true boxes", "ground truth") if name in found]
    fig = Figure(figsize=(7, 0.8 + 0.4 * len(rows)), layout="constrained")
    FigureCanvasAgg(fig)
    ax = fig.add_subplot()
    left = np.zeros(len(rows))
    for where in LOST:
        share = np.array([100 * found[name]["failures"].get(where, 0) / found[name]["in_sight"] for name in rows])
        if share.any():
            ax.barh(rows, share, left=left, label=where)
            left += share
    ax.invert_yaxis()
    ax.set_xlabel("requests lost, %")
    ax.legend(ncols=len(LOST), fontsize="small", loc="lower right")
    with files.replacing(RESULTS / "grasping.png") as temporary:
        fig.savefig(temporary, dpi=150, format="png")


if __name__ == "__main__":
    main()
