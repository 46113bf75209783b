"""calibration.yaml and the tables of a calibration project."""
