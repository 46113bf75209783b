"""The noise of a sensor, estimated from its own pictures (photon_transfer.estimate_noise)."""
