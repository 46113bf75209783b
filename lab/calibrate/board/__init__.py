"""`beampose calibrate board`: printable calibration boards."""
