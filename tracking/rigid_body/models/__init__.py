"""Models of the rigid tracker: motion, occlusion and the information that labelled spots give about the pose."""
