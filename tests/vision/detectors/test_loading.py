"""Detectors by their files, the names of their classes, and one frame after another."""

import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, constant, output
from helpers.pickles import Shell, save
from helpers.tabletop_weights import weights_of
from helpers.yolov5_bytes import Architecture

from arm5dof.errors import UserError
from arm5dof.vision.detectors.loading import detect, load_detector, read_names
from arm5dof.vision.detectors.tabletop.detector import TabletopDetector
from arm5dof.vision.detectors.tabletop.weights import save_weights
from arm5dof.vision.frames import Frame
from arm5dof.vision.objects import CLASS_NAMES

GREY = np.full((480, 640, 3), 100, np.uint8)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "ball.onnx"
    return constant(path, output("yolov8"), (1, 3, SIZE, SIZE), {"names": str(list(NAMES))})


@pytest.fixture
def tabletop(tmp_path):
    """Weights of a tabletop detector."""
    save_weights(tmp_path / "tabletop.npz", weights_of(16, 3.0, 2.0), ("cube", "ball", "ring"))
    return tmp_path / "tabletop.npz"


def test_the_file_says_which_detector_it_is_for(tabletop):
    detector = load_detector(tabletop, confidence=0.95)
    assert isinstance(detector, TabletopDetector) and len(detector(GREY)) == 0
    for options in ({"class_names": ["a", "b", "c"]}, {"size": 320}):
        with pytest.raises(UserError, match="are fixed"):
            load_detector(tabletop, **options)


def test_only_the_tabletop_detector_has_test_time_augmentation(tmp_path):
    (tmp_path / "other.onnx").write_bytes(b"\x08")
    with pytest.raises(UserError, match="tta"):
        load_detector(tmp_path / "other.onnx", tta=True)


def test_only_onnx_files_are_run_by_onnx_runtime(tabletop, tmp_path):
    for path in (None, tabletop, Architecture(4, 1, 2).save(tmp_path / "x.pt")):
        with pytest.raises(UserError, match=r"runs \.onnx files only"):
            load_detector(path, onnxruntime=True)


def test_the_names_of_coco(test_data):
    assert read_names("coco") == list(load_detector(test_data / "vision" / "models" / "yolov5n.pt").class_names)


def test_names_are_no_text(model):
    with pytest.raises(UserError, match="not one text: 'coco'"):
        load_detector(model, "coco")


def test_classes_and_names(tmp_path):
    path = constant(tmp_path / "x.onnx", output("yolov8"), (1, 3, SIZE, SIZE))
    (tmp_path / "names.txt").write_text("\ufeffcup\r\nred ball\r\n\r\n", encoding="utf-8")
    detector = load_detector(path, read_names(tmp_path / "names.txt"))
    assert detector.class_names == ("cup", "red ball")
    frames = [Frame("x", np.zeros((SIZE, SIZE, 3), np.uint8))]
    assert [len(found) for _, found in detect(frames, detector)] == [1]
    assert [len(found) for _, found in detect(frames, detector, ["cup"])] == [0]
    assert [len(found) for _, found in detect(frames, detector, ["cup", "red ball"])] == [1]
    with pytest.raises(UserError, match="knows no class 'bowl'; it knows: cup, red ball"):
        detect(frames, detector, ["bowl"])


def test_a_detector_is_told_by_its_content_where_its_name_says_nothing(model, tmp_path):
    (tmp_path / "network").write_bytes(model.read_bytes())
    Architecture(4, 1, 2).save(tmp_path / "weights.bin")
    assert load_detector(tmp_path / "network").class_names == NAMES
    assert load_detector(tmp_path / "weights.bin", ["a", "b"], size=SIZE).class_names == ("a", "b")
    with pytest.raises(UserError, match="tells 2 classes apart, and 3 names were given"):
        load_detector(tmp_path / "weights.bin", ["a", "b", "c"])


def test_yolov8_weights_are_refused_with_a_remedy(tmp_path):
    save(tmp_path / "yolov8n.pt", {"model": Shell("ultralytics.nn.tasks.DetectionModel")})
    with pytest.raises(UserError, match="YOLOv8 or later, of which only ONNX is read: export it"):
        load_detector(tmp_path / "yolov8n.pt")


def test_without_a_file_it_is_the_one_that_ships():
    assert isinstance(load_detector(), TabletopDetector) and load_detector().class_names == CLASS_NAMES
