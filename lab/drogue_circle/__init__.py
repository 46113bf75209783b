"""`beampose track circle`: a circle in a video or a folder of pictures (Zhou 2014); tables, report, overlay, study."""
