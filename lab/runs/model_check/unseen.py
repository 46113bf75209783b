"""Spots that should be in the picture and are hardly ever measured there.

A laser that points far elsewhere leaves no residual: the tracker takes its light for clutter, and the spot counts as
hidden. Measured: 0.1 deg of a beam with one spot only, and nothing else told of it.
"""

from __future__ import annotations

from dataclasses import dataclass

from calibration.findings import Finding, Level
from geometry.arrays import Ints
from geometry.forward_model import SpotModel
from lab.runs.model_check.recording import ModelCheckRecording

MOSTLY_UNSEEN = 0.2  # measured in less than this share of the frames
FEWEST_FRAMES = 30  # in which it should be seen: a shorter time behind a post is no fault
_INSIDE_PX = 20.0  # of the picture's edge: a whole spot is seen there, also if its place is somewhat wrong


@dataclass(frozen=True, slots=True)
class Unseen:
    """A view that is hardly ever measured."""

    view: int
    measured: int  # frames
    expected: int  # frames in which the pose puts it well inside the picture


def unseen_views(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> tuple[Unseen, ...]:
    """Of the given frames, which all have a pose from other spots."""
    pixels = model.project(recording.poses[frames])[0]
    inside = model.in_picture(pixels, -_INSIDE_PX)
    expected = inside.sum(axis=0)
    measured = (inside & recording.seen[frames]).sum(axis=0)
    return tuple(
        Unseen(i, int(measured[i]), int(expected[i]))
        for i in range(len(model))
        if expected[i] >= FEWEST_FRAMES and measured[i] < MOSTLY_UNSEEN * expected[i]
    )


def unseen_finding(unseen: Unseen, model: SpotModel) -> Finding:
    """In words."""
    camera, spot = model.views[unseen.view]
    return Finding(
        Level.WARN,
        f"spot {spot} in camera `{camera}` was measured in {unseen.measured} of {unseen.expected} frames in which the"
        " pose puts it well inside the picture",
        "its laser is off or hidden, or points so far elsewhere that its light is taken for clutter; the pose is made"
        " without it",
        "Look at the pictures where that spot should be; then check its laser's mount, or calibrate the beams again.",
    )
