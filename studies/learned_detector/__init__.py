"""Training of the learned drogue detector: rendered samples, the networks, the script; study rows."""
