"""Live: detection and the causal tracker as frames arrive, and the ordinary result at the end."""
