"""Columns of the table of candidates (n, COLUMNS), and rows of the arrays that compiled code uses as workspace.

The fields are columns of one array, because every array passed separately costs compile time in each function.
"""

from __future__ import annotations

# Parameters of the fit: centre, px; shape, the covariance of the light before the pixels integrate it, px^2; flux, DN;
# background at the centre, DN, and its slopes, DN/px.
U, V, UU, UV, VV, FLUX, LEVEL, SLOPE_U, SLOPE_V = range(9)
# Quality of the fit: covariance of the centre, px^2; sigma of the flux, DN; highest pixel above plane and neighbours,
# DN (that of the clipping level for a clipped spot); chi-square per degree of freedom; share of the signal above the
# plane, beyond noise, that the Gaussian explains; decrease of chi-square by the Gaussian.
VAR_U, COV_UV, VAR_V, SIGMA_FLUX, PEAK, CHI2, EXPLAINED, GAIN = range(9, 17)
# Moments; then the background from the search, DN; 1 if only a mean of 8x8 pixels detects the candidate; size of the
# largest cells used, px; 1 if it is to be fitted (again); 1 if it is a spot; variance of the first window, px^2; 1 if
# its shape is held in the fit; share of the signal beyond noise and the structure beside the spot that is explained;
# contrast of the texture there; share of the centre's variance due to misfits of the shape; share of the light in the
# near wing, variance that this adds to the core, px^2, share in the far wing, relative variance of the light in each
# pixel beyond these, usual covariance and the variance of a spot's covariance about it (tracking.noise.SpotProfile).
MOMENT_U, MOMENT_V, MOMENT_UU, MOMENT_UV, MOMENT_VV, BACKGROUND, WIDE, CELL_SIZE = range(17, 25)
ACTIVE, ACCEPTED, START, HELD, EXPLAINED_HERE, TEXTURE, MISFIT = range(25, 32)
NEAR_WING, NEAR_VARIANCE, FAR_WING, UNEVEN, USUAL_UU, USUAL_UV, USUAL_VV, USUAL_VARIANCE = range(32, 40)
COLUMNS = 40

# Rows of `cells` (CELL_ROWS, most), of one window: grey values, DN; pixels.OUTSIDE, CLIPPED or VALID; light of the
# neighbours, DN; light of the spot, DN; weight, 1/DN^2, 0 for excluded cells; residual, DN; 0 for cells excluded as hot
# or dead pixels, else 1; workspace for Gaussians, and three more rows; six moments of the light over each pixel;
# scratch values; places of the cells in the spot's frame; six moments of a part of the light.
VALUES, STATE, NEIGHBOUR_LIGHT, LIGHT, WEIGHT, RESIDUAL, USE, ROW = range(8)
LINE = ROW + 1
NODES = LINE + 3
SCRATCH = NODES + 6
AT_X, AT_Y = SCRATCH + 1, SCRATCH + 2
PART = AT_Y + 1
CELL_ROWS = PART + 6
MOST_COLUMNS = 73
MOST_CELLS = MOST_COLUMNS**2

# Parts of `algebra` (ALGEBRA, 9, 10): the normal matrix; right sides and solutions; the Cholesky factor; vectors: the
# right side, and the neighbours with their gaps.
NORMAL, SOLUTION, FACTOR, VECTORS = range(4)
ALGEBRA = 4
RIGHT_SIDE, NEAR, GAPS = range(3)  # rows of VECTORS
