"""Files of the rig: rig.yaml, camera.yaml, screens.yaml, board.yaml, and formats of other programs."""
