"""Columns of the table of candidates (n, COLUMNS), one row each, and rows of the arrays that compiled code works in.

Plain arrays: each array that is passed on as one of its own costs compile time in every function it goes through.
"""

from __future__ import annotations

# What the fit varies: centre, px; shape, the covariance of the light before the pixels integrate it, px^2; flux, DN;
# background at the centre, DN, and its slopes, DN/px.
U, V, UU, UV, VV, FLUX, LEVEL, SLOPE_U, SLOPE_V = range(9)
# What it says of itself: covariance of the centre, px^2; sigma of the flux, DN; highest pixel above plane and
# neighbours, DN (of a clipped spot the clipping level's); chi-square per degree of freedom; share of what stands out of
# the plane, beyond noise, that the Gaussian explains; by how much the Gaussian lowers chi-square.
VAR_U, COV_UV, VAR_V, SIGMA_FLUX, PEAK, CHI2, EXPLAINED, GAIN = range(9, 17)
# Moments; then the background found before, DN; 1 for those that only a mean of 8x8 pixels shows; size of the
# largest cells used, px; 1: to be fitted (again); 1: is a spot.
MOMENT_U, MOMENT_V, MOMENT_UU, MOMENT_UV, MOMENT_VV, GROUND, WIDE, SPAN, ACTIVE, GOOD = range(17, 27)
COLUMNS = 27

# Rows of `cells` (CELL_ROWS, most), of one window: DN; pixels.OUTSIDE, CLIPPED or VALID; light of the neighbours, DN;
# light of the spot, DN; weight, 1/DN^2, 0 where a cell does not count; residual, DN; 0 where it is left out as a hot or
# dead pixel, else 1; a row's Gaussian; the exact integral's six moments along a row; a few numbers.
VALUES, STATE, OTHERS, LIGHT, WEIGHT, RESIDUAL, USE, ROW, NODES = range(9)
FEW = NODES + 6
CELL_ROWS = FEW + 1
MOST_COLUMNS = 73
MOST_CELLS = MOST_COLUMNS**2

# Parts of `algebra` (ALGEBRA, 9, 10): the normal matrix; right sides and solutions; Cholesky's factor; in the last one
# some vectors: the right side, and neighbours.
NORMAL, SOLUTION, FACTOR, VECTORS = range(4)
ALGEBRA = 4
RIGHT_SIDE, NEAR, GAPS = range(3)  # rows of VECTORS
