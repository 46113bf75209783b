"""The fixed part of the pictures of a camera, and what moves in front of it."""
