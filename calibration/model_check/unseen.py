"""Spots that should be in the picture but are hardly ever measured.

A beam that points far away from where the rig file says leaves no residual: the tracker takes its spot for clutter, and
the expected spot counts as occluded. Measured: a beam with a single spot, wrong by 0.1 deg, had no other symptom.
"""

from __future__ import annotations

from dataclasses import dataclass

from calibration.model_check.recording import ModelCheckRecording
from geometry.arrays import Ints
from geometry.forward_model import SpotModel

MOSTLY_UNSEEN = 0.2  # a view measured in less than this share of the frames is reported
FEWEST_FRAMES = 30  # in which it is expected: a shorter occlusion is no fault
_INSIDE_PX = (
    20.0  # distance from the picture's edge at which a whole spot is visible, even if its position is not exact
)


@dataclass(frozen=True, slots=True)
class UnseenView:
    """A view that is hardly ever measured."""

    view: int
    measured: int  # frames
    expected: int  # frames in which the pose puts it well inside the picture


def unseen_views(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> tuple[UnseenView, ...]:
    """The unseen views over the given frames (K,), each of which has a pose from other spots."""
    pixels = model.project(recording.poses[frames])[0]
    inside = model.in_picture(pixels, -_INSIDE_PX)
    expected = inside.sum(axis=0)
    measured = (inside & recording.seen[frames]).sum(axis=0)
    return tuple(
        UnseenView(i, int(measured[i]), int(expected[i]))
        for i in range(len(model))
        if expected[i] >= FEWEST_FRAMES and measured[i] < MOSTLY_UNSEEN * expected[i]
    )
