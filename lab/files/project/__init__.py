"""Files of a calibration project: calibration.yaml, its tables and scanned point clouds."""
