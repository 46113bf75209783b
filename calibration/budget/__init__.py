"""What errors to expect before a rig is built."""
