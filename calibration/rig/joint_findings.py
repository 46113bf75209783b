"""What a joint calibration concludes about itself, in words for the person who can act on it."""

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
from calibration.rig.rig_steps import RigSteps
from geometry.arrays import Array, Ints

_NAMED = 6  # things listed in one line


@dataclass(frozen=True, slots=True)
class RigLimits:
    """When a rig is called poor. Attitude and position are 1 sigma per axis of one frame in the middle."""

    attitude_warn: float = np.deg2rad(0.02)  # twice the goal of 0.01 deg
    attitude_fail: float = np.deg2rad(0.5)
    position_warn_m: float = 1e-3  # twice the goal of 0.5 mm
    position_fail_m: float = 20e-3
    scale_warn: float = 1.3  # times that a kind of measurement misses by more than its sigmas
    scale_fail: float = 4.0
    wrong_warn: float = 0.05  # share of a kind's measurements left out
    wrong_fail: float = 0.25
    hold_out_warn: float = 1.3  # times that held-out positions miss by more than is expected
    hold_out_fail: float = 3.0


# What it means when a kind of measurement misfits, and what to do.
_WHY: Mapping[str, tuple[str, str]] = {
    SPOTS: (
        "something moves the spots that is not in the model: screens that are not flat, lasers that wander while they"
        " warm up, cameras that were touched between dots and spots",
        "see the residuals by camera and position; warm the lasers up, survey more dots to find a bow, record again",
    ),
    DOTS: (
        "dots were found less exactly than told, or the lenses are not as calibrated",
        "give their sigma_px as large as it is; each camera needs its own lens calibration, at the focus in use",
    ),
    SURVEY: (
        "the survey is less exact than told, or a dot has moved since",
        "check the instrument's stations against each other; give the sigmas as large as they are",
    ),
    SURFACES: (
        "the dots do not lie on the surfaces that were fitted",
        "survey more dots, or give surface_sigma_m as large as the surface is rough",
    ),
    RECORDS: (
        "the stand is less exact than told, or its axes are not what its program takes them for",
        "check the stand with a level or an autocollimator; give its sigmas as large as they are",
    ),
    PLACE: (
        "the surveyed place of the stand contradicts the spots",
        "survey it again, or leave world_from_stand out and let it be found",
    ),
    LENSES: (
        "the lenses are not as their calibration says: refocused, other zoom, or another camera's file",
        "calibrate the lenses again, focus locked, and do not touch them before the dots are photographed",
    ),
    CORNERS: (
        "board corners scatter more than they did in the step before",
        "see the photographs; leave out blurred ones",
    ),
    FIXED: (
        "the boards on the screens do not lie as their offsets and tilts say",
        "measure the offset; check that the boards lie flat",
    ),
    SCANS: (
        "scan and dots put the screens in different places",
        "check the registration of the scan; give its sigmas as large as they are",
    ),
}


def joint_findings(
    steps: RigSteps,
    positions: Sequence[str],
    expected: ExpectedPose | None,
    held_out: HoldOut | None,
    limits: RigLimits = RigLimits(),
) -> list[Finding]:
    """All that the joint adjustment says. positions: a name for each of the stand's."""
    joint = steps.joint
    out = [_fit_of(joint, name, limits) for name in joint.groups if name in _WHY]
    out += _together(steps, limits)
    out += _left_out(steps, positions, limits)
    if held_out is not None:
        out.append(_held_out(held_out, limits))
    else:
        out.append(
            Finding(
                Level.FAIL,
                f"none of {len(positions)} positions could be held out: the others do not suffice to predict it",
                "nothing tests the calibration with spots that it has not seen",
                "record 20 positions or more, turned about all axes",
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
    """How one kind of measurement fits all the others."""
    fit = joint.groups[name]
    counted = f"{fit.numbers} numbers, {fit.redundancy:.0f} redundant"
    if np.isnan(fit.p):
        return Finding(Level.PASS, f"{name}: too few redundant numbers ({fit.redundancy:.1f}) to test their sigmas")
    scale = joint.scales.get(name, 1.0)
    if scale == 1.0 and fit.p >= P_MISFIT:
        return Finding(
            Level.PASS, f"{name}: fit all the others within their sigmas (factor {fit.scale:.2f}; {counted})"
        )
    if scale == 1.0:
        now = joint.settled[name]
        if not now.p < P_MISFIT:
            return Finding(
                Level.PASS,
                f"{name}: misfit at first (factor {fit.scale:.2f}), explained by {', '.join(joint.scales)}"
                f" (factor {now.scale:.2f} with their sigmas widened)",
            )
        scale = now.scale
    level = Level.FAIL if scale > limits.scale_fail else Level.WARN if scale > limits.scale_warn else Level.PASS
    done = "all their sigmas were widened by that" if name in joint.scales else "their sigmas were left as told"
    why, remedy = _WHY[name]
    words = f"{name}: {scale:.2g} times as far from the others as their sigmas say ({counted}); {done}"
    return Finding(level, words, why, "" if level == Level.PASS else remedy)


def _together(steps: RigSteps, limits: RigLimits) -> list[Finding]:
    """Whether steps that fit alone contradict each other."""
    alone = steps.screens.fit.variance_factor == 1.0 and steps.beams.fit.scale == 1.0
    worst = max(steps.joint.scales.values(), default=1.0)
    if not alone or worst <= limits.scale_warn:
        return []
    return [
        Finding(
            Level.WARN,
            "cameras and screens fit alone, and beams fit alone, but not together",
            "survey and stand contradict each other: each kind's own figures look well",
            "check that dots and spots were recorded with the same camera settings and nothing moved in between",
        )
    ]


def _left_out(steps: RigSteps, positions: Sequence[str], limits: RigLimits) -> list[Finding]:
    joint, measured = steps.joint, steps.measured
    views = joint.rig.views()
    dots, cameras = measured.network.dots.names, list(joint.rig.cameras)
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
            s = measured.network.sightings
            which = [f"{dots[s.dot_of[i]]} in camera {cameras[s.camera_of[i]]}" for i in wrong]
        else:
            which = []
        share = len(wrong) / len(kept)
        if name == DOTS and share <= limits.wrong_warn and not steps.screens.fit.used[wrong].any():
            continue  # the step before names each, and what it may be
        level = Level.FAIL if share > limits.wrong_fail else Level.WARN if share > limits.wrong_warn else Level.PASS
        if name == RECORDS:
            out.append(
                Finding(
                    max(level, Level.WARN),
                    f"{name}: the recorded pose does not fit the spots at {len(wrong)} of {len(kept)}"
                    f" ({', '.join(positions[i] for i in wrong[:_NAMED])}{' …' if len(wrong) > _NAMED else ''})",
                    "these records took no part",
                    "check the stand's record there: a missed step, or frame numbers that are off by one",
                )
            )
            continue
        named = f": {'; '.join(which[:_NAMED])}{' …' if len(which) > _NAMED else ''}" if which else ""
        out.append(
            Finding(
                level,
                f"{name}: {len(wrong)} of {len(kept)} left out as wrong{named}",
                "" if level == Level.PASS else "with many wrong, the others may agree by chance",
                "" if level == Level.PASS else "look at these pictures and labels; mend them or the light",
            )
        )
        if name == SPOTS:
            out += _bad_positions(measured.spots.position, wrong, positions)
    return out


def _bad_positions(position: Ints, wrong: Sequence[int], positions: Sequence[str]) -> list[Finding]:
    """Positions at which most spots were left out."""
    at, every = Counter(position[wrong].tolist()), Counter(position.tolist())
    bad = [k for k, n in at.items() if n >= 2 and 2 * n > every[k]]
    if not bad:
        return []
    names = ", ".join(positions[k] for k in sorted(bad)[:_NAMED])
    return [
        Finding(
            Level.WARN,
            f"most spots of position {names} were left out",
            "when all spots of a position are off together, its recorded pose or its labels are wrong",
            "check the stand's record there",
        )
    ]


def _held_out(h: HoldOut, limits: RigLimits) -> Finding:
    deg, mm = np.rad2deg(h.attitude_rms), 1e3 * h.position_rms
    words = (
        f"positions held out ({len(h.positions)}, each predicted by a calibration without its spots): attitude on this"
        f" bench {deg:.2g} deg, position {mm:.2g} mm RMS per axis"
    )
    if h.p >= P_MISFIT or h.ratio <= limits.hold_out_warn:
        return Finding(Level.PASS, f"{words}; {h.ratio:.2f} times what is expected")
    return Finding(
        Level.FAIL if h.ratio > limits.hold_out_fail else Level.WARN,
        f"{words}; {h.ratio:.2f} times what is expected",
        "new recordings will be off by more than their covariance says",
        "see which positions stand out; look for what changed between them: a camera, the stand's zero, the lasers",
    )


def _expected(e: ExpectedPose | None, limits: RigLimits) -> Finding:
    if e is None:
        return Finding(
            Level.FAIL,
            "in the middle of the stand's positions too few spots are in the pictures to measure a pose",
            "the rig cannot be used there",
            "aim the cameras at the spots",
        )
    deg, mm = in_degrees(e.total), in_mm(e.total)
    words = (
        f"one frame in the middle: attitude to {deg:.2g} deg, position to {mm:.2g} mm (1 sigma per axis), of it"
        f" {in_degrees(e.systematic):.2g} deg and {in_mm(e.systematic):.2g} mm from the calibration"
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
        f" most of it comes from {most}",
        "improve that first; more positions of the stand, or dots, help where noise is the cause",
    )
