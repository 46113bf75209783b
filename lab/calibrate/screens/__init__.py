"""`beampose calibrate screen`: where screens and cameras are."""
