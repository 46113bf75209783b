"""The usual mistakes of setting up, one at a time, on six rigs: which ones `check` and `run` name."""
