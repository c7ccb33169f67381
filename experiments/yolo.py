"""YOLOv5 in JAX beside the same weights in OpenCV: speed, and differences.

    python experiments/yolo.py DATA        a minute; into experiments/results/yolo.md

DATA is a folder with `vision/models/yolov5n.pt`, `vision/models/yolov5n_fp16.onnx` and `vision/photos/bus.jpg`; none of
them is ours to ship. The two take turns, so that whatever else the machine does strikes both. Run it while nothing
else runs.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import numpy as np

from arm5dof.runtime import files
from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO
from arm5dof.vision.detectors.yolov5.model import YOLOv5
from arm5dof.vision.images import letterbox, read

SIZES, TURNS = (640, 320), 40
RESULTS = Path(__file__).parent / "results"


def in_turns(*calls: Callable[[], object]) -> list[list[float]]:
    """Seconds that each call takes in each turn; one turn beforehand compiles."""
    times: list[list[float]] = [[] for _ in calls]
    for turn in range(TURNS + 1):
        for call, own in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if turn:
                own.append(time.perf_counter() - start)
    return times


def compare(name: str, opencv: Callable[[], object], ours: Callable[[], object]) -> str:
    """One row of the table; the ratio is the median of the turns' own ratios."""
    theirs, mine = in_turns(opencv, ours)
    ratios = [a / b for a, b in zip(theirs, mine, strict=True)]
    low, high = np.quantile(ratios, [0.1, 0.9])
    rates = [1 / statistics.median(times) for times in (theirs, mine)]
    ratio = f"{statistics.median(ratios):.2f} ({low:.2f} to {high:.2f})"
    return f"| {name} | {rates[0]:.1f} | {rates[1]:.1f} | {ratio} |"


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python experiments/yolo.py DATA")
    vision = Path(sys.argv[1]) / "vision"
    image = read(vision / "photos" / "bus.jpg")
    speeds, differences = [], []
    load = os.getloadavg()[0]
    for size in SIZES:
        ours = YOLOv5(vision / "models" / "yolov5n.pt", size=size)
        theirs = OnnxYOLO(vision / "models" / "yolov5n_fp16.onnx", ours.class_names, size=size)
        network = cv2.dnn.readNetFromONNX(str(vision / "models" / "yolov5n_fp16.onnx"))
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        square = letterbox(image, (size, size)).image

        def opencv(network=network, square=square) -> np.ndarray:
            network.setInput(cv2.dnn.blobFromImage(square, 1 / 255))
            return network.forward()[0]

        def forward(ours=ours, square=square) -> list[np.ndarray]:
            return [np.asarray(x) for x in ours.forward(square)]

        speeds.append(compare(f"{size} x {size}, pixels to boxes and scores", opencv, forward))
        speeds.append(
            compare(f"{size} x {size}, photograph to detections", lambda f=theirs: f(image), lambda f=ours: f(image))
        )
        output, (boxes, scores) = opencv(), forward()
        expected = output[:, 4:5] * output[:, 5:]
        confident = expected.max(1) > 0.25
        score, box = np.abs(scores - expected).max(), np.abs(boxes - output[:, :4])[confident].max()
        differences.append(f"| {size} x {size} | {score:.4f} | {box:.2f} px |")
    text = "\n".join(
        [
            "# YOLOv5n in JAX and in OpenCV",
            "",
            f"Frames a second, medians of {TURNS} turns taken one after the other; in brackets the middle 80 % of the",
            f"turns' ratios. {os.cpu_count()} cores, load average {load:.1f} at the start (above 0, others worked too",
            f"and only ratios count); jax {jax.__version__}, OpenCV {cv2.__version__}. Command:",
            "`python experiments/yolo.py DATA`.",
            "",
            "| | OpenCV | JAX | JAX / OpenCV |",
            "| --- | ---: | ---: | ---: |",
            *speeds,
            "",
            "Largest differences on the photograph: of all scores, and of the boxes with a score above 0.25.",
            "",
            "| | score | box |",
            "| --- | ---: | ---: |",
            *differences,
            "",
        ]
    )
    print(text)
    files.write_text(RESULTS / "yolo.md", text)


if __name__ == "__main__":
    main()
