"""The pose from labelled spots: closed forms, least squares, robustness, ambiguity."""
