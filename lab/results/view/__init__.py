"""`beampose view`: a rig, a run or results in three dimensions."""
