"""Pure geometry on arrays: no files, no state (except compilation/). Metres, radians, and OpenCV's pixels."""
