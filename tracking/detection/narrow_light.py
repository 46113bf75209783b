"""The light of narrow spots: integrated over the pixels exactly, with the wings that the spots of a camera share.

Such light is the sum of up to three Gaussians of one centre, of which a second and a third one are wider than the core
by fixed variances (tracking.noise.SpotProfile; noise_estimation/spot_profile.py estimates it). The covariance of a spot
is that of the sum. Where the pixels hardly resolve a spot, its shape and its place within a pixel have similar effects
on them; so the fit starts from knowing that the shape is near the usual one of the camera. Source: ours.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.pixels import Window
from tracking.detection.table import LINE, NODES, PART, ROW, Candidate

EXACT_PX2 = 0.9**2  # px^2: narrower spots are integrated over the pixels numerically
FAR_PX2 = 2.0**2  # px^2: what the far wing adds: its light reaches the border of the window
_TOLERANT = 9.0  # squared sigmas from the usual shape at which that counts half: a spot may be a streak
_FOUR_NODES_PX2 = 0.5**2  # px^2: narrower spots need eight instead of four nodes in each direction
_NEGLIGIBLE = 6.0  # sigmas from the centre at which the light is 2e-8 of its peak

# Gauss-Legendre nodes and weights on [-1/2, 1/2] for 4 and 8 points: accurate to 1e-4 of the peak for sigmas of at
# least 0.5 and 0.2 px.
_FOUR = np.polynomial.legendre.leggauss(4)
_EIGHT = np.polynomial.legendre.leggauss(8)
_NODES4, _WEIGHTS4, _NODES8, _WEIGHTS8 = _FOUR[0] / 2, _FOUR[1] / 2, _EIGHT[0] / 2, _EIGHT[1] / 2


class PolynomialFrame(NamedTuple):
    """The coordinates of the polynomial: relative to the spot's centre, in units of its widths."""

    u0: float  # px, centre of the first cell relative to the spot's centre
    v0: float
    su: float  # px, the spot's sigma in u and v
    sv: float
    S: tuple[float, float, float]  # px^2: covariance of the light after integration over the cells
    exact: bool  # the light is integrated over each pixel numerically


@compiled
def frame_of(window: Window, spot: Candidate) -> PolynomialFrame:
    """The frame of a spot in a window."""
    middle, pixel = 0.5 * (window.cell - 1), window.cell**2 / 12.0
    narrow = ellipse.eigenvalues(spot["uu"], spot["uv"], spot["vv"])[0] < EXACT_PX2
    exact = window.cell == 1 and (narrow or variance_of_wings(spot) > 0.0)
    if exact:
        pixel = 0.0
    S = (spot["uu"] + pixel, spot["uv"], spot["vv"] + pixel)
    return PolynomialFrame(
        window.left + middle - spot["u"], window.top + middle - spot["v"], sqrt(S[0]), sqrt(S[2]), S, exact
    )


@compiled
def variance_of_wings(spot: Candidate) -> float:
    """What the wings add to the variance of a spot's core, px^2."""
    return spot["near_wing"] * spot["near_variance"] + spot["far_wing"] * FAR_PX2


@compiled
def exact_light(window: Window, frame: PolynomialFrame, spot: Candidate, cells: Array) -> None:
    """The light of a spot and its derivatives, the means of each pixel, into cells[NODES:]."""
    S, more = frame.S, variance_of_wings(spot)
    if more <= 0.0:
        _pixel_moments(window, frame, S, spot["flux"], cells, NODES)
        return
    near, far = spot["near_wing"], spot["far_wing"]
    out = cells[NODES : NODES + 6, : window.rows * window.columns]
    out[:] = 0.0
    for share, added in ((1.0 - near - far, 0.0), (near, spot["near_variance"]), (far, FAR_PX2)):
        part = (S[0] - more + added, S[1], S[2] - more + added)
        _pixel_moments(window, frame, part, share * spot["flux"], cells, PART)
        M = _derivatives(frame, part)
        for p in range(6):
            for q in range(6):
                if M[p, q] != 0.0:
                    for k in range(out.shape[1]):
                        out[p, k] += M[p, q] * cells[PART + q, k]


@compiled
def _pixel_moments(
    window: Window, frame: PolynomialFrame, S: tuple[float, float, float], flux: float, cells: Array, first: int
) -> None:
    """Pixel means of a Gaussian of covariance S, px^2, times 1, x, y, x^2, x y, y^2 into cells[first:]."""
    scale = flux / (2 * np.pi * sqrt(S[0] * S[2] - S[1] ** 2))
    for r in range(window.rows):
        out = cells[first : first + 6, r * window.columns : (r + 1) * window.columns]
        _moments_of_row(S, frame.u0, frame.v0 + r, frame.su, frame.sv, scale, cells[ROW : LINE + 3], out)


@compiled
def _moments_of_row(
    S: tuple[float, float, float], u0: float, dv: float, su: float, sv: float, scale: float, work: Array, out: Array
) -> None:
    """Means over the pixels of a row (n,) of a Gaussian of covariance S, px^2, times 1, x, y, x^2, x y, y^2: (6, n).

    u0, dv: px, the first pixel relative to the centre; x and y are such distances over su and sv. scale: its value at
    the centre. Outside the ellipse of _NEGLIGIBLE sigmas they are 0. work: (4, 8 n) or larger.
    """
    wide = ellipse.eigenvalues(S[0], S[1], S[2])[0] > _FOUR_NODES_PX2
    nodes, weights = (_NODES4, _WEIGHTS4) if wide else (_NODES8, _WEIGHTS8)
    a = ellipse.inverse(S[0], S[1], S[2])
    count, columns = nodes.shape[0], out.shape[1]
    for p in range(6):
        for j in range(columns):
            out[p, j] = 0.0
    left2 = _NEGLIGIBLE**2 - max(abs(dv) - 0.5, 0.0) ** 2 / S[2]
    if left2 <= 0.0:
        return
    slope = S[1] / S[2]  # of the line through the middles of the ellipse's rows
    reach = sqrt(left2 / a[0]) + 0.5 * (1.0 + abs(slope))
    first, last = max(int(slope * dv - reach - u0), 0), min(int(slope * dv + reach - u0) + 1, columns)
    n = max(last - first, 0)
    # First the sums over the nodes in v, of the light times 1, y and y^2, at all nodes in u of these pixels.
    u, light = work[0, : count * n], work[1, : count * n]
    light_y, light_yy = work[2, : count * n], work[3, : count * n]
    for m in range(count):
        for j in range(n):
            u[m * n + j] = u0 + nodes[m] + (first + j)
    for i in range(light.shape[0]):
        light[i] = light_y[i] = light_yy[i] = 0.0
    for k in range(count):
        v, y, share = dv + nodes[k], (dv + nodes[k]) / sv, scale * weights[k]
        for i in range(light.shape[0]):
            g = share * ellipse.exponential(-0.5 * (a[0] * u[i] * u[i] + 2.0 * a[1] * u[i] * v + a[2] * v * v))
            light[i] += g
            light_y[i] += g * y
            light_yy[i] += g * y * y
    narrow, out = 1.0 / su, out[:, first:]
    for m in range(count):
        for j in range(n):
            i = m * n + j
            x, one, with_y = u[i] * narrow, weights[m] * light[i], weights[m] * light_y[i]
            out[0, j] += one
            out[1, j] += one * x
            out[2, j] += with_y
            out[3, j] += one * x * x
            out[4, j] += with_y * x
            out[5, j] += weights[m] * light_yy[i]


@compiled
def _derivatives(frame: PolynomialFrame, part: tuple[float, float, float]) -> Array:
    """(6, 6): the columns of the fit as sums of the moments of a Gaussian that is a part of the light.

    The parameters keep their meaning: x and y are the step S (x / su, y / sv) of the centre, and the second degree
    Q is the change 2 S Q S of the shape with a flux that is larger by tr(Q S). For a single Gaussian this is 1.
    """
    S, su, sv = frame.S, frame.su, frame.sv
    P = ellipse.inverse(part[0], part[1], part[2])
    out = np.zeros((6, 6))
    out[0, 0] = 1.0
    for p, a, b in ((1, S[0] / su, S[1] / su), (2, S[1] / sv, S[2] / sv)):
        out[p, 1], out[p, 2] = (P[0] * a + P[1] * b) * su, (P[1] * a + P[2] * b) * sv
    for p, a, b, c in _second_degree(su, sv):
        T = ellipse.between(S, (a, b, c))
        B = ellipse.between(P, T)
        out[p, 0] = a * S[0] + 2 * b * S[1] + c * S[2] - (P[0] * T[0] + 2 * P[1] * T[1] + P[2] * T[2])
        out[p, 3], out[p, 4], out[p, 5] = B[0] * su**2, 2 * B[1] * su * sv, B[2] * sv**2
    return out


@compiled
def add_usual_shape(frame: PolynomialFrame, spot: Candidate, N: Array, b: Array) -> None:
    """Add the usual shape of narrow spots, with its scatter, to the normal equations, if it is known."""
    if spot["usual_variance"] <= 0.0:
        return
    S, d = frame.S, np.zeros(3)
    d[0], d[1], d[2] = spot["usual_uu"] - S[0], spot["usual_uv"] - S[1], spot["usual_vv"] - S[2]
    J = np.zeros((3, 3))
    for p, a, m, c in _second_degree(frame.su, frame.sv):
        T = ellipse.between(S, (a, m, c))
        J[p - 3, 0], J[p - 3, 1], J[p - 3, 2] = 2.0 * T[0], 2.0 * T[1], 2.0 * T[2]
    far = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / spot["usual_variance"]
    weight = 1.0 / (spot["usual_variance"] * (1.0 + far / _TOLERANT))
    for p in range(3):
        for k in range(3):
            b[3 + p] += weight * J[p, k] * d[k]
            for q in range(3):
                N[3 + p, 3 + q] += weight * J[p, k] * J[q, k]


@compiled
def _second_degree(su: float, sv: float) -> tuple:
    """The quadratic forms (uu, uv, vv) of the polynomial's coefficients 3 to 5, 1/px^2, with their numbers."""
    return (3, 1.0 / su**2, 0.0, 0.0), (4, 0.0, 0.5 / (su * sv), 0.0), (5, 0.0, 0.0, 1.0 / sv**2)
