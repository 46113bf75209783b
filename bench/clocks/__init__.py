"""Random recordings of cameras with clocks of their own, against the same with one clock: `python -m bench.clocks`."""
