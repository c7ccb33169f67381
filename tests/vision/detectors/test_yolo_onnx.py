"""Detectors of the YOLO family from ONNX through OpenCV, and through ONNX Runtime where that is installed."""

import sys

import numpy as np
import pytest
from helpers.errors import said
from helpers.onnx_bytes import NAMES, SIZE, UINT8, constant, output, tensor

from arm5dof.errors import UserError
from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO

BLACK = np.zeros((SIZE, SIZE, 3), np.uint8)
ROWS = np.zeros((1, 300, 6))
"""End to end: two boxes of one class that overlap, and no more."""
ROWS[0, :2] = [[12, 16, 28, 40, 0.9, 1], [14, 16, 30, 40, 0.6, 1]]
FREE = (1, 3, "h", "w"), (1, 3, -1, -1), ("batch", "channels", "h", "w"), (-1, -1, -1, -1), (0, 3, 0, 0)


@pytest.mark.parametrize("shape", [*FREE, (1, 3, SIZE, SIZE), ("batch", 3, SIZE, SIZE), (-1, 3, SIZE, SIZE)])
@pytest.mark.parametrize("kind", ["yolov5", "yolov8", "yolox", "yolox decoded"])
def test_layouts_are_recognised(tmp_path, kind, shape):
    array = output(kind)
    if kind == "yolox decoded":
        array = output("yolov5")[:, [i for s, n in ((0, 64), (192, 16), (240, 4)) for i in range(s, s + n)]]
    path = constant(tmp_path / "x.onnx", array, shape)
    detector = OnnxYOLO(path, NAMES, size=SIZE if shape in FREE else None)
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


@pytest.mark.parametrize("text", ["64", "[64, 64]", "(64, 64)"])
def test_the_size_from_the_metadata(tmp_path, text):
    path = constant(tmp_path / "x.onnx", output("yolov8"), (1, 3, -1, -1), {"imgsz": text, "stride": "32"})
    assert len(OnnxYOLO(path, NAMES)(BLACK)) == 1
    assert "for 128 x 128 pixels is none" in said(lambda: OnnxYOLO(path, NAMES, size=128)), "what is asked for counts"
    fixed = constant(tmp_path / "x.onnx", output("yolov8"), (1, 3, SIZE, SIZE), {"imgsz": "[320, 320]"})
    assert len(OnnxYOLO(fixed, NAMES)(BLACK)) == 1, "what the network takes counts more"


def test_sizes_and_strides_of_the_metadata_that_cannot_be(tmp_path):
    for imgsz in ("", "large", "[64]", "[64, 0]", "{}", "-64"):
        path = constant(tmp_path / "x.onnx", output("yolov8"), metadata={"imgsz": imgsz})
        assert "cannot be read: give size" in said(lambda path=path: OnnxYOLO(path, NAMES))
        assert OnnxYOLO(path, NAMES, size=SIZE).class_names == NAMES
    path = constant(tmp_path / "x.onnx", output("yolov8"), metadata={"stride": "64"})
    assert "is none of" in said(lambda: OnnxYOLO(path, NAMES, size=SIZE)), "it has three scales, up to 32"


@pytest.mark.parametrize("task", ["pose", "obb", "classify", "depth"])
def test_networks_for_other_tasks_are_named(tmp_path, task):
    """Before anybody is asked for the names of classes."""
    path = constant(tmp_path / "x.onnx", output("yolov8"), metadata={"task": task})
    names = {"pose": "poses", "obb": "oriented boxes", "classify": "classes of whole images", "depth": "'depth'"}
    assert f"tells {names[task]}" in said(lambda: OnnxYOLO(path, size=SIZE))


def test_networks_for_other_tasks_are_known_by_their_outputs(tmp_path):
    boxes = output("yolov8")
    angles = np.linspace(-0.7, 2.3, boxes.shape[2])[None, None]
    points = np.concatenate([boxes[:, :2] + 3, boxes[:, 4:5]], axis=1)
    for more, says in (((angles,), "oriented boxes"), ((points, points), "poses")):
        path = constant(tmp_path / "x.onnx", np.concatenate([boxes, *more], axis=1))
        assert f"tells {says}" in said(lambda path=path: OnnxYOLO(path, size=SIZE))
    path = constant(tmp_path / "x.onnx", np.zeros((1, 1000)))
    assert "no YOLO detector: its outputs" in said(lambda: OnnxYOLO(path, size=SIZE))
    path = constant(tmp_path / "x.onnx", boxes, kind=UINT8)
    assert "not floating point" in said(lambda: OnnxYOLO(path, size=SIZE))


@pytest.mark.parametrize("kind", ["yolov5", "yolov8", "end to end"])
def test_of_networks_that_segment_the_boxes_are_used(tmp_path, kind):
    array = ROWS if kind == "end to end" else output(kind)
    axis = 1 if kind == "yolov8" else 2
    shape = list(array.shape)
    shape[axis] = 32
    coefficients = np.random.default_rng(0).normal(0, 2, shape)
    path = tmp_path / "x.onnx"
    masks = np.ones((1, 32, SIZE // 4, SIZE // 4))
    constant(path, np.concatenate([array, coefficients], axis), metadata={"task": "segment"}, masks=masks)
    found = OnnxYOLO(path, NAMES, 0.7, size=SIZE)(BLACK)
    np.testing.assert_allclose(found.xyxy, [[12, 16, 28, 40]], atol=1e-3)
    assert found.data["class_name"] == ["ball"]


@pytest.mark.parametrize("array", [ROWS, ROWS[:, :2], ROWS[0, :2], ROWS[0]])
def test_of_networks_end_to_end_every_box_counts(tmp_path, array):
    detector = OnnxYOLO(constant(tmp_path / "x.onnx", array), NAMES, iou=0.1, size=SIZE)
    found = detector(np.zeros((96, 128, 3), np.uint8))
    np.testing.assert_allclose(found.xyxy, [[24, 16, 56, 64], [28, 16, 60, 64]], atol=1e-3)
    np.testing.assert_allclose(found.confidence, [0.9, 0.6])
    assert list(found.data["class_name"]) == ["ball", "ball"]


def test_lists_that_are_not_of_corners_score_and_class(tmp_path):
    for column, value, says in ((5, 0.5, "no list"), (5, -1, "no list"), (4, 3, "no list"), (0, np.nan, "not finite")):
        array = ROWS.copy()
        array[0, 7, column] = value
        path = constant(tmp_path / "x.onnx", array)
        assert says in said(lambda path=path: OnnxYOLO(path, NAMES, size=SIZE))
    detector = OnnxYOLO(constant(tmp_path / "x.onnx", ROWS), ["cube"], size=SIZE)
    assert "finds class 1, and there are 1 names" in said(lambda: detector(BLACK))
    detector = OnnxYOLO(constant(tmp_path / "x.onnx", ROWS / [64, 64, 64, 64, 1, 1]), NAMES, size=SIZE)
    assert "coordinates scaled" in said(lambda: detector(BLACK))


@pytest.mark.parametrize("kind", ["yolov5", "yolov8", "yolox", "end to end"])
def test_onnx_runtime_finds_the_same(tmp_path, kind):
    pytest.importorskip("onnxruntime")
    path = constant(tmp_path / "x.onnx", ROWS if kind == "end to end" else output(kind), (-1, 3, "h", -1))
    one, other = (OnnxYOLO(path, NAMES, size=SIZE, onnxruntime=choice)(BLACK) for choice in (False, True))
    assert one.rows() == other.rows() != []
    path.write_bytes(path.read_bytes().replace(b"Reshape", b"Rezhape"))
    assert "ONNX Runtime cannot read it" in said(lambda: OnnxYOLO(path, NAMES, size=SIZE, onnxruntime=True))


def test_a_network_that_leaves_open_how_many_axes_its_input_has(tmp_path):
    path = constant(tmp_path / "x.onnx", output("yolov8"), None)
    assert "or run it by ONNX Runtime" in said(lambda: OnnxYOLO(path, NAMES, size=SIZE))
    pytest.importorskip("onnxruntime")
    assert len(OnnxYOLO(path, NAMES, size=SIZE, onnxruntime=True)(BLACK)) == 1


def test_onnx_runtime_finds_the_same_on_the_real_network(models, bus, through_opencv):
    """In half precision, in which the two round differently."""
    pytest.importorskip("onnxruntime")
    found = OnnxYOLO(models / "yolov5n_fp16.onnx", through_opencv.class_names, onnxruntime=True)(bus)
    expected = through_opencv(bus)
    assert list(found.class_id) == list(expected.class_id)
    np.testing.assert_allclose(found.xyxy, expected.xyxy, atol=0.5)


def test_without_onnx_runtime_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path = constant(tmp_path / "x.onnx", output("yolov8"))
    assert "pip install 'arm5dof[onnx]'" in said(lambda: OnnxYOLO(path, NAMES, size=SIZE, onnxruntime=True))


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
    start, zero = whole.index(b"Reshape"), tensor("zero", np.zeros((3, 1), np.float32))
    contents = {
        "cut": whole[: len(whole) // 2],
        "text": b"hello, this is no network",
        "empty": b"",
        "operator": whole[:start] + b"Rezhape" + whole[start + 7 :],
        "no_text": whole[:start] + b"Re\xb8hape" + whole[start + 7 :],  # Of which OpenCV's error is none either.
        "small": whole.replace(zero, zero.replace(b"\x08\x03", b"\x08\x7f")),
    }
    for name, content in contents.items():
        (tmp_path / f"{name}.onnx").write_bytes(content)
        with pytest.raises(UserError, match=f"{name}.onnx") as raised:
            OnnxYOLO(tmp_path / f"{name}.onnx", NAMES, size=SIZE)
        assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="no file"):
        OnnxYOLO(tmp_path / "nowhere.onnx", NAMES)
