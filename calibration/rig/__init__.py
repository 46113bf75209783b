"""Joint calibration of cameras, screens and beams."""
