"""`arm5dof vision detect`: images, folders, videos and cameras in; drawn-in boxes and JSON out; bad input one line."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, constant, output
from helpers.photographs import vast_png
from helpers.videos import RATE, greys, read_video, write_video

from arm5dof.cli import main as cli
from arm5dof.cli.vision.detecting import interruptible
from arm5dof.runtime import progress
from arm5dof.vision.detections import Detections
from arm5dof.vision.detectors.loading import detect, load_detector
from arm5dof.vision.frames import Frame
from arm5dof.vision.images import read
from arm5dof.vision.io.sinks import folder
from arm5dof.vision.io.sources import Source, open_source
from arm5dof.vision.objects import CLASS_NAMES

BALL = {"class_name": "ball", "class_id": 1, "confidence": 0.9, "xyxy": [12, 16, 28, 40]}
"""What the network of `model` finds in every image of 64 x 64."""


def command(*arguments):
    return cli.main(["vision", "detect", *map(str, arguments)])


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "ball.onnx"
    return constant(path, output("yolov8"), (1, 3, SIZE, SIZE), {"names": str(list(NAMES))})


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Two seconds."""
    return write_video(tmp_path_factory.mktemp("video") / "clip.mp4", greys(25))


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """An AVI of two seconds, of which half is there."""
    noise = np.random.default_rng(0).integers(0, 255, (25, SIZE, SIZE, 3), np.uint8)
    whole = write_video(tmp_path_factory.mktemp("video") / "cut.avi", list(noise), "MJPG")
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    return whole


@pytest.fixture
def photos(tmp_path):
    inside = tmp_path / "photos"
    inside.mkdir()
    for name, grey in (("b.png", 50), ("a.jpg", 100), ("c.PNG", 150)):
        cv2.imwrite(str(inside / name), np.full((SIZE, SIZE), grey, np.uint8))
    (inside / "notes.txt").write_text("Neither an image nor a video.\n" * 99)
    return inside


@pytest.fixture
def instead_of_the_camera(monkeypatch, clip):
    """A video played where camera 0 would be opened; there is none where tests run."""
    opened = cv2.VideoCapture
    monkeypatch.setattr(
        cv2, "VideoCapture", lambda what, *more: opened(str(clip)) if what == 0 else opened(what, *more)
    )


# Real photographs and weights


def test_the_bus(test_data, tmp_path, capsys):
    vision = test_data / "vision"
    given = [vision / "photos" / "bus.jpg", vision / "checkerboard" / "left01.jpg"]
    assert command(*given, "--detector", vision / "models" / "yolov5n.pt", "--out", tmp_path / "found") == 0
    assert "2 frames in" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "found").iterdir()} == {"bus.jpg", "left01.jpg", "detections.json"}
    frames = json.loads((tmp_path / "found" / "detections.json").read_text())
    assert [frame["name"] for frame in frames] == list(map(str, given))
    assert frames[0]["image_size"] == [810, 1080] and frames[0]["time_s"] is None
    assert Counter(row["class_name"] for row in frames[0]["detections"]) == {"person": 3, "bus": 1}

    drawn = read(tmp_path / "found" / "bus.jpg").astype(int)
    changed = np.abs(drawn - read(given[0])).max(-1) > 60
    for row in frames[0]["detections"]:
        left, top, _, bottom = map(round, row["xyxy"])
        assert changed[top:bottom, left - 1 : left + 2].any(1).mean() > 0.9
    assert changed.mean() < 0.1


def test_one_format_whatever_the_network(test_data, tmp_path, capsys):
    """JSON is printed as it is written; the weights in JAX and as ONNX find the same, of the classes asked for."""
    vision = test_data / "vision"
    names = tmp_path / "names.txt"
    names.write_text("\n".join(load_detector(vision / "models" / "yolov5n.pt").class_names))
    both = []
    for more in (["yolov5n.pt"], ["yolov5n_fp16.onnx", "--names", names]):
        words = ["--detector", vision / "models" / more[0], *more[1:], "--json", "--classes", "bus,train"]
        assert command(vision / "photos" / "bus.jpg", *words) == 0
        both.append(json.loads(capsys.readouterr().out)[0]["detections"])
    ours, theirs = both
    assert [row["class_name"] for row in ours] == ["bus"] == [row["class_name"] for row in theirs]
    assert ours[0]["confidence"] == pytest.approx(theirs[0]["confidence"], abs=0.01)
    np.testing.assert_allclose(ours[0]["xyxy"], theirs[0]["xyxy"], atol=3)


def test_a_video_of_the_bus(test_data, tmp_path):
    """The camera pans to the left, and the man in the middle wanders to the right."""
    vision = test_data / "vision"
    bus, starts = read(vision / "photos" / "bus.jpg"), (100, 60, 20)
    clip = write_video(tmp_path / "pan.mp4", [bus[200:900, x : x + 700] for x in starts])
    out = tmp_path / "found"
    words = ["--detector", vision / "models" / "yolov5n.pt", "--size", 320, "--out", out, "--classes", "person"]
    assert command(clip, *words) == 0
    frames = json.loads((out / "detections.json").read_text())
    assert [frame["time_s"] for frame in frames] == [0, 0.08, 0.16]
    for frame, x in zip(frames, starts, strict=True):
        assert any(abs(row["xyxy"][0] - (220 - x)) < 20 for row in frame["detections"])


# What goes in and comes out


def test_a_folder(photos, model, tmp_path, capsys):
    assert command(photos, "--detector", model, "--out", tmp_path / "new" / "found") == 0
    out = tmp_path / "new" / "found"
    assert {p.name for p in out.iterdir()} == {"a.jpg", "b.png", "c.PNG", "detections.json"}
    frames = json.loads((out / "detections.json").read_text())
    assert [frame["name"] for frame in frames] == [str(photos / name) for name in ("a.jpg", "b.png", "c.PNG")]
    assert all(frame["detections"] == [BALL] and frame["image_size"] == [SIZE, SIZE] for frame in frames)
    said = capsys.readouterr().out
    assert "3 frames in" in said and "3 ball" in said and f"written: {out}" in said
    assert list((tmp_path / "new").iterdir()) == [out], "nothing temporary is left"
    assert out.stat().st_mode & 0o777 == photos.stat().st_mode & 0o777


def test_random_scenes_with_what_ships(tmp_path, capsys):
    assert command("simulated:2", "--out", tmp_path / "found") == 0
    frames = json.loads((tmp_path / "found" / "detections.json").read_text())
    assert [frame["name"] for frame in frames] == ["scene0.png", "scene1.png"]
    assert {box["class_name"] for frame in frames for box in frame["detections"]} <= set(CLASS_NAMES)
    assert sum(len(frame["detections"]) for frame in frames) > 0
    assert read(tmp_path / "found" / "scene1.png").shape == (480, 640, 3)
    assert "2 frames" in capsys.readouterr().out


def test_two_photographs_of_one_name(photos, model, tmp_path):
    (tmp_path / "more").mkdir()
    cv2.imwrite(str(tmp_path / "more" / "a.jpg"), np.full((SIZE, SIZE), 250, np.uint8))
    assert command(photos, tmp_path / "more", "--detector", model, "--out", tmp_path / "found") == 0
    assert {"a.jpg", "a-2.jpg"} < {p.name for p in (tmp_path / "found").iterdir()}
    assert read(tmp_path / "found" / "a-2.jpg")[-1, -1, 0] > 240 > read(tmp_path / "found" / "a.jpg")[-1, -1, 0]


def test_a_table_for_people(photos, model, capsys):
    assert command(photos / "a.jpg", photos / "b.png", "--detector", model) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == f"{photos / 'a.jpg'}, 64 x 64" and lines[3] == f"{photos / 'b.png'}, 64 x 64"
    assert lines[2].split() == ["ball", "0.90", "12.0", "16.0", "28.0", "40.0"]
    assert command(photos / "a.jpg", "--detector", model, "--confidence", 0.95) == 0
    assert "  nothing\n" in capsys.readouterr().out


def test_a_video(clip, model, tmp_path, capsys):
    out = tmp_path / "found"
    assert command(clip, "--detector", model, "--out", out, "--json") == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "detections.json").read_text())
    pictures, rate = read_video(out / "clip.mp4")
    frames = json.loads((out / "detections.json").read_text())
    assert len(pictures) == len(frames) == 25 and rate == RATE
    np.testing.assert_allclose([frame["time_s"] for frame in frames], np.arange(25) / RATE, atol=1e-3)
    before, _ = read_video(clip)
    for drawn, picture in zip(pictures, before, strict=True):
        away = np.abs(drawn.astype(int) - picture)
        assert away[48:].max() < 30 and away[28, 11:14].max() > 40


def test_frames_of_other_sizes_fit_into_one_video(tmp_path):
    nothing = Detections(np.empty((0, 4)), np.empty(0), np.empty(0), NAMES)
    pictures = [np.full((60 + 20 * i, 80, 3), 90, np.uint8) for i in range(3)]
    source = Source((Frame("all sorts", picture, i / 5) for i, picture in enumerate(pictures)), 3, 5.0)
    with folder(tmp_path / "found", source) as write:
        for frame in source.frames:
            write(frame, nothing)
    assert [p.shape for p in read_video(tmp_path / "found" / "all sorts.mp4")[0]] == [(60, 80, 3)] * 3


def test_a_camera(instead_of_the_camera, model, tmp_path, capsys):
    """Its video takes as long as it took, though only so many frames were looked at."""
    source = open_source(["0"])
    assert source.live and source.length is None and source.rate == RATE
    with folder(tmp_path / "found", source) as write:
        for frame, found in detect(source.frames, load_detector(model)):
            write(frame, found)
            if frame.time > 1:
                break
            time.sleep(0.2)
    pictures, _ = read_video(tmp_path / "found" / "camera0.mp4")
    frames = json.loads((tmp_path / "found" / "detections.json").read_text())
    assert len(frames) < 8 and len(pictures) == pytest.approx(RATE * frames[-1]["time_s"] + 1, abs=1)

    assert command(0, "--detector", model, "--json") == 2, "the camera is gone when the video is over"
    said = capsys.readouterr()
    assert "camera 0 gives no picture any more" in said.err and len(json.loads(said.out)) == 25


def test_frames_are_rgb_and_let_go_of_their_file(tmp_path):
    red = np.zeros((SIZE, SIZE, 3), np.uint8)
    red[..., 0] = 250
    frames = open_source([str(write_video(tmp_path / "red.avi", [red] * 3, "MJPG"))]).frames
    frame = next(frames)
    assert frame.image.dtype == np.uint8 and frame.image[..., 0].min() > 200 and frame.image[..., 1:].max() < 50
    frames.close()
    assert list(frames) == []


# What is wrong


def test_bad_input_is_one_line(photos, clip, model, tmp_path, capfd):
    (tmp_path / "none").mkdir()
    for name, content in [
        ("words.jpg", b"hello"),
        ("empty.jpg", b""),
        ("empty.mp4", b""),
        ("words.mp4", b"hello"),
        ("cut.mp4", clip.read_bytes()[: clip.stat().st_size // 2]),
        ("words.pt", b"hello"),
        ("words.onnx", b"hello"),
        ("model.tflite", b"hello"),
        ("three.txt", b"a\nb\nc\n"),
        ("gap.txt", b"a\n\nb\n"),
        ("latin.txt", b"caf\xe9\nb\n"),
    ]:
        (tmp_path / name).write_bytes(content)
    foreign = constant(tmp_path / "foreign.onnx", np.zeros((1, 10)))
    before = sorted(tmp_path.rglob("*"))
    photo = photos / "a.jpg"
    for given, changes, expected in [
        ([tmp_path / "absent.mp4"], {}, "no image, video or folder"),
        ([tmp_path / "none"], {}, "holds no images"),
        ([tmp_path / "words.jpg"], {}, "words.jpg is empty, damaged, or no image"),
        ([tmp_path / "empty.jpg"], {}, "empty.jpg is empty"),
        ([tmp_path / "empty.mp4"], {}, "empty.mp4 is empty"),
        ([tmp_path / "words.mp4"], {}, "no image or video"),
        ([tmp_path / "cut.mp4"], {}, "cut.mp4 is empty, damaged"),
        ([photos / "notes.txt"], {}, "notes.txt is empty, damaged"),
        ([clip, photo], {}, "give one video by itself"),
        (["77"], {}, "no camera 77 can be opened"),
        ([photo], {"--detector": tmp_path / "absent.pt"}, "no detector"),
        ([photo], {"--detector": tmp_path / "words.pt"}, "not a PyTorch file"),
        ([photo], {"--detector": tmp_path / "words.onnx"}, "not an ONNX file"),
        ([photo], {"--detector": tmp_path / "model.tflite"}, "is no detector: give YOLOv5's weights"),
        ([photo], {"--detector": foreign, "--names": tmp_path / "three.txt"}, "no YOLO detector"),
        ([photo], {"--names": tmp_path / "three.txt"}, "tells 2 classes apart, and 3 names were given"),
        ([photo], {"--names": tmp_path / "gap.txt"}, "has an empty line"),
        ([photo], {"--names": tmp_path / "latin.txt"}, "is no text"),
        ([photo], {"--names": tmp_path / "absent.txt"}, "absent.txt: No such file"),
        ([photo], {"--classes": "ball,bowl"}, "knows no class 'bowl'; it knows: cube, ball"),
        ([photo], {"--confidence": 1.5}, "confidence must lie between 0 and 1"),
        ([photo], {"--iou": -1}, "iou must lie between 0 and 1"),
        ([photo], {"--size": 100}, "64 x 64 pixels only"),
        ([photo], {"--out": tmp_path / "none"}, "exists: choose another --out"),
        ([photo], {"--clases": "ball"}, "unexpected argument '--clases'"),
    ]:
        words = [
            word for pair in {"--detector": model, "--out": tmp_path / "found", **changes}.items() for word in pair
        ]
        assert command(*given, *words) == 2, expected
        said = capfd.readouterr()
        assert said.err.startswith("arm5dof: ") and expected in said.err and said.err.count("\n") == 1, said.err
        assert said.out == "" and sorted(tmp_path.rglob("*")) == before, expected
    assert command(photo, "--names", tmp_path / "three.txt") == 2 and "are fixed" in capfd.readouterr().err
    assert command("simulated:0") == 2 and "ask for one or more" in capfd.readouterr().err


@pytest.mark.parametrize("damaged", [["a.jpg"], ["b.png"], ["c.PNG"], ["a.jpg", "c.PNG"], ["b.png", "c.PNG"]])
def test_damaged_images_are_named_and_left_out(damaged, photos, model, tmp_path, capfd):
    for name in damaged:
        whole = (photos / name).read_bytes()
        (photos / name).write_bytes(whole[: len(whole) // 2])
    assert command(photos, "--detector", model, "--out", tmp_path / "found", "--json") == 1
    said = capfd.readouterr()
    *each, last = said.err.splitlines()
    assert [line.partition(" is empty, damaged")[0] for line in each] == [f"arm5dof: {photos / n}" for n in damaged]
    assert last == f"arm5dof: {len(damaged)} of 3 files left out, for the reasons above"
    good = [name for name in ("a.jpg", "b.png", "c.PNG") if name not in damaged]
    assert {p.name for p in (tmp_path / "found").iterdir()} == {*good, "detections.json"}
    frames = json.loads((tmp_path / "found" / "detections.json").read_text())
    assert frames == json.loads(said.out) and [frame["name"] for frame in frames] == [str(photos / n) for n in good]


def test_no_image_left_is_one_line(photos, model, tmp_path, capfd):
    for path in photos.iterdir():
        path.write_text("hello")
    assert command(photos, "--detector", model, "--out", tmp_path / "found") == 2
    err = capfd.readouterr().err
    assert "a.jpg is empty, damaged" in err and "; and none of the 2 others can be used" in err and err.count("\n") == 1
    assert set(tmp_path.iterdir()) == {photos}


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="a file that root too cannot read")
def test_a_file_that_cannot_be_read_is_left_out(photos, model, capfd):
    (photos / "a.jpg").unlink()
    (photos / "a.jpg").symlink_to("/proc/self/mem")
    assert command(photos, "--detector", model) == 1
    assert "a.jpg cannot be read: Input/output error" in capfd.readouterr().err


def test_specks_and_strips_are_images_like_others(tmp_path, capfd):
    """By the detector that ships; beyond what OpenCV reads they are left out."""
    for name, shape in {"speck": (1, 1), "wide": (1, 3000), "tall": (3000, 2)}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full(shape, 90, np.uint8))
    (tmp_path / "vast.png").write_bytes(vast_png())
    assert command(tmp_path, "--json") == 1
    said = capfd.readouterr()
    assert said.err.count("\n") == 2 and "vast.png is empty, damaged, or no image that OpenCV reads" in said.err
    assert [frame["image_size"] for frame in json.loads(said.out)] == [[1, 1], [2, 3000], [3000, 1]]


def test_a_video_that_breaks_off_is_kept_up_to_there(cut, model, tmp_path, capfd):
    assert command(cut, "--detector", model, "--out", tmp_path / "found", "--json") == 2
    said = capfd.readouterr()
    assert "cut.avi breaks off after" in said.err and "of 2.0 s" in said.err and said.err.count("\n") == 1
    pictures, _ = read_video(tmp_path / "found" / "cut.mp4")
    assert 5 < len(pictures) < 20
    assert len(pictures) == len(json.loads(said.out)) == len(read_video(cut)[0])


def test_a_full_disk_leaves_nothing(model, tmp_path):
    """Past its file-size limit a process gets the errors of a full disk, of which the video's encoder says nothing."""
    noise = np.random.default_rng(0).integers(0, 255, (10, 240, 320, 3), np.uint8)
    clip = write_video(tmp_path / "noise.mp4", list(noise))
    code = (
        "import resource, sys; from arm5dof.cli import main as cli;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536));"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    words = ["vision", "detect", clip, "--detector", model, "--out", tmp_path / "found"]
    done = subprocess.run([sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 2 and "is the disk full?" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert set(tmp_path.iterdir()) == {clip}


# Ctrl-C

CAMERA = """
import sys
import cv2
from arm5dof.cli import main as cli

opened, video = cv2.VideoCapture, sys.argv.pop(1)
cv2.VideoCapture = lambda what, *more: opened(video) if what == 0 else opened(what, *more)
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize(("what", "status"), [("video", 130), ("camera", 0)])
def test_ctrl_c_finishes_the_files(what, status, model, tmp_path):
    long = write_video(tmp_path / "long.mp4", greys(4000))
    command = [sys.executable, "-m", "arm5dof"] if what == "video" else [sys.executable, "-c", CAMERA, str(long)]
    words = ["vision", "detect", long if what == "video" else 0, "--detector", model, "--out", tmp_path / "found"]
    process = subprocess.Popen(
        [*command, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    while not any(file.stat().st_size for file in tmp_path.glob(".found-*/detections.json")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == status, err
    frames = json.loads((tmp_path / "found" / "detections.json").read_text())
    assert 0 < len(frames) < 4000 and not list(tmp_path.glob(".found-*"))
    if what == "video":
        assert err == f"arm5dof: interrupted; {len(frames)} frames before that in {tmp_path / 'found'}\n"
        assert len(read_video(tmp_path / "found" / "long.mp4")[0]) == len(frames)
    else:
        assert err == "" and f"{len(frames)} frames in" in out
        assert len(read_video(tmp_path / "found" / "camera0.mp4")[0]) >= len(frames)


def test_a_second_ctrl_c_is_heard_at_once(monkeypatch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible() as interrupts:
            signal.raise_signal(signal.SIGINT)
            assert interrupts
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with interruptible() as interrupts:
            signal.raise_signal(signal.SIGINT)
        assert not interrupts
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_bar_on_a_terminal_leaves_what_is_printed_alone(clip, model):
    terminal, end = pty.openpty()
    words = ["vision", "detect", clip, "--detector", model, "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "arm5dof", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=end,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
    )
    os.close(end)
    said = os.read(terminal, 100_000).decode()
    os.close(terminal)
    assert done.returncode == 0 and len(json.loads(done.stdout)) == 25
    assert "detecting" in said and "25/25" in said and "/s" in said and "ball" in said


def test_progress_without_a_terminal_is_lines(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1)
    for total, expected in (
        (8, r"looking: 4/8 frames  [\d.]+/s  a ball  ETA \d+ s"),
        (None, r"looking: 4 frames .* a ball"),
    ):
        with progress.Bar("looking", total, "frames") as bar:
            bar.update(4, "a ball")
        assert re.fullmatch(expected, capsys.readouterr().err.strip())


def test_help_teaches(capsys):
    with pytest.raises(SystemExit):
        command("--help")
    said = capsys.readouterr().out
    assert "--detector yolov5n.pt" in said and "detections.json" in said and "Ctrl-C" in said
