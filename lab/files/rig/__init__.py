"""Files about the rig: rig.yaml, camera.yaml, screens.yaml, board.yaml, other programs' formats."""
