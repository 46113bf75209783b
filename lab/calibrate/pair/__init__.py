"""`calibrate pair`: calibrates two cameras and their relative pose from photographs of a board."""
