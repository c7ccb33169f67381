"""Public arms as their makers' MJCF has them, trained by the command that ships: accuracy in both dynamics, and time.

    python experiments/gallery.py --models DIR [DIR ...]             all: results/gallery.md, docs/gallery.png
    python experiments/gallery.py --models DIR --only ur5e panda     some of them; nothing is written

A DIR is a checkout of MuJoCo Menagerie, or a folder laid out like it. Without --models the arms come from Menagerie as
the package robot_descriptions has it (it clones from GitHub), if that is installed. What is not found is skipped. The
runs are left in runs/gallery/; one that is there already is measured, not trained anew.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import mujoco
import numpy as np

from arm5dof import Run
from arm5dof.runtime import files, xla

HERE = Path(__file__).parent
OUT = Path("runs") / "gallery"
LIMIT, SAMPLES, CELL = 0.02, 2000, 320
COMMAND = [sys.executable, "-m", "arm5dof"]


class Public(NamedTuple):
    """An arm: where it lies in Menagerie, and its tool where the choice that is made for it is not the tool's tip."""

    title: str
    file: str
    tool: str = ""


ARMS = {
    "ur5e": Public("Universal Robots UR5e", "universal_robots_ur5e/ur5e.xml"),
    "so_arm100": Public("SO-ARM100", "trs_so_arm100/so_arm100.xml", "Fixed_Jaw 0 -0.1 0"),
    "panda": Public("Franka Panda with hand", "franka_emika_panda/panda.xml", "hand 0 0 0.1034"),
    "yam": Public("I2RT YAM", "i2rt_yam/yam.xml"),
    "gen3": Public("Kinova Gen3", "kinova_gen3/gen3.xml"),
    "iiwa14": Public("KUKA iiwa 14", "kuka_iiwa_14/iiwa14.xml"),
    "z1": Public("Unitree Z1", "unitree_z1/z1.xml"),
    "lite6": Public("UFACTORY Lite 6", "ufactory_lite6/lite6.xml"),
    "sawyer": Public("Rethink Sawyer", "rethink_robotics_sawyer/sawyer.xml"),
    "xarm7": Public("UFACTORY xArm7", "ufactory_xarm7/xarm7.xml"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, nargs="+", default=None)
    parser.add_argument("--only", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--at-once", type=int, default=1, metavar="N", help="train so many at a time; default 1")
    arguments = parser.parse_args()
    roots = arguments.models or menagerie()
    files_of = {}
    for name in arguments.only:
        public = ARMS[name]
        found = [root / public.file for root in roots if (root / public.file).is_file()]
        if found:
            files_of[name] = found[0]
        else:
            print(f"{public.title}: skipped, {public.file} is not in {' or '.join(map(str, roots)) or 'any folder'}")
    rows, pictures = [], []
    with ThreadPoolExecutor(arguments.at_once) as pool:
        trained = {name: pool.submit(train, name, ARMS[name], file) for name, file in files_of.items()}
        for name, training in trained.items():
            print(f"{ARMS[name].title}: {training.result()}", flush=True)
    for name, file in files_of.items():  # When nothing is timed any more.
        rows.append(measure(ARMS[name], OUT / name))
        pictures.append(picture(name, ARMS[name], file))
        print(rows[-1], flush=True)
    text = markdown(rows, arguments.at_once)
    print(text)
    if arguments.only == list(ARMS) and rows:
        files.write_text(HERE / "results" / "gallery.md", text)
        cv2.imwrite(str(HERE.parent / "docs" / "gallery.png"), montage(pictures))


def menagerie() -> list[Path]:
    """Where robot_descriptions keeps MuJoCo Menagerie, cloned if need be; nothing where it is not installed."""
    try:
        from robot_descriptions import panda_mj_description
    except ImportError:
        return []
    return [Path(panda_mj_description.REPOSITORY_PATH)]


def tool(public: Public) -> list[str]:
    return ["--site", public.tool] if public.tool else []


def train(name: str, public: Public, file: Path) -> Path:
    """The run of an arm, and beside it how long the command took."""
    folder = OUT / name
    if not (OUT / f"{name}.json").exists():
        started = time.monotonic()
        command = [*COMMAND, "train", "--arm", str(file), *tool(public), "--out", str(folder)]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        said = [line for line in done.stderr.splitlines() if "servos" in line]
        took = {"seconds": time.monotonic() - started, "status": done.returncode, "said": said}
        files.write_text(OUT / f"{name}.json", json.dumps(took))
        if done.returncode > 1:
            raise SystemExit(f"{public.title}: {done.stderr.splitlines()[-1]}")
    return folder


def measure(public: Public, folder: Path) -> list[str]:
    """A row of the table."""
    run, took = Run.open(folder), json.loads(folder.with_suffix(".json").read_text())
    policy, last = run.policy(), run.evaluations[-1]
    arm = policy.env.arm
    poses = arm.sample(jax.random.key(0), (SAMPLES,))
    goals = np.asarray(jax.vmap(arm.forward)(poses))
    answer = policy.solve(goals, corrections=10)
    apart = np.abs(np.linalg.norm(reached(arm, np.asarray(answer.q)) - goals, axis=1) - answer.errors["distance"])
    within = lambda kind, limit: f"{last[kind]['within'][limit]:.2f} %"
    return [
        public.title,
        str(arm.dof),
        f"{last['one_shot']['median_mm']:.2f} mm, {within('one_shot', '10')}",
        within("refined", "1"),
        f"{within('episode', '5')}, {within('episode', '1')}",
        f"{near_limit(arm, np.asarray(answer.q)):.0f} % ({near_limit(arm, np.asarray(poses)):.0f} %)",
        f"{1e3 * apart.max():.3f} mm",
        f"{took['seconds'] / 60:.1f} min",
    ]


def near_limit(arm: Any, q: np.ndarray) -> float:
    """The share, in percent, of poses (n, dof) that have a joint within 2 % of its range of a limit."""
    limited = ~np.array(arm.turns)
    place = ((q - arm.lower) / (arm.upper - arm.lower))[:, limited]
    return float(100 * ((place < LIMIT) | (place > 1 - LIMIT)).any(1).mean())


def reached(arm: Any, q: np.ndarray) -> np.ndarray:
    """Where joint positions (n, dof) lead by C MuJoCo, (n, 3) metres."""
    data, found = mujoco.MjData(arm.mj_model), []
    for row in q:
        data.qpos[arm.qpos] = row
        mujoco.mj_kinematics(arm.mj_model, data)
        found.append(data.site_xpos[arm.site].copy())
    return np.array(found)


def picture(name: str, public: Public, file: Path) -> np.ndarray:
    """What `arm5dof arm --figure` draws, (CELL, CELL, 3), with the name below."""
    path = OUT / f"{name}.png"
    if not path.exists():
        command = [*COMMAND, "arm", str(file), *tool(public), "--figure", str(path)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    image = cv2.resize(cv2.imread(str(path)), (CELL, CELL), interpolation=cv2.INTER_AREA)
    cv2.putText(image, public.title, (8, CELL - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (43, 37, 34), 1, cv2.LINE_AA)
    return image


def montage(pictures: list[np.ndarray], columns: int = 5) -> np.ndarray:
    """Pictures in rows, white where there is none."""
    blank = np.full_like(pictures[0], 255)
    padded = [*pictures, *[blank] * (-len(pictures) % columns)]
    return np.vstack([np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)])


def markdown(rows: list[list[str]], at_once: int) -> str:
    header = [
        *("arm", "joints", "one answer: median, <= 10 mm", "corrected: <= 1 mm", "servos: <= 5 mm, <= 1 mm"),
        *("near a limit (uniform poses)", "apart from C MuJoCo, at most", "train and evaluate"),
    ]
    lines = [
        "# Public arms, unedited, with the command that ships",
        "",
        f"Command: `python experiments/gallery.py --models DIR`. {platform.machine()} CPU, {xla.cores()} cores. Each",
        "was trained by `arm5dof train --arm FILE`: 400 episodes, one seed, 10,000 unseen targets. Near a limit:",
        "corrected answers with a joint within 2 % of its range of a limit, and in brackets uniform poses.",
        f"The times are those of {at_once} trainings at once." if at_once > 1 else "One was trained after the other.",
        "",
        "| " + " | ".join(header) + " |",
        "| --- |" + " ---: |" * (len(header) - 1),
        *("| " + " | ".join(row) + " |" for row in rows),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
