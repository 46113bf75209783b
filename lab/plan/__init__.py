"""`beampose plan`: what a rig will see and how well it will measure."""
