"""Sound inputs of every reader, made where the project's tests make theirs: small, and from nothing."""

from __future__ import annotations

import io
import pickle
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from readers import OTHERS, READERS, ROOT, SETTINGS, TINY, Canary


def prepare(sound: Path) -> None:
    """Make sound inputs: a folder for each reader, and in it one for each kind of input."""
    sys.path.append(str(ROOT / "tests"))
    import cv2
    from helpers import onnx_bytes, photographs, yolov5_bytes
    from helpers.tabletop_weights import weights_of

    from arm5dof.cli.main import main
    from arm5dof.vision.detectors.tabletop.weights import save_weights

    common = sound / "common"
    common.mkdir(parents=True)
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (48, 64, 3), np.uint8)
    cv2.imwrite(str(common / "small.png"), small)
    names = {"names": "{0: 'cube', 1: 'ball'}"}
    onnx_bytes.constant(common / "net.onnx", onnx_bytes.output("yolov8"), (1, 3, 64, 64), names)
    onnx_bytes.constant(common / "nameless.onnx", onnx_bytes.output("yolov5"))
    (common / "names.txt").write_text("cube\nball\n")
    yolov5_bytes.Architecture(4, 1, 2).save(common / "net.pt")
    save_weights(common / "net.npz", weights_of(20, 1, 1), ("a", "b", "c"))
    (common / "photos").mkdir()
    paths, seen = photographs.photograph_board(common / "photos")
    for path in paths[6:]:
        path.unlink()
    photographs.KNOWN.save(common / "lens.yml")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1, -1, -1]), (0.2, 0, 0.6)
    photographs.KNOWN.replace(rotation=pose[:3, :3], position=pose[:3, 3]).save(common / "camera.yml")
    hands = photographs.hand_poses(seen, True)[:6]
    photographs.write_poses(common / "poses.csv", hands, [f"photos/{path.name}" for path in paths[:6]])
    shutil.copy(paths[0], common / "board.png")
    cv2.imwrite(str(common / "depth.png"), np.full((480, 640), 600, np.uint16))
    (common / "found.json").write_text(
        f'[{{"name": "a.png", "time_s": null, "image_size": [640, 480], "detections": [{BOX}]}}]'
    )
    (common / "targets.csv").write_text("x,y,z\n0.1,0,0.2\n0.15,0.05,0.12\n")
    (common / "job.toml").write_text(
        '[[step]]\npick = "any"\nbin = "class"\n[[step]]\npick = "ball"\nplace = [0.15, -0.1]\n'
    )
    assert main(["train", "kinematic.toml", *SETTINGS, "--out", str(common / "run")]) in (0, 1)
    for reader in READERS:
        for name, content in _inputs(reader, common, small):
            shutil.copytree(common, sound / reader / name) if reader in NEEDS_ALL else (sound / reader / name).mkdir(
                parents=True
            )
            for file, data in content.items():
                (sound / reader / name / file).parent.mkdir(parents=True, exist_ok=True)
                (sound / reader / name / file).write_bytes(data)
    _others(sound, common)


NEEDS_ALL = ("commands",)


def _inputs(reader: str, common: Path, small: np.ndarray) -> Iterator[tuple[str, dict[str, bytes]]]:
    """The files of each sound input of a reader."""
    import cv2
    from helpers import onnx_bytes, videos

    def some(*names: str) -> dict[str, bytes]:
        files = (
            p for name in names for p in ([common / name] if (common / name).is_file() else (common / name).rglob("*"))
        )
        return {str(p.relative_to(common)): p.read_bytes() for p in files if p.is_file()}

    experiments, mjcf = ROOT / "experiments", ROOT / "mjcf"
    match reader:
        case "experiment":
            for path in (*experiments.glob("*.toml"),):
                if not path.name.startswith("sweep"):
                    yield path.stem, {"my.toml": path.read_bytes()}
            yield "whole", {"my.toml": (common / "run" / "config.toml").read_bytes()}
        case "sweep":
            for path in experiments.glob("sweep*.toml"):
                yield path.stem, {"my.toml": path.read_bytes()}
            yield "axes", {"my.toml": SWEEP.encode()}
        case "mjcf":
            for path in mjcf.glob("*.xml"):
                include = {"arm5.xml": (mjcf / "arm5.xml").read_bytes()} if path.stem == "reach" else {}
                yield path.stem, {"robot.xml": path.read_bytes(), **include}
            yield "mesh", {"robot.xml": MESH.encode(), "part.stl": _stl(), "part.obj": OBJ.encode()}
        case "urdf":
            yield "urdf", {"robot.urdf": URDF.encode()}
        case "images":
            big = cv2.resize(small, (80, 60))
            for suffix in (".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm", ".gif"):
                ok, data = cv2.imencode(suffix, big)
                if ok:
                    yield suffix[1:], {"image": data.tobytes(), **some("net.onnx")}
        case "video":
            for suffix in ("mp4", "avi"):
                path = videos.write_video(
                    common / f"clip.{suffix}", videos.greys(5), "mp4v" if suffix == "mp4" else "MJPG"
                )
                yield suffix, {"video": path.read_bytes(), **some("net.onnx")}
        case "camera" | "detections":
            yield "posed", some("camera.yml", "found.json")
            if reader == "camera":
                for name, data in _camera_files(common).items():
                    yield name, {**some("found.json"), "camera.yml": data}
            else:
                yield (
                    "list",
                    {
                        **some("camera.yml"),
                        "found.json": f"[{BOX}]".encode(),
                    },
                )
        case "onnx":
            for kind in ("yolov5", "yolov8", "yolox"):
                path = onnx_bytes.constant(
                    common / f"{kind}.onnx", onnx_bytes.output(kind), metadata={"names": "['cube', 'ball']"}
                )
                yield kind, {"net.onnx": path.read_bytes(), **some("small.png")}
            yield "fixed", some("net.onnx", "small.png")
        case "depth":
            yield "depth", some("camera.yml", "found.json", "depth.png")
        case "photographs":
            yield "six", some("photos")
        case "targets":
            yield "points", some("run", "targets.csv")
        case "hand poses":
            yield "six", {**some("photos", "poses.csv"), "camera.yml": (common / "lens.yml").read_bytes()}
        case "job":
            yield "two", some("job.toml")
        case "names":
            yield "two", some("names.txt", "nameless.onnx", "small.png")
        case "pt" | "weights":
            suffix = {"pt": "pt", "weights": "npz"}[reader]
            yield suffix, some(f"net.{suffix}", "small.png")
        case "policy":
            yield "arm5", {"policy.zip": (ROOT / "arm5dof/grasp/policies/arm5.zip").read_bytes()}
        case "checkpoint" | "run":
            yield "run", some("run")
        case "swept":
            from arm5dof.sweeps.spec import parse
            from arm5dof.sweeps.sweep import sweep

            folder = common / "swept"
            if not folder.exists():
                sweep(parse({"base": "kinematic.toml", "axes": {"seed": [0, 1]}, "fixed": TINY}), folder, workers=1)
            yield "two", some("swept")
        case _:
            yield "words", {}


def _camera_files(common: Path) -> dict[str, bytes]:
    """Cameras as others write them: OpenCV's JSON and XML."""
    import cv2

    found = {}
    values = cv2.FileStorage(str(common / "camera.yml"), cv2.FILE_STORAGE_READ)
    for suffix in (".json", ".xml"):
        made = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        for name in values.root().keys():  # noqa: SIM118
            node = values.getNode(name)
            made.write(name, node.mat() if node.isMap() else node.string() if node.isString() else node.real())
        found[suffix[1:]] = made.releaseAndGetString().encode()
    return found


def _others(sound: Path, common: Path) -> None:
    """Files of all kinds, and pickles that tell when they are run."""
    folder = sound / OTHERS
    folder.mkdir()
    for number, path in enumerate(p for p in common.iterdir() if p.is_file()):
        shutil.copy(path, folder / f"{number}{path.suffix}")
    for protocol in (0, 2, 4):
        (folder / f"pickle{protocol}").write_bytes(pickle.dumps(Canary(), protocol))
    objects = np.array([Canary(), 1], object)
    np.save(folder / "objects.npy", objects, allow_pickle=True)
    np.savez(folder / "objects.npz", class_names=objects, **{"actor.0": objects})
    for name, member in (("torch", "archive/data.pkl"), ("policy", "networks.npz"), ("plain", "data.pkl")):
        with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
            buffer = io.BytesIO()
            np.savez(buffer, a=objects)
            archive.writestr(member, buffer.getvalue() if name == "policy" else pickle.dumps(Canary(), 2))


BOX = '{"class_name": "ball", "class_id": 1, "confidence": 0.9, "xyxy": [300.5, 220, 340, 260]}'
SWEEP = """base = "kinematic.toml"
sample_seed = 0
[axes]
actor_lr = [1e-3, 3e-3]
critic_lr = { log_uniform = [1e-4, 1e-2], count = 4 }
noise = { uniform = [0.1, 0.5], count = 3 }
heads = { range = [2, 8, 2] }
seed = { count = 2 }
[fixed]
episodes = 100
[variants]
"the recipe" = {}
"no noise" = { noise = 0, final_noise = 0 }
"""
MESH = """<mujoco model="m"><asset><mesh name="a" file="part.stl"/><mesh name="b" file="part.obj" scale="0.1 0.1 0.1"/>
<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 1 0"/></asset><default><joint damping="1"/></default>
<worldbody><body name="link1" pos="0 0 0.1"><joint name="j1" type="hinge" axis="0 0 1" range="-1 1" limited="true"/>
<geom type="mesh" mesh="a"/><body name="link2" pos="0.2 0 0"><joint name="j2" type="slide" axis="1 0 0" range="0 0.1"
limited="true"/><geom type="mesh" mesh="b"/><site name="tool" pos="0.1 0 0"/></body></body></worldbody>
<actuator><position joint="j1" kp="10"/><position joint="j2" kp="10"/></actuator>
<equality><weld body1="link1" body2="world" active="false"/></equality></mujoco>
"""
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
URDF = """<robot name="r"><link name="base_link"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
ixy="0" ixz="0" iyz="0"/></inertial></link><link name="link1"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
<box size="0.1 0.1 0.1"/></geometry></collision></link><link name="link2"><inertial><mass value="0.5"/><inertia
ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="tool"/>
<joint name="j1" type="revolute"><parent link="base_link"/><child link="link1"/><origin xyz="0 0 0.1" rpy="0 0 0"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint><joint name="j2" type="continuous">
<parent link="link1"/><child link="link2"/><origin xyz="0.2 0 0" rpy="0 0.1 0"/><axis xyz="0 1 0"/></joint>
<joint name="flange" type="fixed"><parent link="link2"/><child link="tool"/><origin xyz="0.1 0 0"/></joint></robot>
"""


def _stl() -> bytes:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) / 10
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    rows = b"".join(np.r_[np.zeros(3), corners[list(f)].ravel()].astype("<f4").tobytes() + b"\0\0" for f in faces)
    return b"\0" * 80 + np.uint32(len(faces)).tobytes() + rows
