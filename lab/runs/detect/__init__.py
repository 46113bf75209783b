"""`beampose detect`: spots and sensor noise of any pictures, without a rig."""
