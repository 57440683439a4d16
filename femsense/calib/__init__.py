"""Calibration: the camera's pose and the initial inputs of the cables."""
