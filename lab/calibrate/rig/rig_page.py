"""Findings and report of a joint rig calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.rig.joint import DOTS, LEAST_REDUNDANCY, LOST, P_MISFIT, RECORDS, SPOTS, Joint
from calibration.rig.rig_figures import ExpectedPose, HoldOut, RigCalibration, in_degrees, in_mm
from calibration.screens.network import FRAMES
from calibration.screens.screens import camera_sigmas
from calibration.terms.rig_blocks import POSES, STAND, lines_in, stacks_of
from calibration.terms.surveyed import pose_of
from geometry.arrays import Array, Bools, Ints
from geometry.pose import ypr_sigmas
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import split_name
from lab.calibrate.beams.beams_page import ARCSEC, WORST_NAMED, bad_positions, beam_table
from lab.findings.finding import Finding, Level, entries, finding, level_above, passed
from lab.number_format import format_number, format_some, format_vector
from lab.report.calibration.calibration_drawings import (
    correlation_matrix,
    flatness_map,
    residual_field,
    residual_histogram,
)
from lab.report.calibration.calibration_scene import rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section

_MISFIT = "BP-R02"  # its variants: the kinds of measurements


@dataclass(frozen=True, slots=True)
class RigLimits:
    """Thresholds of the findings. Attitude and position are 1 sigma per axis of one frame at the central pose."""

    attitude_warn: float = np.deg2rad(0.02)  # twice the goal of 0.01 deg
    attitude_fail: float = np.deg2rad(0.5)
    position_warn_m: float = 1e-3  # twice the goal of 0.5 mm
    position_fail_m: float = 20e-3
    scale_warn: float = 1.3  # residuals of a kind of measurement over their sigmas
    scale_fail: float = 4.0
    wrong_warn: float = 0.05  # share of outliers of a kind
    wrong_fail: float = 0.25
    hold_out_warn: float = 1.3  # errors of held-out positions over the expected ones
    hold_out_fail: float = 3.0


LIMITS = RigLimits()


@dataclass(frozen=True, slots=True)
class CalibratedRig:
    """A calibrated rig, and how accurate its poses are."""

    steps: RigCalibration
    expected: ExpectedPose | None
    held_out: HoldOut | None


def joint_findings(
    steps: RigCalibration,
    positions: Sequence[str],
    expected: ExpectedPose | None,
    held_out: HoldOut | None,
) -> list[Finding]:
    """All findings of the joint adjustment. positions: names of the stand's positions."""
    joint = steps.joint
    out = [_fit_of(joint, name) for name in joint.groups if name in entries()[_MISFIT].variants]
    out += _contradiction(steps)
    out += _outliers(steps, positions)
    if held_out is not None:
        out.append(_held_out_finding(held_out))
    else:
        what = f"none of {len(positions)} positions could be held out: the others do not determine the calibration"
        out.append(finding("BP-R01", Level.FAIL, what))
    out.append(_expected_finding(expected))
    return out


def _fit_of(joint: Joint, name: str) -> Finding:
    """Consistency of one kind of measurement with all others."""
    fit = joint.groups[name]
    counted = f"{fit.numbers} numbers, redundancy {fit.redundancy:.0f}"
    if np.isnan(fit.p):
        return passed(f"{name}: too little redundancy ({fit.redundancy:.1f}) to test their sigmas")
    scale = joint.scales.get(name, 1.0)
    if scale == 1.0 and fit.p >= P_MISFIT:
        return passed(f"{name}: consistent with the others within their sigmas (factor {fit.scale:.2f}; {counted})")
    if scale == 1.0:
        now = joint.settled[name]
        if not now.p < P_MISFIT:
            return passed(
                f"{name}: initial misfit (factor {fit.scale:.2f}), explained by {', '.join(joint.scales)}"
                f" (factor {now.scale:.2f} with their increased sigmas)"
            )
        scale = now.scale
    done = "all their sigmas were multiplied by it" if name in joint.scales else "their sigmas were not changed"
    what = f"{name}: residuals are {scale:.2g} times their sigmas ({counted}); {done}"
    return finding("BP-R02", level_above(scale, LIMITS.scale_warn, LIMITS.scale_fail), what, variant=name)


def _contradiction(steps: RigCalibration) -> list[Finding]:
    """Whether steps that are consistent separately contradict each other."""
    alone = steps.screens.fit.variance_factor == 1.0 and steps.beams.fit.scale == 1.0
    worst = max(steps.joint.scales.values(), default=1.0)
    if not alone or worst <= LIMITS.scale_warn:
        return []
    what = "cameras and screens are consistent separately, and so are beams, but not together"
    return [finding("BP-R03", Level.WARN, what)]


def _outliers(steps: RigCalibration, positions: Sequence[str]) -> list[Finding]:
    joint, measured = steps.joint, steps.measured
    views = joint.rig.views()
    names, cameras = measured.network.control_points.names, list(joint.rig.cameras)
    out = []
    for name, kept in joint.kept.items():
        wrong: list[int] = np.flatnonzero(~kept).tolist()
        if not wrong:
            continue
        share = len(wrong) / len(kept)
        level = level_above(share, LIMITS.wrong_warn, LIMITS.wrong_fail)
        if name == RECORDS:
            where = format_some([positions[i] for i in wrong], WORST_NAMED)
            what = f"{name}: the recorded pose does not fit the spots at {len(wrong)} of {len(kept)} ({where})"
            out.append(finding("BP-R04", max(level, Level.WARN), what))
            continue
        which = []
        if name == SPOTS:
            at = measured.spots
            which = [f"position {positions[at.position[i]]} camera {views[at.view[i]][0]} spot {views[at.view[i]][1]}"
                     for i in wrong]  # fmt: skip
        elif name == DOTS:
            if share <= LIMITS.wrong_warn and not steps.screens.fit.used[wrong].any():
                continue  # listed with their causes by the previous step
            s = measured.network.point_observations
            seen = zip(s.point_of[wrong].tolist(), s.camera_of[wrong].tolist(), strict=True)
            which = [f"{names[dot]} in camera {cameras[camera]}" for dot, camera in seen]
        named = f": {format_some(which, WORST_NAMED, '; ')}" if which else ""
        out.append(finding("BP-R05", level, f"{name}: {len(wrong)} of {len(kept)} excluded as outliers{named}"))
        if name == SPOTS and (bad := bad_positions(measured.spots.position, wrong, positions)):
            out.append(finding("BP-R06", Level.WARN, f"most spots of position {', '.join(bad)} were excluded"))
    return out


def _held_out_finding(h: HoldOut) -> Finding:
    deg, mm = np.rad2deg(h.attitude_rms), 1e3 * h.position_rms
    what = (
        f"hold-out of positions ({len(h.positions)}, each predicted by a calibration without its spots): attitude on"
        f" this stand {deg:.2g} deg, position {mm:.2g} mm RMS per axis; {h.ratio:.2f} times the expected error"
    )
    level = Level.PASS if h.p >= P_MISFIT else level_above(h.ratio, LIMITS.hold_out_warn, LIMITS.hold_out_fail)
    return finding("BP-R07", level, what)


def _expected_finding(e: ExpectedPose | None) -> Finding:
    if e is None:
        what = "at the centre of the stand's positions too few spots are in the pictures to measure a pose"
        return finding("BP-R08", Level.FAIL, what)
    deg, mm = in_degrees(e.total), in_mm(e.total)
    what = (
        f"one frame at the central pose: attitude to {deg:.2g} deg, position to {mm:.2g} mm (1 sigma per axis), of"
        f" which {in_degrees(e.systematic):.2g} deg and {in_mm(e.systematic):.2g} mm from the calibration"
    )
    turn, shift = float(np.deg2rad(deg)), 1e-3 * mm
    if turn <= LIMITS.attitude_warn and shift <= LIMITS.position_warn_m:
        return passed(what)
    unusable = turn > LIMITS.attitude_fail or shift > LIMITS.position_fail_m
    most = "the spots' noise"
    if in_degrees(e.systematic) > in_degrees(e.noise):
        most = max(e.shares, key=lambda n: in_degrees(e.shares[n]))
    why = (
        f"the goal is {np.rad2deg(LIMITS.attitude_warn) / 2:.2g} deg and {1e3 * LIMITS.position_warn_m / 2:.2g} mm;"
        f" the largest part is from {most}"
    )
    return finding("BP-R09", Level.FAIL if unusable else Level.WARN, what, why=why)


_GAUGE_SIGMA = 3e-6  # m, rad: parameters with smaller sigmas are fixed by convention, not measured
_TABLE_ROWS = 10  # held-out positions in the table


def page_of(o: CalibratedRig, nominal: Rig, positions: Sequence[str]) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. nominal: the rig with the beams as designed; positions: their names."""
    sections = [
        _expected(o),
        _shares(o),
        _held_out(o, positions),
        _groups(o),
        _residuals(o),
        _screens(o),
        _beams(o, nominal),
        _cameras(o),
        _correlations(o),
        _lab(o),
    ]
    return _key_figures(o), [s for s in sections if s is not None]


def _key_figures(o: CalibratedRig) -> list[KeyFigure]:
    joint, out = o.steps.joint, []
    if o.expected is not None:
        e = o.expected
        out.append(("attitude, one frame", f"{in_degrees(e.total):.2g} deg", "expected 1 sigma per axis, central pose"))
        out.append(("position, one frame", f"{in_mm(e.total):.2g} mm", "expected 1 sigma per axis, central pose"))
        words = f"{in_degrees(e.systematic):.2g} deg · {in_mm(e.systematic):.2g} mm"
        out.append(("part of the calibration", words, "not reduced by averaging"))
    if o.held_out is not None:
        h = o.held_out
        words = f"{np.rad2deg(h.attitude_rms):.2g} deg · {1e3 * h.position_rms:.2g} mm"
        out.append(("held-out positions", words, f"RMS per axis, {h.ratio:.2f} times the expected value"))
    spots = joint.every[SPOTS].linearise(joint.values).residuals
    px = _spot_pixels(o, spots)[joint.kept[SPOTS]]
    out.append(("spots", f"{format_number(float(np.sqrt(np.mean(px**2))), 3)} px", "RMS residual per axis"))
    if DOTS in joint.every:
        s = o.steps.measured.network.point_observations
        px = joint.every[DOTS].linearise(joint.values).residuals * s.sigma_px[:, None]
        rms = float(np.sqrt(np.mean(px[joint.kept[DOTS]] ** 2)))
        out.append(("control points", f"{format_number(rms, 3)} px", "RMS residual per axis"))
    sigma = _beam_sigmas(joint)[0] / ARCSEC
    out.append(("beam directions", f"{format_number(float(np.sqrt(np.mean(sigma**2))), 3)} arcsec", "1 sigma per axis"))
    return out


def _expected(o: CalibratedRig) -> Section | None:
    e = o.expected
    if e is None:
        return None
    rows = []
    for name, C in (("all", e.total), ("noise of the spots in that frame", e.noise), ("calibration", e.systematic)):
        mm = 1e3 * np.sqrt(np.maximum(np.diagonal(C)[:3], 0))
        rows.append((name, *np.rad2deg(ypr_sigmas(e.world_from_body, C)), *mm))
    heads = ("part", "yaw (deg)", "pitch (deg)", "roll (deg)", "x (mm)", "y (mm)", "z (mm)")
    words = [
        f"Expected 1 sigma of a pose measured from one frame, in the middle of the stand's positions, with {e.views}"
        " spots in the pictures.",
        "The noise differs from frame to frame and is reduced by averaging. The part of the calibration is the same in"
        " every frame and is not reduced; it cancels in the difference of two similar poses.",
    ]
    return Section("Expected uncertainty of one frame", words, (), PageTable(heads, rows))


def _shares(o: CalibratedRig) -> Section | None:
    e = o.expected
    if e is None:
        return None
    total = float(np.trace(e.systematic[3:, 3:])), float(np.trace(e.systematic[:3, :3]))
    rows = [
        (
            name,
            f"{in_degrees(C):.5f}",
            f"{in_mm(C):.4f}",
            f"{100 * float(np.trace(C[3:, 3:])) / total[0]:.1f}",
            f"{100 * float(np.trace(C[:3, :3])) / total[1]:.1f}",
        )
        for name, C in e.shares.items()
        if name not in (FRAMES, LOST)
    ]
    rows.sort(key=lambda r: -float(r[3]))
    heads = ("errors of", "attitude (deg)", "position (mm)", "% of attitude variance", "% of position variance")
    words = [
        "Contribution of each kind of measurement to the calibration's part, propagated through the joint adjustment to"
        " the pose. The variances add up to the total.",
        f"Improve {rows[0][0]} first: use more precise measurements, or more of them." if rows else "",
    ]
    return Section("Largest contributions", words, (), PageTable(heads, rows))


def _held_out(o: CalibratedRig, positions: Sequence[str]) -> Section | None:
    h = o.held_out
    if h is None:
        return None
    deg, mm = np.rad2deg(h.errors[:, 3:]), 1e3 * h.errors[:, :3]
    rows = [
        (positions[k], *(f"{v:.4f}" for v in deg[i]), *(f"{v:.3f}" for v in mm[i]), f"{h.sigmas[i]:.2f}")
        for i, k in enumerate(h.positions)
    ]
    rows = sorted(rows, key=lambda r: -float(r[-1]))[:_TABLE_ROWS]
    heads = (
        "position", "about x (deg)", "about y (deg)", "about z (deg)", "x (mm)", "y (mm)", "z (mm)",
        "misfit / expected",
    )  # fmt: skip
    drawings = [
        residual_histogram(deg, "Attitude error of held-out positions, per axis", "deg"),
        residual_histogram(mm, "Position error of held-out positions, per axis", "mm"),
    ]
    words = (
        "Cross-validation with five folds: the poses of each fifth of the positions were measured with a calibration"
        " made without their spots and compared with the recorded poses of the stand. These are the errors to expect in"
        f" use, including the errors of the stand. The table lists the {min(_TABLE_ROWS, len(rows))} largest; x, y, z"
        " are the axes of the body for the attitude and of the world for the position."
    )
    return Section("Held-out positions", words, drawings, PageTable(heads, rows))


def _groups(o: CalibratedRig) -> Section:
    joint = o.steps.joint
    rows = []
    for name, g in joint.groups.items():
        if name in (FRAMES, LOST):
            continue
        kept = joint.kept.get(name)
        left_out = 0 if kept is None else int(np.sum(~kept))
        tested = g.redundancy > LEAST_REDUNDANCY
        misfit, p = (f"{g.scale:.2f}", f"{g.p:.2g}") if tested else ("–", "–")
        raised = f"{joint.scales.get(name, 1.0):.2f}"
        rows.append((name, g.numbers, f"{g.redundancy:.0f}", misfit, p, left_out, raised))
    heads = ("kind", "numbers", "redundant", "misfit / sigma", "p", "excluded", "sigmas multiplied by")
    words = [
        "Deviation of each kind of measurement from the prediction by all others, in units of its sigmas; the expected"
        " value is 1. Measurements without redundancy are the only ones that determine some parameter, and cannot be"
        " tested.",
        "If the misfit of a kind is significant (p below 0.001), its sigmas were increased until it fits.",
    ]
    return Section("Consistency of the measurements", words, (), PageTable(heads, rows))


def _residuals(o: CalibratedRig) -> Section:
    joint, measured = o.steps.joint, o.steps.measured
    cameras = list(joint.rig.cameras)
    views = joint.rig.views()
    spots = joint.every[SPOTS].linearise(joint.values).residuals
    camera_of = np.array([cameras.index(views[v][0]) for v in measured.spots.view], dtype=np.int64)
    drawings = _fields(o, "spots", measured.spots.pixels, -_spot_pixels(o, spots), camera_of, joint.kept[SPOTS])
    if DOTS in joint.every:
        s = measured.network.point_observations
        r = joint.every[DOTS].linearise(joint.values).residuals
        drawings += _fields(o, "control points", s.pixels, -r * s.sigma_px[:, None], s.camera_of, joint.kept[DOTS])
    drawings.append(residual_histogram(spots[joint.kept[SPOTS]], "Spots: normalised residuals", "sigma", sigma=1.0))
    words = (
        "Measured minus predicted, without excluded measurements. Arrows that vary slowly over the picture indicate an"
        " error of the lens or the screen; equal arrows at all spots of one position indicate an error of the stand."
        " residuals.csv lists all residuals."
    )
    return Section("Residuals", words, drawings)


def _fields(o: CalibratedRig, what: str, pixels: Array, residuals: Array, camera_of: Ints, kept: Bools) -> list[str]:
    out = []
    for c, (name, camera) in enumerate(o.steps.joint.rig.cameras.items()):
        here = (camera_of == c) & kept
        if here.any():
            title = f"Camera {name}: {what}, measured − predicted"
            out.append(residual_field(camera.image_size_px, pixels[here], residuals[here], title, things=what))
    return out


def _spot_pixels(o: CalibratedRig, residuals: Array) -> Array:
    """Residuals of spots (N, 2) in px, from normalised residuals (N, 2)."""
    roots = np.linalg.cholesky(o.steps.measured.spots.covariance)
    return np.asarray((roots @ residuals[..., None])[..., 0])


# Screens, beams, cameras and the correlations of their errors.


def _screens(o: CalibratedRig) -> Section | None:
    """Section on the poses and the flatness of the screens; None if the project has no screens."""
    joint = o.steps.joint
    drawings, rows = [], []
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    for (name, screen), result in zip(joint.rig.screens.items(), o.steps.screens.screens, strict=True):
        if result.flatness is not None and len(result.xyz):
            chosen = result.flatness.chosen
            sigma = float(np.median(chosen.sigma_m[chosen.used]))
            title, shape = f"Screen {name}: height of the control points over its plane", screen.bow
            xy, z = result.xyz[:, :2], result.xyz[:, 2]
            bent = shape if any(shape) else None
            drawings.append(flatness_map(xy, z, title, size_m=screen.size_m, bow=bent, sigma_m=sigma))
        normal = screen.world_from_screen.rotation[:, 2]
        along = tilt = 0.0
        if "screens" in joint.unknowns.column:
            at = joint.unknowns.column["screens"][list(joint.rig.screens).index(name)]
            C = joint.all_covariance[np.ix_(at, at)]
            along = float(np.sqrt(np.maximum(normal @ C[:3, :3] @ normal, 0.0)))
            tilt = float(np.sqrt(np.maximum(C[3, 3] + C[4, 4], 0.0) / 2))
        bow = float(sigmas.get(f"screens.{name}.bow_xx_per_m", 0.0))
        place = format_vector(screen.world_from_screen.translation, 4)
        surface = "bent" if any(screen.bow) else "flat"
        rows.append((name, place, 1e3 * along, np.rad2deg(tilt), surface, 1e3 * bow or None))
    heads = ("screen", "origin (m)", "sigma along its normal (mm)", "sigma of its tilt (deg)", "surface",
             "sigma of the bow (1/km)")  # fmt: skip
    words = (
        "Poses of the screens. The origin and the axes within the plane are a convention and have no error; the sigmas"
        " are those of the distance along the normal and of the tilt."
    )
    return Section("Screens", words, drawings, PageTable(heads, rows))


def _beams(o: CalibratedRig, nominal: Rig) -> Section:
    """Section on the beams, compared with the nominal ones, and on the pose of the stand."""
    joint = o.steps.joint
    direction, offset = _beam_sigmas(joint)
    off = lines_in(joint.values).minus(lines_in(stacks_of(nominal)))
    pose, unknowns = pose_of(joint.values, STAND)[0], joint.unknowns
    words = ["Each laser in the body frame, the frame of the stand's carriage as its poses were recorded."]
    if STAND in unknowns.column:
        at = unknowns.column[STAND][0]
        C = joint.all_covariance[np.ix_(at, at)]
        mm = ", ".join(
            f"{1e3 * t:.2f} ± {1e3 * s:.2f}" for t, s in zip(pose.translation, np.sqrt(np.diagonal(C)[:3]), strict=True)
        )
        deg = ", ".join(
            f"{v:.4f} ± {s:.4f}" for v, s in zip(np.rad2deg(pose.ypr), np.rad2deg(ypr_sigmas(pose, C)), strict=True)
        )
        words.append(f"Pose of the stand in the world: x, y, z {mm} mm; yaw, pitch, roll {deg} deg.")
    distances = np.linalg.norm(off.reshape(-1, 2, 2), axis=2)  # angle (rad), distance (m)
    table = beam_table(joint.rig, direction, offset, distances)
    return Section("Beams", words, (), table)


def _cameras(o: CalibratedRig) -> Section:
    joint = o.steps.joint
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    before = o.steps.measured.network.rig
    rows = []
    for i, (name, camera) in enumerate(joint.rig.cameras.items()):
        at = joint.unknowns.column["cameras"][i]
        place_m, turn = camera_sigmas(camera, joint.all_covariance[np.ix_(at, at)])
        fx, sigma = camera.matrix[0, 0], sigmas.get(f"cameras.{name}.fx", 0.0)
        place = format_vector(camera.camera_from_world.inverse().translation, 4)
        change = fx - before.cameras[name].matrix[0, 0]
        rows.append((name, place, 1e3 * place_m, np.rad2deg(turn), fx, sigma, change))
    heads = ("camera", "position (m)", "sigma of position (mm)", "sigma of attitude (deg)", "fx (px)",
             "sigma of fx (px)", "change of fx since the lens calibration (px)")  # fmt: skip
    words = (
        "Sigmas are RMS per axis. The errors of a camera's lens and pose are correlated: a longer focal length has"
        " nearly the same effect as a more distant camera. rig.yaml holds the joint covariance."
    )
    return Section("Cameras", words, (), PageTable(heads, rows))


def _correlations(o: CalibratedRig) -> Section:
    C = o.steps.joint.covariance
    sigma = np.sqrt(np.diagonal(C.matrix))
    shown = [
        i
        for i, n in enumerate(C.names)
        if split_name(n)[0] == "beams"
        or (sigma[i] > _GAUGE_SIGMA and not split_name(n)[2].startswith(("k", "p1", "p2", "s", "tau")))
    ]
    shown.sort(key=lambda i: ("beams", "screens", "cameras").index(split_name(C.names[i])[0]))
    names = [_short_name(C.names[i]) for i in shown]
    picture = correlation_matrix(names, C.matrix[np.ix_(shown, shown)], "Correlations of the rig's parameters")
    words = "Correlated errors partly cancel in the pose: without the correlations its sigma would be too large."
    return Section("Correlations", words, [PageDrawing(picture, wide=True)])


def _short_name(name: str) -> str:
    """`camera left fx` for `cameras.left.fx`."""
    kind, thing, parameter = split_name(name)
    bare = parameter.removesuffix("_per_m").removesuffix("_rad").removesuffix("_m")
    return f"{kind.removesuffix('s')} {thing} {bare}"


def _lab(o: CalibratedRig) -> Section:
    joint = o.steps.joint
    body = (
        o.expected.world_from_body
        if o.expected is not None
        else pose_of(joint.values, STAND)[0] @ pose_of(joint.values, POSES)[0]
    )
    return Section(
        "The lab",
        "Calibrated cameras, screens and beams, with the vehicle in the middle of the stand's positions.",
        scene_views(rig_things(joint.rig, body)),
    )


def _beam_sigmas(joint: Joint) -> tuple[Array, Array]:
    """Sigmas of each beam's direction (rad) and offset (m), RMS over the two axes across the beam."""
    variances = np.diagonal(joint.all_covariance)[joint.unknowns.column["beams"]]
    return np.sqrt(variances[:, :2].mean(axis=1)), np.sqrt(variances[:, 2:].mean(axis=1))
