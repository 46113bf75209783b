"""Cameras, screens and beams from measurements of them."""
