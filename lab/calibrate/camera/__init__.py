"""`beampose calibrate camera`: lens calibration from photographs of a board."""
