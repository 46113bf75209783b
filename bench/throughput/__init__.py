"""Process time and memory of a run, by stage."""
