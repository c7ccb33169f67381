"""Detectors: any YOLO as ONNX, YOLOv5's own weights in JAX, and the tabletop detector that ships."""
