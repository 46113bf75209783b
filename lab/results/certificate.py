"""`beampose report --certificate`: the uncertainty of attitude and position in the form of the GUM (JCGM 100:2008)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.budget import axes_jacobian
from calibration.run_budget import (
    COVERAGE,
    LINES,
    CalibrationShare,
    Expanded,
    along_axes,
    calibration_share,
    expanded,
    monte_carlo,
)
from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.run.results import PoseTrack, ResultFolder, SpotGrid, read_result_table
from lab.files.run.run_file import Run
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_write_text
from lab.findings.finding import Done
from lab.number_format import format_number
from lab.report.page import Page, PageTable, Section, html_of, made_with
from tracking.statuses import PoseStatus

FILE_NAME = "certificate.html"
DRAWS = 10_000  # of the Monte Carlo: its expanded uncertainty is known to 1 %
NOISE, PLACES, TURNS, CLOCKS = "centroid noise", "errors of a place", "turns within the exposure", "cameras' clocks"
# Type of evaluation, distribution, and where the figure comes from.
EVALUATED = {
    NOISE: ("A", "normal", "residuals of the recording"),
    PLACES: ("A", "normal", "products of residuals at the same place; mean of the posterior distribution"),
    TURNS: ("B", "uniform", "instant of a velocity jump within the step, which is not known"),
    CLOCKS: ("A", "normal", "the recording, where run.yaml lets the clocks be estimated; stated clocks are exact"),
    **dict.fromkeys(LINES, ("B", "normal", "covariance in rig.yaml, from the calibration")),
}
# Name, place in `AXES`, unit and scale of a value, unit and scale of its uncertainty.
_SHOWN = (
    *((name, i, "deg", 1.0, "mdeg", 1e3) for name, i in (("yaw", 3), ("pitch", 4), ("roll", 5))),
    *((name, i, "mm", 1e3, "µm", 1e6) for name, i in (("x", 0), ("y", 1), ("z", 2))),
)
_HEADS = tuple(f"{name} ({unit})" for name, _, _, _, unit, _ in _SHOWN)


@dataclass(frozen=True, slots=True)
class FrameCertificate:
    """The budget of one measured frame along `AXES`."""

    frame: int
    t_s: float
    value: Array  # (6,)
    rotation: Array  # (3, 3) world from body
    lines: tuple[str, ...]
    variances: Array  # (l, 6), m^2 and deg^2
    degrees_of_freedom: Array  # (l,)
    result: Expanded
    share: CalibrationShare | None
    spots: int
    spot_sigma_px: float  # root mean square
    draws: int  # of the Monte Carlo
    simulated: tuple[Array, Array] | None = None  # standard and expanded uncertainty (6,) by Monte Carlo


@dataclass(frozen=True, slots=True)
class Certificate:
    """The budgets of a result: of chosen frames, and the expanded uncertainty of all measured frames."""

    name: str
    summary: Mapping[str, Any]  # summary.json
    run: Run
    frames: tuple[FrameCertificate, ...]
    measured: Ints  # (k,) frame numbers
    over_recording: Expanded  # (k, 6)


def certificate(
    results: Path, run_folder: Path | None = None, at: Sequence[int] = (), draws: int = DRAWS
) -> Certificate:
    """The budgets of the frames `at`; without any, of the measured frame with the median uncertainty of attitude.

    Raises InputError: a table or the run folder cannot be read, or a frame is not measured.
    """
    folder = ResultFolder(results, run_folder)
    run, poses, spots = folder.run(), folder.poses, folder.spots
    stated = _rest_parts(results, poses)
    measured = np.flatnonzero(poses.has(PoseStatus.MEASURED) & np.isfinite(poses.covariance).all(axis=(1, 2)))
    if not len(measured):
        raise InputError(f"{results}: expected a frame with a measured pose, found none")
    if set(spots.views) != set(run.rig.views()):
        raise InputError(f"{run.path}: expected the cameras and spots of {results}, found another rig")
    dof = _degrees_of_freedom(spots, measured, poses)
    rest = _rest_variances(poses, measured, *stated)
    systematic = np.nan_to_num(poses.systematic[measured])
    calibration = along_axes(systematic, poses.world_from_body[measured])
    whole = expanded(np.concatenate([rest, calibration[None]]), np.array([dof, *[np.inf] * len(rest)]))
    chosen = [int(poses.frames[measured[k]]) for k in _median(whole)] if not at else list(at)
    made = []
    for number in chosen:
        here = np.flatnonzero(poses.frames[measured] == number)
        if not len(here):
            raise InputError(
                f"--at {number}: expected a frame with a measured pose, found another or none of this number"
            )
        made.append(_of_frame(run, poses, spots, int(measured[here[0]]), rest[:, here[0]], dof, draws))
    return Certificate(results.resolve().name, folder.summary, run, tuple(made), poses.frames[measured], whole)


def _rest_parts(results: Path, poses: PoseTrack) -> tuple[Array, Array, Array]:
    """By frame: share (T,) of errors of places; covariances (T, 6, 6) of turns and of clocks; 0 where not stated."""
    share, turns, clocks = np.zeros(len(poses.frames)), *np.zeros((2, len(poses.frames), 6, 6))
    path = results / "budget.csv"
    if path.is_file():
        table = read_result_table(path, columns.BUDGET)
        at = np.searchsorted(poses.frames, table.numbers["frame"])
        share[at] = table.numbers["place_share"]
        turns[at] = table.stack(*columns.BUDGET[2:8])[..., None] ** 2 * np.eye(6)
        for name, i, j in zip(columns.BUDGET[8:], *np.triu_indices(6), strict=True):
            clocks[at, i, j] = clocks[at, j, i] = table.numbers[name]
    return share, turns, clocks


def _rest_variances(poses: PoseTrack, rows: Ints, place_share: Array, turns: Array, clocks: Array) -> Array:
    """Variances (4, k, 6) along `AXES` of noise, errors of places, turns and clocks in some frames."""
    pose = poses.world_from_body[rows]
    rest = poses.covariance[rows] - np.nan_to_num(poses.systematic[rows])
    both = along_axes(rest - turns[rows] - clocks[rows], pose)
    share = place_share[rows, None]
    each = [along_axes(part[rows], pose) for part in (turns, clocks)]
    return np.stack([(1 - share) * both, share * both, *each])


def _degrees_of_freedom(spots: SpotGrid, measured: Ints, poses: PoseTrack) -> float:
    """Of the residuals that the noise is estimated from: coordinates of the spots less six for each pose."""
    rows = np.isin(spots.frames, poses.frames[measured])
    return float(max(2 * int(spots.measured[rows].sum()) - 6 * len(measured), 1))


def _median(whole: Expanded) -> list[int]:
    """Row of the frame whose expanded uncertainty of the attitude is the median."""
    size = np.linalg.norm(whole.expanded[:, 3:], axis=1)
    return [int(np.argsort(size, kind="stable")[len(size) // 2])]


def _of_frame(
    run: Run, poses: PoseTrack, spots: SpotGrid, k: int, rest: Array, dof: float, draws: int
) -> FrameCertificate:
    pose, row = poses.world_from_body[k], int(np.searchsorted(spots.frames, poses.frames[k]))
    order = {view: i for i, view in enumerate(spots.views)}
    place = np.array([order[view] for view in run.rig.views()])
    seen = spots.measured[row][place]
    rows = np.flatnonzero(seen)
    sigma = spots.sigma_px[row][place][rows]
    cov = np.einsum("mi,ij->mij", sigma**2, np.eye(2))
    cov[:, 0, 1] = cov[:, 1, 0] = np.nan_to_num(spots.cov_uv_px2[row][place][rows])
    systematic = poses.systematic[k]
    names, variances = [NOISE, PLACES, TURNS, CLOCKS], [*rest]
    share = None
    if run.covariance is not None and np.isfinite(systematic).all() and np.any(systematic):
        share = calibration_share(run.rig, run.covariance, pose, rows, cov, systematic)
        for line, part in share.by_line().items():
            names.append(line)
            variances.append(along_axes(part, pose))
    freedom = np.array([dof, *[np.inf] * (len(names) - 1)])
    random = poses.covariance[k] - np.nan_to_num(systematic)
    simulated = monte_carlo(run.rig, share, pose, random, dof, draws, 0) if draws else None
    return FrameCertificate(
        frame=int(poses.frames[k]),
        t_s=float(poses.t_s[k]),
        value=np.concatenate([pose.translation, poses.yaw_pitch_roll_deg[k]]),
        rotation=pose.rotation,
        lines=tuple(names),
        variances=np.array(variances),
        degrees_of_freedom=freedom,
        result=expanded(np.array(variances), freedom),
        share=share,
        spots=len(rows),
        spot_sigma_px=float(np.sqrt(np.mean(sigma**2))),
        draws=draws,
        simulated=simulated,
    )


# The page.


def write_certificate(
    results: Path, run_folder: Path | None = None, at: Sequence[int] = (), draws: int = DRAWS
) -> Done[Path]:
    """Write certificate.html into a results folder. Raises InputError."""
    found = certificate(results, run_folder, at, draws)
    path = results / FILE_NAME
    atomic_write_text(html_of(_page(found, results)), path)
    frames = ", ".join(str(f.frame) for f in found.frames)
    return Done(path, (f"certificate: {path} (frame {frames}; range of {len(found.measured)} frames)",))


def _page(c: Certificate, results: Path) -> Page:
    of_frames = [section for f in c.frames for section in _frame_sections(f)]
    sections = [_measurand(c), *of_frames, _range(c), _traceability(c, results)]
    first = c.frames[0].result
    low, high = f"{first.factor.min():.2f}", f"{first.factor.max():.2f}"
    note = f"frame {c.frames[0].frame}, k = {low if low == high else f'{low} to {high}'}"
    keys = [
        (f"U of the {label}, worst axis", f"{format_number(scale * float(first.expanded[rows].max()), 2)} {unit}", note)
        for label, rows, unit, scale in (("attitude", slice(3, 6), "deg", 1.0), ("position", slice(0, 3), "mm", 1e3))
    ]
    notes = []
    if c.run.covariance is None:
        notes.append(
            "rig.yaml states no covariance: the uncertainty of the calibration is not part of this budget, which is"
            " then incomplete. Calibrate with beampose, which writes the covariance."
        )
    if c.summary.get("verdict", {}).get("status") == "fail":
        notes.append("The verdict of this run is FAIL: its results must not be used; see report.html.")
    recorded = "date of the recording not stated" if c.run.recorded is None else f"recorded {c.run.recorded}"
    made = [
        made_with("numpy", "scipy"),
        ("form", "JCGM 100:2008 (GUM), JCGM 101:2008 (Monte Carlo)"),
        ("command of the run", str(c.summary.get("command", ""))),
    ]
    return Page("uncertainty of a measurement", c.name, f"{c.run.name}, {recorded}", sections, keys, notes, made)


def _measurand(c: Certificate) -> Section:
    return Section(
        "Measurand and model",
        [
            "Measurand: the attitude (yaw, pitch, roll; R = Rz(yaw) Ry(pitch) Rx(roll)) and the position (x, y, z of"
            " the body's origin) of the vehicle in the frame of the laboratory (world), at mid-exposure of a frame.",
            "Model: each beam, given in body, is moved to world by the pose and meets its screen, and the camera"
            " projects the lit point to a pixel. The pose is the weighted least-squares solution of the measured"
            " centroids; a smoothed result averages over neighbouring frames with the motion model. Input quantities"
            f" are the centroids ({len(c.run.rig.views())} views) and the parameters of lenses, cameras, screens and"
            " beams.",
            "The sensitivity of the pose to a parameter is G S: S is the derivative of the pixels by the parameter, G"
            " that of the pose by the pixels.",
        ],
    )


def _frame_sections(f: FrameCertificate) -> list[Section]:
    at, r = f"frame {f.frame} (t = {format_number(f.t_s, 5)} s)", f.result
    of_result: list[list[object]] = []
    for name, i, unit, scale, _, _ in _SHOWN:
        value, u, U = (_rounded(scale * x, scale * r.expanded[i]) for x in (f.value[i], r.combined[i], r.expanded[i]))
        row: list[object] = [value, u, f"{r.degrees_of_freedom[i]:.0f}", f"{r.factor[i]:.3f}", U]
        if f.simulated is not None:
            of_draws = f.simulated[1][i]
            difference = f"{100 * (of_draws / r.expanded[i] - 1):+.1f}".replace("-", "\u2212")
            row += [_rounded(scale * of_draws, scale * r.expanded[i]), difference]
        of_result.append([f"{name} ({unit})", *row])
    probability = f"{100 * COVERAGE:g} %"
    heads = ["", "value", "u", "dof", "k", "U"]
    words = [
        f"{f.spots} spots were measured in this frame. u is the combined standard uncertainty, U = k u the expanded"
        f" uncertainty for a coverage probability of {probability}; k is the quantile of Student's distribution for the"
        " effective degrees of freedom (dof, Welch and Satterthwaite)."
    ]
    if f.simulated is not None:
        heads += ["U, Monte Carlo", "difference (%)"]
        words.append(
            f"Monte Carlo: in each of {f.draws:,} draws a rig is drawn from the covariance of the calibration, and the"
            " spots are projected with it and solved with the nominal rig, without linearisation; the errors that"
            " change from frame to frame are drawn from covariance.csv less systematic.csv. U is half the interval of"
            f" that probability; chance changes it by {format_number(100 / np.sqrt(f.draws), 1)} %."
        )
    budget: list[list[object]] = []
    for line, v, dof in zip(f.lines, np.sqrt(np.maximum(f.variances, 0.0)), f.degrees_of_freedom.tolist(), strict=True):
        budget.append([line, *EVALUATED[line][:2], dof, *_shown(v)])
    budget.append(["combined (u)", "", "", "", *_shown(r.combined)])
    sections = [
        Section(f"Result of {at}", words, (), PageTable(heads, of_result)),
        Section(
            f"Budget of {at}",
            [
                "Contribution of each source to the standard uncertainty of each axis. Their squares add up to that of"
                " the last row, which is covariance.csv. The place of a camera is calibrated with its lens: the line of"
                " the lenses contains how the places follow them, and each later line what is independent of the lines"
                " above it.",
                _sources(f.lines),
            ],
            (),
            PageTable(["source", "type", "distribution", "dof", *_HEADS], budget),
        ),
    ]
    return sections if f.share is None else [*sections, _sensitivities(f, f.share, at)]


def _shown(u: Array) -> list[str]:
    """Standard uncertainties (6,) as the tables show them."""
    return [format_number(scale * float(u[i])) for _, i, *_, scale in _SHOWN]


def _sources(lines: Sequence[str]) -> str:
    """Where the figures of a budget's lines come from."""
    places = dict.fromkeys(EVALUATED[line][2] for line in lines)
    named = (f"{', '.join(x for x in lines if EVALUATED[x][2] == place)}: {place}" for place in places)
    return f"Evaluated from: {'; '.join(named)}."


def _rounded(value: float, uncertainty: float) -> str:
    """A number to the second significant digit of its expanded uncertainty (GUM 7.2.6)."""
    decimals = max(0, 1 - int(np.floor(np.log10(uncertainty)))) if uncertainty > 0 else 3
    return f"{value:.{decimals}f}".replace("-", "\u2212")


def _sensitivities(f: FrameCertificate, share: CalibrationShare, at: str) -> Section:
    u = np.sqrt(np.maximum(np.diagonal(share.covariance.matrix), 0.0))
    of_noise = np.sqrt(np.maximum(f.variances[0], 0.0)) / f.spot_sigma_px
    T = axes_jacobian(f.rotation) @ share.sensitivity
    columns_of = {"centroids, all spots (px)": (f.spot_sigma_px, of_noise)}
    columns_of |= {n: (float(u[p]), T[:, p]) for p, n in enumerate(share.covariance.names) if u[p] > 0}
    change = 100 * float(np.abs(np.linalg.eigvals(share.adjusted) - 1).max())
    heads = ["input quantity", "u", *(f"{h} per unit" for h in _HEADS)]
    rows = [[name, of, *(scale * c[i] for _, i, *_, scale in _SHOWN)] for name, (of, c) in columns_of.items()]
    return Section(
        f"Sensitivities of {at}",
        [
            "Standard uncertainty of each input quantity, and change of the pose per unit of it. Units are those of the"
            " names (fx, fy, cx, cy: px). The first row is the contribution of the noise, as averaged over frames and"
            " spots, over the mean sigma of a spot. Contributions of single parameters of a calibration do not add as"
            " squares, since the parameters are correlated.",
            "The run weighted its spots with the labels and the noise that it knew before smoothing. Against the"
            f" weights of the reported spots this changes the sensitivities by up to {format_number(change, 2)} %,"
            " which is contained.",
        ],
        (),
        PageTable(heads, rows),
    )


def _range(c: Certificate) -> Section:
    U = c.over_recording.expanded
    figures = zip(_HEADS, *map(_shown, np.quantile(U, [0.0, 0.5, 0.95, 1.0], axis=0)), strict=True)
    rows = [[*row, c.measured[np.argmax(U[:, i])]] for row, (_, i, *_) in zip(figures, _SHOWN, strict=True)]
    words = (
        f"Expanded uncertainty U of the {len(c.measured)} measured frames. Other frames have no certificate; their"
        " covariances are in covariance.csv."
    )
    heads = ["", "least", "median", "95 % of frames within", "largest", "in frame"]
    return Section("Range over the recording", words, (), PageTable(heads, rows))


def _traceability(c: Certificate, results: Path) -> Section:
    state = c.run.calibration
    rig = "rig.yaml states no date and verdict of its calibration."
    if state is not None:
        rig = f"Calibration of the rig: {state.date}, verdict {state.verdict}, {state.validity}. {state.notes}".strip()
    rows = [[Path(str(i["path"])).name, i["sha256"], i.get("covers", "")] for i in c.summary.get("inputs") or ()]
    made = [results / name for name in ("attitude.csv", "covariance.csv", "systematic.csv", "budget.csv")]
    rows += [
        [p.name, hashlib.sha256(p.read_bytes()).hexdigest(), "contents (this result)"] for p in made if p.is_file()
    ]
    return Section(
        "Traceability",
        [
            rig,
            "Scale and axes are those of the survey, the boards and the stand that the rig was calibrated with; the"
            " laboratory adds their certificates.",
            "Not contained: errors of these references beyond their stated sigmas, time offsets and row times that"
            " run.yaml states (taken as exact), changes of the rig since its calibration (see the model check in"
            " report.html), and wrong labels of spots.",
        ],
        (),
        PageTable(["file", "SHA-256", "covers"], rows),
    )
