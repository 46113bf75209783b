"""Figures of a run report: errors and residuals, the spots' statuses and their tracks (Huo 2015, Fig. 8), the motion.

Pose, velocity and angular rate over time have the value on the left, the uncertainty on the right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from lab.files.run.results import POSE_STATUSES, SPOT_STATUSES, PoseTrack
from lab.report.plot import svg
from lab.report.plot.series import Band, Line, Shade, ZoomData, time_data, time_panel, time_scale, time_ticks, unwrapped
from lab.report.run.report_data import ReportData
from lab.runs.verdict.score import differenced, normalised_squares
from tracking.statuses import PoseStatus, SpotStatus

U_COLOUR, V_COLOUR = svg.BLUE, svg.VERMILLION
_RMS_HEIGHT = 180


def pose_shades(m: ReportData) -> tuple[Shade, ...]:
    """The frames with a predicted or lost pose."""
    return (
        Shade(m.poses.has(PoseStatus.PREDICTED), "predicted", "pose predicted, not measured"),
        Shade(m.poses.has(PoseStatus.LOST), "lost", "pose lost"),
    )


def _of_poses(m: ReportData, zoom: ZoomData | None) -> partial[str]:
    """A `time_panel` over the times of the poses, with their statuses."""
    t = m.poses.t_s if m.time_name != "frame" else m.poses.frames.astype(float)
    return partial(time_panel, t, shades=pose_shades(m), time_name=m.time_name, zoom=zoom, row=0)


def nees_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """The normalised estimation error squared over time; empty without truth."""
    delta = m.pose_errors
    if delta is None:
        return ""
    nees = normalised_squares(delta, m.poses.covariance)
    if not np.isfinite(nees).any():
        return ""
    return nees_panel(nees, partial(_of_poses(m, zoom), width=1090, height=140))


def nees_panel(nees: Array, panel: Callable[..., str]) -> str:
    """The normalised estimation errors squared (n,) of poses over time; panel: a `time_panel` with its times."""
    n = np.ones(len(nees))
    usual = nees[np.isfinite(nees)]
    top = max(25.0, min(float(usual.max()) * 1.08, 2.0 * float(np.percentile(usual, 99))))
    # Chi-squared with 6 degrees of freedom lies in 1.237 .. 14.449 with a probability of 95 %.
    return panel(
        "NEES: squared pose error over its covariance; mean 6 if the stated uncertainty is correct, band: 95 %",
        "",
        lines=(Line(nees, svg.BLUE, "NEES", 0.8), Line(6.0 * n, svg.GREEN, "6, the expected mean", 1.4, "6 4")),
        bands=(Band(1.237 * n, 14.449 * n, svg.GREEN, "95 % of the frames if the covariance is correct", 0.15),),
        y_range=(0.0, top),
    )


def view_shades(m: ReportData, j: int) -> tuple[Shade, ...]:
    """The frames in which the position of view j is not measured."""
    status = (SpotStatus.OUT_OF_VIEW, "outside"), (SpotStatus.OCCLUDED, "predicted"), (SpotStatus.NO_IMAGE, "lost")
    shades = [Shade(m.spots.has(s)[:, j], css, f"{s}: {s.meaning_for(m.summary.method)}") for s, css in status]
    return (*shades, Shade(m.spots.has(SpotStatus.LOST)[:, j], "lost", "lost"))


def error_grid(m: ReportData, columns: tuple[tuple[str, Array], ...], zoom: ZoomData | None = None) -> str:
    """A row of panels for each view: u and v of the named errors (F, V, 2), px, over time; one y scale per column."""
    out = []
    shown = [j for j in range(len(m.spots.views)) if any(np.isfinite(e[:, j]).any() for _, e in columns)]
    ranges = [svg.robust_range(e[:, shown], 0.5) if shown else (-1.0, 1.0) for _, e in columns]
    for j in shown:
        camera, spot = m.spots.views[j]
        last = j == shown[-1]
        panel = partial(
            time_panel, m.t_s, shades=view_shades(m, j), height=128 if last else 104, with_time=last,
            time_name=m.time_name, zoom=zoom, row=1 + j,
        )  # fmt: skip
        for (name, errors), y_range in zip(columns, ranges, strict=True):
            lines = tuple(
                Line(errors[:, j, k], colour, f"spot {spot}, {'uv'[k]}: {name}", 0.9)
                for k, colour in enumerate((U_COLOUR, V_COLOUR))
            )
            out.append(panel(title=f"spot {spot} ({camera}): {name}", unit="px", lines=lines, y_range=y_range))
    return "".join(out)


def truth_columns(m: ReportData) -> tuple[tuple[str, Array], ...]:
    """Prediction error and tracking error (Huo 2015, Figs. 5 to 7, 9, 12 and 13)."""
    if m.truth is None or m.truth.uv_px is None:
        return ()
    return (
        ("predicted \u2212 true", m.spots.predicted_px - m.truth.uv_px),
        ("estimate \u2212 true", m.spots.uv_px - m.truth.uv_px),
    )


def residual_columns(m: ReportData) -> tuple[tuple[str, Array], ...]:
    """Innovation, and residual where the rig is known."""
    columns: tuple[tuple[str, Array], ...] = (("measured \u2212 predicted", m.innovation_px),)
    if m.residual_px is not None:
        columns += (("measured \u2212 from the pose", m.residual_px),)
    return columns


def rms_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """The residual RMS of the pose over time, and a histogram of the residuals."""
    p = m.poses
    if not np.isfinite(p.rms_px).any():
        return ""
    top = min(1.08 * float(np.nanmax(p.rms_px)), 4.0 * float(np.nanpercentile(p.rms_px, 99)))
    over_time = _of_poses(m, zoom)(
        "residual of the pose, RMS over the spots used",
        "px",
        lines=(Line(p.rms_px, svg.BLUE, "rms_px of attitude.csv", 0.9),),
        y_range=(0.0, max(top, 1e-6)),
        height=_RMS_HEIGHT,
    )
    if m.residual_px is None:
        limits = 0.0, max(float(np.nanpercentile(p.rms_px, 99.5)) * 1.2, 1e-9)
        return over_time + _counts(p.rms_px, limits, "residual of the pose, RMS", "RMS (px)", 0.0)
    sigma = float(np.sqrt(m.residual_share or 0.0))
    title = "residual over the stated \u03c3; curve: expected after the fit of the pose"
    return over_time + _counts(m.residual_px / m.spots.sigma_px, (-5.0, 5.0), title, "residual (\u03c3)", sigma)


def _counts(values: Array, limits: tuple[float, float], title: str, x_name: str, sigma: float) -> str:
    """A histogram with the number of values within and beyond its limits."""
    finite = values[np.isfinite(values)]
    beyond = int(((finite < limits[0]) | (finite > limits[1])).sum())
    words = f"{finite.size} values, {beyond} of them beyond the axis"
    return svg.histogram(values, limits, title, x_name, sigma=sigma, footnote=words, bins=50, height=_RMS_HEIGHT)


_CAUSAL_WIDTH = 0.6


@dataclass(frozen=True, slots=True)
class _Curve:
    """One component of pose or motion over F frames."""

    name: str
    unit: str
    small_unit: str  # a thousandth of `unit`, used for uncertainties up to ...
    large: float  # ... this value, in `unit`
    value: Array  # (F,)
    sigma: Array  # (F,)
    error: Array | None  # (F,) estimate minus truth
    causal: Array | None  # (F,) error of the causal filter, or its difference to `value` where there is no truth


def pose_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """Attitude and position over time beside their uncertainty; empty where no pose is known."""
    p = m.poses
    if not p.known.any():
        return ""
    true = None if m.truth is None else m.truth.world_from_body
    errors, causal = _minus(p, true), _causal(m, true)
    values = np.concatenate([unwrapped(p.yaw_pitch_roll_deg), p.world_from_body.translation], axis=1)
    sigmas = np.concatenate([p.sigma_ypr_deg, p.sigma_position_m], axis=1)
    names, units = ("yaw", "pitch", "roll", "x", "y", "z"), (("deg", "mdeg", 1.0), ("m", "mm", 0.1))
    return _rows(m, zoom, names, units, values, sigmas, errors, causal)


def motion_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """Velocity and angular rate beside their uncertainty; empty where neither is known.

    Truth: differences of the true poses.
    """
    values, sigmas = _motion(m.poses)
    if not np.isfinite(values).any():
        return ""
    errors = None
    if m.truth is not None and m.truth.world_from_body is not None:
        errors = values - differenced(m.truth.world_from_body, m.poses.t_s)[0]
    names = [f"{what} {axis}" for what in ("velocity", "rate") for axis in "xyz"]
    causal = None  # ten times as uncertain: it would cover the other curves
    return _rows(m, zoom, names, (("m/s", "mm/s", 1.0), ("rad/s", "mrad/s", 1.0)), values, sigmas, errors, causal)


def _motion(p: PoseTrack) -> tuple[Array, Array]:
    """Velocity (m/s) and rate (rad/s) side by side, (F, 6), and their sigmas."""
    both = [p.velocity_m_s, p.rate_rad_s], [p.sigma_velocity_m_s, p.sigma_rate_rad_s]
    return np.concatenate(both[0], axis=1), np.concatenate(both[1], axis=1)


def _causal(m: ReportData, true: Pose | None) -> Array | None:
    """(F, 6) as `_minus`: causal minus true poses (smoothed ones without truth); None without causal poses."""
    return None if m.causal is None else _minus(m.causal, m.poses.world_from_body if true is None else true)


def _minus(poses: PoseTrack, true: Pose | None) -> Array | None:
    """(F, 6): yaw, pitch, roll (deg, wrapped) and x, y, z (m), estimate minus truth; None without truth."""
    if true is None:
        return None
    ypr = poses.yaw_pitch_roll_deg - np.degrees(rotations.ypr_from_matrix(true.rotation))
    ypr = (ypr + 180.0) % 360.0 - 180.0
    shift = poses.world_from_body.translation - true.translation
    return np.concatenate([np.where(np.isfinite(shift[:, :1]), ypr, np.nan), shift], axis=1)


def _rows(
    m: ReportData,
    zoom: ZoomData | None,
    names: Sequence[str],
    units: tuple[tuple[str, str, float], tuple[str, str, float]],
    values: Array,
    sigmas: Array,
    errors: Array | None,
    causal: Array | None,
) -> str:
    """A row of two panels for each of six components (F, 6); units: `_Curve`'s, of the first and the last three."""
    measured, rows = m.poses.has(PoseStatus.MEASURED), []
    for i, name in enumerate(names):
        known = (None if found is None else found[:, i] for found in (errors, causal))
        curve = _Curve(name, *units[i // 3], values[:, i], sigmas[:, i], *known)
        rows.append(_row(m, zoom, curve, measured, i == len(names) - 1))
    return "".join(rows)


def _row(m: ReportData, zoom: ZoomData | None, c: _Curve, measured: Bools, last: bool) -> str:
    """Two panels: the value with its band, and the uncertainty with the known errors."""
    panel = partial(_of_poses(m, zoom), height=128 if last else 104, with_time=last)
    value = panel(
        c.name,
        c.unit,
        lines=(Line(c.value, svg.BLUE, c.name, 1.3),),
        bands=(Band.about(c.value, c.sigma, 3.0, svg.SKY, "\u00b13\u03c3", 0.45),),
        # Only the bands of measured poses set the range: that of a long prediction would flatten the rest.
        y_range=svg.padded_range(
            np.concatenate([c.value, (c.value - 3 * c.sigma)[measured], (c.value + 3 * c.sigma)[measured]])
        ),
        fit=True,
    )
    shown = c.sigma[measured] if measured.any() else c.sigma
    unit, factor = (c.unit, 1.0) if np.nanmax(shown, initial=0.0) > c.large else (c.small_unit, 1000.0)
    limit = 1.25 * svg.robust_range(3 * factor * shown)[1]
    lines: list[Line] = []
    reference = "truth" if c.error is not None else "smoothed"
    for errors, colour, width, name in (
        (c.causal, svg.GREY, _CAUSAL_WIDTH, f"{c.name}: causal minus {reference}"),
        (c.error, svg.VERMILLION, 0.9, f"{c.name}: estimate minus truth"),
    ):
        if errors is not None:
            lines.append(Line(factor * errors, colour, name, width))
            if np.isfinite(errors[measured]).any():
                limit = max(limit, svg.robust_range(factor * errors[measured])[1])
    uncertainty = panel(
        f"{c.name}: \u00b1\u03c3, \u00b13\u03c3" + (" and error" if c.error is not None else ""),
        unit,
        lines=tuple(lines),
        bands=(
            Band.about(0.0, c.sigma, 3 * factor, svg.SKY, "\u00b13\u03c3", 0.35),
            Band.about(0.0, c.sigma, factor, svg.BLUE, "\u00b1\u03c3", 0.35),
        ),
        y_range=(-limit, limit),
    )
    return value + uncertainty


TRACK_COLOURS = (svg.BLUE, svg.VERMILLION, svg.GREEN, svg.PURPLE, svg.ORANGE, svg.SKY, "#6b4c9a", "#7a5c2e")
_BEYOND = 0.75  # how far outside the picture tracks are drawn, in picture sizes
_MOST_POINTS = 3000  # of a drawn track
_MOST_TURNS = 60  # marked turns of a spot


def tracks_figure(m: ReportData, camera: str, zoom: ZoomData | None = None) -> str:
    """The tracks of a camera's spots in pixels with the edge of the picture; parts outside it are dashed."""
    views = m.spots.views_of(camera)
    uv = m.spots.uv_px[:, views]
    if not np.isfinite(uv).any():
        return ""
    size = m.picture_sizes.get(camera)
    p, picture = _track_plane(uv, m.spots.measured[:, views], size)
    left, top, wide, high = p.box
    clip = f"clip-{m.spots.cameras.index(camera)}"
    out = [f'<clipPath id="{clip}"><rect x="{left}" y="{top}" width="{wide:.1f}" height="{high:.1f}"/></clipPath>']
    if size is not None:
        (x0, y0), (x1, y1) = p.at(picture).tolist()
        out.append(
            f'<rect class="picture" x="{x0:.1f}" y="{y0:.1f}" width="{x1 - x0:.1f}" height="{y1 - y0:.1f}">'
            f"<title>the picture, {size[0]} × {size[1]} px</title></rect>"
        )
    out.append(f'<g clip-path="url(#{clip})">')
    labels, starts = [], []
    for i, j in enumerate(views):
        colour = TRACK_COLOURS[i % len(TRACK_COLOURS)]
        at = p.at(uv[:, i])
        out += _track(m, j, at, colour)
        inside = np.all((at > [left, top]) & (at < [left + wide, top + high]), axis=1)  # False for nan
        if inside.any():
            x, y = at[int(np.argmax(inside))].tolist()
            labels.append((x, y, m.spots.views[j][1]))
            starts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>first position</title></circle>'
            )
    out += ["</g>", *starts, *svg.names(labels, p)]
    low, high_uv = np.array([p.X.lo, p.Y.lo]), np.array([p.X.hi, p.Y.hi])
    beyond = bool(np.any(np.isfinite(uv) & ((uv < low) | (uv > high_uv))))
    words = f"camera {camera}" + (" (parts of the tracks lie outside this drawing)" if beyond else "")
    out += [*svg.axes(p, words, "u (px)", "v (px)", grid=False), svg.frame(p, closed=False)]
    data = "" if zoom is None else _track_data(p, uv, zoom)
    return svg.figure(p.width, p.height, f"Tracks of the spots in the picture of camera {camera}", out, data=data)


def _track_data(p: svg.PlotArea, uv: Array, zoom: ZoomData) -> str:
    """The attributes from which cursor.js marks the places of the spots at the cursor: uv (F, n, 2), px."""
    names = [zoom.add(uv[:, i, axis]) for i in range(uv.shape[1]) for axis in (0, 1)]
    if None in names:
        return ""
    colours = [TRACK_COLOURS[i % len(TRACK_COLOURS)] for i in range(uv.shape[1])]
    scales = [s for scale in (p.X, p.Y) for s in (scale.lo, scale.hi, scale.a, scale.b)]
    return (
        f' data-map="{" ".join(f"{float(s):.6g}" for s in scales)}" data-uv="{" ".join(map(str, names))}"'
        f' data-colours="{" ".join(colours)}"'
    )


def _track_plane(uv: Array, measured: Bools, size: tuple[int, int] | None) -> tuple[svg.PlotArea, Array]:
    """The plot area for positions (F, n, 2), px, and the corners (2, 2) of the picture.

    Without a rig (size None) the edge of the picture is unknown, and the measured positions stand for it.
    """
    if size is None:
        lo, hi = (f(uv[measured] if measured.any() else uv.reshape(-1, 2), axis=0) for f in (np.nanmin, np.nanmax))
    else:
        lo, hi = np.array([-0.5, -0.5]), np.array(size) - 0.5
    margin = _BEYOND * (hi - lo) + 1.0
    low = np.maximum(np.minimum(np.nanmin(uv, axis=(0, 1)), lo), lo - margin) - 0.03 * (hi - lo) - 1.0
    high = np.minimum(np.maximum(np.nanmax(uv, axis=(0, 1)), hi), hi + margin) + 0.03 * (hi - lo) + 1.0
    p = svg.plot_area((low[0], high[0]), (low[1], high[1]), equal=True, y_down=True, bottom=38, tallest=420)
    return p, np.stack([lo, hi])


def _track(m: ReportData, j: int, at: Array, colour: str) -> list[str]:
    """The track of view j through drawing coordinates (F, 2), by status, with circles at its turns."""
    spot = m.spots.views[j][1]
    parts = (
        (m.spots.measured[:, j], "", 1.5, "measured"),
        (m.spots.has(SpotStatus.OCCLUDED, SpotStatus.NO_IMAGE)[:, j], "1.5 2.5", 1.5, "estimate"),
        (m.spots.has(SpotStatus.OUT_OF_VIEW)[:, j], "6 4", 1.2, "out of view, from the other spots"),
    )
    out = []
    for where, dash, thick, name in parts:
        d = _thinned_path(at[:, 0], at[:, 1], where)
        if d:
            dashes = f' stroke-dasharray="{dash}"' if dash else ""
            out.append(
                f'<path class="line" d="{d}" stroke="{colour}" stroke-width="{thick}"{dashes}>'
                f"<title>{escape(f'spot {spot}: {name}')}</title></path>"
            )
    turned = np.flatnonzero(m.spots.has(SpotStatus.TURNED)[:, j])
    return out + [
        f'<circle class="turn" cx="{at[k, 0]:.1f}" cy="{at[k, 1]:.1f}" r="3" stroke="{colour}">'
        f"<title>{escape(f'spot {spot} turned, frame {m.spots.frames[k]}')}</title></circle>"
        for k in turned[:: max(1, -(-len(turned) // _MOST_TURNS))]
    ]


def _thinned_path(x: Array, y: Array, where: Bools) -> str:
    """The path through drawing coordinates (F,) where `where`, without points that coincide with the one before."""
    near = where.copy()
    near[1:] |= where[:-1]  # each part includes its neighbours, so that the track has no gaps
    near[:-1] |= where[1:]
    x, y = np.where(near, x, np.nan), np.where(near, y, np.nan)
    step = 0.5
    cell = np.stack([np.round(x / step), np.round(y / step)], -1)
    same = np.zeros(len(x), dtype=bool)
    same[1:] = np.all((cell[1:] == cell[:-1]) | (np.isnan(cell[1:]) & np.isnan(cell[:-1])), axis=-1)
    x, y = x[~same], y[~same]
    if len(x) > _MOST_POINTS:  # keeps the extremes of each interval in both directions
        wide = -(-len(x) // (_MOST_POINTS // 4))
        starts = range(0, len(x), wide)
        keep: list[int] = []
        for s in starts:
            u, v = x[s : s + wide], y[s : s + wide]
            if np.isfinite(u).any():
                keep += sorted({s + int(f(a)) for a in (u, v) for f in (np.nanargmin, np.nanargmax)})
                gaps = np.flatnonzero(np.isnan(u))
                if len(gaps):
                    keep = sorted({*keep, s + int(gaps[0])})
            else:
                keep.append(s)
        x, y = x[keep], y[keep]
    return svg.line_path(x, y)


def _status_rows(m: ReportData) -> list[tuple[str, Ints, list[tuple[str, str]]]]:
    """Name, status codes (F,), and the words and colours of the codes: of the pose, and of each view."""
    pose_words = [(str(s), svg.POSE_COLOURS[s]) for s in POSE_STATUSES]
    spot_words = [(str(s), svg.SPOT_COLOURS[s]) for s in SPOT_STATUSES]
    rows: list[tuple[str, Ints, list[tuple[str, str]]]] = []
    if len(m.poses.frames) == len(m.spots.frames):
        rows.append(("pose", m.poses.status, pose_words))
    return rows + [(f"{c} / {s}", m.spots.status[:, j], spot_words) for j, (c, s) in enumerate(m.spots.views)]


def zoom_data(m: ReportData) -> ZoomData | None:
    """An empty store with the statuses: row 0 of the pose, then one per view; None where the tables disagree."""
    if not len(m.spots.frames) or not np.array_equal(m.poses.frames, m.spots.frames):
        return None
    zoom = ZoomData(m.t_s, m.spots.frames)
    for name, codes, words in _status_rows(m):
        zoom.add_row(name, codes, words)
    return zoom


def timeline_figure(m: ReportData) -> str:
    """A strip of colours for the pose and for each view: its status over time."""
    n = len(m.spots.frames)
    left, right, row = 128.0, 985.0, 19.0
    n_columns = min(n, int(right - left))
    column = np.arange(n) * n_columns // max(n, 1)
    size = np.bincount(column, minlength=n_columns)
    rows = _status_rows(m)
    names: list[str] = []
    out, y = ['<g class="whole">'], 8.0
    tops = []
    for name, status, words in rows:
        tops.append(f"{y:.0f}")
        names.append(svg.text(left - 8, y + 13, name if len(name) <= 20 else name[:19] + "…", "end"))
        measured = int(np.isin(status, [0] if name == "pose" else [0, 1]).sum())
        below = np.zeros(n_columns)
        for code, (word, colour) in enumerate(words):
            count = np.bincount(column[status == code], minlength=n_columns)
            share = count / size
            if count.any():
                d = _strip(share, below, left, (right - left) / n_columns, y, row - 4)
                title = escape(f"{name}: {word} in {count.sum()} of {n} frames")
                out.append(f'<path d="{d}" fill="{colour}"><title>{title}</title></path>')
            below += share
        names.append(svg.text(right + 8, y + 13, f"{100 * measured / max(n, 1):.1f} % measured"))
        y += row + (6 if name == "pose" else 0)
    X = time_scale(m.t_s, left, right)
    X = time_scale(m.t_s, left, right, 0.5 * (X.hi - X.lo) / max(n - 1, 1))
    p = svg.PlotArea(X, svg.Scale(0, 1, y + 1, 8), 1110, y + 24)
    out += [time_ticks(p, m.time_name), "</g>", *names]
    data = f'{time_data(X)} data-tops="{" ".join(tops)}" data-high="{row - 4:.0f}" data-name="{m.time_name}"'
    data += f' data-y="0 1 {y + 1:.0f} 8"'
    return svg.figure(p.width, p.height, "Status of the pose and of every spot over time", out, data=data)


def _strip(share: Array, below: Array, left: float, wide: float, top: float, height: float) -> str:
    """One status of one strip: boxes with the height of its share of each column; equal neighbours are joined."""
    d = []
    change = np.flatnonzero((np.diff(share) != 0) | (np.diff(below) != 0)) + 1
    edges = np.concatenate([[0], change, [len(share)]])
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if share[a] > 0:
            tall = max(height * float(share[a]), 0.8)
            y = top + height * float(below[a])
            d.append(f"M{left + a * wide:.1f} {y:.1f}h{(b - a) * wide:.2f}v{tall:.1f}h{-(b - a) * wide:.2f}z")
    return "".join(d)
