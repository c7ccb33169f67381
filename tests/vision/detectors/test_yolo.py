"""Detectors of the YOLO family: YOLOv5 in JAX from its weights, any of them from ONNX through OpenCV."""

import cv2
import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, STRIDES, constant, output
from helpers.pickles import Shell, save
from helpers.yolov5_bytes import ANCHORS, Architecture

from arm5dof.errors import UserError
from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO
from arm5dof.vision.detectors.yolov5.layers import Conv
from arm5dof.vision.detectors.yolov5.model import YOLOv5
from arm5dof.vision.images import letterbox, read

GREY = np.full((48, 64, 3), 100, np.uint8)


# The published network


@pytest.fixture(scope="session")
def models(test_data):
    return test_data / "vision" / "models"


@pytest.fixture(scope="session")
def bus(test_data):
    return read(test_data / "vision" / "photos" / "bus.jpg")


@pytest.fixture(scope="session")
def published(models):
    return YOLOv5(models / "yolov5n.pt")


@pytest.fixture(scope="session")
def through_opencv(models, published):
    return OnnxYOLO(models / "yolov5n_fp16.onnx", published.class_names)


def test_three_persons_and_a_bus(published, through_opencv, bus):
    for detector in (published, through_opencv):
        assert sorted(detector(bus).data["class_name"]) == ["bus", "person", "person", "person"]


def test_jax_and_opencv_agree(published, through_opencv, bus):
    ours, theirs = published(bus), through_opencv(bus)
    np.testing.assert_allclose(ours.confidence, theirs.confidence, atol=0.01)
    np.testing.assert_allclose(ours.xyxy, theirs.xyxy, atol=3)
    np.testing.assert_array_equal(ours.class_id, theirs.class_id)


def test_jax_and_opencv_agree_box_by_box(published, models, bus):
    image = letterbox(bus, (640, 640)).image
    network = cv2.dnn.readNetFromONNX(str(models / "yolov5n_fp16.onnx"))
    network.setInput(cv2.dnn.blobFromImage(image, 1 / 255))
    theirs = network.forward()[0]
    boxes, scores = (np.asarray(x) for x in published.forward(image))
    expected = theirs[:, 4:5] * theirs[:, 5:]
    assert (expected.max(1) > 0.25).sum() > 10
    np.testing.assert_allclose(scores, expected, atol=0.01)
    likely = expected.max(1) > 0.05
    np.testing.assert_allclose(boxes[likely], theirs[likely, :4], atol=3)


def test_a_tight_input_finds_the_same_boxes(published, models, bus):
    tight = YOLOv5(models / "yolov5n.pt", confidence=0.6, square=False)(bus)
    sure = published(bus)[:3]
    order, other = np.argsort(tight.xyxy[:3, 0]), np.argsort(sure.xyxy[:, 0])
    np.testing.assert_allclose(tight.xyxy[:3][order], sure.xyxy[other], atol=30)


def test_nothing_in_a_grey_image(published):
    assert len(published(GREY)) == 0
    assert len(published.class_names) == 80


# Other widths and depths


@pytest.mark.parametrize("width, depth, classes", [(4, 1, 2), (6, 2, 5)])
def test_widths_and_depths_are_the_files(tmp_path, width, depth, classes):
    detector = YOLOv5(Architecture(width, depth, classes).save(tmp_path / "x.pt"), size=SIZE)
    boxes, scores = detector.forward(np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), np.uint8))
    cells = sum((SIZE // s) ** 2 for s in STRIDES)
    assert boxes.shape == (2 * cells, 4) and scores.shape == (2 * cells, classes)
    assert detector.class_names == tuple(f"class {i}" for i in range(classes))

    # As published: centres reach half a cell beyond their own, sizes to four times the anchor.
    start = 0
    for stride, anchors in zip(STRIDES, ANCHORS, strict=True):
        for anchor in anchors:
            side = SIZE // stride
            found = np.asarray(boxes[start : start + side**2]).reshape(side, side, 4)
            x, y = np.meshgrid(np.arange(side), np.arange(side))
            away = found[..., :2] / stride - np.stack([x, y], axis=-1)
            assert (away >= -0.5).all() and (away <= 1.5).all()
            assert (found[..., 2:] <= 4 * stride * np.array(anchor) + 1e-3).all()
            start += side**2


def test_normalisation_folded_by_us_and_in_the_file_agree(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), np.uint8)
    ours = YOLOv5(Architecture(4, 1, 2).save(tmp_path / "x.pt")).forward(image)
    theirs = YOLOv5(Architecture(4, 1, 2, folded=True).save(tmp_path / "y.pt")).forward(image)
    assert np.ptp(np.asarray(ours[1])) > 0.01
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("size, stride, padding", [(6, 2, 2), (1, 1, 0), (3, 1, 1), (3, 2, 1), (1, 2, 0)])
def test_every_way_to_convolve_is_the_same_sum(size, stride, padding):
    random = np.random.default_rng(0)
    x, weight = random.normal(size=(1, 8, 12, 3)), random.normal(size=(size, size, 3, 5))
    bias = random.normal(size=5)
    padded = np.pad(x[0], ((padding, padding), (padding, padding), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), (0, 1))[::stride, ::stride]
    expected = np.einsum("hwcij,ijco->hwo", windows, weight) + bias
    conv = Conv(np.float32(weight), np.float32(bias), (stride, stride), (padding, padding), activated=False)
    np.testing.assert_allclose(conv(np.float32(x))[0], expected, rtol=1e-4, atol=1e-4)
    active = conv.replace(activated=True)(np.float32(x))[0]
    np.testing.assert_allclose(active, expected / (1 + np.exp(-expected)), rtol=1e-4, atol=1e-4)


def test_files_of_other_networks_are_refused(tmp_path):
    architecture = Architecture(4, 1, 2)
    ghost = Shell("torch.nn.modules.container.Sequential", _modules={"0": Shell("models.common.GhostConv", f=-1)})
    for says, path in {
        "does not match|do not match": architecture.save(tmp_path / "a.pt", names=["one"]),
        "GhostConv": architecture.save(tmp_path / "b.pt", _modules={"model": ghost}),
        "no 'model'": architecture.save(tmp_path / "c.pt", _modules={}),
        "no YOLOv5": save(tmp_path / "d.pt", {"state_dict": [1]}),
        "holds no": save(tmp_path / "e.pt", [1, 2]),
    }.items():
        with pytest.raises(UserError, match=says):
            YOLOv5(path)
    with pytest.raises(UserError, match="multiple of 32"):
        YOLOv5(architecture.save(tmp_path / "f.pt"), size=100)
    with pytest.raises(UserError, match="confidence"):
        YOLOv5(tmp_path / "f.pt", confidence=2)


# ONNX


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


def test_an_image_that_is_not_finite_never_reaches_a_network(tmp_path):
    jax = YOLOv5(Architecture(4, 1, 2).save(tmp_path / "x.pt"), size=SIZE)
    opencv = OnnxYOLO(constant(tmp_path / "x.onnx", output("yolov5")), NAMES, size=SIZE)
    for detector in (jax, opencv):
        with pytest.raises(UserError, match="not finite"):
            detector(np.full((SIZE, SIZE, 3), np.nan, np.float32))
