"""`beampose calibrate camera`: photographs of a board to a lens."""
