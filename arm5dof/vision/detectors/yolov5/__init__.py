"""YOLOv5 v6 in JAX."""
