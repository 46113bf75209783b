"""Learned detector of drogues: a small network on an image pyramid, run by OpenCV."""
