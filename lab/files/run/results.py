"""Reading a results folder back: the tables as arrays, arranged by frame and view.

A run writes plain CSV; the score and the report read it here. Nothing of the run itself is needed.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.text import columns
from lab.files.text.columns import CAUSAL
from tracking.statuses import PoseStatus, SpotStatus

SPOT_STATUSES = tuple(SpotStatus)
POSE_STATUSES = tuple(PoseStatus)
ABSENT = -1  # the status code of a row that the file does not have
_LARGE = 4_000_000  # bytes of a table: about where pandas is the faster, with its import
_ROWS_AT_ONCE = 1_500  # bounds the memory that text takes (1 MB): a long table is read in such pieces


@dataclass(frozen=True, slots=True)
class Text:
    """A column of words, each kept once."""

    codes: Ints  # (n,) index into words
    words: tuple[str, ...]

    def recoded(self, words: tuple[str, ...]) -> Ints:
        """(n,) index into the given words; -1 for a word that is not among them."""
        place = {word: i for i, word in enumerate(words)}
        return np.array([place.get(word, -1) for word in self.words] or [-1], dtype=np.int64)[self.codes]


@dataclass(frozen=True, slots=True)
class CsvColumns:
    """Some columns of a CSV file, n rows: numbers as float (nan where the field is empty), words coded."""

    numbers: dict[str, Array]
    texts: dict[str, Text]

    def __len__(self) -> int:
        return next((len(c) for c in self.numbers.values()), 0)

    def stack(self, *names: str) -> Array:
        """(n, k): the columns of these names side by side."""
        return np.stack([self.numbers[n] for n in names], axis=-1)


def read_table(
    path: Path, numbers: Iterable[str], texts: Iterable[str] = (), optional: Iterable[str] = ()
) -> CsvColumns:
    """The named columns of a CSV file; numbers that are `optional` are nan in a file without such a column.

    Other columns are ignored. The csv module reads small files and pandas large ones: spots.csv of 600 frames takes 14
    ms against 5, but importing pandas takes 400; of 50,000 frames 2.3 s against 0.4. Raises InputError.
    """
    numbers, texts = tuple(numbers), tuple(texts)
    table = _read_large(path, numbers, texts, tuple(optional))
    return _read_rows(path, numbers, texts, tuple(optional)) if table is None else table


def _read_large(path: Path, numbers: Sequence[str], texts: Sequence[str], optional: Sequence[str]) -> CsvColumns | None:
    """By pandas; None where the file is small or anything about it is unusual, which the other reader can name."""
    try:
        data = path.read_bytes() if path.stat().st_size >= _LARGE else b""
    except OSError:
        return None
    header = data[: data.find(b"\n") + 1].decode("utf-8", errors="replace").strip().split(",")
    there = [name for name in (*numbers, *texts) if name in header]
    rows = data.count(b"\n") if data.endswith(b"\n") else 0
    even = data.count(b",") == rows * (len(header) - 1) and b'"' not in data and b"\n\n" not in data
    if not rows or not even or not {*numbers, *texts} - set(optional) <= set(header):
        return None
    del data  # memory
    import pandas as pd

    # To the last bit; since 3.1 that is what pandas does, and asking for it is deprecated.
    exactly: Any = {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
    try:
        table = pd.read_csv(
            path,
            usecols=there,
            dtype={name: "category" if name in texts else float for name in there},
            keep_default_na=False,
            na_values={name: ["", "nan"] for name in numbers if name in there},
            **exactly,
        )
    except ValueError:
        return None
    coded = {}
    for name in texts:
        # In the order in which the words come, as the other reader has them.
        codes, words = pd.factorize(table[name])
        coded[name] = Text(np.asarray(codes, dtype=np.int64), tuple(map(str, words)))
    absent = np.full(len(table), np.nan)
    return CsvColumns({n: table[n].to_numpy(dtype=float) if n in table else absent.copy() for n in numbers}, coded)


def _read_rows(path: Path, numbers: Sequence[str], texts: Sequence[str], optional: Sequence[str]) -> CsvColumns:
    """By the csv module. Raises InputError."""
    pieces: dict[str, list[Array]] = {n: [] for n in numbers}
    code_pieces: dict[str, list[Ints]] = {n: [] for n in texts}
    words: dict[str, dict[str, int]] = {n: {} for n in texts}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            place = {name: i for i, name in enumerate(next(reader, []))}
            absent = {name for name in optional if name not in place}
            for name in (*numbers, *texts):
                if name not in place and name not in absent:
                    raise InputError(f"{path}: expected a column {name!r}, found {', '.join(place) or 'an empty file'}")
            while rows := list(islice(reader, _ROWS_AT_ONCE)):
                columns = list(zip(*rows, strict=True))
                for name in numbers:
                    if name in absent:
                        pieces[name].append(np.full(len(rows), np.nan))
                        continue
                    fields = [field or "nan" for field in columns[place[name]]]
                    pieces[name].append(np.array(list(map(float, fields))))
                for name in texts:
                    known = words[name]
                    codes = [known.setdefault(field, len(known)) for field in columns[place[name]]]
                    code_pieces[name].append(np.array(codes, dtype=np.int64))
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read: it is not text in UTF-8; process the run again") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: expected rows of equal length and numbers in number columns ({error})") from error
    return CsvColumns(
        numbers={n: np.concatenate([np.zeros(0), *pieces[n]]) for n in numbers},
        texts={n: Text(np.concatenate([np.zeros(0, dtype=np.int64), *code_pieces[n]]), tuple(words[n])) for n in texts},
    )


@dataclass(frozen=True, slots=True)
class SpotGrid:
    """spots.csv by frame and view: F frame numbers, V views."""

    frames: Ints  # (F,), rising
    t_s: Array  # (F,)
    views: tuple[tuple[str, str], ...]  # (V,) camera, spot
    uv_px: Array  # (F, V, 2), distorted pixels; nan where nothing is known
    sigma_px: Array  # (F, V, 2)
    predicted_px: Array  # (F, V, 2), before the picture was looked at
    gain: Array  # (F, V)
    label_probability: Array  # (F, V) that the label is right; nan without a label, and in older results
    status: Ints  # (F, V) index into SPOT_STATUSES, or ABSENT

    @property
    def measured(self) -> Bools:
        """(F, V): a detection stands behind the position."""
        return self.has(SpotStatus.MATCHED, SpotStatus.TURNED)

    def has(self, *statuses: SpotStatus) -> Bools:
        """(F, V): the status is one of these."""
        return np.isin(self.status, [SPOT_STATUSES.index(s) for s in statuses])

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras, in the order in which the file first names them."""
        return tuple(dict.fromkeys(camera for camera, _ in self.views))


@dataclass(frozen=True, slots=True)
class PoseTrack:
    """attitude.csv, covariance.csv and systematic.csv by frame: F frames."""

    frames: Ints  # (F,), rising
    t_s: Array  # (F,)
    world_from_body: Pose  # (F,); identity and nan translation where lost
    yaw_pitch_roll_deg: Array  # (F, 3)
    sigma_position_m: Array  # (F, 3)
    sigma_ypr_deg: Array  # (F, 3)
    spots_used: Array  # (F,)
    rms_px: Array  # (F,)
    status: Ints  # (F,) index into POSE_STATUSES, or ABSENT
    covariance: Array  # (F, 6, 6), of [dt (m, world), dtheta (rad, body)]; nan where the file has none
    systematic: Array  # (F, 6, 6), the calibration's share of it; nan where there is none
    velocity_m_s: Array  # (F, 3), of the body origin, in world; nan where unknown
    rate_rad_s: Array  # (F, 3), about the body's axes
    sigma_velocity_m_s: Array  # (F, 3)
    sigma_rate_rad_s: Array  # (F, 3)

    def has(self, status: PoseStatus) -> Bools:
        """(F,): the pose's status is this one."""
        return np.equal(self.status, POSE_STATUSES.index(status))

    @property
    def known(self) -> Bools:
        """(F,): there is a pose."""
        return np.all(np.isfinite(self.world_from_body.translation), axis=-1)


def on_grid(
    frame: Array, camera: Text, spot: Text, views: tuple[tuple[str, str], ...], frames: Ints
) -> tuple[Ints, Ints, Ints]:
    """Row numbers of a long table and their places on a grid: rows (k,), frame index (k,), view index (k,).

    Rows whose frame or view the grid does not have are left out.
    """
    cameras = tuple(dict.fromkeys(c for c, _ in views))
    spots = tuple(dict.fromkeys(s for _, s in views))
    place = np.full((len(cameras) + 1, len(spots) + 1), -1, dtype=np.int64)
    for i, (c, s) in enumerate(views):
        place[cameras.index(c), spots.index(s)] = i
    view = place[camera.recoded(cameras), spot.recoded(spots)]
    at = np.searchsorted(frames, frame)
    inside = at < len(frames)
    here = inside & (frames[np.where(inside, at, 0)] == frame) if len(frames) else inside
    rows = np.flatnonzero(here & (view >= 0))
    return rows, at[rows], view[rows]


def read_spots(results: Path) -> SpotGrid:
    """spots.csv of a results folder."""
    numbers = [c for c in columns.SPOTS if c not in ("camera", "spot", "status", "cov_uv_px2")]
    table = read_table(results / "spots.csv", numbers, ("camera", "spot", "status"), columns.ADDED)
    frame, camera, spot = table.numbers["frame"], table.texts["camera"], table.texts["spot"]
    frames = np.unique(frame).astype(np.int64)
    pairs = np.unique(np.stack([camera.codes, spot.codes], -1), axis=0) if len(table) else np.zeros((0, 2), np.int64)
    views = tuple((camera.words[c], spot.words[s]) for c, s in pairs)
    rows, i, j = on_grid(frame, camera, spot, views, frames)

    def grid(*names: str) -> Array:
        out = np.full((len(frames), len(views), len(names)), np.nan)
        out[i, j] = table.stack(*names)[rows]
        return out

    status = np.full((len(frames), len(views)), ABSENT, dtype=np.int64)
    status[i, j] = table.texts["status"].recoded(SPOT_STATUSES)[rows]
    t_s = np.full(len(frames), np.nan)
    t_s[i] = table.numbers["t_s"][rows]
    return SpotGrid(
        frames=frames,
        t_s=t_s,
        views=views,
        uv_px=grid("u_px", "v_px"),
        sigma_px=grid("sigma_u_px", "sigma_v_px"),
        predicted_px=grid("predicted_u_px", "predicted_v_px"),
        gain=grid("gain")[..., 0],
        label_probability=grid("label_probability")[..., 0],
        status=status,
    )


def pose_stack(position_m: Array, quaternion_wxyz: Array) -> Pose:
    """A stack of poses (n,) from (n, 3) and (n, 4); where a number is missing: nan translation, identity rotation."""
    known = np.all(np.isfinite(position_m), axis=-1) & np.all(np.isfinite(quaternion_wxyz), axis=-1)
    quaternion = np.where(known[:, None], quaternion_wxyz, [1.0, 0.0, 0.0, 0.0])
    return Pose.from_quaternion(quaternion, np.where(known[:, None], position_m, np.nan))


def read_poses(results: Path, causal: bool = False) -> PoseTrack:
    """attitude.csv, and covariance.csv and systematic.csv where there are such, of a results folder.

    causal: the tables of what was known at each instant, attitude_causal.csv and covariance_causal.csv, instead.
    """
    which = CAUSAL if causal else ""
    numbers = [c for c in columns.ATTITUDE if c != "status"]
    table = read_table(results / f"attitude{which}.csv", numbers, ("status",), columns.ADDED)
    frames = table.numbers["frame"].astype(np.int64)
    return PoseTrack(
        frames=frames,
        t_s=table.numbers["t_s"],
        world_from_body=pose_stack(table.stack("x_m", "y_m", "z_m"), table.stack("qw", "qx", "qy", "qz")),
        yaw_pitch_roll_deg=table.stack("yaw_deg", "pitch_deg", "roll_deg"),
        sigma_position_m=table.stack("sigma_x_m", "sigma_y_m", "sigma_z_m"),
        sigma_ypr_deg=table.stack("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg"),
        spots_used=table.numbers["spots_used"],
        rms_px=table.numbers["rms_px"],
        status=table.texts["status"].recoded(POSE_STATUSES),
        covariance=_read_covariance(results / f"covariance{which}.csv", frames),
        systematic=_read_covariance(results / "systematic.csv", frames),
        velocity_m_s=table.stack(*columns.MOTION[0:3]),
        rate_rad_s=table.stack(*columns.MOTION[3:6]),
        sigma_velocity_m_s=table.stack(*columns.MOTION[6:9]),
        sigma_rate_rad_s=table.stack(*columns.MOTION[9:12]),
    )


def has_causal(results: Path) -> bool:
    """Whether a results folder holds the causal filter's poses beside the smoothed ones."""
    return (results / f"attitude{CAUSAL}.csv").is_file()


def _read_covariance(path: Path, frames: Ints) -> Array:
    out = np.full((len(frames), 6, 6), np.nan)
    if not path.exists() or not len(frames):
        return out
    table = read_table(path, columns.COVARIANCE)
    at = np.searchsorted(frames, table.numbers["frame"])
    here = (at < len(frames)) & (frames[np.minimum(at, len(frames) - 1)] == table.numbers["frame"])
    for name in columns.COVARIANCE[1:]:
        i, j = int(name[1]), int(name[2])
        out[at[here], i, j] = out[at[here], j, i] = table.numbers[name][here]
    return out


def read_summary(results: Path) -> dict[str, Any]:
    """summary.json of a results folder; empty where there is none."""
    path = results / "summary.json"
    if not path.exists():
        return {}
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a JSON object ({error})") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(summary).__name__}")
    return summary
