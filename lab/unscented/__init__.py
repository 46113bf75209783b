"""`beampose study fu2016`: the unscented filter of Fu (2016) on simulated recordings."""
