"""`beampose calibrate rig`: the joint calibration of a whole project."""
