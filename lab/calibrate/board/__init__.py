"""`beampose calibrate board`: boards to print."""
