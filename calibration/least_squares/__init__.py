"""The sparse least-squares engine of all calibrations."""
