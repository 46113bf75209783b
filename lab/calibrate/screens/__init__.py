"""`beampose calibrate screen`: poses of screens and cameras."""
