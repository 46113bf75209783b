"""Cameras, screens and beams in one solve."""
