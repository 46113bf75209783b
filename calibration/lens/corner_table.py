"""What the photographs of one board by one camera gave: the table of corners that the intrinsics are solved from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints


@dataclass(frozen=True, slots=True)
class CornerTable:
    """N corners in V views of one board with P points."""

    view: Ints  # (N,): in which photograph, 0 ... V - 1; in ascending order
    point: Ints  # (N,): which point of the board
    pixels: Array  # (N, 2)
    board_points: Array  # (P, 3), m
    middle: Array  # (3,), m: about which a bent board is described
    views: int
    image_size_px: tuple[int, int]

    def __post_init__(self) -> None:
        if not np.isfinite(self.pixels).all():
            raise ValueError("expected finite pixels for every corner, got nan or infinity; drop what was not found")
        if len(self.point) and (self.point.min() < 0 or self.point.max() >= len(self.board_points)):
            raise ValueError(f"expected points of the board, 0 to {len(self.board_points) - 1}, got {self.point.max()}")

    @staticmethod
    def of(
        views: Sequence[tuple[Ints, Array]], board_points: Array, middle: Array, image_size_px: tuple[int, int]
    ) -> CornerTable:
        """From (ids (n,), pixels (n, 2)) per photograph."""
        sizes = [len(ids) for ids, _ in views]
        return CornerTable(
            view=np.repeat(np.arange(len(views)), sizes),
            point=np.concatenate([np.asarray(ids, dtype=np.int64) for ids, _ in views] or [np.zeros(0, np.int64)]),
            pixels=np.concatenate([np.asarray(p, dtype=float).reshape(-1, 2) for _, p in views] or [np.zeros((0, 2))]),
            board_points=np.asarray(board_points, dtype=float),
            middle=np.asarray(middle, dtype=float),
            views=len(views),
            image_size_px=image_size_px,
        )

    def __len__(self) -> int:
        return len(self.view)

    @property
    def points(self) -> Array:
        """(N, 3), m: each corner on the board."""
        return self.board_points[self.point]

    def counts(self, used: Bools | None = None) -> Ints:
        """(V,): corners of each view, of the used ones alone if given (N,)."""
        view = self.view if used is None else self.view[used]
        return np.bincount(view, minlength=self.views)

    def mean_per_view(self, values: Array, used: Bools) -> Array:
        """(V,): the mean of values (N,) over the used corners of each view; nan where it has none."""
        count = self.counts(used)
        total = np.bincount(self.view[used], weights=values[used], minlength=self.views)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def only_views(self, views: Ints) -> CornerTable:
        """The same table with some of its views, renumbered in the given order."""
        number = np.full(self.views, -1)
        number[views] = np.arange(len(views))
        mine = np.flatnonzero(number[self.view] >= 0)
        order = mine[np.argsort(number[self.view[mine]], kind="stable")]
        return CornerTable(
            number[self.view[order]],
            self.point[order],
            self.pixels[order],
            self.board_points,
            self.middle,
            len(views),
            self.image_size_px,
        )
