"""Figures of the spots: tracks over the picture (Huo 2015, Fig. 8), statuses over time."""

from __future__ import annotations

from html import escape

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.files.run.results import POSE_STATUSES, SPOT_STATUSES
from lab.report.plot.axes import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    POSE_COLOURS,
    PURPLE,
    SKY,
    SPOT_COLOURS,
    VERMILLION,
    PlotArea,
    Scale,
    axes,
    figure,
    frame,
    line_path,
    plot_area,
    text,
)
from lab.report.plot.series import ZoomData, time_data, time_scale, time_ticks
from lab.report.run.report_data import ReportData
from tracking.statuses import SpotStatus

TRACK_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, "#6b4c9a", "#7a5c2e")
_BEYOND = 0.75  # how far outside the picture tracks are drawn, in picture sizes
_MOST_POINTS = 3000  # of a drawn track
_MOST_TURNS = 60  # marked turns of a spot


def tracks_figure(m: ReportData, camera: str, zoom: ZoomData | None = None) -> str:
    """The tracks of a camera's spots in pixels with the edge of the picture; parts outside it are dashed."""
    views = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
    uv = m.spots.uv_px[:, views]
    if not np.isfinite(uv).any():
        return ""
    size = m.picture_sizes.get(camera)
    p, picture = _track_plane(uv, m.spots.measured[:, views], size)
    left, top, wide, high = p.box
    clip = f"clip-{m.spots.cameras.index(camera)}"
    out = [
        f'<clipPath id="{clip}"><rect x="{left}" y="{top}" width="{wide:.1f}" height="{high:.1f}"/></clipPath>',
    ]
    if size is not None:
        (x0, y0), (x1, y1) = p.at(picture).tolist()
        out.append(
            f'<rect class="picture" x="{x0:.1f}" y="{y0:.1f}" width="{x1 - x0:.1f}" height="{y1 - y0:.1f}">'
            f"<title>the picture, {size[0]} × {size[1]} px</title></rect>"
        )
    out.append(f'<g clip-path="url(#{clip})">')
    labels = []
    for i, j in enumerate(views):
        colour = TRACK_COLOURS[i % len(TRACK_COLOURS)]
        at = p.at(uv[:, i])
        out += _track(m, j, at, colour)
        inside = np.all((at > [left, top]) & (at < [left + wide, top + high]), axis=1)  # False for nan
        if inside.any():
            x, y = at[int(np.argmax(inside))].tolist()
            labels.append((x, y, m.spots.views[j][1], colour))
    out += ["</g>", *_labels(labels)]
    low, high_uv = np.array([p.X.lo, p.Y.lo]), np.array([p.X.hi, p.Y.hi])
    beyond = bool(np.any(np.isfinite(uv) & ((uv < low) | (uv > high_uv))))
    words = f"camera {camera}" + (" (parts of the tracks lie outside this drawing)" if beyond else "")
    out += [*axes(p, words, "u (px)", "v (px)", grid=False), frame(p, closed=False)]
    data = "" if zoom is None else _track_data(p, uv, zoom)
    return figure(p.width, p.height, f"Tracks of the spots in the picture of camera {camera}", out, data=data)


def _track_data(p: PlotArea, uv: Array, zoom: ZoomData) -> str:
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


def _track_plane(uv: Array, measured: Bools, size: tuple[int, int] | None) -> tuple[PlotArea, Array]:
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
    p = plot_area((low[0], high[0]), (low[1], high[1]), equal=True, y_down=True, bottom=38, tallest=420)
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
    return line_path(x, y)


def _labels(labels: list[tuple[float, float, str, str]]) -> list[str]:
    """Names at the first positions, moved down where two would overlap."""
    placed: list[tuple[float, float]] = []
    out = []
    for x, y, spot, colour in labels:
        lx, ly = x + 8, y - 6
        while any(abs(lx - px) < 14 and abs(ly - py) < 14 for px, py in placed):
            ly += 15
        placed.append((lx, ly))
        out.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>first position</title></circle>'
            + text(lx, ly, spot, "label", f"fill:{INK}")
        )
    return out


def _status_rows(m: ReportData) -> list[tuple[str, Ints, list[tuple[str, str]]]]:
    """Name, status codes (F,), and the words and colours of the codes: of the pose, and of each view."""
    pose_words = [(str(s), POSE_COLOURS[s]) for s in POSE_STATUSES]
    spot_words = [(str(s), SPOT_COLOURS[s]) for s in SPOT_STATUSES]
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
    left, right, row = 128.0, 1000.0, 19.0
    n_columns = min(n, int(right - left))
    column = np.arange(n) * n_columns // max(n, 1)
    size = np.bincount(column, minlength=n_columns)
    rows = _status_rows(m)
    names: list[str] = []
    out, y = ['<g class="whole">'], 8.0
    tops = []
    for name, status, words in rows:
        tops.append(f"{y:.0f}")
        names.append(text(left - 8, y + 13, name if len(name) <= 20 else name[:19] + "…", "end"))
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
        names.append(text(right + 8, y + 13, f"{100 * measured / max(n, 1):.1f} % measured"))
        y += row + (6 if name == "pose" else 0)
    X = time_scale(m.t_s, left, right)
    X = time_scale(m.t_s, left, right, 0.5 * (X.hi - X.lo) / max(n - 1, 1))
    p = PlotArea(X, Scale(0, 1, y + 1, 8), 1110, y + 24)
    out += [time_ticks(p, m.time_name), "</g>", *names]
    data = f'{time_data(X)} data-tops="{" ".join(tops)}" data-high="{row - 4:.0f}" data-name="{m.time_name}"'
    data += f' data-y="0 1 {y + 1:.0f} 8"'
    return figure(p.width, p.height, "Status of the pose and of every spot over time", out, data=data)


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
