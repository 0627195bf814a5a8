"""Where a calibration begins, and how the ground is touched."""
