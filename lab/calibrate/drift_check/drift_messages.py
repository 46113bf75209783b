"""A daily check's findings in words: what has changed, what it means, what to do."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np

from calibration.drift import ALL_CHANGED, LASER_MOVED, MOVED, TURNED, TURNED_ZOOMED, ZOOMED
from calibration.findings import Finding, Level
from lab.calibrate.drift_check.drift_result import CameraDrift, DailyLimits, OtherChange, is_weak, level_of
from lab.files.rig.calibration_state import CalibrationState
from lab.number_format import short

_RECALIBRATE = {
    TURNED: "Look for a knocked or loose mount; fix it, then find the camera's place anew (`calibrate rig`).",
    MOVED: "Look for a knocked or loose mount; fix it, then find the camera's place anew (`calibrate rig`).",
    ZOOMED: "Check the focus and zoom rings and the lens mount, lock them, then calibrate this camera's lens anew.",
    TURNED_ZOOMED: "Check mount, focus and zoom rings; lock them, then calibrate the lens and the camera's place anew.",
    ALL_CHANGED: "Check mount, focus and zoom rings; lock them, then calibrate the lens and the camera's place anew.",
}


def state_findings(state: CalibrationState | None, today: datetime.date, warning_days: int) -> list[Finding]:
    """What rig.yaml says of its own calibration."""
    if state is None:
        return [
            Finding(
                Level.WARN,
                "rig.yaml does not say when it was calibrated (no block `calibration`)",
                "nobody can tell whether it is out of date",
                "Calibrate with beampose, or add calibration: {date: ..., verdict: PASS, valid_until: ...}.",
            )
        ]
    out = []
    if state.verdict == "FAIL":
        out.append(
            Finding(
                Level.FAIL,
                f"the calibration of {state.date} failed: {state.reasons[0] if state.reasons else 'no reason given'}",
                "it must not be used, whatever today's drift",
                "Put the cause right and calibrate again.",
            )
        )
    if state.date > today:
        out.append(
            Finding(
                Level.WARN,
                f"the calibration is dated {state.date}, after today ({today})",
                "its age cannot be judged",
                "Check the clock of this computer and the date in rig.yaml.",
            )
        )
    if state.valid_until is None:
        out.append(Finding(Level.PASS, f"calibrated on {state.date}, without an expiry date"))
        return out
    left = (state.valid_until - today).days
    if left < 0:
        out.append(
            Finding(
                Level.FAIL,
                f"the calibration expired on {state.valid_until}, {_days(-left)} ago",
                "mounts and lenses creep; the lab has set this date",
                "Calibrate again, or, if the drift below is within its limits, set a new valid_until in rig.yaml.",
            )
        )
    elif left <= warning_days:
        out.append(
            Finding(
                Level.WARN,
                f"the calibration expires on {state.valid_until}, in {_days(left)}",
                "after that day runs are refused",
                "Plan a new calibration.",
            )
        )
    else:
        out.append(Finding(Level.PASS, f"calibrated on {state.date}, valid until {state.valid_until}"))
    return out


def _days(count: int) -> str:
    return f"{count} day{'s' if count != 1 else ''}"


def size(px: float, mm: float) -> str:
    """`0.52 px (1.5 mm at the screen)`."""
    return f"{short(px)} px" + (
        f" ({short(mm)} mm at the screen)" if np.isfinite(mm) else " (its rays miss its screen)"
    )


def camera_findings(c: CameraDrift, limits: DailyLimits, pose_free: bool) -> list[Finding]:
    """What a check found in one camera."""
    out = []
    name = f"camera {c.camera}"
    if c.change is not None:
        level = level_of(c.drift_px, c.drift_mm, limits)
        limit = limits.fail_mm if level == Level.FAIL else limits.warn_mm
        why = {
            Level.PASS: f"it is sure but small: below {limits.warn_mm:g} mm it is lost in the spots' own noise",
            Level.WARN: f"beyond {limit:g} mm it shows in the pose; the stated sigmas are too small by it",
            Level.FAIL: f"beyond {limit:g} mm the pose is wrong by more than it claims",
        }[level]
        also = " An unknown vehicle pose may hide part of the change." if pose_free else ""
        remedy = "" if level == Level.PASS else _RECALIBRATE[c.change.kind]
        what = f"{name} {told(c)}: its picture is off by {size(c.drift_px, c.drift_mm)}, p = {_p(c.change.p_value)}"
        out.append(Finding(level, what, why + "." + also if also else why, remedy))
    if np.isfinite(c.unexplained_px):
        out.append(
            Finding(
                level_of(c.unexplained_px, c.unexplained_mm, limits),
                f"{name}: pixels are off by {size(c.unexplained_px, c.unexplained_mm)} in a way that neither a turned"
                " or moved camera, a changed focus nor a few wrong points explain",
                "the points, the screen or the lens model are not what the calibration says",
                "Check the points' names and places; if they are right, calibrate again.",
            )
        )
    if out:
        return out
    weak = is_weak(c.detectable_mm, limits)
    seen = "a common shift of its picture could not have been found"
    if np.isfinite(c.detectable_px):
        seen = f"a shift of {size(c.detectable_px, c.detectable_mm)} would have been found"
    state = "shows no change, but this check is weak" if weak else "has not changed"
    what = f"{name} {state}: drift {size(c.drift_px, c.drift_mm)}, by noise alone {short(c.noise_px)} px; {seen}"
    if not weak:
        return [Finding(Level.PASS, what)]
    remedy = "Measure more points, spread over the picture, or with a smaller sigma."
    if pose_free:
        remedy = "A vehicle at an unknown pose hides such shifts: give its pose (--pose) or measure known points."
    why = f"a drift far beyond {limits.fail_mm:g} mm, where it must not be used, could have been missed"
    return [Finding(Level.WARN, what, why, remedy)]


def told(c: CameraDrift) -> str:
    """What a camera did, with its figures."""
    assert c.change is not None
    kind = c.change.kind
    if kind == ZOOMED:
        return (
            f"has another focal length ({_signed(c.scale_ppm)} ± {short(c.sigma_scale_ppm)} ppm): focus or zoom changed"
        )
    if kind in (TURNED, TURNED_ZOOMED):
        turn = c.change.delta[:3]
        sigma = np.sqrt(np.maximum(np.diagonal(c.change.covariance)[:3], 0))
        angle = float(np.linalg.norm(turn))
        of_angle = float(np.sqrt((turn / max(angle, 1e-12)) ** 2 @ sigma**2))
        axis = ("its horizontal axis (up or down)", "its vertical axis (sideways)", "its optical axis (rolled)")
        main = axis[int(np.argmax(np.abs(turn)))]
        words = f"turned by {short(np.rad2deg(angle))} ± {short(np.rad2deg(of_angle), 2)} deg, mainly about {main}"
        return words + (", and its focal length changed" if kind == TURNED_ZOOMED else "")
    moved = 1e3 * float(np.linalg.norm(c.change.delta[3:6]))
    turned = np.rad2deg(float(np.linalg.norm(c.change.delta[:3])))
    words = f"moved by about {short(moved, 2)} mm and turned by about {short(turned, 2)} deg"
    return words + (", and its focal length changed" if kind == ALL_CHANGED else "")


def other_findings(others: Sequence[OtherChange], limits: DailyLimits) -> list[Finding]:
    """Points that are wrong, lasers that moved."""
    out = []
    for o in others:
        level = level_of(o.px, o.mm, limits)
        if o.change.kind == LASER_MOVED:
            what = f"laser {o.change.subject} points elsewhere: its spots are off by {size(o.px, o.mm)}"
            why, remedy = "its direction in rig.yaml no longer holds", "Fix its mount, then calibrate the beams again."
        else:
            what = f"one point is wrong: {o.change.subject} is off by {size(o.px, o.mm)}; the others do not follow it"
            why = "the point moved, or was mistaken; the cameras are judged without it"
            remedy = "Look at the point, measure it again, and leave it out of the file if it is lost."
            level = min(level, Level.WARN)  # it accuses the point, not the calibration
        out.append(Finding(level, what + f", p = {_p(o.change.p_value)}", why, remedy if level > Level.PASS else ""))
    return out


def _p(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1g}"


def _signed(value: float) -> str:
    return ("+" if value > 0 else "") + short(value)
