"""`beampose stereo`: files, processing and report of the binocular measurement."""
