"""The published YOLOv5n, which several tests run."""

import pytest

from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO
from arm5dof.vision.detectors.yolov5.model import YOLOv5
from arm5dof.vision.images import read


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
