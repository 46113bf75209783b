"""Spots in any pictures, without a rig: what a detector sees, and with what noise."""
