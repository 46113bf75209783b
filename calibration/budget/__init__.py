"""Expected errors and error budget of a rig before it is built."""
