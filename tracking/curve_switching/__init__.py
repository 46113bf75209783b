"""The curve-switching tracker of Huo, Yang & Yang 2015: a Kalman filter per spot, gains g1 to g3, three-step matching.

Equations: (1) to (6) in kalman.py, (7) to (9) and section 4.1.2 in matching.py, (10) to (14) in out_of_view.py
and geometry/pose_solver/closed_form.py. spot_tracker.py runs the loop of fig. 1. Ours: vehicle.py, which uses the fact
that all spots belong to one rigid body.
"""
