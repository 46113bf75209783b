"""Labels of a whole run given the smoothed motion: reassociation of each frame, and continuity of each spot's path."""
