"""`beampose verify`: a result computed again from its recorded inputs, and compared byte by byte."""
