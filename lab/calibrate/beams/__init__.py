"""`beampose calibrate beams`: recordings at stand positions to the lines of the beams."""
