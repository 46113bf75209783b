"""The overlay video shows each kind of target where its table says that it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.targets.circle import CircleTarget
from lab.targets.drogue import DrogueTarget
from lab.targets.point import PointFrame, PointTarget
from lab.targets.recording import Recording
from lab.targets.target import Track
from lab.targets.track import drawn
from tracking.drogue_circle import tracker as circles
from tracking.light_tracker import frames as drogues
from tracking.single_target.point_tracker import NOTHING
from tracking.statuses import Cause, PoseStatus

CENTRE, RADIUS, SCALE = np.array([80.0, 90.0]), 24.0, 0.5
SEEN = {"status": PoseStatus.MEASURED}
STATE = np.array([*CENTRE, RADIUS, 0, 0, 0])
KINDS = {
    "circle": (CircleTarget, replace(circles.nothing_known(Cause.NONE), **SEEN, state=STATE)),
    "drogue": (
        DrogueTarget,
        replace(drogues.nothing_known(Cause.NONE), **SEEN, centre_px=CENTRE, diameter_px=2 * RADIUS),
    ),
    "point": (
        PointTarget,
        PointFrame(replace(NOTHING, **SEEN, x=STATE[[0, 1, 3, 4]], P=np.eye(4) * (RADIUS / 3) ** 2), None),
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_outline_has_the_radius_of_the_target_or_three_sigma_of_a_point(kind):
    target, frame = KINDS[kind]
    recording = Recording("r", Path("r"), 25.0, np.array([7]), np.array([0.28]), (240, 200))
    image = drawn(np.zeros((100, 120), np.uint8), target(), Track(recording, [frame], 0.0), 0, np.full(2, SCALE))
    v, u = np.nonzero(image[30:].max(axis=2))  # below the label
    place = (CENTRE + 0.5) * SCALE - 0.5
    away = np.hypot(u - place[0], v + 30 - place[1])
    assert away.max() == pytest.approx(RADIUS * SCALE, abs=1.5)  # 1 px of line and its blurred edge
    assert np.abs([u.mean() - place[0], v.mean() + 30 - place[1]]).max() < 0.5
