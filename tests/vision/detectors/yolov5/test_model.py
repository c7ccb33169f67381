"""YOLOv5 in JAX from its weights, beside the same weights in OpenCV."""

import cv2
import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, STRIDES, constant, output
from helpers.pickles import Shell, save
from helpers.yolov5_bytes import ANCHORS, Architecture

from arm5dof.errors import UserError
from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO
from arm5dof.vision.detectors.yolov5.model import YOLOv5
from arm5dof.vision.images import letterbox

GREY = np.full((48, 64, 3), 100, np.uint8)


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


def test_normalization_folded_by_us_and_in_the_file_agree(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), np.uint8)
    ours = YOLOv5(Architecture(4, 1, 2).save(tmp_path / "x.pt")).forward(image)
    theirs = YOLOv5(Architecture(4, 1, 2, folded=True).save(tmp_path / "y.pt")).forward(image)
    assert np.ptp(np.asarray(ours[1])) > 0.01
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


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


def test_an_image_that_is_not_finite_never_reaches_a_network(tmp_path):
    jax = YOLOv5(Architecture(4, 1, 2).save(tmp_path / "x.pt"), size=SIZE)
    opencv = OnnxYOLO(constant(tmp_path / "x.onnx", output("yolov5")), NAMES, size=SIZE)
    for detector in (jax, opencv):
        with pytest.raises(UserError, match="not finite"):
            detector(np.full((SIZE, SIZE, 3), np.nan, np.float32))
