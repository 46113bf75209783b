"""Data association: the joint assignment of one frame's detections to all spots."""
