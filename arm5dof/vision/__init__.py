"""What the arm sees: cameras, their calibration, and where in the base frame the things in a picture are."""
