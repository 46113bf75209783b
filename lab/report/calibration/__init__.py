"""Reports of calibrations: the page and its charts, maps and scenes."""
