"""The types of calibration boards, with OpenCV's dictionaries of markers and the text that describes a board."""

from __future__ import annotations

import difflib
import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from geometry.arrays import Array, Ints


def read_count(text: str) -> tuple[int, int]:
    """Columns and rows from a text such as 9x6. Raises ValueError: the text is not valid."""
    found = re.fullmatch(r"(\d{1,4})\s*[xX×]\s*(\d{1,4})", text)
    if found is None:
        raise ValueError(f"expected columns x rows such as 9x6, got {text!r}")
    return int(found[1]), int(found[2])


def read_length(text: str) -> float:
    """A length in m from a text with a unit, such as 25mm. Raises ValueError: the text is not valid."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(mm|cm|m)", text, flags=re.IGNORECASE)
    if found is None:
        raise ValueError(f"expected a length with its unit such as 25mm, got {text!r}")
    # By division: 25 / 1000 is the double nearest to 0.025, and 25 * 0.001 is not.
    return float(found[1]) / {"mm": 1000.0, "cm": 100.0, "m": 1.0}[found[2].lower()]


def in_mm(length_m: float) -> str:
    """The text of a length, which `read_length` reads: 25mm."""
    return f"{round(length_m * 1000, 9):.12g}mm"


_FAMILIES = "DICT_4X4_50 (_100, _250, _1000), likewise DICT_5X5_, DICT_6X6_ and DICT_7X7_, and DICT_APRILTAG_36h11"


class DictionaryError(ValueError):
    """An unknown dictionary of markers."""


def _dictionaries() -> dict[str, int]:
    """OpenCV's predefined dictionaries by name; of names for the same one (36H11, 36h11), the lower case."""
    by_number: dict[int, str] = {}
    for name in sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_")):  # upper case sorts first
        by_number[int(getattr(cv2.aruco, name))] = name
    return {by_number[number]: number for number in sorted(by_number)}


DICTIONARIES = _dictionaries()  # name -> OpenCV's number, in OpenCV's order


def dictionary_name(text: str) -> str:
    """OpenCV's name of a dictionary of ArUco markers, from a name in any case.

    Raises ValueError: there is no such dictionary; the message gives similar names.
    """
    by_lower = {name.lower(): name for name in DICTIONARIES}
    if text.lower() in by_lower:
        return by_lower[text.lower()]
    if f"dict_{text.lower()}" in by_lower:
        return by_lower[f"dict_{text.lower()}"]
    near = difflib.get_close_matches(text.lower(), by_lower, n=2, cutoff=0.6)
    hint = f"did you mean {' or '.join(by_lower[n] for n in near)}? " if near else ""
    raise DictionaryError(f"expected one of OpenCV's dictionaries, got {text!r}; {hint}there are {_FAMILIES}")


def dictionary_size(name: str) -> int:
    """Number of markers of a dictionary."""
    return len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[name]).bytesList)


# The types of calibration boards.
#
# All boards use the same kind of frame: the origin is the first point, x points along the columns to the last point of
# the first row, y down the rows, and z = x cross y INTO the board, away from a viewer of its printed side (OpenCV's
# convention). All points have z = 0. Seen from the front with the first point at the top left, x points right and y
# down.

EXAMPLES = {
    "chessboard": "chessboard:9x6:25mm (inner corners, side of a square)",
    "circles": "circles:10x10:12mm (circles, distance of neighbours; optionally their diameter, :6mm)",
    "acircles": "acircles:4x11:20mm (circles in a row, rows, distance of two rows; optionally their diameter, :14mm)",
    "charuco": "charuco:5x7:40mm:20mm:DICT_4X4_50 (squares, side of a square, side of a marker, dictionary;"
    " optionally :inverted for white markers, :legacy for OpenCV's pattern before 4.6)",
}
_FEWEST = 3  # points along each side: with two, a board cannot be distinguished from its surroundings
_MOST = 200
# Diameter of printed circles over the distance of neighbours. Larger circles merge when blurred; smaller ones have
# fewer edge pixels to measure.
_INK = 0.5


class _Points(ABC):
    """Points of a board, numbered from 0 row by row (OpenCV's order)."""

    __slots__ = ()

    @property
    @abstractmethod
    def points(self) -> Array:
        """(N, 3), m, in the board's frame."""

    @property
    def ids(self) -> Ints:
        """(N,): 0, 1, ... row by row."""
        return np.arange(len(self.points))

    @property
    def middle(self) -> Array:
        """(3,), m: origin of the warp polynomial."""
        return (self.points.min(axis=0) + self.points.max(axis=0)) / 2


@dataclass(frozen=True, slots=True)
class Chessboard(_Points):
    """A plain chessboard. The square above and left of the first inner corner is black.

    This determines the first corner if columns + rows is odd. If it is even, the board looks the same after half a turn
    (`symmetry` 2), and after a quarter turn if it is square with even sides (4).
    """

    columns: int  # inner corners
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        _check_count("inner corners", self.columns, self.rows)
        _check_length("chessboard", "square", self.square_m)

    @property
    def points(self) -> Array:
        """Inner corners (columns * rows, 3), m, in the board's frame, row by row."""
        return _lattice(self.columns, self.rows, self.square_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed squares."""
        return (self.columns + 1) * self.square_m, (self.rows + 1) * self.square_m

    @property
    def spacing_m(self) -> float:
        """Distance of neighbouring points."""
        return self.square_m

    def describe(self) -> str:
        """The text that `parse` reads."""
        return f"chessboard:{self.columns}x{self.rows}:{in_mm(self.square_m)}"


@dataclass(frozen=True, slots=True)
class CircleGrid(_Points):
    """Black circles on white, in rows and columns, or asymmetric: every second row shifted by half a step.

    spacing_m is the distance of neighbours, or for an asymmetric grid that of two ROWS; circles of one row are then
    2 spacing_m apart and neighbours sqrt(2) spacing_m (OpenCV's convention: x = (2 j + i % 2) spacing, y = i spacing).
    """

    columns: int  # circles in a row
    rows: int
    spacing_m: float
    asymmetric: bool = False
    stated_diameter_m: float | None = None  # of the circles; None: not stated

    def __post_init__(self) -> None:
        _check_count("circles", self.columns, self.rows)
        _check_length(self.kind, "spacing", self.spacing_m)
        if self.stated_diameter_m is not None:
            _check_length(self.kind, "diameter", self.stated_diameter_m)
            if self.stated_diameter_m >= self.neighbours_m:
                raise ValueError(
                    f"{self.kind}: expected circles smaller than the {1000 * self.neighbours_m:.4g} mm between"
                    f" neighbours, got a diameter of {in_mm(self.stated_diameter_m)}; the spacing comes first; example:"
                    f" {EXAMPLES[self.kind]}"
                )

    @property
    def kind(self) -> str:
        """The first word of the board's text."""
        return "acircles" if self.asymmetric else "circles"

    @property
    def points(self) -> Array:
        """Centres (columns * rows, 3), m, in the board's frame, row by row."""
        points = _lattice(self.columns, self.rows, self.spacing_m)
        if self.asymmetric:
            row = np.arange(len(points)) // self.columns
            points[:, 0] = 2 * points[:, 0] + (row % 2) * self.spacing_m
        return points

    @property
    def neighbours_m(self) -> float:
        """Distance of the nearest centres."""
        return self.spacing_m * (math.sqrt(2) if self.asymmetric else 1.0)

    @property
    def diameter_m(self) -> float:
        """Diameter as stated, or as beampose prints it. Calibrations measure it and do not rely on this value."""
        return _INK * self.neighbours_m if self.stated_diameter_m is None else self.stated_diameter_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed area."""
        span = np.ptp(self.points, axis=0)
        return float(span[0]) + self.diameter_m, float(span[1]) + self.diameter_m

    def describe(self) -> str:
        """The text that `parse` reads."""
        text = f"{self.kind}:{self.columns}x{self.rows}:{in_mm(self.spacing_m)}"
        return text if self.stated_diameter_m is None else f"{text}:{in_mm(self.stated_diameter_m)}"


@dataclass(frozen=True, slots=True)
class Charuco(_Points):
    """A chessboard with an ArUco marker in each white square; its points are the inner chessboard corners.

    The markers identify the corners, so that a part of the board is sufficient and there is no symmetry.
    """

    columns: int  # SQUARES, as in OpenCV
    rows: int
    square_m: float
    marker_m: float
    dictionary: str  # OpenCV's name
    inverted: bool = False  # printed with black and white exchanged
    legacy: bool = False  # OpenCV's pattern before 4.6, which differs if the number of rows is even

    def __post_init__(self) -> None:
        _check_count("squares", self.columns, self.rows)
        _check_length("charuco", "square", self.square_m)
        _check_length("charuco", "marker", self.marker_m)
        if self.marker_m >= self.square_m:
            raise ValueError(
                f"charuco: expected markers smaller than the squares, got {in_mm(self.marker_m)} in"
                f" {in_mm(self.square_m)}; the square comes first: {EXAMPLES['charuco']}"
            )
        object.__setattr__(self, "dictionary", dictionary_name(self.dictionary))
        kept = dictionary_size(self.dictionary)
        if self.markers > kept:
            raise ValueError(
                f"charuco: {self.columns}x{self.rows} squares need {self.markers} markers, {self.dictionary} has"
                f" {kept}; take a larger dictionary"
            )

    @property
    def markers(self) -> int:
        """Number of markers; they are numbered from 0."""
        return self.columns * self.rows // 2  # a board with an odd number of squares starts and ends with a black one

    @property
    def rim_modules(self) -> float:
        """White rim between a marker and the black squares around it, in modules (cells of the marker)."""
        return (self.square_m - self.marker_m) / 2 / (self.marker_m / self._modules)

    def marker_with_rim_m(self, rim_modules: float) -> float:
        """Side of a marker that leaves a rim of this many modules."""
        return self.square_m / (1 + 2 * rim_modules / self._modules)

    @property
    def _modules(self) -> int:
        """Modules along a marker's side, including its black border."""
        return int(cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).markerSize) + 2

    @property
    def light_first(self) -> bool:
        """Whether the top left square contains a marker (before inversion)."""
        return self.legacy and self.rows % 2 == 0

    @property
    def points(self) -> Array:
        """Inner corners ((columns - 1) * (rows - 1), 3), m, in the board's frame, row by row."""
        return _lattice(self.columns - 1, self.rows - 1, self.square_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed squares."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def spacing_m(self) -> float:
        """Distance of neighbouring points."""
        return self.square_m

    def describe(self) -> str:
        """The text that `parse` reads."""
        text = f"charuco:{self.columns}x{self.rows}:{in_mm(self.square_m)}:{in_mm(self.marker_m)}:{self.dictionary}"
        return text + (":inverted" if self.inverted else "") + (":legacy" if self.legacy else "")


Board: TypeAlias = Chessboard | CircleGrid | Charuco


def parse(text: str) -> Board:
    """The board described by a text.

    chessboard:9x6:25mm, circles:10x10:12mm[:DIAMETER], acircles:4x11:20mm[:DIAMETER],
    charuco:5x7:40mm:20mm:DICT_4X4_50[:inverted][:legacy]; lengths in mm, cm or m. Raises ValueError: the text is not
    valid; the message is one line with an example.
    """
    kind, *parts = [part.strip() for part in text.strip().split(":")]
    kind = kind.lower()
    if kind not in EXAMPLES:
        near = difflib.get_close_matches(kind, EXAMPLES, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(
            f"board {text!r}: expected one of {', '.join(EXAMPLES)} first, got {kind!r}; {hint}"
            f"example: {EXAMPLES[near[0] if near else 'chessboard']}"
        )
    try:
        return _board_of(kind, parts)
    except DictionaryError as error:  # this message lists the dictionaries instead of an example
        raise ValueError(f"board {text!r}: {error}") from None
    except ValueError as error:
        hint = "" if EXAMPLES[kind] in str(error) else f"; example: {EXAMPLES[kind]}"
        raise ValueError(f"board {text!r}: {error}{hint}") from None


def _board_of(kind: str, parts: list[str]) -> Board:
    wanted = 4 if kind == "charuco" else 2
    round_ones = kind in ("circles", "acircles")
    if len(parts) < wanted or (kind != "charuco" and len(parts) > wanted + round_ones):
        most = f"{wanted} or {wanted + 1}" if round_ones else f"{wanted}"
        raise ValueError(f"expected {most} parts after {kind!r}, got {len(parts)}")
    columns, rows = read_count(parts[0])
    if kind == "chessboard":
        return Chessboard(columns, rows, read_length(parts[1]))
    if kind != "charuco":
        diameter = read_length(parts[2]) if len(parts) > 2 else None
        return CircleGrid(columns, rows, read_length(parts[1]), kind == "acircles", diameter)
    words = [word.lower() for word in parts[4:]]
    for word in words:
        if word not in ("inverted", "legacy"):
            raise ValueError(f"expected 'inverted' or 'legacy' at the end, got {word!r}")
    return Charuco(
        columns,
        rows,
        read_length(parts[1]),
        read_length(parts[2]),
        parts[3],
        inverted="inverted" in words,
        legacy="legacy" in words,
    )


def _check_count(what: str, columns: int, rows: int) -> None:
    if min(columns, rows) < _FEWEST or max(columns, rows) > _MOST:
        raise ValueError(f"expected {_FEWEST} to {_MOST} {what} along each side, got {columns}x{rows}")


def _check_length(kind: str, what: str, length_m: float) -> None:
    if not (math.isfinite(length_m) and 1e-4 <= length_m <= 10):
        raise ValueError(
            f"{kind}: expected a {what} of 0.1 mm to 10 m, got {length_m:g} m; give the unit as in {EXAMPLES[kind]}"
        )


def _lattice(columns: int, rows: int, step: float) -> Array:
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([j.ravel() * step, i.ravel() * step, np.zeros(columns * rows)], axis=1)
