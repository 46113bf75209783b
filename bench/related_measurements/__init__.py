"""Monte Carlo of the related measurements: circle, point, unscented filter, stereo, learned detector."""
