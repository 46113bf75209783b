"""`beampose doctor`: whether the installation, the machine and calibration files are fit for use."""
