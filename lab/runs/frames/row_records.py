"""From processed moments to the rows of the tables, for runs whose cameras have clocks of their own.

A row has the pose of its frame's instant. Its spots are those of the row's pictures, each at its own instant: of a
camera without times of its own, picture n belongs to row n, however late it is; of the others, the picture nearest to
the row's instant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from geometry.arrays import Array, Ints
from lab.runs.frames.moments import Moment
from lab.runs.frames.pipeline import FrameRecord, Pair, ShownPicture
from tracking.statuses import TrackedFrame


def row_records(
    pairs: Iterable[Pair], moments: Sequence[Moment], cameras: Sequence[str], own_times: Sequence[bool], camera_of: Ints
) -> Iterator[Pair]:
    """The rows of processed moments, in order.

    moments: complete when the first pair comes. cameras: names; own_times: whether each has times of its own;
    camera_of (n,): the camera of each view.
    """
    sources: list[list[int]] = []
    rows: list[int] = []
    kept: dict[int, Pair] = {}
    shown: list[ShownPicture] = []
    waiting: Pair | None = None
    following = 0
    for i, pair in enumerate(pairs):
        if not rows:
            sources = _sources(moments, cameras, own_times)
            rows = [k for k, moment in enumerate(moments) if moment.is_row]
        kept[i] = pair
        shown += _shown(pair[0], cameras)
        while following < len(rows) and max(rows[following], *sources[following]) <= i:
            if waiting is not None:
                yield waiting
            waiting = _row(kept, rows[following], sources[following], camera_of, tuple(shown))
            shown = []
            following += 1
            least = min((min(rows[r], *sources[r]) for r in range(following, len(rows))), default=i + 1)
            kept = {k: value for k, value in kept.items() if k >= least}
    if waiting is not None:
        record, causal = waiting
        yield replace(record, pictures=(*(record.pictures or ()), *shown)), causal


def _sources(moments: Sequence[Moment], cameras: Sequence[str], own_times: Sequence[bool]) -> list[list[int]]:
    """For each row: the moment of each camera's picture; the row's own where it has none."""
    place = [{m.pictures[name].number: i for i, m in enumerate(moments) if name in m.pictures} for name in cameras]
    out = []
    for i, moment in enumerate(moments):
        if moment.is_row:
            of_row = zip(place, own_times, strict=True)
            out.append([i if own else numbers.get(moment.frame, i) for numbers, own in of_row])
    return out


def _shown(record: FrameRecord, cameras: Sequence[str]) -> list[ShownPicture]:
    """The pictures of a moment with detections."""
    assert record.moment is not None
    pictures = record.moment.pictures
    return [
        ShownPicture(pictures[name].number, pictures[name].t_s, camera, found)
        for camera, (name, found) in enumerate(zip(cameras, record.detections, strict=True))
        if name in pictures and found is not None
    ]


def _row(
    kept: dict[int, Pair], at: int, sources: Sequence[int], camera_of: Ints, shown: tuple[ShownPicture, ...]
) -> Pair:
    record = _combined(kept[at][0], [kept[i][0] for i in sources], camera_of)
    before = kept[at][1]
    causal = None
    if before is not None:
        causal = _combined(before, [c for i in sources if (c := kept[i][1]) is not None], camera_of)
    return replace(record, pictures=shown), causal


def _combined(own: FrameRecord, of_cameras: Sequence[FrameRecord], camera_of: Ints) -> FrameRecord:
    """A row's record: the pose of its own moment, and each camera's spots of the moment of its picture."""
    if all(other is own for other in of_cameras):
        return own
    cameras = range(len(of_cameras))
    tracked = [of_cameras[c].tracked for c in camera_of]

    def by_view(name: str) -> Array:
        return np.stack([getattr(t, name)[v] for v, t in enumerate(tracked)])

    def by_view_where_known(name: str) -> Array | None:
        return None if any(getattr(t, name) is None for t in tracked) else by_view(name)

    changes: dict[str, Any] = {name: by_view(name) for name in ("uv_px", "cov_px2", "predicted_px", "gain", "point")}
    changes |= {name: by_view_where_known(name) for name in ("label_probability", "used_in_pose", "predicted_cov_px2")}
    joined: TrackedFrame = replace(
        own.tracked,
        status=tuple(t.status[v] for v, t in enumerate(tracked)),
        events=tuple(
            [e for e in own.tracked.events if e.view is None]
            + [e for v, t in enumerate(tracked) for e in t.events if e.view == v]
        ),
        **changes,
    )
    return replace(
        own,
        detections=tuple(of_cameras[c].detections[c] for c in cameras),
        missing=tuple(of_cameras[c].missing[c] for c in cameras),
        tracked=joined,
    )
