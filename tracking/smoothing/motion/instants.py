"""The instants of a run's labelled spots, between those of its frames.

Cameras with clocks of their own show the vehicle at other instants than those of the frames. There the motion is
estimated at the instants of the frames and of all labelled spots: each spot is about the pose at its own instant, and
what the motion leaves open between that and the frame is one unknown for all spots of a picture. Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.models.motion import state_after
from tracking.smoothing.motion.run_detections import Delays, Reference, WholeRun

# Of the usual step between two frames: spots as close as this share an instant. Each is projected at its own time,
# with the velocities of the instant at the last reference. Where these are open, as in a turn between two cameras'
# pictures, they follow from the poses at instants as far apart as that, and farther apart each step would make the
# error of the last one larger.
TOGETHER = 0.01


@dataclass(frozen=True, slots=True)
class Instants:
    """F instants of T frames, in order."""

    t_s: Array  # (F,)
    of_frame: Ints  # (T,) which of them are those of the frames
    frame: Ints  # (F,) the frame to which each belongs
    run: WholeRun  # the same run with its labelled detections at these instants ...
    assigned: Ints  # (F, n) ... and their labels

    @staticmethod
    def of(run: WholeRun, assigned: Ints, used: Bools) -> Instants:
        """The instants of the labels (T, n) of the used frames (T,)."""
        delays, seen = run.delays, run.detections
        assert delays is not None
        frames_s, step_s = np.cumsum(run.dt), usual_step(run.dt)
        k, view = np.nonzero((assigned >= 0) & used[:, None])
        chosen = assigned[k, view]
        rows = seen.begin[k] + chosen % BLENDED
        at_s = frames_s[k] + delays.after_s[rows]
        node_s = np.round(at_s / (TOGETHER * step_s)) * TOGETHER * step_s
        frame = _nearest(frames_s, node_s)
        # Steps much shorter than the others would be lost in rounding.
        node_s = np.where(np.abs(node_s - frames_s[frame]) < 0.5 * TOGETHER * step_s, frames_s[frame], node_s)
        t_s, index = np.unique(np.concatenate([frames_s, node_s]), return_inverse=True)
        of_frame, of_spot = index[: len(frames_s)], index[len(frames_s) :]
        order = np.argsort(of_spot, kind="stable")
        rows, of_spot = rows[order], of_spot[order]
        begin = np.searchsorted(of_spot, np.arange(len(t_s) + 1))
        labels = np.full((len(t_s), assigned.shape[1]), -1, dtype=np.int64)
        labels[of_spot, view[order]] = np.arange(len(rows)) - begin[of_spot] + chosen[order] // BLENDED * BLENDED
        detections = seen._replace(
            uv=seen.uv[rows], cov=seen.cov[rows], blend_px=seen.blend_px[rows], size_px=seen.size_px[rows], begin=begin,
        )  # fmt: skip
        own = Delays(at_s[order] - t_s[of_spot], delays.row_time_s[rows], delays.sigma_s[rows], delays.clocks[:0])
        whole = replace(run, detections=detections, delays=own, dt=np.diff(t_s, prepend=t_s[:1]))
        return Instants(t_s, of_frame, _nearest(frames_s, t_s), whole, labels)


def usual_step(dt: Array) -> float:
    """The median of the steps (T,) between frames, s."""
    return float(np.median(dt[dt > 0])) if np.any(dt > 0) else 1.0


def _nearest(at_s: Array, t_s: Array) -> Ints:
    """(m,): which of the times at_s (T,), in order, is nearest to each of t_s (m,)."""
    after = np.clip(np.searchsorted(at_s, t_s), 1, max(len(at_s) - 1, 1))
    last = len(at_s) - 1
    return np.minimum(np.where(t_s - at_s[after - 1] < at_s[np.minimum(after, last)] - t_s, after - 1, after), last)


def motion_at(ref: Reference, at_s: Array, t_s: Array) -> Reference:
    """A motion (T,) of the times at_s (T,) at other times t_s (F,): each from the nearest of the former."""
    nearest = _nearest(at_s, t_s)
    return _moved(Reference(*(np.ascontiguousarray(a[nearest]) for a in ref)), t_s - at_s[nearest])


@compiled
def _moved(ref: Reference, after_s: Array) -> Reference:
    out = Reference(ref.R.copy(), ref.t.copy(), ref.m.copy())
    for k in range(after_s.shape[0]):
        R, t, m = state_after(ref.R[k], ref.t[k], ref.m[k], after_s[k])
        out.R[k], out.t[k], out.m[k] = R, t, m
    return out
