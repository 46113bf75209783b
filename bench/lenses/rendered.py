"""Lenses from rendered photographs with exact truth: `python -m bench.lenses.rendered [sets] [seed] [n] [KIND ...]`.

KIND: LENS-BOARD with LENS plain (five coefficients), zoom (the same, 15 to 30 deg wide, tangential coefficients of
.006), rational (eight) or fisheye and BOARD chess, circles, acircles or charuco; default: all sixteen. A set has 6 to
40 photographs of 1280 x 960 px, or n. Ten sets per kind take an hour or two.
Process times of sets of fewer than 20 are too long: not all of the work grows with the photographs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board, Charuco, CircleGrid, parse
from calibration.boards.board_view import BoardView
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel, folds_in_picture, rational_of_fisheye
from calibration.lens.intrinsics import Intrinsics, IntrinsicsError, IntrinsicsOptions, calibrate_intrinsics
from geometry.arrays import Array
from geometry.camera import FISHEYE, PERSPECTIVE, Camera
from geometry.pose import Pose
from geometry.rotations import exp
from lab.calibrate.camera.camera import corner_table
from lab.calibrate.camera.camera_page import findings_of
from lab.calibrate.camera.photos import PhotoSet
from lab.findings.finding import Level, verdict
from lab.simulate.board_photo import PhotoSettings, photograph
from tests.calibration.lens.random_lenses import KEPT, TrueLens, lens_error

SIZE = (1280, 960)
LENSES = ("plain", "rational", "fisheye", "zoom")
BOARDS = {
    "chess": "chessboard:9x6:30mm",
    "circles": "circles:9x7:30mm",
    "acircles": "acircles:4x11:24mm",
    "charuco": "charuco:9x7:30mm:22mm:DICT_4X4_50",
}
LOOK = PhotoSettings(blur_px=0.7, noise_dn=2.0)
MOST_TILT_DEG = 65.0  # of a board against the line of sight: nobody photographs boards almost from the side


@dataclass(frozen=True, slots=True)
class RenderedSet:
    """Detected points, their true positions and the true lens."""

    table: CornerTable
    truth: Array  # (N, 2), px
    lens: Array  # (18,)
    fisheye: bool
    seconds: float  # process time of the detection, per photograph, with those in which the board is not found


def true_lens(kind: str, rng: np.random.Generator) -> Array:
    """(18,), of a lens that does not fold in the picture: real lenses never do."""
    while True:
        lens = _drawn(kind, rng)
        if not folds_in_picture(lens, kind == "fisheye", SIZE):
            return lens


def _drawn(kind: str, rng: np.random.Generator) -> Array:
    out = np.zeros(18)
    centre = (np.array(SIZE) - 1) / 2 + rng.normal(0, 8, 2)
    if kind == "plain":
        f = rng.uniform(850, 1100)
        out[:4] = f, f * (1 + rng.normal(0, 3e-4)), *centre
        out[4:9] = rng.uniform(-0.35, -0.1), rng.uniform(0.05, 0.15), *rng.normal(0, 5e-4, 2), rng.uniform(-0.1, 0.1)
        return out
    if kind == "zoom":
        f = rng.uniform(2400, 4800)
        out[:4] = f, f * (1 + rng.normal(0, 3e-4)), *centre
        out[4:9] = rng.uniform(-0.6, 0.2), rng.uniform(-0.5, 0.5), *(rng.choice([-1, 1], 2) * 0.006), 0.0
        return out
    f = rng.uniform(400, 480) if kind == "fisheye" else rng.uniform(480, 560)
    out[:4] = f, f * (1 + rng.normal(0, 3e-4)), *centre
    out[4:8] = rng.uniform(-0.02, 0.04), rng.uniform(-0.01, 0.01), rng.normal(0, 2e-3), 0.0
    if kind == "rational":
        out = rational_of_fisheye(out, np.deg2rad(62))
        out[6:8] = rng.normal(0, 3e-4, 2)
    return out


def rendered_set(kind: str, text: str, seed: int, views: int | None = None) -> RenderedSet:
    """The photographs of one set; 6 to 40 of them."""
    rng = np.random.default_rng([seed, len(text), LENSES.index(kind)])
    lens, board, fisheye = true_lens(kind, rng), parse(text), kind == "fisheye"
    fx, fy, cx, cy = lens[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    coefficients = {"plain": 5, "zoom": 5, "rational": 8, "fisheye": 4}[kind]
    camera = Camera(
        "", "", SIZE, K, tuple(lens[4 : 4 + coefficients]), Pose.identity(), lens=FISHEYE if fisheye else PERSPECTIVE
    )
    wanted = int(rng.integers(6, 41)) if views is None else views
    found: list[BoardView] = []
    truth = []
    clock, searched = 0.0, 0
    partial = text.startswith("charuco")
    while len(found) < wanted:
        pose = _pose(board, fx, kind in ("rational", "fisheye"), partial, rng)
        inside = np.all((p := camera.project(pose.apply(board.points))) > 12, axis=1) & np.all(
            p < np.array(SIZE) - 13, 1
        )
        sight = pose.apply(board.middle)
        facing = float(pose.rotation[:, 2] @ sight / np.linalg.norm(sight))
        if inside.mean() < (0.5 if partial else 1.0) or facing < np.cos(np.deg2rad(MOST_TILT_DEG)):
            continue
        picture = photograph(board, camera, pose, look=LOOK, seed=int(rng.integers(1 << 30)))
        start = time.process_time()
        view = find_board(picture.image, board)
        clock += time.process_time() - start
        searched += 1
        if isinstance(view, BoardView):
            found.append(view)
            truth.append(_nearest(board, picture.pixels, view))
    table = corner_table(PhotoSet(board, SIZE, tuple(("", v) for v in found), (), {}))
    return RenderedSet(table, np.concatenate(truth), lens, fisheye, clock / searched)


def _pose(board: Board, f: float, wide: bool, partial: bool, rng: np.random.Generator) -> Pose:
    R = exp(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.5])
    share = rng.uniform(0.35, 0.8)
    z = f * max(board.size_m) / (SIZE[0] * share) * (0.75 if wide else 1.0)
    reach = 0.85 if wide else 0.5
    at = np.append(rng.uniform(-reach, reach, 2) * np.array(SIZE) / f * (1.1 if partial else 1.0), 1.0) * z
    return Pose(R, at - R @ board.middle)


def _nearest(board: Board, pixels: Array, view: BoardView) -> Array:
    """The true pixels of the points of a view, in the numbering of a symmetric board that the view has."""
    return pixels[np.searchsorted(board.ids, view.ids)] if not _is_symmetric(board) else _matched(pixels, view.pixels)


def _is_symmetric(board: Board) -> bool:
    """Whether the board looks the same after a rotation in its plane, so that its numbering has several solutions."""
    if isinstance(board, Charuco):
        return False
    if isinstance(board, CircleGrid):
        return not board.asymmetric or board.rows % 2 == 0
    return (board.columns + board.rows) % 2 == 0


def _matched(truth: Array, found: Array) -> Array:
    return truth[np.argmin(np.linalg.norm(found[:, None] - truth[None], axis=2), axis=1)]


def projection(s: RenderedSet) -> TrueLens:
    """The true lens for `lens_error`."""
    from geometry.camera import project_points_full

    wide = np.asarray(s.fisheye)
    return TrueLens(
        "", 0.0, lambda x: project_points_full(x, s.lens[:4], s.lens[4:], np.asarray(np.inf), wide).pixels, s.lens[0]
    )


@dataclass(frozen=True, slots=True)
class Row:
    """The result of one set."""

    kind: str
    model: str
    level: str
    lost: bool  # FAIL where 4, 5 or fisheye coefficients give PASS or WARN
    z: Array  # errors of fx, fy, cx, cy in sigmas
    ratio: float  # error of directions where corners were seen, over the claim
    error_px: float
    chance: float  # of such a ratio or a larger one, if the stated covariance is right
    kept: float  # the probability of a ratio of at most 1.3 then, by Monte Carlo
    seconds_20: float  # process time per 20 photographs


def judged(kind: str, s: RenderedSet) -> Row:
    """Calibrate one set."""
    start = time.process_time()
    c = _calibrated(s.table, None)
    seconds = 20 * ((time.process_time() - start) / s.table.views + s.seconds)
    lost = False
    if c is None or verdict(findings_of(c)) is Level.FAIL:
        others = [_calibrated(s.table, m) for m in (LensModel(4), LensModel(5), LensModel(4, FISHEYE))]
        lost = any(o is not None and verdict(findings_of(o)) < Level.FAIL for o in others)
    if c is None:
        return Row(kind, "none", "ERROR", lost, np.full(4, np.nan), np.nan, np.nan, np.nan, np.nan, seconds)
    e = lens_error(projection(s), c)
    z = (c.fit.lens - s.lens)[:4] / c.sigmas[:4]
    return Row(
        kind,
        c.model.title,
        verdict(findings_of(c)).name,
        lost,
        z,
        e.error_px / e.stated_px,
        e.error_px,
        e.chance,
        e.kept,
        seconds,
    )


def _calibrated(table: CornerTable, lens: LensModel | None) -> Intrinsics | None:
    try:
        return calibrate_intrinsics(table, IntrinsicsOptions(lens=lens))
    except IntrinsicsError:
        return None


def corner_error(s: RenderedSet) -> tuple[float, float, float]:
    """RMS of the points' errors, px; their mean component towards the picture's centre; and its standard error."""
    off = s.table.pixels - s.truth
    inward = s.lens[2:4] - s.truth
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    along = np.sum(off * inward, axis=1)
    return float(np.sqrt(np.mean(off**2))), float(along.mean()), float(along.std() / np.sqrt(len(along)))


def summary(rows: Sequence[Row]) -> str:
    """One line for several sets."""
    z = np.array([r.z for r in rows])
    ratio = np.array([r.ratio for r in rows])
    failed = sum(r.level in ("FAIL", "ERROR") for r in rows)
    return (
        f"FAIL {failed}, of these lost {sum(r.lost for r in rows)}, of {len(rows)}; within 1 sigma"
        f" {100 * np.nanmean(np.abs(z) < 1):.0f} %; map error over claim: median {np.nanmedian(ratio):.2f}, RMS"
        f" {np.sqrt(np.nanmean(ratio**2)):.2f}, at most {KEPT} in {100 * np.mean(ratio <= KEPT):.0f} % (claims that are"
        f" right: {100 * np.nanmean([r.kept for r in rows]):.0f} %), chance below .05 in"
        f" {100 * np.mean([r.chance < 0.05 for r in rows]):.0f} %; fx {np.nanmean(z[:, 0]):+.2f} sigmas in the mean;"
        f" {np.max([r.seconds_20 for r in rows]):.1f} s per 20 photographs at most"
    )


def main(arguments: list[str]) -> None:
    """Print a line per set and per kind, and one for all."""
    count = int(arguments[0]) if arguments else 10
    first = int(arguments[1]) if len(arguments) > 1 else 1
    views = int(arguments.pop(2)) if len(arguments) > 2 and arguments[2].isdigit() else None
    kinds = arguments[2:] or [f"{lens}-{board}" for lens in LENSES for board in BOARDS]
    every: list[Row] = []
    cv2.setNumThreads(1)  # as the commands do, which search several photographs at a time
    for kind in kinds:
        lens, board = kind.split("-")
        rows = []
        for seed in range(first, first + count):
            s = rendered_set(lens, BOARDS[board], seed, views)
            row = judged(kind, s)
            rms, inward, error = corner_error(s)
            print(
                f"{kind:17s} {seed:4d} {s.table.views:3d} photographs: {row.level:5s} {row.model:7s}"
                f" z {np.round(row.z, 1).tolist()} map {row.error_px:.3f} px, {row.ratio:.2f} of the claim (chance"
                f" {row.chance:.2f});"
                f" points {rms:.3f} px, inward {inward:+.4f} ± {error:.4f} px; {row.seconds_20:.1f} s"
                f"{' LOST' if row.lost else ''}",
                flush=True,
            )
            rows.append(row)
        every += rows
        print(f"{kind}: {summary(rows)}", flush=True)
    print(f"all: {summary(every)}")


if __name__ == "__main__":
    main(sys.argv[1:])
