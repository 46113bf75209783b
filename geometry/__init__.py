"""Pure geometry on arrays: no files, no state. Lengths in metres, angles in radians, pixels as in OpenCV."""
