"""The rig's parameters, their covariance, and its effect on pixels; chi-square quantiles."""
