"""Lenses and pairs from real photographs: `python -m bench.lenses.real [subsets] [seed] [PART ...]`.

PART: a set of SETS (the whole set, OpenCV's plain solve and the published focal length, then random subsets of 5 to 13
photographs), a pair of PAIRS, or sets (whole sets only); default: all sets and pairs. 100 subsets of each take an hour.
simulated-SET: the same spread in draws of the errors of a set, whose sigmas then are what the program makes of them.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.boards.board_types import parse
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.view_equations import ViewEquations
from calibration.lens.intrinsics import Intrinsics, IntrinsicsError, IntrinsicsOptions, calibrate_intrinsics
from calibration.pair import PairError, calibrate_pair
from geometry.arrays import Array, Bools, Ints
from lab.calibrate.camera.camera import corner_table
from lab.calibrate.camera.camera_page import findings_of
from lab.calibrate.camera.pair import baseline_sigma
from lab.calibrate.camera.pair import findings_of as pair_findings
from lab.calibrate.camera.photos import find_in_photos
from lab.findings.finding import Level, verdict

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
_TWO = "charuco_two_cameras/cam_"
_CHARUCO = "charuco:4x5:54mm:40.5mm:DICT_4X4_1000:inverted"
# Photographs, board, published focal length in px (None: none; see SOURCE.md of each set).
SETS: dict[str, tuple[str, str, float | None]] = {
    "stereo-left": ("chessboard_stereo_opencv/left0*.jpg", "chessboard:9x6:25mm", 535.9),
    "stereo-right": ("chessboard_stereo_opencv/right0*.jpg", "chessboard:9x6:25mm", None),
    "lowquality": ("chessboard_lowquality_400x300/*.png", "chessboard:9x6:25mm", None),
    "portrait-1": ("chessboard_portrait_cams/cam01/*.jpg", "chessboard:4x7:60mm", 1681.2),
    "portrait-2": ("chessboard_portrait_cams/cam02/*.jpg", "chessboard:4x7:60mm", 1673.7),
    "webcam": ("chessboard_webcam_c920/*.jpg", "chessboard:9x7:24.4mm", None),
    "robot-wrist": ("circlegrid_robot_wrist/images/*.png", "circles:10x10:25.4mm", 542.3),
    "charuco-0": (f"{_TWO}0.mp4", _CHARUCO, 903.6),
    "charuco-1": (f"{_TWO}1.mp4", _CHARUCO, 760.3),
}
SIMULATED = "simulated-"
PAIRS = {"stereo": ("stereo-left", "stereo-right")}


def table_of(name: str) -> tuple[CornerTable, float]:
    """The corners of a set, and the process time per photograph of their detection, with those without a board."""
    pattern, board, _ = SETS[name]
    start = time.process_time()
    photos = find_in_photos([DATA / pattern], parse(board))
    return corner_table(photos), (time.process_time() - start) / (len(photos.views) + len(photos.refused))


def calibrated(table: CornerTable, lens: LensModel | None = None) -> Intrinsics | str:
    """The camera, or why it could not be calibrated."""
    try:
        return calibrate_intrinsics(table, IntrinsicsOptions(lens=lens))
    except IntrinsicsError as error:
        return str(error)


def line(found: Intrinsics | str) -> str:
    """The result in a few words."""
    if isinstance(found, str):
        return f"ERROR {found[:80]}"
    findings = findings_of(found)
    failed = ",".join(f.code for f in findings if f.level is Level.FAIL)
    fx, sigma = found.fit.lens[0], found.sigmas[0]
    return f"{verdict(findings).name:4s} {found.model.title:7s} fx {fx:8.2f} ± {sigma:5.2f} px {failed}"


def plain_opencv(table: CornerTable) -> tuple[float, float, float]:
    """fx of cv2.calibrateCamera with five coefficients, and how much it scatters if one photograph is left out, px.

    The scatters are the jackknife's sigmas of the whole set: of fx, and of directions, px, which a tenth of the picture
    exceeds (turned onto each other, as poses of the camera take up a turn).
    """
    size = np.array(table.image_size_px)
    grid = np.stack(np.meshgrid(*((np.linspace(0, n - 1, 24)) for n in size)), axis=-1).reshape(-1, 1, 2)

    def solved(views: Ints) -> tuple[float, Array]:
        points = [table.points[table.view == v].astype(np.float32) for v in views]
        pixels = [table.pixels[table.view == v].astype(np.float32) for v in views]
        K, coefficients = cv2.calibrateCamera(points, pixels, table.image_size_px, None, None)[1:3]
        rays = np.append(cv2.undistortPoints(grid, K, coefficients)[:, 0], np.ones((len(grid), 1)), axis=1)
        return float(K[0, 0]), rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def away_px(rays: Array) -> Array:
        turn, _ = Rotation.align_vectors(whole, rays)
        return np.asarray(fx * np.linalg.norm(turn.apply(rays) - whole, axis=1))

    every = np.flatnonzero(table.counts() >= 6)
    fx, whole = solved(every)
    left = [solved(np.delete(every, k)) for k in range(len(every))]
    focal, px = np.array([f for f, _ in left]), np.array([away_px(rays) for _, rays in left])
    times = len(left) - 1
    scatter = np.sqrt(times * np.mean(px**2, axis=0))
    return fx, float(np.sqrt(times * np.mean((focal - focal.mean()) ** 2))), float(np.quantile(scatter, 0.9))


def is_usable(found: Intrinsics | str) -> bool:
    return not isinstance(found, str) and verdict(findings_of(found)) < Level.FAIL


def distinct_subsets(rng: np.random.Generator, views: int, most: int, count: int) -> list[Ints]:
    """Random subsets of 5 to `most` of the views, at most `count`, none twice: of six views there are only seven."""
    drawn = [rng.choice(views, rng.integers(5, most + 1), replace=False) for _ in range(count)]
    return [np.array(rows) for rows in dict.fromkeys(tuple(np.sort(one).tolist()) for one in drawn)]


def by_number(shares: list[float]) -> Array:
    """(n,): variance of subsets about the whole set over their own variance, if all photographs are alike."""
    return 1 - np.array(shares)


def by_information(equations: ViewEquations, subsets: list[Ints]) -> tuple[Array, Array]:
    """The same (n,) of fx from what each photograph determines, and the correlation (n, n) of these differences.

    A subset's fx is a sum over its photographs' gradients, which are independent; subsets share photographs, and the
    priors (on the radius of circles, which photographs alone may leave open) count in every one.
    """
    by_fx, own, weights = equations.basis[0], [], []
    priors = np.eye(len(by_fx)) - np.sum(equations.information, axis=0)
    information = np.concatenate([equations.information, priors[None]])
    for rows in subsets:
        mine = np.append(np.isin(equations.views, rows), True)
        a = np.linalg.solve(np.sum(information[mine], axis=0), by_fx)
        own.append(by_fx @ a)
        weights.append(mine[:, None] * a - by_fx)
    C = np.einsum("nvq,vqr,mvr->nm", weights, information, weights)
    sizes = np.sqrt(np.diagonal(C))
    return np.diagonal(C) / np.array(own), C / np.outer(sizes, sizes)


def spread(off: Array, sigmas: Array, ratios: Array, correlation: Array | None = None) -> str:
    """RMS and robust spread of subsets about the whole set, in sigmas.

    ratios: `by_number` or `by_information`; with the correlation, the chance of such an RMS if the sigmas are right.
    """
    if not len(off):
        return "no smaller subset"
    z = off / (sigmas * np.sqrt(ratios))
    square = float(np.mean(z**2))
    words = f"RMS {np.sqrt(square):.2f}, by the median {np.median(np.abs(z)) / 0.6745:.2f}"
    if correlation is not None:
        dof = len(z) ** 2 / float(np.sum(correlation**2))  # Satterthwaite's, of a sum of dependent squares
        words += f" (chance {chi2.sf(square * dof, dof):.2f}, {dof:.1f} degrees of freedom)"
    return f"{words} of {len(z)}"


def bench_set(name: str, count: int, seed: int) -> None:
    """A whole set, then random subsets of it."""
    table, seconds = table_of(name)
    start = time.process_time()
    whole = calibrated(table)
    took = 20 * ((time.process_time() - start) / table.views + seconds)
    fx, scatter, directions = plain_opencv(table)
    print(
        f"{name} ({table.views} photographs): {line(whole)}; OpenCV {fx:.2f}, jackknife ± {scatter:.2f}, directions"
        f" {directions:.2g} px; published {SETS[name][2]}; {took:.1f} s per 20 photographs",
        flush=True,
    )
    rng = np.random.default_rng([seed, list(SETS).index(name)])
    values: list[float] = []
    sigmas: list[float] = []
    subsets: list[Ints] = []
    failed = lost = 0
    drawn = distinct_subsets(rng, table.views, min(13, table.views), count)
    for rows in drawn:
        size, part = len(rows), table.only_views(rows)
        found = calibrated(part)
        if not is_usable(found):
            failed += 1
            others = [calibrated(part, LensModel(k)) for k in (4, 5)]
            if any(map(is_usable, others)):
                lost += 1
                print(f"  {size} photographs: {line(found)} | 4: {line(others[0])} | 5: {line(others[1])}", flush=True)
        if not isinstance(found, str) and size < table.views:
            values.append(float(found.fit.lens[0]))
            sigmas.append(float(found.sigmas[0]))
            subsets.append(rows)
    if count and not isinstance(whole, str):
        off = np.array(values) - float(whole.fit.lens[0])
        ratios, correlation = by_information(ViewEquations.of(whole.table, whole.fit), subsets)
        print(
            f"  {len(drawn)} subsets: FAIL {failed}, of these where 4 or 5 do not {lost}; fx in sigmas by the number of"
            f" photographs {spread(off, np.array(sigmas), by_number([len(s) / table.views for s in subsets]))}; by"
            f" their information {spread(off, np.array(sigmas), ratios, correlation)}",
            flush=True,
        )


APART = (0.0, 1.0, 2.0, 5.0)  # sizes of the errors of each photograph's own, in sigmas of the whole set's unknowns
DRAWS = 200


def bench_simulated(name: str, count: int, seed: int) -> None:
    """Draws of the gradients of a set's photographs, linear about its solution: are sigmas right, what is the spread?

    The gradient of a photograph is noise with the covariance of its information, and an error of its own.
    """
    table, _ = table_of(name)
    whole = calibrated(table)
    assert not isinstance(whole, str)
    equations = ViewEquations.of(whole.table, whole.fit)
    priors = np.eye(len(equations.basis)) - np.sum(equations.information, axis=0)
    roots = [_root(S) for S in (*equations.information, priors)]
    rng = np.random.default_rng(seed)
    views = len(equations.views)
    every = np.ones(views, dtype=bool)
    subsets = [s for s in distinct_subsets(rng, views, min(13, views), count) if len(s) < views]
    ratios, _ = by_information(equations, [equations.views[s] for s in subsets])
    for apart in APART:
        spreads, errors, significant = [], [], 0
        for _ in range(DRAWS):
            noise = [R @ rng.normal(size=len(R)) for R in roots]
            own = [apart * S @ rng.normal(size=len(S)) for S in equations.information]
            drawn = replace(equations, gradient=np.array(noise[:-1]) + np.array(own)), noise[-1]
            fx, sigma, scatters = _solved_part(*drawn, every)
            errors.append(fx / sigma)
            significant += scatters
            parts = [_solved_part(*drawn, np.isin(np.arange(views), s)) for s in subsets]
            off, sigmas = np.array([p[0] - fx for p in parts]), np.array([p[1] for p in parts])
            spreads.append(np.sqrt(np.mean((off / sigmas) ** 2 / ratios)))
        low, high = np.quantile(spreads, [0.05, 0.95])
        good = np.mean((np.array(spreads) >= 0.8) & (np.array(spreads) <= 1.3))
        print(
            f"  simulated {name}, errors {apart:g}: scatter significant in {significant / DRAWS:.0%}; fx in"
            f" sigmas, RMS {np.sqrt(np.mean(np.square(errors))):.2f}, within one {np.mean(np.abs(errors) < 1):.0%};"
            f" spread over subsets, RMS {np.sqrt(np.mean(np.square(spreads))):.2f}, of 90 % of the draws {low:.2f} to"
            f" {high:.2f}, .8 to 1.3 in {good:.0%}",
            flush=True,
        )


def _root(C: Array) -> Array:
    values, vectors = np.linalg.eigh(C)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def _solved_part(equations: ViewEquations, prior: Array, which: Bools) -> tuple[float, float, bool]:
    """fx of some views against the truth, its sigma, and whether they scatter; prior (q,): its gradient."""
    left = np.eye(len(prior)) - np.sum(equations.information[~which], axis=0)
    values, vectors = np.linalg.eigh(left)
    T = vectors / np.sqrt(values)  # to coordinates in which these views have the identity as information
    y = -T @ (T.T @ (np.sum(equations.gradient[which], axis=0) + prior))
    part = replace(
        equations,
        information=T.T @ equations.information[which] @ T,
        correlated=T.T @ equations.noise[which] @ T,
        gradient=(equations.gradient[which] + equations.information[which] @ y) @ T,
        views=equations.views[which],
        basis=equations.basis @ T,
    )
    spread = part.scatter()
    sigma = np.sqrt(part.scattered_covariance(spread)[0, 0])
    return float((equations.basis @ y)[0]), float(sigma), spread.is_significant


def bench_pair(name: str, count: int, seed: int) -> None:
    """The baseline of a pair: all photographs, then random subsets."""
    tables = [table_of(side)[0] for side in PAIRS[name]]
    views = tables[0].views

    def solved(rows: Ints, lens: LensModel | None = None) -> tuple[float, float, bool] | str:
        """Baseline and sigma, mm, and whether the pair is no FAIL; or why there is none."""
        single = [calibrated(t.only_views(rows), lens) for t in tables]
        if isinstance(single[0], str) or isinstance(single[1], str):
            return f"{single[0]} {single[1]}"
        numbers = list(range(len(rows)))
        try:
            pair = calibrate_pair(("left", "right"), (single[0], single[1]), (numbers, numbers))
        except PairError as error:
            return str(error)
        usable = verdict(pair_findings(pair, ("left", "right"))) < Level.FAIL
        return 1000 * pair.baseline_m, 1000 * baseline_sigma(pair), usable

    whole = solved(np.arange(views))
    print(f"pair {name}: baseline and sigma, mm: {whole}", flush=True)
    rng = np.random.default_rng(seed)
    values: list[float] = []
    sigmas: list[float] = []
    shares: list[float] = []
    failed = lost = 0
    drawn = distinct_subsets(rng, views, min(13, views - 1), count)
    for rows in drawn:
        size = len(rows)
        found = solved(rows)
        if isinstance(found, str) or not found[2]:
            failed += 1
            others = [solved(rows, LensModel(k)) for k in (4, 5)]
            lost += any(not isinstance(one, str) and one[2] for one in others)
            print(f"  {size} pairs: {found} | 4: {others[0]} | 5: {others[1]}", flush=True)
        if isinstance(found, str):
            continue
        values.append(found[0])
        sigmas.append(found[1])
        shares.append(size / views)
    if count and not isinstance(whole, str):
        around = spread(np.array(values) - whole[0], np.array(sigmas), by_number(shares))
        print(
            f"  {len(drawn)} subsets: FAIL {failed}, of these where 4 or 5 do not {lost}; baseline in sigmas {around}"
        )


def main(arguments: list[str]) -> None:
    """Print the figures."""
    count = int(arguments[0]) if arguments else 100
    seed = int(arguments[1]) if len(arguments) > 1 else 1
    parts = arguments[2:] or [*SETS, *PAIRS]
    if parts == ["sets"]:
        count, parts = 0, [*SETS]
    for part in parts:
        if part.startswith(SIMULATED):
            bench_simulated(part.removeprefix(SIMULATED), count, seed)
        else:
            (bench_set if part in SETS else bench_pair)(part, count, seed)


if __name__ == "__main__":
    main(sys.argv[1:])
