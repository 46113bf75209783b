"""`beampose track drogue`: the learned detector with the light tracker between its frames."""
