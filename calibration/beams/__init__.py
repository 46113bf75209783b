"""The lasers' lines in the vehicle."""
