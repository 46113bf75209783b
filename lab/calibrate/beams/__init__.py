"""`beampose calibrate beams`: the lines of the beams from recordings at stand positions."""
