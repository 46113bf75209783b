"""The table of board corners detected in the photographs of one camera: the observations of its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints


@dataclass(frozen=True, slots=True)
class CircleAreas:
    """Marks the points as circles, of which centroids were detected, with the data on their size."""

    areas_px2: Array | None = None  # (N,), of their blobs; None: not measured
    diameter_m: float | None = None  # as stated; None: not stated


@dataclass(frozen=True, slots=True)
class CornerTable:
    """N corners, or centroids of circles, in V views of one board with P points."""

    view: Ints  # (N,): index of the photograph, 0 ... V - 1; in ascending order
    point: Ints  # (N,): index of the board point
    pixels: Array  # (N, 2)
    board_points: Array  # (P, 3), m
    middle: Array  # (3,), m: origin of the warp polynomial
    views: int
    image_size_px: tuple[int, int]
    circles: CircleAreas | None = None  # None: the points are not circles
    sigmas_px: Array | None = None  # (N,): of a coordinate, from the noise of the picture; None: not measured
    picture_noise: Array | None = None  # (N,): of each corner, in units of that of the set; None: the same for all
    view_noise: Array | None = None  # (V,): factor on it of a view's corners; None: the same in all

    def __post_init__(self) -> None:
        if not np.isfinite(self.pixels).all():
            raise ValueError("expected finite pixels for every corner, got nan or infinity; drop undetected corners")
        if len(self.point) and (self.point.min() < 0 or self.point.max() >= len(self.board_points)):
            raise ValueError(f"expected points of the board, 0 to {len(self.board_points) - 1}, got {self.point.max()}")

    @staticmethod
    def of(
        views: Sequence[tuple[Ints, Array]],
        board_points: Array,
        middle: Array,
        image_size_px: tuple[int, int],
        circles: CircleAreas | None = None,
        sigmas_px: Array | None = None,
    ) -> CornerTable:
        """From (ids (n,), pixels (n, 2)) per photograph; areas of circles and sigmas are in the order of the views."""
        sizes = [len(ids) for ids, _ in views]
        return CornerTable(
            view=np.repeat(np.arange(len(views)), sizes),
            point=np.concatenate([np.asarray(ids, dtype=np.int64) for ids, _ in views] or [np.zeros(0, np.int64)]),
            pixels=np.concatenate([np.asarray(p, dtype=float).reshape(-1, 2) for _, p in views] or [np.zeros((0, 2))]),
            board_points=np.asarray(board_points, dtype=float),
            middle=np.asarray(middle, dtype=float),
            views=len(views),
            image_size_px=image_size_px,
            circles=circles,
            sigmas_px=sigmas_px,
        )

    def __len__(self) -> int:
        return len(self.view)

    @property
    def points(self) -> Array:
        """(N, 3), m: position of each corner on the board."""
        return self.board_points[self.point]

    @property
    def noise(self) -> Array:
        """(N,): of each corner, in units of that of the set."""
        by_picture = np.ones(len(self)) if self.picture_noise is None else self.picture_noise
        return by_picture if self.view_noise is None else by_picture * self.view_noise[self.view]

    def counts(self, used: Bools | None = None) -> Ints:
        """(V,): number of corners of each view; of the used ones (N,) only, if given."""
        view = self.view if used is None else self.view[used]
        return np.bincount(view, minlength=self.views)

    def mean_per_view(self, values: Array, used: Bools) -> Array:
        """(V,): mean of values (N,) over the used corners of each view; nan for a view without any."""
        count = self.counts(used)
        total = np.bincount(self.view[used], weights=values[used], minlength=self.views)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def only_views(self, views: Ints) -> CornerTable:
        """The table reduced to some of its views, renumbered in the given order."""
        number = np.full(self.views, -1)
        number[views] = np.arange(len(views))
        mine = np.flatnonzero(number[self.view] >= 0)
        order = mine[np.argsort(number[self.view[mine]], kind="stable")]

        def some(values: Array | None, rows: Ints = order) -> Array | None:
            return None if values is None else values[rows]

        return replace(
            self, view=number[self.view[order]], point=self.point[order], pixels=self.pixels[order], views=len(views),
            circles=None if self.circles is None else replace(self.circles, areas_px2=some(self.circles.areas_px2)),
            sigmas_px=some(self.sigmas_px), picture_noise=some(self.picture_noise),
            view_noise=some(self.view_noise, views),
        )  # fmt: skip

    @property
    def spacing_m(self) -> float:
        """Distance of neighbouring points of the board."""
        xy = self.board_points[:, :2]
        return float(np.min(np.linalg.norm(xy[1:] - xy[0], axis=1)))
