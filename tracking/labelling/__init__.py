"""First labels: the assignment of points of light to spots from one frame, with or without a prior."""
