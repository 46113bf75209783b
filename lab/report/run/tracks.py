"""Two figures of the spots: their tracks over the picture (Huo 2015, Fig. 8), and their statuses over time."""

from __future__ import annotations

from html import escape

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.files.run.results import POSE_STATUSES, SPOT_STATUSES
from lab.report.plot import svg
from lab.report.run.report_data import ReportData
from tracking.statuses import PoseStatus, SpotStatus

TRACK_COLOURS = (svg.BLUE, svg.VERMILLION, svg.GREEN, svg.PURPLE, svg.ORANGE, svg.SKY, "#6b4c9a", "#7a5c2e")
SPOT_COLOURS = {
    SpotStatus.MATCHED: svg.GREEN,
    SpotStatus.TURNED: svg.PURPLE,
    SpotStatus.OCCLUDED: svg.ORANGE,
    SpotStatus.OUT_OF_VIEW: svg.SKY,
    SpotStatus.OFF_SCREEN: svg.BLUE,
    SpotStatus.NO_IMAGE: svg.GREY,
    SpotStatus.LOST: svg.VERMILLION,
}
POSE_COLOURS = {
    PoseStatus.MEASURED: svg.GREEN,
    PoseStatus.PREDICTED: svg.ORANGE,
    PoseStatus.LOST: svg.VERMILLION,
}
_BEYOND = 0.75  # how far outside the picture tracks are drawn, in picture sizes


def tracks_figure(m: ReportData, camera: str) -> str:
    """The tracks of a camera's spots in pixels, the picture's border, parts outside it dashed."""
    views = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
    uv = m.spots.uv_px[:, views]
    if not np.isfinite(uv).any():
        return ""
    size = m.picture_sizes.get(camera)
    inside = m.spots.measured[:, views]
    if size is None:  # no rig: the border is unknown, so what was measured sets the frame
        lo, hi = (f(uv[inside] if inside.any() else uv.reshape(-1, 2), axis=0) for f in (np.nanmin, np.nanmax))
    else:
        lo, hi = np.array([-0.5, -0.5]), np.array(size) - 0.5
    margin = _BEYOND * (hi - lo) + 1.0
    low = np.maximum(np.minimum(np.nanmin(uv, axis=(0, 1)), lo), lo - margin) - 0.03 * (hi - lo) - 1.0
    high = np.minimum(np.maximum(np.nanmax(uv, axis=(0, 1)), hi), hi + margin) + 0.03 * (hi - lo) + 1.0
    width, left, top = 540.0, 50.0, 24.0
    scale = (width - left - 10) / (high[0] - low[0])
    scale = min(scale, 420.0 / (high[1] - low[1]))
    right, bottom = left + scale * (high[0] - low[0]), top + scale * (high[1] - low[1])
    X, Y = svg.Scale(low[0], high[0], left, right), svg.Scale(low[1], high[1], top, bottom)
    clip = f"clip-{m.spots.cameras.index(camera)}"
    out = [
        f'<svg class="plot" viewBox="0 0 {width:.0f} {bottom + 34:.0f}" role="img">'
        f"<title>{escape(f'Tracks of the spots in the picture of camera {camera}')}</title>",
        f'<clipPath id="{clip}"><rect x="{left}" y="{top}" width="{right - left:.1f}" height="{bottom - top:.1f}"/>'
        "</clipPath>",
    ]
    if size is not None:
        a, b = X(np.array([lo[0], hi[0]])), Y(np.array([lo[1], hi[1]]))
        out.append(
            f'<rect class="picture" x="{a[0]:.1f}" y="{b[0]:.1f}" width="{a[1] - a[0]:.1f}" height="{b[1] - b[0]:.1f}">'
            f"<title>the picture, {size[0]} × {size[1]} px</title></rect>"
        )
    for axis, values in ((X, svg.ticks(low[0], high[0], 7)), (Y, svg.ticks(low[1], high[1], 6))):
        for value, words in zip(values, svg.tick_texts(values), strict=True):
            at = float(axis(value))
            if axis is X:
                out.append(
                    f'<path class="grid" d="M{at:.1f} {bottom}v4"/>{svg.text(at, bottom + 15, words, "tick mid")}'
                )
            else:
                out.append(
                    f'<path class="grid" d="M{left} {at:.1f}h-4"/>{svg.text(left - 6, at + 3.5, words, "tick end")}'
                )
    out.append(f'<g clip-path="url(#{clip})">')
    labels = []
    for i, j in enumerate(views):
        colour, spot = TRACK_COLOURS[i % len(TRACK_COLOURS)], m.spots.views[j][1]
        x, y = X(uv[:, i, 0]), Y(uv[:, i, 1])
        parts = (
            (inside[:, i], "", 1.5, "measured"),
            (m.spots.has(SpotStatus.OCCLUDED, SpotStatus.NO_IMAGE)[:, j], "1.5 2.5", 1.5, "estimate"),
            (m.spots.has(SpotStatus.OUT_OF_VIEW)[:, j], "6 4", 1.2, "out of view, solved from the other beams"),
        )
        for where, dash, thick, name in parts:
            d = _thin_track(x, y, where)
            if d:
                dashes = f' stroke-dasharray="{dash}"' if dash else ""
                out.append(
                    f'<path class="line" d="{d}" stroke="{colour}" stroke-width="{thick}"{dashes}>'
                    f"<title>{escape(f'spot {spot}: {name}')}</title></path>"
                )
        turned = np.flatnonzero(m.spots.has(SpotStatus.TURNED)[:, j])
        out += [
            f'<circle class="turn" cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="3" stroke="{colour}">'
            f"<title>{escape(f'spot {spot} turned, frame {m.spots.frames[k]}')}</title></circle>"
            for k in turned[:: max(1, -(-len(turned) // 60))]
        ]
        known = np.flatnonzero(np.isfinite(x) & (x > left) & (x < right) & (y > top) & (y < bottom))
        if len(known):
            labels.append((float(x[known[0]]), float(y[known[0]]), spot, colour))
    out.append("</g>")
    out += _labels(labels)
    beyond = bool(np.any(np.isfinite(uv) & ((uv < low) | (uv > high))))
    note = f"camera {camera}" + (" (tracks reach farther out than is drawn)" if beyond else "")
    out.append(svg.text(left, 14, note, "title"))
    out.append(svg.text(right, bottom + 29, "u (px)", "tick end") + svg.text(left - 6, top - 4, "v (px)", "tick end"))
    out.append(f'<path class="frame" d="M{left} {top}V{bottom:.1f}H{right:.1f}"/></svg>')
    return "".join(out)


def _thin_track(x: Array, y: Array, where: Bools) -> str:
    """The path of a track's part, without the points that would fall on the one before."""
    near = where.copy()
    near[1:] |= where[:-1]  # a part begins at the last point of the one before, so that the track has no holes
    near[:-1] |= where[1:]
    x, y = np.where(near, x, np.nan), np.where(near, y, np.nan)
    step = 0.5
    cell = np.stack([np.round(x / step), np.round(y / step)], -1)
    same = np.zeros(len(x), dtype=bool)
    same[1:] = np.all((cell[1:] == cell[:-1]) | (np.isnan(cell[1:]) & np.isnan(cell[:-1])), axis=-1)
    x, y = x[~same], y[~same]
    most = 3000
    if len(x) > most:  # of each stretch its outermost points in both directions
        wide = -(-len(x) // (most // 4))
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


def _labels(labels: list[tuple[float, float, str, str]]) -> list[str]:
    """Names at the tracks' beginnings, moved apart where two would overlap."""
    placed: list[tuple[float, float]] = []
    out = []
    for x, y, spot, colour in labels:
        lx, ly = x + 8, y - 6
        while any(abs(lx - px) < 14 and abs(ly - py) < 14 for px, py in placed):
            ly += 15
        placed.append((lx, ly))
        out.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>first position</title></circle>'
            + svg.text(lx, ly, spot, "label", f"fill:{colour}")
        )
    return out


def timeline_figure(m: ReportData) -> str:
    """A strip of colours for the pose and for each view: what its status was over time."""
    n = len(m.spots.frames)
    width, left, right, row = 1090.0, 128.0, 1000.0, 19.0
    n_columns = min(n, int(right - left))
    out = []
    y = 8.0
    rows: list[tuple[str, Ints, list[tuple[str, str]]]] = []
    pose_words = [(str(s), POSE_COLOURS[s]) for s in POSE_STATUSES]
    spot_words = [(str(s), SPOT_COLOURS[s]) for s in SPOT_STATUSES]
    if len(m.poses.frames) == n:
        rows.append(("pose", m.poses.status, pose_words))
    rows += [(f"{c} / {s}", m.spots.status[:, j], spot_words) for j, (c, s) in enumerate(m.spots.views)]
    column = np.arange(n) * n_columns // max(n, 1)
    size = np.bincount(column, minlength=n_columns)
    for name, status, words in rows:
        out.append(svg.text(left - 8, y + 13, name if len(name) <= 20 else name[:19] + "…", "tick end"))
        found = int(np.isin(status, [0, 1] if words is spot_words else [0]).sum())
        below = np.zeros(n_columns)
        for code, (word, colour) in enumerate(words):
            count = np.bincount(column[status == code], minlength=n_columns)
            share = count / size
            if count.any():
                d = _strip(share, below, left, (right - left) / n_columns, y, row - 4)
                said = f"{name}: {word} in {count.sum()} of {n} frames"
                out.append(f'<path d="{d}" fill="{colour}"><title>{escape(said)}</title></path>')
            below += share
        out.append(svg.text(right + 8, y + 13, f"{100 * found / max(n, 1):.1f} % seen", "tick"))
        y += row + (6 if name == "pose" else 0)
    t_lo, t_hi = float(m.t_s[0]), float(m.t_s[-1])
    if t_hi <= t_lo:
        t_lo, t_hi = t_lo - 0.5, t_hi + 0.5
    half = 0.5 * (t_hi - t_lo) / max(n - 1, 1)
    X = svg.Scale(t_lo - half, t_hi + half, left, right)
    out.append(svg.time_ticks(X, y + 1, True, m.time_name))
    head = (
        f'<svg class="plot" viewBox="0 0 {width:.0f} {y + 24:.0f}" data-t="{X.lo!r} {X.hi!r} {left} {right}"'
        ' role="img">'
        "<title>Status of the pose and of every spot over time</title>"
    )
    return head + "".join(out) + "</svg>"


def _strip(share: Array, below: Array, left: float, wide: float, top: float, height: float) -> str:
    """One status of one strip: boxes whose height is its share of each column, equal neighbours joined."""
    d = []
    change = np.flatnonzero((np.diff(share) != 0) | (np.diff(below) != 0)) + 1
    edges = np.concatenate([[0], change, [len(share)]])
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if share[a] > 0:
            tall = max(height * float(share[a]), 0.8)
            y = top + height * float(below[a])
            d.append(f"M{left + a * wide:.1f} {y:.1f}h{(b - a) * wide:.2f}v{tall:.1f}h{-(b - a) * wide:.2f}z")
    return "".join(d)
