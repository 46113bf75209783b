"""The pose from labelled spots: closed forms, least squares, outliers, ambiguity, visibility."""
