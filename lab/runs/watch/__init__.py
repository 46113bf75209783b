"""`beampose watch`: detection and causal tracking while frames arrive, and the usual results at the end."""
