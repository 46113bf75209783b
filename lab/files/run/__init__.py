"""Files of a run: run.yaml, detections, truth, and its results read back."""
