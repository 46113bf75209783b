"""`beampose calibrate check`: whether a stored calibration still holds."""
