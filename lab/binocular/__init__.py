"""`beampose stereo`: files, processing, report and study of the binocular measurement."""
