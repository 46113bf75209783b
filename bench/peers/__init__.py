"""The tracking bench with peers: other people's trackers and ours on the same points."""
