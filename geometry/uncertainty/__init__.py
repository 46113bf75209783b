"""The rig's numbers, their covariance, and what it does to pixels."""
