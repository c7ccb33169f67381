"""Detectors of the YOLO family from ONNX through OpenCV."""

import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, constant, output

from arm5dof.errors import UserError
from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO


@pytest.mark.parametrize("shape", [(1, 3, "h", "w"), (1, 3, SIZE, SIZE), ("batch", 3, SIZE, SIZE)])
@pytest.mark.parametrize("kind", ["yolov5", "yolov8", "yolox", "yolox decoded"])
def test_layouts_are_recognised(tmp_path, kind, shape):
    array = output(kind)
    if kind == "yolox decoded":
        array = output("yolov5")[:, [i for s, n in ((0, 64), (192, 16), (240, 4)) for i in range(s, s + n)]]
    path = constant(tmp_path / "x.onnx", array, shape)
    detector = OnnxYOLO(path, NAMES, size=None if SIZE in shape else SIZE)
    found = detector(np.zeros((96, 128, 3), np.uint8))  # Twice as large, 8 grey rows above and below.
    assert list(found.data["class_name"]) == ["ball"]
    np.testing.assert_allclose(found.confidence, [0.9 if kind == "yolov8" else 0.72], rtol=1e-5)
    np.testing.assert_allclose(found.xyxy, [[24, 16, 56, 64]], atol=1e-3)


@pytest.mark.parametrize("text", ["{0: 'cube', 1: 'ball'}", "['cube', 'ball']"])
def test_names_from_the_metadata(tmp_path, text):
    path = constant(tmp_path / "x.onnx", output("yolov8"), metadata={"author": "x", "names": text})
    assert OnnxYOLO(path, size=SIZE).class_names == NAMES
    assert OnnxYOLO(path, ["a", "b"], size=SIZE).class_names == ("a", "b")


@pytest.mark.parametrize("text", ["", "{1: 'cube'}", "[1, 2]", "'ball'", "__import__('os').getcwd()", "(" * 10_000])
def test_names_that_are_none(tmp_path, text):
    path = constant(tmp_path / "x.onnx", output("yolov8"), metadata={"names": text})
    with pytest.raises(UserError, match="give class_names"):
        OnnxYOLO(path, size=SIZE)


def test_class_counts_must_match(tmp_path):
    for metadata, given in (({}, ["a", "b", "c"]), ({"names": "['a']"}, None)):
        path = constant(tmp_path / "x.onnx", output("yolov5"), metadata=metadata)
        with pytest.raises(UserError, match="tells 2 classes apart"):
            OnnxYOLO(path, given, size=SIZE)


def test_sizes_that_do_not_fit_are_refused(tmp_path):
    fixed = constant(tmp_path / "x.onnx", output("yolov5"), (1, 3, SIZE, SIZE))
    with pytest.raises(UserError, match="takes images of 64 x 64"):
        OnnxYOLO(fixed, NAMES, size=128)
    free = constant(tmp_path / "x.onnx", output("yolov5"))
    with pytest.raises(UserError, match="none of YOLOv5's"):
        OnnxYOLO(free, NAMES, size=128)
    with pytest.raises(UserError, match="multiple of 32"):
        OnnxYOLO(free, NAMES, size=100)


def test_the_real_network_at_a_size_that_its_grids_are_not_made_for(models, published):
    with pytest.raises(UserError, match="960 x 960"):
        OnnxYOLO(models / "yolov5n_fp16.onnx", published.class_names, size=960)


def test_outputs_of_other_networks_are_refused(tmp_path):
    shuffled, logits, broken = (output("yolov5") for _ in range(3))
    shuffled[..., :2] = shuffled[:, ::-1, :2]
    logits[..., 4:] = -5
    logits[..., 5:] = 3
    broken[0, 7, 4] = np.nan
    for says, array in {
        "far from their cells": shuffled,
        r"outside \[0, 1\]": logits,
        "not finite": broken,
        "none of YOLOv5's": np.zeros((1, 1000)).reshape(1, 100, 10),
        "its outputs have the shapes": np.zeros((1, 1000)),
    }.items():
        with pytest.raises(UserError, match=says):
            OnnxYOLO(constant(tmp_path / "x.onnx", array), NAMES, size=SIZE)


@pytest.mark.parametrize("shape", [(1, 1, SIZE, SIZE), (4, 3, SIZE, SIZE), (1, 3)])
def test_inputs_that_are_no_image_are_refused(tmp_path, shape):
    with pytest.raises(UserError, match="no YOLO detector"):
        OnnxYOLO(constant(tmp_path / "x.onnx", output("yolov5"), shape), NAMES)


def test_damaged_files_are_refused(tmp_path):
    whole = constant(tmp_path / "x.onnx", output("yolov5")).read_bytes()
    start = whole.index(b"Reshape")
    contents = {
        "cut": whole[: len(whole) // 2],
        "text": b"hello, this is no network",
        "empty": b"",
        "operator": whole[:start] + b"Rezhape" + whole[start + 7 :],
    }
    for name, content in contents.items():
        (tmp_path / f"{name}.onnx").write_bytes(content)
        with pytest.raises(UserError, match=f"{name}.onnx") as raised:
            OnnxYOLO(tmp_path / f"{name}.onnx", NAMES, size=SIZE)
        assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="no file"):
        OnnxYOLO(tmp_path / "nowhere.onnx", NAMES)
