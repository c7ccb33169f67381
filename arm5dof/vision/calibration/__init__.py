"""Calibration: boards, a camera's intrinsics and extrinsics, hand-eye, each with its covariance."""
