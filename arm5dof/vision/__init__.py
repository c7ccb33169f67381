"""What the camera sees, and where it is: images in; cameras, calibration and detections out."""
