"""`beampose study`: published experiments repeated."""
