"""What a camera, a grabber or a converter does to successive pictures: repeats, averages over time, interlaced rows."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lab.pictures.picture_file import REPEATED, TORN, GreyPicture, MissingPicture
from tracking.noise_estimation.averaging import LEAST_KEPT, RowCounts, kept_of_the_last

_COMPARED = 16  # every such row of two pictures is compared
_CHANGED = 0.01  # share of the pixels that change from picture to picture by noise: by spots that move fewer do
_NOISY = 0.3  # share in each row, of a camera whose noise is not compressed: there an unchanged row is an earlier one


def without_repeats(stream: Generator[tuple[int, Any], None, None]) -> Generator[tuple[int, Any], None, None]:
    """Numbered pictures; those that repeat the one before, or rows of it, are missing.

    A grabber or a converter of videos that has no new picture often gives the last one again, or a part of it, with the
    spots of an earlier instant. Pictures of a sensor differ by its noise everywhere. Those without noise, of a
    simulation or a compressed video, may be equal while all is at rest: of such a camera no picture counts as a repeat.
    """
    before, noisy, in_all_rows = np.zeros(0), False, False
    with closing(stream):
        for number, picture in stream:
            if isinstance(picture, MissingPicture):
                yield number, picture
                continue
            some = picture[::_COMPARED].copy()
            alike = some.shape == before.shape
            changed = np.mean(some != before, axis=tuple(range(1, some.ndim))) if alike else np.zeros(len(some))
            before = some
            if alike and noisy and not changed.any():
                yield number, MissingPicture(REPEATED)
            elif alike and in_all_rows and np.median(changed[changed > 0]) > _NOISY and not changed.all():
                yield number, MissingPicture(TORN)
            else:
                noisy, in_all_rows = float(np.mean(changed)) > _CHANGED, float(np.min(changed)) > _NOISY
                yield number, picture


_EVERY = 4  # each so many pictures are looked at
_LEAST_LOOKS = 5
_PICTURES = 5  # of a look
_FADES = 0.8  # of a share r, r^2 is left of every second picture; texture that drifts shows as much there
# How much the looks at the share may differ (half of them). Independent pictures have 0 with a scatter of .03, a share
# of .5 one of .15.
_SCATTER = 0.15
_MOST = 1.3  # means of two pictures have the noise of a share of 1; a texture that drifts has up to 3


@dataclass(slots=True)
class Delivery:
    """Whether the pictures of a camera are averages over time, or interlaced; they are given one after the other."""

    _count: int = 0
    _last: list[GreyPicture] = field(default_factory=list)  # up to five
    _shares: list[tuple[float, float]] = field(default_factory=list)  # of successive pictures, and of every second one
    _alternating: RowCounts = field(default_factory=RowCounts)

    def add(self, picture: Any) -> None:
        """The next picture (h, w) or (h, w, 3); None where it is missing."""
        if picture is None:
            self._last = []
            return
        some = picture[..., 1] if picture.ndim == 3 else picture
        self._last = [*self._last[1 - _PICTURES :], some]
        self._count += 1
        if self._count % _EVERY == 0 and len(self._last) > 1:
            self._alternating.add(*self._last[-2:])
            if len(self._last) == _PICTURES:
                from tracking.noise_estimation.grey_values import grey_step  # deferred: it loads OpenCV

                rounding = grey_step(self._last[-1:]) ** 2 / 12
                self._shares.append(
                    (kept_of_the_last(self._last[-3:], rounding), kept_of_the_last(self._last[::2], rounding))
                )

    @property
    def averaged_share(self) -> float:
        """Share of each picture that is the picture before, at least; 0 where none is seen."""
        shares = np.array([s for s in self._shares if np.isfinite(s).all()])
        if len(shares) < _LEAST_LOOKS:
            return 0.0
        low, share, high = np.percentile(shares[:, 0], (25, 50, 75)).tolist()
        fades = np.median(shares[:, 1]) < _FADES * share
        seen = LEAST_KEPT < share < _MOST and high - low < _SCATTER and fades
        return min(float(share), 0.5) if seen else 0.0

    @property
    def interlaced(self) -> bool:
        """Whether even and odd rows show what moves at two places."""
        return self._alternating.interlaced
