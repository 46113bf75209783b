"""Accuracy of calibrations and of their stated uncertainty: `python -m bench.calibration [seeds] [first seed] [PART]`.

Each figure is printed with its goal. 200 seeds take about 15 minutes on one core. PART: only lenses, circles or
random_lenses.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.rig_calibration import bench_figures
from calibration.boards.board_types import parse
from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_parameters import AS_STATED
from calibration.lens.fit.lens_start import start
from calibration.lens.intrinsics import IntrinsicsError, calibrate_intrinsics
from lab.calibrate.camera.camera_page import findings_of
from lab.findings.finding import Level, verdict
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import ARCSEC, exact, unknown_place
from tests.calibration.beams.test_beams import bench_case, tally
from tests.calibration.lens.lens_scenes import TRUTH, Scene, photographs
from tests.calibration.lens.random_lenses import corners_of, lens_error, random_lens
from tests.calibration.lens.rendered_circles import LENS as CIRCLE_LENS
from tests.calibration.lens.rendered_circles import CircleScene, table_of
from tests.calibration.lens.test_intrinsics import FIVE, bowed, coverage_and_nees
from tests.tracking.curve_switching.test_calibration_errors import mean_nees


def lenses(seeds: range) -> Iterator[tuple[str, str, str]]:
    """Coverage and NEES of single calibrations; five coefficients, 12 photographs, corners to 0.2 px."""
    z, nees = coverage_and_nees(seeds, FIVE)
    inside = 100 * (np.abs(z) < 1).mean(axis=0)
    band = 1.96 * np.sqrt(2 / z.size)
    yield "lens: each parameter within 1 sigma", f"{inside.min():.1f} to {inside.max():.1f} %", "62 to 75 %"
    yield "lens: NEES per parameter", f"{nees.mean():.3f}", f"{1 - band:.3f} to {1 + band:.3f}"


def circles(seeds: range) -> Iterator[tuple[str, str, str]]:
    """Grids of circles in 15 rendered photographs of 1280 x 1024, noise 2 DN; for two seeds with the whole search."""
    for text in ("acircles:4x11:20mm", "circles:9x7:25mm"):
        z, error, claim = [], [], []
        for seed in seeds:
            scene = CircleScene(parse(text))
            c = calibrate_intrinsics(table_of(scene, seed, searched=seed < seeds.start + 2), FIVE)
            truth = np.zeros(18)
            truth[:9] = CIRCLE_LENS
            off = (c.fit.lens - truth)[c.model.free]
            z.append(off / c.sigmas)
            error.append(np.nanmean(np.sum((c.map.by_parameter @ off) ** 2, axis=-1)))
            claim.append(np.nanmean(np.trace(c.map.covariance_px2(c.covariance), axis1=-2, axis2=-1)))
        inside = 100 * float(np.mean(np.abs(z) < 1))
        each = 100 * np.mean(np.abs(z) < 1, axis=0)
        kind = text.split(":")[0]
        yield (
            f"{kind}: parameters within 1 sigma",
            f"{inside:.0f} % ({each.min():.0f} to {each.max():.0f})",
            "60 to 76 %",
        )
        yield f"{kind}: projection error / stated", f"{np.sqrt(np.mean(error) / np.mean(claim)):.2f}", "0.8 to 1.25"


def random_lenses(seeds: range) -> Iterator[tuple[str, str, str]]:
    """Lenses of all kinds up to 120 deg, some of which no model describes; errors in the calibrated area."""
    ratios, silent, grave = [], 0, []
    for seed in seeds:
        true = random_lens(seed)
        try:
            c = calibrate_intrinsics(corners_of(true, seed))
        except IntrinsicsError as error:
            grave.append(f"{seed} {error}")
            continue
        j = lens_error(true, c)
        ratio = j.error_px / j.stated_px
        ratios.append(ratio)
        level = verdict(findings_of(c))
        silent += ratio > 1.3 and level is Level.PASS
        print(
            f"  {seed} {true.kind} {true.fov_deg:.0f} deg -> {c.model.title}: error {j.error_px:.3f} px, stated"
            f" {j.stated_px:.3f}, ratio {ratio:.2f}, {level.name}",
            flush=True,
        )
    good = int(np.sum(np.array(ratios) <= 1.3))
    found = f"{good} of {len(seeds)}; {silent} above without a warning; {len(grave)} refused"
    yield "random lenses: error / stated <= 1.3", found, "18 of 20; 0"
    yield "random lenses: median and worst ratio", f"{np.median(ratios):.2f}, {np.max(ratios):.2f}", ""


def bent_boards(seeds: range) -> Iterator[tuple[str, str, str]]:
    """A board bowed by 1.5 mm over 0.33 m, calibrated by us and by OpenCV for a plane board."""
    ours, plain = [], []
    for seed in seeds:
        scene = Scene(views=10, warp=bowed(0.0015, 0.33), columns=12, rows=8, distance_m=(0.45, 0.9))
        table = photographs(scene, seed)
        found = calibrate_intrinsics(table, FIVE)
        ours.append((found.fit.lens[0] - TRUTH[0]) / found.sigmas[0])
        views = [np.flatnonzero(table.view == v) for v in np.unique(table.view)]
        answer = cv2.calibrateCameraExtended(
            [table.points[v].astype(np.float32) for v in views],
            [table.pixels[v].astype(np.float32) for v in views],
            table.image_size_px,
            None,
            None,
        )
        plain.append(((answer[1][0, 0] - TRUTH[0]), float(np.ravel(answer[5])[0])))
    off, claimed = np.mean(plain, axis=0)
    found = f"{np.mean(ours):+.2f} sigma (of one set up to {np.abs(ours).max():.1f})"
    yield "bowed board: focal bias", found, "2 sigma"
    yield "bowed board: plain OpenCV", f"{off:+.0f} px at a stated sigma of {claimed:.1f} px", ""


def wrong_corners(seeds: range) -> Iterator[tuple[str, str, str]]:
    """Four corners of one view with an error of 8 px."""
    worst = 0.0
    for seed in seeds:
        table = photographs(Scene(), seed)
        model, values = start(table, False)
        clean = robust_fit(table, model, values, AS_STATED)
        pixels = table.pixels.copy()
        pixels[np.flatnonzero(table.view == 3)[[0, 1, 9, 10]]] += 8 / np.sqrt(2)
        model, values = start(replace(table, pixels=pixels), False)
        found = robust_fit(replace(table, pixels=pixels), model, values, AS_STATED)
        moved = (found.lens - clean.lens)[:9] / np.sqrt(np.diagonal(clean.covariance))
        worst = max(worst, float(np.abs(moved).max()))
    yield "four corners off by 8 px: largest move", f"{worst:.2f} sigma", "0.5 sigma"


def many_views() -> Iterator[tuple[str, str, str]]:
    """Process time for 400 photographs without the detection of corners."""
    table = photographs(Scene(views=400), 5)
    clock = time.process_time()
    calibrate_intrinsics(table)
    ours = time.process_time() - clock
    yield "400 views: model selection, hold-out and halves", f"{ours:.1f} s", "20 s"


def beams(seeds: range) -> Iterator[tuple[str, str, str]]:
    """40 stand positions, spots to 0.2 mm."""
    for name, known in (("known", exact), ("unknown", unknown_place)):
        within, nees, size = tally(bench_case(s, known, RIGS["unequal-fan"]()) for s in seeds)
        text = f"{size / ARCSEC:.1f} arcsec; {100 * within:.0f} % within 1 sigma, NEES {nees:.2f}"
        yield f"beam directions, pose of the stand {name}", text, "15 arcsec"


def rigs(seeds: range) -> Iterator[tuple[str, str, str]]:
    """Campaigns calibrated jointly, then new frames measured with the result."""
    f = bench_figures(seeds)
    yield (
        "attitude and position with a calibrated rig, one frame",
        (f"{f['attitude_rms_deg']:.4f} deg, {f['position_rms_mm']:.2f} mm RMS"),
        "0.01 deg, 0.5 mm",
    )
    yield (
        "NEES/6 of these poses; of the noise alone",
        (f"{f['nees_per_number']:.2f}; {f['nees_noise_alone']:.2f}"),
        "0.85 to 1.15",
    )


def runs(seeds: range) -> Iterator[tuple[str, str, str]]:
    """The tracker with rigs whose calibration errors are drawn from their stated covariance."""
    for scenario in ("clean", "four-skew-beams"):
        mean, _, _ = mean_nees(scenario, seeds)
        yield f"NEES/6 through the tracker, {scenario}", f"{mean:.2f}", "0.85 to 1.15"


def main(arguments: list[str]) -> None:
    """Print the table."""
    count = int(arguments[0]) if arguments else 200
    first = int(arguments[1]) if len(arguments) > 1 else 5000
    few = range(first, first + min(count, 10))
    seeds = range(first, first + count)
    parts: list[Callable[[], Iterator[tuple[str, str, str]]]] = [
        lambda: lenses(seeds), lambda: circles(range(first, first + min(count, 20))),
        lambda: random_lenses(range(first, first + min(count, 20))),
        lambda: bent_boards(few), lambda: wrong_corners(few), many_views,
        lambda: beams(seeds), lambda: rigs(seeds), lambda: runs(seeds),
    ]  # fmt: skip
    named = {"lenses": 0, "circles": 1, "random_lenses": 2}
    if len(arguments) > 2:
        parts = [parts[named[arguments[2]]]]
    for part in parts:
        for what, found, goal in part():
            print(f"{what:56s} {found:42s} {goal}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
