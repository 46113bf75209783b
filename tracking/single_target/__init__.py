"""One target's centre over time: Duan's (2020) constant-velocity Kalman filter, with gate, acquisition and statuses."""
