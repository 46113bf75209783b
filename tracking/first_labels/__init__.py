"""The search for the labels of one frame: candidate poses from geometry, completed and weighed."""
