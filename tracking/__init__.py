"""From pictures to labelled spots and poses: detection, labelling, trackers, smoothing. Reads and writes no files."""
