"""Findings of a joint calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.findings import Finding, Level
from calibration.rig.joint import (
    CORNERS,
    DOTS,
    FIXED,
    LENSES,
    P_MISFIT,
    PLACE,
    RECORDS,
    SCANS,
    SPOTS,
    SURFACES,
    SURVEY,
    Joint,
)
from calibration.rig.rig_figures import ExpectedPose, HoldOut
from calibration.rig.rig_steps import RigCalibration
from geometry.arrays import Array, Ints

_LISTED = 6  # items listed in one line


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


# Cause and remedy if a kind of measurement misfits.
_CAUSES: Mapping[str, tuple[str, str]] = {
    SPOTS: (
        "an error that the model does not contain: screens that are not flat, lasers that drift while they warm up,"
        " cameras that were touched between dots and spots",
        "see the residuals by camera and position; warm up the lasers, survey more dots to find a bow, record again",
    ),
    DOTS: (
        "dots were detected less accurately than stated, or the lenses have changed since their calibration",
        "increase their sigma_px; each camera needs its own lens calibration, at the focus in use",
    ),
    SURVEY: (
        "the survey is less accurate than stated, or a dot has moved since",
        "check the instrument's stations against each other; increase the sigmas",
    ),
    SURFACES: (
        "the dots are not on the fitted surfaces",
        "survey more dots, or give the roughness of the surface as surface_sigma_m",
    ),
    RECORDS: (
        "the stand is less accurate than stated, or its axes are not as defined in its program",
        "check the stand with a level or an autocollimator; increase its sigmas",
    ),
    PLACE: (
        "the surveyed pose of the stand contradicts the spots",
        "survey it again, or omit world_from_stand so that it is estimated",
    ),
    LENSES: (
        "the lenses differ from their calibration: refocused, other zoom, or another camera's file",
        "calibrate the lenses again with locked focus, and do not touch them before the dots are photographed",
    ),
    CORNERS: (
        "board corners scatter more than in the previous step",
        "see the photographs; remove blurred ones",
    ),
    FIXED: (
        "the boards on the screens are not at the stated offsets and tilts",
        "measure the offset; check that the boards lie flat",
    ),
    SCANS: (
        "scan and dots give different poses of the screens",
        "check the registration of the scan; increase its sigmas",
    ),
}


def joint_findings(
    steps: RigCalibration,
    positions: Sequence[str],
    expected: ExpectedPose | None,
    held_out: HoldOut | None,
    limits: RigLimits = RigLimits(),
) -> list[Finding]:
    """All findings of the joint adjustment. positions: names of the stand's positions."""
    joint = steps.joint
    out = [_fit_of(joint, name, limits) for name in joint.groups if name in _CAUSES]
    out += _contradiction(steps, limits)
    out += _outliers(steps, positions, limits)
    if held_out is not None:
        out.append(_held_out(held_out, limits))
    else:
        out.append(
            Finding(
                Level.FAIL,
                f"none of {len(positions)} positions could be held out: the others do not determine the calibration",
                "the calibration is not tested with independent spots",
                "record 20 positions or more, turned about all axes",
                code="BP-R01",
            )
        )
    out.append(_expected(expected, limits))
    return out


def in_degrees(covariance: Array) -> float:
    """RMS over the three axes of the attitude sigmas of a pose covariance (6, 6), deg."""
    return float(np.rad2deg(np.sqrt(np.mean(np.maximum(np.diagonal(covariance)[3:], 0.0)))))


def in_mm(covariance: Array) -> float:
    """RMS over the three axes of the position sigmas of a pose covariance (6, 6), mm."""
    return float(1e3 * np.sqrt(np.mean(np.maximum(np.diagonal(covariance)[:3], 0.0))))


def _fit_of(joint: Joint, name: str, limits: RigLimits) -> Finding:
    """Consistency of one kind of measurement with all others."""
    fit = joint.groups[name]
    counted = f"{fit.numbers} numbers, redundancy {fit.redundancy:.0f}"
    if np.isnan(fit.p):
        return Finding(Level.PASS, f"{name}: too little redundancy ({fit.redundancy:.1f}) to test their sigmas")
    scale = joint.scales.get(name, 1.0)
    if scale == 1.0 and fit.p >= P_MISFIT:
        return Finding(
            Level.PASS, f"{name}: consistent with the others within their sigmas (factor {fit.scale:.2f}; {counted})"
        )
    if scale == 1.0:
        now = joint.settled[name]
        if not now.p < P_MISFIT:
            return Finding(
                Level.PASS,
                f"{name}: initial misfit (factor {fit.scale:.2f}), explained by {', '.join(joint.scales)}"
                f" (factor {now.scale:.2f} with their increased sigmas)",
            )
        scale = now.scale
    level = Level.FAIL if scale > limits.scale_fail else Level.WARN if scale > limits.scale_warn else Level.PASS
    done = "all their sigmas were multiplied by it" if name in joint.scales else "their sigmas were not changed"
    why, remedy = _CAUSES[name]
    words = f"{name}: residuals are {scale:.2g} times their sigmas ({counted}); {done}"
    return Finding(level, words, why, "" if level == Level.PASS else remedy, code="BP-R02")


def _contradiction(steps: RigCalibration, limits: RigLimits) -> list[Finding]:
    """Whether steps that are consistent separately contradict each other."""
    alone = steps.screens.fit.variance_factor == 1.0 and steps.beams.fit.scale == 1.0
    worst = max(steps.joint.scales.values(), default=1.0)
    if not alone or worst <= limits.scale_warn:
        return []
    return [
        Finding(
            Level.WARN,
            "cameras and screens are consistent separately, and so are beams, but not together",
            "survey and stand contradict each other, although each has small residuals of its own",
            "check that dots and spots were recorded with the same camera settings and nothing moved in between",
            code="BP-R03",
        )
    ]


def _outliers(steps: RigCalibration, positions: Sequence[str], limits: RigLimits) -> list[Finding]:
    joint, measured = steps.joint, steps.measured
    views = joint.rig.views()
    names, cameras = measured.network.control_points.names, list(joint.rig.cameras)
    out = []
    for name, kept in joint.kept.items():
        wrong: list[int] = np.flatnonzero(~kept).tolist()
        if not wrong:
            continue
        if name == SPOTS:
            at = measured.spots
            which = [f"position {positions[at.position[i]]} camera {views[at.view[i]][0]} spot {views[at.view[i]][1]}"
                     for i in wrong]  # fmt: skip
        elif name == DOTS:
            s = measured.network.point_observations
            seen = [(names[p], cameras[c]) for p, c in zip(s.point_of[wrong], s.camera_of[wrong], strict=True)]
            which = [f"{dot} in camera {camera}" for dot, camera in seen]
        else:
            which = []
        share = len(wrong) / len(kept)
        if name == DOTS and share <= limits.wrong_warn and not steps.screens.fit.used[wrong].any():
            continue  # listed with their causes by the previous step
        level = Level.FAIL if share > limits.wrong_fail else Level.WARN if share > limits.wrong_warn else Level.PASS
        if name == RECORDS:
            out.append(
                Finding(
                    max(level, Level.WARN),
                    f"{name}: the recorded pose does not fit the spots at {len(wrong)} of {len(kept)}"
                    f" ({', '.join(positions[i] for i in wrong[:_LISTED])}{' …' if len(wrong) > _LISTED else ''})",
                    "these records were excluded",
                    "check the stand's record there: a missed step, or shifted frame numbers",
                    code="BP-R04",
                )
            )
            continue
        named = f": {'; '.join(which[:_LISTED])}{' …' if len(which) > _LISTED else ''}" if which else ""
        out.append(
            Finding(
                level,
                f"{name}: {len(wrong)} of {len(kept)} excluded as outliers{named}",
                "" if level == Level.PASS else "with many outliers, the others may agree by chance",
                "" if level == Level.PASS else "inspect these pictures and labels; correct them or the light",
                code="BP-R05",
            )
        )
        if name == SPOTS:
            out += _bad_positions(measured.spots.position, wrong, positions)
    return out


def _bad_positions(position: Ints, wrong: Sequence[int], positions: Sequence[str]) -> list[Finding]:
    """Positions of which most spots were excluded."""
    at, every = Counter(position[wrong].tolist()), Counter(position.tolist())
    bad = [k for k, n in at.items() if n >= 2 and 2 * n > every[k]]
    if not bad:
        return []
    names = ", ".join(positions[k] for k in sorted(bad)[:_LISTED])
    return [
        Finding(
            Level.WARN,
            f"most spots of position {names} were excluded",
            "if all spots of a position have large residuals, its recorded pose or its labels are wrong",
            "check the stand's record there",
            code="BP-R06",
        )
    ]


def _held_out(h: HoldOut, limits: RigLimits) -> Finding:
    deg, mm = np.rad2deg(h.attitude_rms), 1e3 * h.position_rms
    words = (
        f"hold-out of positions ({len(h.positions)}, each predicted by a calibration without its spots): attitude on"
        f" this stand {deg:.2g} deg, position {mm:.2g} mm RMS per axis"
    )
    if h.p >= P_MISFIT or h.ratio <= limits.hold_out_warn:
        return Finding(Level.PASS, f"{words}; {h.ratio:.2f} times the expected error")
    return Finding(
        Level.FAIL if h.ratio > limits.hold_out_fail else Level.WARN,
        f"{words}; {h.ratio:.2f} times the expected error",
        "errors of new recordings will exceed their covariance",
        "see which positions have large errors and what changed between them: a camera, the stand's zero, the lasers",
        code="BP-R07",
    )


def _expected(e: ExpectedPose | None, limits: RigLimits) -> Finding:
    if e is None:
        return Finding(
            Level.FAIL,
            "at the centre of the stand's positions too few spots are in the pictures to measure a pose",
            "the rig cannot be used there",
            "aim the cameras at the spots",
            code="BP-R08",
        )
    deg, mm = in_degrees(e.total), in_mm(e.total)
    words = (
        f"one frame at the central pose: attitude to {deg:.2g} deg, position to {mm:.2g} mm (1 sigma per axis), of"
        f" which {in_degrees(e.systematic):.2g} deg and {in_mm(e.systematic):.2g} mm from the calibration"
    )
    turn, shift = float(np.deg2rad(deg)), 1e-3 * mm
    if turn <= limits.attitude_warn and shift <= limits.position_warn_m:
        return Finding(Level.PASS, words)
    unusable = turn > limits.attitude_fail or shift > limits.position_fail_m
    most = "the spots' noise"
    if in_degrees(e.systematic) > in_degrees(e.noise):
        most = max(e.shares, key=lambda n: in_degrees(e.shares[n]))
    return Finding(
        Level.FAIL if unusable else Level.WARN,
        words,
        f"the goal is {np.rad2deg(limits.attitude_warn) / 2:.2g} deg and {1e3 * limits.position_warn_m / 2:.2g} mm;"
        f" the largest part is from {most}",
        "improve that first; more positions of the stand, or dots, help if noise is the cause",
        code="BP-R09",
    )
