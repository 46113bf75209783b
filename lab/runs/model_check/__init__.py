"""Whether the rig file fits a recording, and which part of it does not."""
