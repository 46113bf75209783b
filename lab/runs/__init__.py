"""`beampose run`, `batch` and `check`: run folders in, result folders out."""
