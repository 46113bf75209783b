"""Reports: HTML files that open without a network. Runs in run/, calibrations in calibration/, drawings in plot/."""
