"""Reports of calibrations: page, charts, maps and 3-D views."""
