"""`beampose calibrate rig`: joint calibration of cameras, screens and beams."""
