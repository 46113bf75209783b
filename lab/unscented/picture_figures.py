"""Rows and figure of the part of the study of Fu (2016) that uses pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import ORANGE, VERMILLION, picture_uri
from lab.study.comparison import ComparisonRow, Figure
from lab.unscented.experiment_fu2016 import FILTERS, FROM_S, simulate
from lab.unscented.picture_experiment import PictureRun
from lab.unscented.tanker_pictures import CLEAR, GUST, marker_model, pose_of, render
from tracking.corner_markers.harris import harris_corners
from tracking.corner_markers.matching import match_markers
from tracking.detections import UNMATCHED

_SETTLED_S = 1.0
_SHOWN_PX = (420, 180)  # size of the part of a picture that is shown


def picture_rows(runs: dict[str, PictureRun]) -> list[ComparisonRow]:
    """The rows; runs: one recording of pictures through the filters of these names."""

    def row(quantity: str, unit: str, paper: float | None, of: dict[str, float], note: str = "") -> ComparisonRow:
        return ComparisonRow(f"pictures: {quantity}", unit, paper, tuple(of.get(n) for n in FILTERS), note)

    quiet = {n: ~r.gust & (r.t_s > _SETTLED_S) for n, r in runs.items()}
    seen = {n: np.isfinite(r.single[:, 0]) for n, r in runs.items()}
    out = [
        row(
            "clear ones with a pose", "%", None, {n: 100 * float(seen[n][~r.gust].mean()) for n, r in runs.items()},
            "four or five lamps agree with one pose, and no other labels do",
        ),
        row("wrong labels, all pictures", "", None, {n: float(r.wrong.sum()) for n, r in runs.items()}),
    ]  # fmt: skip
    if any(r.gust.any() for r in runs.values()):
        with_pose = {n: 100 * float(seen[n][r.gust].mean()) for n, r in runs.items()}
        out.append(row("disturbed ones with a pose", "%", None, with_pose, "blur, 16 false lights, hidden lamps"))
    for quantity, of, unit, scale in (
        ("range x", [0], "m", 1.0),
        ("position y, z", [1, 2], "m", 1.0),
        ("yaw, pitch", [6, 7], "deg", float(np.rad2deg(1.0))),
    ):
        rms = {n: scale * float(np.sqrt(np.mean(r.error[quiet[n]][:, of] ** 2))) for n, r in runs.items()}
        out.append(row(f"quiet RMS, {quantity}", unit, None, rms, "the pose observes all eight numbers of the state"))
    if any(r.gust.any() for r in runs.values()):
        largest = {n: float(np.abs(r.error[r.gust][:, :3]).max()) for n, r in runs.items()}
        out.append(row("largest position error, 6 to 8 s", "m", 0.1, largest, "x, y, z; the paper: within 10 cm"))
    return out


def picture_figure(seed: int, run: PictureRun) -> Figure:
    """A clear and a disturbed picture with corners and lamps, and the errors over time."""
    panels = [_shown(seed, False), _shown(seed, True)]
    shade = (Shade(run.gust, "predicted", "disturbed"),)
    for column, single, title in ((0, 0, "x"), (1, 1, "y")):
        lines = (
            Line(run.single[:, single], ORANGE, "pose of one picture"),
            Line(run.error[:, column], VERMILLION, "filter"),
        )
        panels.append(
            time_panel(run.t_s, f"{title}: estimate − true", "m", lines=lines, shades=shade, y_range=(-0.1, 0.1))
        )
    return Figure(
        "Pose from pictures: Harris corners and RANSAC (Figs. 2 and 3)",
        "Rendered pictures of a tanker with two lamps on the wing and three on the fuselage, 640 x 512 pixels, f = 500"
        " px. Circles: corners; squares: those that RANSAC assigns to lamps. Left: clear. Right: disturbed. Below:"
        " orange: pose of each picture; red: Student-t filter. Pictures without a safe pose have no orange value.",
        "".join(panels),
    )


def _shown(seed: int, disturbed: bool) -> str:
    """The part of a rendered picture around the tanker with its corners, as an img element."""
    recording = simulate(seed, 0, "none")
    state = recording.states[int(np.argmin(np.abs(recording.t_s - (FROM_S if disturbed else 1.0))))]
    rng = np.random.default_rng([seed, 73])
    grey = render(state, GUST if disturbed else CLEAR, rng)
    corners = harris_corners(grey).uv_px
    match = match_markers(marker_model(), corners, pose_of(state), rng)
    picture: Any = cv2.cvtColor(cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR)
    for u, v in (2 * corners + 0.5).round().astype(int).tolist():
        cv2.circle(picture, (u, v), 9, (80, 200, 255), 1, cv2.LINE_AA)
    matched = [] if match is None else match.rows[match.rows != UNMATCHED].tolist()
    for u, v in (2 * corners[matched] + 0.5).round().astype(int).tolist():
        cv2.rectangle(picture, (u - 12, v - 12), (u + 12, v + 12), (80, 220, 80), 1, cv2.LINE_AA)
    middle = marker_model().project(pose_of(state))[0].mean(axis=0)
    left, top = (2 * middle - np.array(_SHOWN_PX)).round().astype(int).tolist()
    left, top = (int(np.clip(at, 0, n - 2 * size)) for at, n, size in zip(
        (left, top), (picture.shape[1], picture.shape[0]), _SHOWN_PX, strict=True))  # fmt: skip
    part = picture[top : top + 2 * _SHOWN_PX[1], left : left + 2 * _SHOWN_PX[0]]
    jpeg = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    word = "disturbed" if disturbed else "clear"
    return f'<img src="{picture_uri(jpeg, "jpeg")}" width="100%" alt="{word} picture with corners and lamps">'
