"""How far the spots move between the instant of a frame and that at which a picture shows them; compiled.

A camera with a clock of its own takes its picture before or after the frame's instant, and a rolling shutter exposes
each row at another time. The pixel of a spot is then that of the pose at the spot's own instant: the pixel at the
frame's instant plus a shift, which follows from the velocities. Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, project_view
from tracking.detections import Detections
from tracking.picture_clock import AT_THE_FRAME
from tracking.rigid_body.models.information import inverse_2x2
from tracking.rigid_body.models.motion import STATE, state_after, transition

ROW_STEPS = 4  # of the search for the row in which a spot is exposed: each gains a factor of its speed in rows per row


def has_clocks(found: Sequence[Detections | None]) -> bool:
    """Whether some picture of a frame was not taken at the frame's instant, or row by row."""
    return any(f is not None and f.clock is not None for f in found)


def clocks_of(found: Sequence[Detections | None]) -> Array:
    """(cameras, 3): the clocks of a frame's pictures, as PictureClock.numbers."""
    return np.array([AT_THE_FRAME if f is None or f.clock is None else f.clock.numbers for f in found])


@compiled
def exposed_after(clock: Array, v: float) -> float:
    """When row v is exposed, s after the frame's instant. clock (3,): as PictureClock.numbers."""
    return clock[0] + (min(max(v, -0.5), 2 * clock[2] + 0.5) - clock[2]) * clock[1]


@compiled
def picture_shifts(
    views: Views, camera: Ints, clocks: Array, R: Array, t: Array, m: Array, P: Array
) -> tuple[Array, Array]:
    """Shifts (n, 2), px, of the n views' spots from a frame's instant to that of their pictures, and their covariances.

    views: without a shift; camera (n,): of each view; clocks (cameras, 3): as PictureClock.numbers; R, t, m: the state
    at the frame's instant, as in motion.py; P (6, 6): the covariance of its velocities, which makes those of the shifts
    (n, 2, 2), px^2. 0 for spots without a projection.
    """
    n = views.shape[0]
    shift, cov = np.zeros((n, 2)), np.zeros((n, 2, 2))
    here, there, J = np.empty(2), np.empty(2), np.empty((2, 6))
    for i in range(n):
        clock = clocks[camera[i]]
        if (clock[0] == 0.0 and clock[1] == 0.0) or not project_view(views, i, R, t, here, J):
            continue
        v, after, known = here[1], 0.0, True
        for _ in range(ROW_STEPS if clock[1] != 0.0 else 1):
            after = exposed_after(clock, v)
            R_then, t_then, _ = state_after(R, t, m, after)
            known = project_view(views, i, R_then, t_then, there, J)
            if not known:
                break
            v = there[1]
        if not known:
            continue
        for a in range(2):
            shift[i, a] = there[a] - here[a]
            for b in range(2):
                for j in range(6):
                    for k in range(6):
                        cov[i, a, b] += after * after * J[a, j] * P[j, k] * J[b, k]
    return shift, cov


@compiled
def run_shifts(views: Views, camera: Ints, clocks: Array, R: Array, t: Array, m: Array) -> Array:
    """Shifts (T, n, 2), px, as of `picture_shifts`, of T frames: clocks (T, cameras, 3), R (T, 3, 3), t, m (T, 12)."""
    frames, n = t.shape[0], views.shape[0]
    out, no_P = np.empty((frames, n, 2)), np.zeros((6, 6))
    for k in range(frames):
        shift, _ = picture_shifts(views, camera, clocks[k], R[k], t[k], m[k], no_P)
        for i in range(n):
            out[k, i, 0], out[k, i, 1] = shift[i, 0], shift[i, 1]
    return out


@compiled
def timed_spot(
    views: Views, i: int, R: Array, t: Array, m: Array, after: float, at: Array, J: Array, H: Array
) -> tuple[bool, Array]:
    """The pixel of view i `after` seconds from a state (R, t, m), and its Jacobian by that state.

    Writes the pixel, without the views' shift, to at (2,), the Jacobian by the pose at that time to J (2, 6), and that
    by the state's error (18) to H (2, 18). Returns whether there is a projection, and the motion (12,) at that time.
    """
    R_then, t_then, m_then = state_after(R, t, m, after)
    if not project_view(views, i, R_then, t_then, at, J):
        return False, m_then
    F, _ = transition(m, after)
    for a in range(2):
        at[a] -= views[i]["shift"][a]
        for j in range(STATE):
            H[a, j] = 0.0
            for c in range(6):
                H[a, j] += J[a, c] * F[c, j]
    return True, m_then


@compiled
def timed_information(
    views: Views, camera: Ints, clocks: Array, state: tuple[Array, Array, Array], use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, float, int, float]:
    """As `frame_information`, about the state (R, t, m) of spots that each have an instant of their own.

    clocks (cameras, 3). Returns the normal matrix (18, 18), the vector (18,), the chi-square of the residuals, the
    number of spots, and the sum of log det(2 pi C).
    """
    R, t, m = state
    L, g = np.zeros((STATE, STATE)), np.zeros(STATE)
    chi2 = log_det = 0.0
    count = 0
    at, J, H = np.empty(2), np.empty((2, 6)), np.empty((2, STATE))
    for i in range(use.shape[0]):
        if not use[i]:
            continue
        projected, _ = timed_spot(views, i, R, t, m, exposed_after(clocks[camera[i]], uv[i, 1]), at, J, H)
        if not projected:
            continue
        a, b, c, det = inverse_2x2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
        chi2 += add_spot(L, g, H, a, b, c, uv[i, 0] - at[0], uv[i, 1] - at[1])
        log_det += np.log(det) + 2 * np.log(2 * np.pi)
        count += 1
    return L, g, chi2, count, log_det


@compiled
def add_spot(L: Array, g: Array, H: Array, a: float, b: float, c: float, y0: float, y1: float) -> float:
    """Add a spot to the normal matrix L (s, s) and the vector g (s,), in place; returns its chi-square.

    H (2, s): its Jacobian; a, b, c: entries of the inverse of its covariance; y0, y1: its residual, px.
    """
    z0, z1 = a * y0 + b * y1, b * y0 + c * y1
    for j in range(H.shape[1]):
        x0, x1 = a * H[0, j] + b * H[1, j], b * H[0, j] + c * H[1, j]
        g[j] += H[0, j] * z0 + H[1, j] * z1
        for k in range(H.shape[1]):
            L[j, k] += x0 * H[0, k] + x1 * H[1, k]
    return y0 * z0 + y1 * z1
