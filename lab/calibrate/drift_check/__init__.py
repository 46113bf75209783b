"""`beampose calibrate check`: checks a stored calibration for drift."""
