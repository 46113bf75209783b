"""`beampose track point` and `beampose study duan2020`: the centre of one target in a video, pictures or a table."""
