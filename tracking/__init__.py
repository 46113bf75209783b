"""From pictures to labelled spots: detection, the paper's tracker, first labels. Knows no files."""
