"""`beampose calibrate pair`: two cameras calibrated together, and the findings."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards.board_types import Board
from calibration.lens.fit.lens_models import named
from calibration.lens.intrinsics import (
    FEWEST_VIEWS,
    Intrinsics,
    IntrinsicsError,
    IntrinsicsOptions,
    calibrate_intrinsics,
)
from calibration.pair import CalibratedPair, PairError, calibrate_pair
from geometry.arrays import Array
from lab.calibrate.camera.camera import LENSES, corner_table
from lab.calibrate.camera.camera_page import findings_of as lens_findings
from lab.calibrate.camera.photos import PhotoSet, find_in_photos
from lab.calibrate.step import Solved, Step, run_step
from lab.errors import CalibrationError, InputError
from lab.files.rig.board_file import load_board_or_text
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.pair_file import PairFile, save_pair_file
from lab.files.text.csv_text import write_table
from lab.files.text.error_text import require_one_of
from lab.findings.finding import Finding, Level, Outcome, finding, level_above, verdict
from lab.number_format import format_length, format_number
from lab.pictures.source import number_of
from lab.progress import Progress
from lab.report.page import KeyFigure, PageTable, Section
from tracking.binocular.marker_model import StereoPair, calibration_jacobian, project

# Findings of a pair's calibration, and the uncertainty of distances that it leaves.

GOOD_MISFIT, LARGEST_MISFIT = 1.3, 3.0  # joint residuals over those of the cameras by themselves
GOOD_PAIRS = 8
_ENOUGH_PAIRS, _FEWEST_MORE = 15, 5  # pairs in all, and at least to add
GOOD_RANGE_SHARE, LARGEST_RANGE_SHARE = 0.002, 0.02  # sigma of the distance over the distance, at 20 baselines
BASELINES = (5.0, 10.0, 20.0, 40.0)
_JUDGED = 20.0


def range_sigmas(pair: CalibratedPair) -> Array:
    """(n, 2): distances, m, and their sigmas, m, due to the calibration alone, of points ahead between both axes.

    nan where a distance is not in both pictures.
    """
    stereo = StereoPair(pair.cameras, pair.covariance)
    out = []
    for times in BASELINES:
        distance = times * pair.baseline_m
        eyes = [c.camera_from_world.inverse() for c in pair.cameras]
        ahead = eyes[0].rotation[:, 2] + eyes[1].rotation[:, 2]
        point = (eyes[0].translation + eyes[1].translation) / 2 + distance * ahead / np.linalg.norm(ahead)
        pixels, J = project(stereo, point[None])
        if not np.isfinite(pixels).all():
            out.append([distance, np.nan])
            continue
        by_point = J.reshape(4, 3)
        by_calibration = calibration_jacobian(stereo, point[None]).reshape(4, -1)
        gain = np.linalg.pinv(by_point) @ by_calibration
        C = gain @ pair.covariance.matrix @ gain.T
        sight = ahead / np.linalg.norm(ahead)
        out.append([distance, float(np.sqrt(sight @ C @ sight))])
    return np.array(out)


def findings_of(pair: CalibratedPair, names: tuple[str, str]) -> tuple[Finding, ...]:
    """All findings."""
    found = [_misfit(pair), _count(pair), _range(pair)]
    for name, single in zip(names, pair.single, strict=True):
        # Warnings at most: the lens in use is that of the joint adjustment, whose residuals BP-Q01 judges.
        found += [
            finding("BP-Q04", Level.WARN, f"camera {name} ({f.code}): {f.what}", why=f.why, remedy=f.remedy)
            for f in lens_findings(single)
            if f.level > Level.PASS
        ]
    return tuple(found)


def next_pairs(pair: CalibratedPair, names: tuple[str, str]) -> str:
    """What to photograph next, in one sentence, from what the pairs lack."""
    wanted = max(_ENOUGH_PAIRS - len(pair.keys) + len(pair.separated), _FEWEST_MORE)
    places = [
        f"near the {' and the '.join(single.coverage.gaps)} of {name}'s picture"
        for name, single in zip(names, pair.single, strict=True)
        if single.coverage.gaps
    ]
    where = f", {' and '.join(places)}" if places else ""
    return (
        f"Photograph next: {wanted} more pairs, the board at rest and in both pictures, near and far{where}, tilted by"
        " 20 to 45 deg to all sides"
    )


def _misfit(pair: CalibratedPair) -> Finding:
    m = pair.misfit
    level = Level.PASS if m < GOOD_MISFIT else Level.WARN if m < LARGEST_MISFIT else Level.FAIL
    apart = f"; in {len(pair.separated)} pairs the board moved between the exposures" if pair.separated else ""
    what = f"joint residuals are {format_number(m)} times those of the cameras by themselves{apart}"
    return finding("BP-Q01", level, what)


def _count(pair: CalibratedPair) -> Finding:
    n = len(pair.keys) - len(pair.separated)
    level = Level.PASS if n >= GOOD_PAIRS else Level.WARN
    return finding("BP-Q02", level, f"{n} pairs of photographs show the board in both cameras")


def _range(pair: CalibratedPair) -> Finding:
    table = range_sigmas(pair)
    distance, sigma = table[BASELINES.index(_JUDGED)]
    share = sigma / distance
    ahead = f"{format_number(distance)} m"
    if not np.isfinite(share):
        return finding("BP-Q03", Level.WARN, f"a point {ahead} ahead (20 baselines) is not in both pictures")
    what = f"distances at {ahead} (20 baselines) are uncertain by {100 * share:.2g} % due to the calibration"
    return finding("BP-Q03", level_above(share, GOOD_RANGE_SHARE, LARGEST_RANGE_SHARE), what)


# `calibrate pair`: calibrates two cameras together; writes pair.yaml and a report.


PAIR, FAILED, PAIRS = "pair.yaml", "pair.failed.yaml", "pairs.csv"
PAIR_COLUMNS = ("number", "rms_px", "separated")
_STEP = Step("pair", (PAIRS,), PAIR)


@dataclass(frozen=True, slots=True)
class PairOptions:
    """Options of a pair's calibration."""

    names: tuple[str, str] = ("left", "right")
    lens: str = "auto"
    valid_days: int = 365

    def __post_init__(self) -> None:
        require_one_of("lens", self.lens, LENSES)
        if self.names[0] == self.names[1]:
            raise InputError(f"names: expected two different names, got {self.names[0]!r} twice")


def calibrate_pair_folder(
    left: Path | str,
    right: Path | str,
    board: Board | str | Path,
    out: Path,
    options: PairOptions = PairOptions(),
    progress: Progress | None = None,
) -> Outcome[CalibratedPair]:
    """Calibrate a pair from photographs of a board by both cameras; equal numbers in file names are one instant.

    left, right: a folder or a pattern. Writes pair.yaml, pairs.csv and report.html into the folder `out`. If the
    verdict is FAIL, the file is called pair.failed.yaml. Raises InputError: for pictures or a board that cannot be
    used; CalibrationError: if the photographs do not determine a camera or the pair.
    """
    return run_step(_STEP, out, lambda: _solve((left, right), board, options, progress))


def _solve(
    photos: tuple[Path | str, Path | str],
    board: Board | str | Path,
    options: PairOptions,
    progress: Progress | None,
) -> Solved[CalibratedPair]:
    day = datetime.date.today()
    known = load_board_or_text(board) if isinstance(board, str | Path) else board
    sets, single = [], []
    for name, path in zip(options.names, photos, strict=True):
        found = find_in_photos([path], known, progress, fewest=FEWEST_VIEWS)
        sets.append(found)
        single.append(_calibrated(name, found, options))
    numbers = (_numbers(sets[0], options.names[0]), _numbers(sets[1], options.names[1]))
    title = f"{options.names[0]} and {options.names[1]}"
    try:
        pair = calibrate_pair(options.names, (single[0], single[1]), numbers)
    except PairError as error:
        raise CalibrationError(f"{title}: {error}") from None
    findings = findings_of(pair, options.names)
    failed = verdict(findings) is Level.FAIL

    def write(folder: Path) -> None:
        save_pair_file(_file_of(pair, findings, day, options), folder / (FAILED if failed else PAIR))
        rows = zip(pair.keys, pair.pair_rms_px.tolist(), strict=True)
        write_table(
            folder / PAIRS,
            PAIR_COLUMNS,
            [[k, "" if np.isnan(r) else f"{r:.4f}", int(k in pair.separated)] for k, r in rows],
        )

    sigma = format_length(baseline_sigma(pair))
    return Solved(
        name=title,
        result=pair,
        findings=findings,
        figures=f"baseline {format_length(pair.baseline_m)} ± {sigma}, RMS {pair.rms_px[0]:.3f} and"
        f" {pair.rms_px[1]:.3f} px",
        write=write,
        page=lambda: page_of(pair, options.names),
        day=day,
        inputs=list(dict.fromkeys(s.paths[name] for s in sets for name, _ in s.views)),
        advice=next_pairs(pair, options.names),
    )


def baseline_sigma(pair: CalibratedPair) -> float:
    """1 sigma of the baseline, m: the length of the right camera's translation."""
    t = pair.cameras[1].camera_from_world.translation
    along = t / np.linalg.norm(t)
    C = pair.covariance.matrix[-6:-3, -6:-3]
    return float(np.sqrt(along @ C @ along))


def _calibrated(name: str, found: PhotoSet, options: PairOptions) -> Intrinsics:
    lens = None if options.lens == "auto" else named(options.lens)
    try:
        return calibrate_intrinsics(
            corner_table(found), IntrinsicsOptions(lens=lens, names=tuple(n for n, _ in found.views))
        )
    except IntrinsicsError as error:
        raise CalibrationError(f"{name} ({found.line()}): {error}") from None


def _numbers(photos: PhotoSet, name: str) -> list[int]:
    """The number in the name of each view's picture. Raises InputError where one has none, or two have the same."""
    out: list[int] = []
    for view, _ in photos.views:
        number = number_of(f"{Path(view).stem}.png")
        if number is None:
            raise InputError(f"{name}: {view}: expected a number in the name, which says to which picture of the other"
                             " camera it belongs")  # fmt: skip
        if number in out:
            raise InputError(f"{name}: {view}: expected one picture of number {number}, got two; rename or remove one")
        out.append(number)
    return out


def _file_of(pair: CalibratedPair, findings: Sequence[Finding], day: datetime.date, options: PairOptions) -> PairFile:
    level = verdict(findings)
    until = None if level is Level.FAIL else day + datetime.timedelta(options.valid_days)
    why = tuple(f"{f.level.name}: {f.what}" for f in findings if f.level > Level.PASS)
    cameras = dict(zip(options.names, pair.cameras, strict=True))
    return PairFile(
        cameras, pair.covariance, CalibrationState(date=day, verdict=level.name, valid_until=until, reasons=why)
    )


def page_of(pair: CalibratedPair, names: tuple[str, str]) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report."""
    sigma = np.sqrt(np.diagonal(pair.covariance.matrix))
    table = range_sigmas(pair)
    right = pair.cameras[1].camera_from_world
    angles = np.rad2deg(right.ypr)
    parameters = [
        [name, _value(pair, names, name), float(s)] for name, s in zip(pair.covariance.names, sigma, strict=True)
    ]  # fmt: skip
    return (
        [
            ("baseline", format_length(pair.baseline_m), f"± {format_length(baseline_sigma(pair))}"),
            ("pairs", str(len(pair.keys) - len(pair.separated)), "photographs with the board in both cameras"),
            ("residual", f"{pair.rms_px[0]:.3f} / {pair.rms_px[1]:.3f} px", "RMS per coordinate, left / right"),
            ("misfit", format_number(pair.misfit), "joint residuals over single ones; 1 expected"),
            ("right camera turned", f"{format_number(float(np.linalg.norm(angles)))} deg", "against the left one"),
        ],
        [
            Section(
                "Distances",
                "Sigma of a distance due to this calibration alone, for a point straight ahead. It is the same in all"
                " frames: averaging does not reduce it.",
                table=PageTable(
                    ("distance (m)", "sigma (mm)", "share (%)"),
                    [[float(d), 1000 * float(s), 100 * float(s / d)] for d, s in table],
                ),
            ),
            Section(
                "Pairs",
                "RMS of the residuals of each pair of photographs, both cameras together.",
                table=PageTable(
                    ("number", "RMS (px)", "used as a pair"),
                    [[k, float(r), k not in pair.separated] for k, r in zip(pair.keys, pair.pair_rms_px, strict=True)],
                ),
            ),
            Section(
                "Parameters",
                "The world is the frame of the left camera. The errors of the right camera's pose are [dt in the"
                " camera, dtheta in world]; pair.yaml has the joint covariance.",
                table=PageTable(("parameter", "value", "sigma"), parameters),
            ),
        ],
    )


def _value(pair: CalibratedPair, names: tuple[str, str], name: str) -> float:
    """The value of a parameter; of rotations those of the rotation vector of camera_from_world."""
    from geometry.rotations import log
    from geometry.uncertainty.rig_uncertainty import PINHOLE, POSE, distortion_names, split_name

    _, item, parameter = split_name(name)
    camera = pair.cameras[names.index(item)]
    pinhole = [camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]]
    pose = [*camera.camera_from_world.translation, *log(camera.camera_from_world.rotation)]
    values = dict(zip((*PINHOLE, *distortion_names(camera), *POSE), (*pinhole, *camera.distortion, *pose), strict=True))
    return float(values[parameter])
