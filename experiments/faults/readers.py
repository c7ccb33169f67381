"""What reads files and words from outside: sound inputs for each reader, how they are damaged, and the command that
reads them. Work that would follow (training, simulating, networks) is cut short, since only the reading is tried."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from damage import damaged_csv, damaged_json, damaged_text, damaged_toml, damaged_xml
from damage_binary import damaged_array, damaged_bytes, damaged_message, damaged_png, damaged_zip
from values import NUMBERS, WORDS, Rng, pick

ROOT = Path(__file__).parents[2]
TINY = {
    **{"episodes": 10, "num_envs": 5, "evaluate_every": 5, "checkpoint_every": 5, "episode_length": 32},
    **{"targets": 50, "interim_targets": 50, "updates_per_step": 8, "refinements": 0, "replay_capacity": 1024},
    **{"actor_width": 16, "critic_width": 16, "heads": 2, "restarts": 1},
}
SETTINGS = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
CANARY = "a-pickle-was-run"
OTHERS = "others"
"""The folder of files that are put in the place of another."""


class Reader(NamedTuple):
    """A reader of files in a folder, or of the words of a command."""

    share: int
    """Of all inputs."""
    command: Callable[[Path, Path, Rng], list[str]]
    """From a folder with the input, and a name for an output, to the words of a command."""
    damaged: str = "*"
    """What is damaged: a pattern of files in the folder; nothing where the words are."""
    kept: bool = True
    """Whether every file of the input must be as it was."""


class Began(BaseException):
    """What was read was taken, and the work would begin."""


def cut(*_: object, **__: object) -> None:
    """Stands for work that takes its time."""
    raise Began


def shorten() -> None:
    """Cut all that follows reading."""
    import arm5dof.cli.grasp
    import arm5dof.grasp.evaluation
    import arm5dof.sweeps.sweep
    import arm5dof.training.evaluate
    import arm5dof.training.loop
    import arm5dof.vision.detectors.tabletop.detector
    import arm5dof.vision.detectors.tabletop.training.train
    import arm5dof.vision.detectors.yolov5.model
    import arm5dof.vision.evaluation.detection
    import arm5dof.vision.evaluation.doctor

    arm5dof.training.loop.resume = cut  # type: ignore[assignment]
    arm5dof.training.evaluate.evaluate = cut  # type: ignore[assignment]
    arm5dof.sweeps.sweep._drive = cut  # type: ignore[assignment]
    arm5dof.grasp.evaluation.Program.trial = cut  # type: ignore[method-assign]
    arm5dof.grasp.evaluation.evaluate = cut  # type: ignore[assignment]
    arm5dof.cli.grasp._photograph = cut  # type: ignore[assignment]
    arm5dof.vision.detectors.yolov5.model.YOLOv5.__call__ = cut  # type: ignore[method-assign]
    arm5dof.vision.detectors.tabletop.detector.TabletopDetector.__call__ = cut  # type: ignore[method-assign]
    arm5dof.vision.detectors.tabletop.training.train.train = cut  # type: ignore[assignment]
    arm5dof.vision.evaluation.detection.evaluate = cut  # type: ignore[assignment]
    arm5dof.vision.evaluation.doctor.rendering = cut  # type: ignore[assignment]


def _robot(folder: Path, out: Path, rng: Rng) -> list[str]:
    """Most are trained in kinematics, which is quick to set up; some are looked at in physics too."""
    file = str(folder / ("robot.urdf" if list(folder.glob("*.urdf")) else "robot.xml"))
    more = pick(rng, ([], [], ["--site", "tool"], ["--base", "link1"]))
    if rng.random() < 0.08:
        return ["arm", file, *more, "--json"]
    return ["train", "kinematic.toml", "--arm", file, *more, *SETTINGS, "--out", str(out)]


def _run(folder: Path, out: Path, rng: Rng) -> list[str]:
    run = str(folder / "run")
    return pick(
        rng,
        (
            ["compare", run],
            ["compare", run, "--figure", str(out)],
            ["solve", run, "--target", "0.1", "0", "0.2", "--json"],
            ["eval", run, "--json"],
            ["export", run, f"{out}.zip"],
            ["train", "--resume", run, "--episodes", "20"],
        ),
    )


def _settings(_: Path, out: Path, rng: Rng) -> list[str]:
    from arm5dof.training import config

    experiment = pick(rng, ("kinematic.toml", "kinematic.toml", "reach_pose.toml", "reach.toml"))
    fields = [f for f in config.fields(config.load_config(experiment)) if f.name != "task"]
    words = ["train", experiment, "--dynamics=kinematic", "--out", str(out)]
    for _ in range(int(rng.integers(1, 4))):
        field = pick(rng, fields)
        value = _value(rng, field.value)
        name = field.name.replace("_", "-") if rng.random() < 0.9 else pick(rng, (*WORDS, field.name[:-1]))
        words += [f"--{name}={value}"] if rng.random() < 0.7 else [f"--{name}", value]
    return [word for word in words if "\x00" not in word]


def _value(rng: Rng, now: object) -> str:
    """What may be given for a setting: one of its type that is large, small or negative, or anything."""
    if isinstance(now, (int, float)) and not isinstance(now, bool) and rng.random() < 0.5:
        return str(type(now)(now * pick(rng, (-1, 0, 2, 3, 10, 1000, 10**6, 0.5, 0.1))))
    if isinstance(now, tuple) and rng.random() < 0.5:
        return ",".join(str(v) for v in now[: int(rng.integers(len(now) + 1))]) + pick(
            rng, ("", ",", ",1", ",nan", ",x")
        )
    return pick(rng, (*NUMBERS, *NUMBERS, *WORDS))


COMMANDS = (
    "arm arm7.xml --json --tool wrist",
    "eval @run --targets 10 --seed 1 --json",
    "solve @run --target 0.1 0 0.2 --refine 3 --json --tolerance-mm 5",
    "solve @run --target 0.1 0 0.2 --near 0 0 0 0 0 --json",
    "solve @run --csv @targets.csv --path --out OUT.csv",
    "solve @run --csv @targets.csv --all",
    "export @run OUT.zip",
    "compare @run --figure OUT.png",
    "train --resume @run --episodes 30",
    "train kinematic.toml --smoke --out OUT --log tensorboard",
    "sweep sweep_smoke.toml --out OUT --workers 2 --executor local",
    "grasp --pick ball --place 0.1 0.1 --seed 3 --eyes truth --json",
    "grasp --pick ball --bin ball --scenes 2 --radii 0.1 0.2",
    "vision pose @camera.yml @board.png --board 8x5 --square 0.03 --at 0.2 0.1 0 -90 --out OUT.yml",
    "vision calibrate @photos --board 8x5 --square 0.03 --out OUT.yml --distortion 5 --preview OUT.png",
    "vision locate @found.json --camera @camera.yml --height ball=0.02 --table 0 --reach 0.1 2 --json",
    "vision locate @found.json --camera @camera.yml --box-std 1 --depth-error 0.002 --depth @depth.png",
    "vision detect @small.png --detector @net.onnx --confidence 0.2 --iou 0.5 --json",
    "vision detect @small.png --detector @net.onnx --classes ball --size 64",
    "vision train --out OUT --seed 1 --scenes 10 --proposer-steps 3",
    "vision eval --scenes 3 --seed 1 --back-end software --json",
)


def _words(folder: Path, out: Path, rng: Rng) -> list[str]:
    """A sound command of any kind, of which a word or two is another."""
    words = _on(*pick(rng, COMMANDS).split())(folder, out, rng)
    for _ in range(int(rng.integers(1, 3))):
        i = int(rng.integers(1, len(words)))
        match int(rng.integers(6)):
            case 0 if len(words) > 2:
                del words[i]
            case 1:
                words.insert(i, pick(rng, words))
            case 2:
                words.insert(i, pick(rng, (*WORDS, "--json", "--out", "--help", "-x", "--", "--seed")))
            case _:
                words[i] = pick(rng, (*NUMBERS, *NUMBERS, *WORDS))
    return [word for word in words if "\x00" not in word and not word.startswith("/etc")]


def _on(*words: str) -> Callable[[Path, Path, Rng], list[str]]:
    """A command with files of the input (`@name`) and the output (`OUT`)."""
    return lambda folder, out, _: [
        str(folder / w[1:]) if w.startswith("@") else w.replace("OUT", str(out)) for w in words
    ]


BOARD = ("--board", "8x5", "--square", "0.03", "--out", "OUT.yml")
LOCATE = ("vision", "locate", "@found.json", "--camera", "@camera.yml", "--json")
SIZE = ("--size", "64")  # For which those networks are made.
DETECT = ("vision", "detect", "@small.png", "--detector")


def _swept(folder: Path, out: Path, rng: Rng) -> list[str]:
    swept = str(folder / "swept")
    return pick(rng, (["compare", swept], ["sweep", "--out", swept, "--resume", "--workers", "1"]))


READERS = {
    "experiment": Reader(1000, _on("train", "@my.toml", "--out", "OUT"), "my.toml"),
    "settings": Reader(1000, _settings, ""),
    "commands": Reader(700, _words, ""),
    "sweep": Reader(700, _on("sweep", "@my.toml", "--out", "OUT", "--workers", "1"), "my.toml"),
    "mjcf": Reader(800, _robot, "*.xml"),
    "urdf": Reader(400, _robot, "*.urdf"),
    "images": Reader(900, _on("vision", "detect", "@image", "--detector", "@net.onnx", "--json"), "image"),
    "depth": Reader(200, _on(*LOCATE, "--depth", "@depth.png"), "depth.png"),
    "video": Reader(100, _on("vision", "detect", "@video", "--detector", "@net.onnx", "--json"), "video"),
    "camera": Reader(900, _on(*LOCATE), "camera.yml"),
    "photographs": Reader(150, _on("vision", "calibrate", "@photos", *BOARD), "photos/*"),
    "targets": Reader(700, _on("solve", "@run", "--csv", "@targets.csv", "--out", "OUT.csv"), "targets.csv"),
    "hand poses": Reader(
        300, _on("vision", "hand-eye", "@camera.yml", "@poses.csv", "--eye-in-hand", *BOARD), "poses.csv"
    ),
    "detections": Reader(800, _on(*LOCATE), "found.json"),
    "job": Reader(300, _on("grasp", "--task", "@job.toml", "--eyes", "truth"), "job.toml"),
    "names": Reader(150, _on(*DETECT, "@nameless.onnx", *SIZE, "--names", "@names.txt"), "names.txt"),
    "onnx": Reader(600, _on(*DETECT, "@net.onnx", *SIZE, "--json"), "net.onnx"),
    "pt": Reader(400, _on(*DETECT, "@net.pt"), "net.pt"),
    "weights": Reader(300, _on(*DETECT, "@net.npz"), "net.npz"),
    "policy": Reader(250, _on("grasp", "--policy", "@policy.zip", "--eyes", "truth"), "policy.zip"),
    "checkpoint": Reader(300, _run, "run/checkpoints/**/*", kept=False),
    "run": Reader(450, _run, "run/*", kept=False),
    "swept": Reader(150, _swept, "swept/**/*", kept=False),
}


def damage(rng: Rng, folder: Path, pattern: str, sound: Path) -> None:
    """Damage one file of an input, now and then two."""
    for _ in range(1 + (rng.random() < 0.1)):
        files = sorted(path for path in folder.glob(pattern) if path.is_file() and path.name != ".lock")
        if not files:
            return
        path = pick(rng, files)
        chance = rng.random()
        if chance < 0.03:
            path.write_bytes(b"")
        elif chance < 0.05:
            path.unlink()
        elif chance < 0.06:
            path.unlink()
            target = pick(rng, (None, path.name, "nowhere"))
            path.symlink_to(target) if target else path.mkdir()
        elif chance < 0.13:
            path.write_bytes(pick(rng, sorted((sound / OTHERS).iterdir())).read_bytes())
        else:
            path.write_bytes(_damaged(rng, path.name, path.read_bytes()))


def _damaged(rng: Rng, name: str, content: bytes) -> bytes:
    for start, special in SPECIAL:
        if start(name, content) and rng.random() < 0.6:
            try:
                return special(rng, content)
            except (ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, SyntaxError, EOFError):
                break  # It is damaged already.
    is_text = content[:200].isascii() and b"\x00" not in content[:200]
    return (damaged_text if is_text and rng.random() < 0.7 else damaged_bytes)(rng, content)


def _member(rng: Rng, name: str, content: bytes) -> bytes:
    """Damage inside an archive."""
    if name.endswith(".pkl") and rng.random() < 0.3:
        return pickle.dumps(Canary(), 2)
    if name.endswith(".npy") and rng.random() < 0.8:
        return damaged_array(rng, name, content)
    return _damaged(rng, name, content)


SPECIAL: tuple[tuple[Callable[[str, bytes], bool], Callable[[Rng, bytes], bytes]], ...] = (
    (lambda _, content: content[:4] == b"PK\x03\x04", lambda rng, content: damaged_zip(rng, content, _member)),
    (lambda _, content: content[:4] == b"\x89PNG", damaged_png),
    (lambda name, _: name.endswith(".toml"), damaged_toml),
    (lambda name, _: name.endswith((".json", "METADATA")), damaged_json),
    (lambda name, _: name.endswith((".xml", ".urdf")), damaged_xml),
    (lambda name, _: name.endswith(".csv"), damaged_csv),
    (lambda name, _: name.endswith(".onnx"), damaged_message),
)


class Canary:
    """A pickle that leaves a file when it is run."""

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (os.environ["FAULTS_CANARY"], "w")
