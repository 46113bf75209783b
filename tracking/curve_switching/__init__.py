"""The paper's tracker (Huo 2015): a Kalman filter per spot, gains g1 to g3, three-step matching."""
