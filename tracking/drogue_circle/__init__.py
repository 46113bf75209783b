"""A circle in pictures (the drogue of Zhou 2014): acquisition, gradient votes, rim fit, occlusion, Kalman filter."""
