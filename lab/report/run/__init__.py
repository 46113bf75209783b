"""The report of a run, and the index of a batch."""
