"""What a camera, a grabber or a converter does to successive pictures: repeats, averages over time, interlaced rows."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lab.pictures.picture_file import REPEATED, TORN, GreyPicture, MissingPicture

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
_BLOCK = 16  # pixels along a row that are one of many blocks ...
_STILL = 0.5  # ... of which this share, those that change least, are at rest or even
# Share of the picture before in each picture, and how much the looks at it may differ (half of them). Independent
# pictures have 0 with a scatter of .03, a share of .5 one of .15.
_AVERAGED, _SCATTER = 0.15, 0.15
# Rows that alternate this often in turn, and of those that alternate four times. Interlaced edges do in .3 to .6 of
# these, the texture and the blocks of videos in .03 to .07. As many columns alternate in texture.
_SHORT, _LONG, _LONG_SHARE, _OF_COLUMNS = 4, 6, 0.2, 4
_LEAST_COMBS = 20  # pixels in all pictures looked at
_COMB_SIGMAS, _COMB_DN = 4.0, 4.0  # least difference of two rows


@dataclass(slots=True)
class Delivery:
    """Whether the pictures of a camera are averages over time, or interlaced; they are given one after the other.

    separate: each picture is a file of its own. A video's compression repeats the noise of the picture before.
    """

    separate: bool
    _count: int = 0
    _last: list[GreyPicture] = field(default_factory=list)  # some rows of up to five pictures
    _shares: list[tuple[float, float]] = field(default_factory=list)  # of successive pictures, and of every second one
    _combs: list[tuple[int, int, int]] = field(default_factory=list)  # pixels: short and long, of columns

    def add(self, picture: Any) -> None:
        """The next picture (h, w) or (h, w, 3); None where it is missing."""
        if picture is None:
            self._last = []
            return
        if picture.ndim == 3:
            picture = picture[..., 1]
        some = picture[::_COMPARED].astype(np.int32)
        self._last = [p for p in self._last[-4:] if p.shape == some.shape] + [some]
        self._count += 1
        if self._count % _EVERY:
            return
        if self.separate and len(self._last) == _PICTURES and np.mean(self._last[-2] != some) > _NOISY:
            self._shares.append((_share_of_last(*self._last[2:]), _share_of_last(*self._last[::2])))
        if short := _alternating(picture, _SHORT):
            self._combs.append((short, _alternating(picture, _LONG), _alternating(picture.T, _SHORT)))

    @property
    def averaged_share(self) -> float:
        """Share of each picture that is the picture before; 0 where none is seen."""
        if len(self._shares) < _LEAST_LOOKS:
            return 0.0
        low, share, high = np.percentile([s for s, _ in self._shares], (25, 50, 75)).tolist()
        fades = np.median([s for _, s in self._shares]) < _FADES * share
        return float(share) if share > _AVERAGED and high - low < _SCATTER and fades else 0.0

    @property
    def interlaced(self) -> bool:
        """Whether even and odd rows show what moves at two places."""
        short, long, columns = np.sum(self._combs, axis=0).tolist() if self._combs else (0, 0, 0)
        return bool(long >= max(_LEAST_COMBS, _LONG_SHARE * short) and short > _OF_COLUMNS * columns)


def _share_of_last(first: GreyPicture, second: GreyPicture, third: GreyPicture) -> float:
    """Share r of the picture before in each of three pictures, (h, w), from the correlation of their noise.

    If x(k) = r x(k-1) + (1 - r) new, the mean squares of x(2) - x(0) and of x(2) - 2 x(1) + x(0) are as 1 + r to 3 - r.
    Second differences along the rows contain little else than noise where the picture is even or at rest.
    """
    once, twice = (_squares(np.diff(d, 2)) for d in (third - first, third - 2 * second + first))
    both = (
        once / 2 + twice / 6
    )  # of independent pictures the two are equal, so that a choice by the sum changes neither
    still = both <= np.quantile(both, _STILL)
    # Rounding is noise of 1/12 DN^2, not averaged; a second difference has six times that.
    rounded = 6 / 12
    ratio = max(float(np.median(once[still])) - 2 * rounded, 0.0) / max(
        float(np.median(twice[still])) - 6 * rounded, 1.0
    )
    return (3 * ratio - 1) / (1 + ratio)


def _squares(values: Any) -> Any:
    """Mean squares (n,) of values (h, w) in blocks of _BLOCK along the rows."""
    blocks = (values.shape[1] - 1) // _BLOCK
    return np.mean(values[:, : blocks * _BLOCK].reshape(-1, _BLOCK) ** 2, axis=1)


def _alternating(picture: GreyPicture, count: int) -> int:
    """Pixels from which `count` differences of successive rows have signs in turn, and are clearly more than noise."""
    steps = np.diff(picture.astype(np.int32), axis=0)
    noise = float(np.median(np.abs(steps[::_COMPARED]))) / 0.6745
    large = np.abs(steps) > _COMB_SIGMAS * noise + _COMB_DN
    turns = ((steps[1:] > 0) != (steps[:-1] > 0)) & large[1:] & large[:-1]
    out = turns[: len(turns) - count + 2].copy()
    for k in range(1, count - 1):
        out &= turns[k : k + len(out)]
    return int(np.count_nonzero(out))
