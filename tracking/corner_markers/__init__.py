"""Markers on a vehicle in one picture: Harris corners, RANSAC with three-point poses, and the pose of all markers."""
