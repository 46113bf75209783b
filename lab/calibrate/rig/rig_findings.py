"""Findings of a joint calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.rig.joint import DOTS, P_MISFIT, RECORDS, SPOTS, Joint
from calibration.rig.rig_figures import ExpectedPose, HoldOut, RigCalibration, in_degrees, in_mm
from lab.calibrate.beams.beam_findings import bad_positions, first_names
from lab.findings.finding import ENTRIES, Finding, Level, finding, level_above, passed

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
    out = [_fit_of(joint, name) for name in joint.groups if name in ENTRIES[_MISFIT].variants]
    out += _contradiction(steps)
    out += _outliers(steps, positions)
    if held_out is not None:
        out.append(_held_out(held_out))
    else:
        what = f"none of {len(positions)} positions could be held out: the others do not determine the calibration"
        out.append(finding("BP-R01", Level.FAIL, what))
    out.append(_expected(expected))
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
            where = first_names([positions[i] for i in wrong])
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
        named = f": {first_names(which, '; ')}" if which else ""
        out.append(finding("BP-R05", level, f"{name}: {len(wrong)} of {len(kept)} excluded as outliers{named}"))
        if name == SPOTS and (bad := bad_positions(measured.spots.position, wrong, positions)):
            out.append(finding("BP-R06", Level.WARN, f"most spots of position {', '.join(bad)} were excluded"))
    return out


def _held_out(h: HoldOut) -> Finding:
    deg, mm = np.rad2deg(h.attitude_rms), 1e3 * h.position_rms
    what = (
        f"hold-out of positions ({len(h.positions)}, each predicted by a calibration without its spots): attitude on"
        f" this stand {deg:.2g} deg, position {mm:.2g} mm RMS per axis; {h.ratio:.2f} times the expected error"
    )
    level = Level.PASS if h.p >= P_MISFIT else level_above(h.ratio, LIMITS.hold_out_warn, LIMITS.hold_out_fail)
    return finding("BP-R07", level, what)


def _expected(e: ExpectedPose | None) -> Finding:
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
