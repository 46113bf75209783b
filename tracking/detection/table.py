"""Candidates for spots as records, peaks of the search likewise, and rows of the arrays that compiled code works in.

The fields of a candidate are one record, because every array passed separately costs compile time in each function.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

PEAK = np.dtype(
    [
        ("u", np.float64),  # px
        ("v", np.float64),
        ("height", np.float64),  # DN: mean of 3x3 pixels above the background
        ("level", np.float64),  # DN: the background
        ("wide", np.float64),  # 1 if only the mean of 8x8 pixels detects the peak
        # px: half side of the square that the light around it fills, 1 for a narrow spot (search.find_separate_peaks)
        ("scale", np.float64),
        ("contrast", np.float64),  # of the texture there
    ]
)

CANDIDATE = np.dtype(
    [
        # The fit: centre, px; shape, the covariance of the light before the pixels integrate it, px^2; flux, DN;
        # background at the centre, DN, and its slopes, DN/px.
        *((name, np.float64) for name in ("u", "v", "uu", "uv", "vv", "flux", "level", "slope_u", "slope_v")),
        # Its quality.
        ("var_u", np.float64),  # px^2: covariance of the centre
        ("cov_uv", np.float64),
        ("var_v", np.float64),
        ("sigma_flux", np.float64),  # DN
        ("peak", np.float64),  # DN: highest pixel above plane and neighbours; of a clipped spot that of clipping
        ("chi2", np.float64),  # per degree of freedom
        ("explained", np.float64),  # share of the signal above the plane, beyond noise, that the Gaussian explains
        ("explained_here", np.float64),  # the same, beyond noise and the structure beside the spot
        ("gain", np.float64),  # decrease of chi-square by the Gaussian
        ("misfit", np.float64),  # share of the centre's variance due to misfits of the shape
        # Moments: centre, px, and covariance, px^2.
        ("moment_u", np.float64),
        ("moment_v", np.float64),
        ("moment_uu", np.float64),
        ("moment_uv", np.float64),
        ("moment_vv", np.float64),
        ("background", np.float64),  # DN: from the search
        ("texture", np.float64),  # contrast of the texture there
        ("wide", np.float64),  # 1 if only a mean of 8x8 pixels detects it
        ("cell_size", np.float64),  # px: of the largest cells used
        ("start", np.float64),  # px^2: variance of the first window
        # States, 0 or 1.
        ("active", np.float64),  # is to be fitted (again)
        ("accepted", np.float64),  # is a spot
        ("held", np.float64),  # its shape is held in the fit
        # The usual light of narrow spots (tracking.noise.SpotProfile): share in the near wing and the variance, px^2,
        # that it adds to the core; share in the far wing; relative variance of the light in each pixel beyond these;
        # usual covariance, px^2, and the variance of a spot's covariance about it, px^4. 0 for a plain Gaussian.
        ("near_wing", np.float64),
        ("near_variance", np.float64),
        ("far_wing", np.float64),
        ("uneven", np.float64),
        ("usual_uu", np.float64),
        ("usual_uv", np.float64),
        ("usual_vv", np.float64),
        ("usual_variance", np.float64),
    ]
)
Peak: TypeAlias = np.void  # one PEAK
Peaks: TypeAlias = NDArray[np.void]  # (n,) of PEAK
Candidate: TypeAlias = np.void  # one CANDIDATE
Candidates: TypeAlias = NDArray[np.void]  # (n,) of CANDIDATE

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
