"""Files of a run: run.yaml, timestamps, detections, truth, and the tables of its results."""
