"""Average precision where it can be counted by hand, and the commands that train and measure the detector."""

import json

import numpy as np
import pytest

from arm5dof.cli.main import main
from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections
from arm5dof.vision.evaluation.detection import average_precision, speed
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.ground_truth import Truth

BOX = [10.0, 20.0, 30.0, 40.0]


@pytest.fixture(autouse=True)
def _coco():
    pytest.importorskip("pycocotools")


def truth(*things):
    """Of (box, class, share that can be seen)."""
    boxes, class_id, visible = zip(*things, strict=True) if things else ((), (), ())
    n = len(things)
    return Truth(
        np.float32(boxes).reshape(-1, 4),
        np.array(class_id, int),
        np.array(visible, float),
        np.zeros((n, 3)),
        np.zeros(n),
    )


def found(*things):
    """Of (box, class, confidence)."""
    boxes, class_id, confidence = zip(*things, strict=True) if things else ((), (), ())
    return Detections(np.reshape(boxes, (-1, 4)), confidence, class_id, CLASS_NAMES)


def test_all_found():
    there = [truth((BOX, 0, 1), ([50, 50, 80, 90], 2, 0.7)), truth()]
    result = average_precision(there, [found((BOX, 0, 0.9), ([50, 50, 80, 90], 2, 0.3)), found()])
    assert result.map50 == result.map50_95 == pytest.approx(1)
    assert result.by_class["ball"] == 1 and result.by_class["ring"] is None


@pytest.mark.parametrize("share, levels", [(0.61, 3), (0.76, 6), (0.96, 10), (0.4, 0)])
def test_boxes_count_at_the_overlaps_that_they_reach(share, levels):
    smaller = [10.0, 20.0, 30.0, 20.0 + 20 * share]
    result = average_precision([truth((BOX, 0, 1))], [found((smaller, 0, 0.9))])
    assert result.map50 == pytest.approx(float(levels > 0)) and result.map50_95 == pytest.approx(levels / 10)


def test_half_found_and_wrongly_found():
    there = [truth((BOX, 0, 1)), truth((BOX, 0, 1))]
    # Precision is 1 up to a recall of a half: 51 of COCO's 101 recalls.
    assert average_precision(there, [found((BOX, 0, 0.9)), found()]).map50 == pytest.approx(51 / 101)
    first = average_precision(there, [found(([90, 90, 99, 99], 0, 0.99), (BOX, 0, 0.9)), found((BOX, 0, 0.8))])
    assert first.map50 == pytest.approx(2 / 3)
    assert average_precision(there, [found((BOX, 1, 0.9)), found()]).map50 == 0
    assert average_precision(there, [found(), found()]).map50 == 0


def test_what_is_mostly_hidden_may_be_found_or_not():
    hidden = [60.0, 60.0, 80.0, 80.0]
    there = [truth((BOX, 0, 1), (hidden, 0, 0.3))]
    for some in (found((BOX, 0, 0.5)), found((BOX, 0, 0.5), (hidden, 0, 0.9))):
        assert average_precision(there, [some]).map50_95 == pytest.approx(1)
    with pytest.raises(UserError, match="nothing to find"):
        average_precision([truth((hidden, 0, 0.3))], [found()])


def test_the_command_prints_what_it_measured(capsys):
    assert main(["vision", "eval", "--scenes", "4", "--back-end", "software", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert 0.5 < printed["map50_95"] < printed["map50"] <= 1
    assert 0 < printed["position_median_mm"] < printed["position_p95_mm"] < 30 and printed["frames_per_s"] > 1
    assert set(printed["positions"]) == {"plane", "depth", "two_views"}
    assert printed["positions"]["plane"]["median_mm"] == printed["position_median_mm"]


def test_speed_is_of_whole_calls():
    calls = []
    assert speed(lambda image: calls.append(image), [np.zeros((2, 2, 3), np.uint8)] * 5) > 0
    assert len(calls) == 16
