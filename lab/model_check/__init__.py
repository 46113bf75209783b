"""Whether the rig file fits a recording, and which part of the set-up is the likely culprit where it does not."""
