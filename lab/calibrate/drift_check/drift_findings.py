"""Findings of a drift check: the state of the calibration, the change of each camera, wrong points and moved lasers."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np

from calibration.drift import ALL_CHANGED, LASER_MOVED, TURNED, TURNED_ZOOMED, ZOOMED
from lab.calibrate.drift_check.drift_result import CameraDrift, DriftLimits, OtherChange, is_weak, level_of
from lab.files.rig.calibration_state import CalibrationState
from lab.findings.finding import Finding, Level, finding, passed
from lab.number_format import format_number


def state_findings(state: CalibrationState | None, today: datetime.date, warning_days: int) -> list[Finding]:
    """Findings on the date, verdict and expiry of the calibration in rig.yaml."""
    if state is None:
        what = "rig.yaml does not state when it was calibrated (no block `calibration`)"
        return [finding("BP-C01", Level.WARN, what)]
    out = []
    if state.failed:
        why = state.reasons[0] if state.reasons else "no reason given"
        out.append(finding("BP-C02", Level.FAIL, f"the calibration of {state.date} failed: {why}"))
    if state.date > today:
        out.append(finding("BP-C03", Level.WARN, f"the calibration is dated {state.date}, after today ({today})"))
    left = state.days_left(today)
    if left is not None and left < 0:
        what = f"the calibration expired on {state.valid_until}, {_days(-left)} ago"
        out.append(finding("BP-C04", Level.FAIL, what))
    elif left is not None and left <= warning_days:
        what = f"the calibration expires on {state.valid_until}, in {_days(left)}"
        out.append(finding("BP-C05", Level.WARN, what))
    else:
        out.append(passed(f"calibrated on {state.date}, {state.validity}"))
    return out


def _days(count: int) -> str:
    return f"{count} day{'s' if count != 1 else ''}"


def unchecked_finding(cameras: Sequence[str]) -> Finding:
    """The finding on cameras without measurements."""
    them = "it" if len(cameras) == 1 else "them"
    what = f"camera {', '.join(cameras)} not checked: nothing was measured in {them}"
    return finding("BP-C10", Level.WARN, what)


def size(px: float, mm: float) -> str:
    """An amount of drift in words: `0.52 px (1.5 mm at the screen)`."""
    return f"{format_number(px)} px" + (
        f" ({format_number(mm)} mm at the screen)" if np.isfinite(mm) else " (the rays miss the screen)"
    )


def camera_findings(c: CameraDrift, limits: DriftLimits, pose_free: bool) -> list[Finding]:
    """Findings on one camera. pose_free: whether the pose of the vehicle was fitted."""
    out = []
    name = f"camera {c.camera}"
    if c.change is not None:
        level = level_of(c.drift_px, c.drift_mm, limits)
        why = {
            Level.PASS: f"it is significant but small: below {limits.warn_mm:g} mm it is less than the spots' noise",
            Level.WARN: f"beyond {limits.warn_mm:g} mm it affects the pose, and the stated sigmas do not include it",
            Level.FAIL: f"beyond {limits.fail_mm:g} mm the error of the pose exceeds the stated sigmas",
        }[level]
        if pose_free:
            why += ". The fit of the unknown vehicle pose may absorb part of the change."
        change = describe_change(c)
        what = f"{name} {change}: its picture is off by {size(c.drift_px, c.drift_mm)}, p = {_p(c.change.p_value)}"
        out.append(finding("BP-C06", level, what, why=why, variant=c.change.kind))
    if np.isfinite(c.unexplained_px):
        what = (
            f"{name}: pixels are off by {size(c.unexplained_px, c.unexplained_mm)} in a way that a turned or moved"
            " camera, a changed focus or a few wrong points do not explain"
        )
        out.append(finding("BP-C07", level_of(c.unexplained_px, c.unexplained_mm, limits), what))
    if out:
        return out
    weak = is_weak(c.detectable_mm, limits)
    detectable = "a common shift of its picture is not detectable"
    if np.isfinite(c.detectable_px):
        detectable = f"the smallest detectable shift is {size(c.detectable_px, c.detectable_mm)}"
    state = "shows no change, but this check is weak" if weak else "has not changed"
    what = f"{name} {state}: drift {size(c.drift_px, c.drift_mm)}, expected from noise {format_number(c.noise_px)} px"
    what += f"; {detectable}"
    if not weak:
        return [passed(what)]
    why = f"the check can miss a drift far beyond {limits.fail_mm:g} mm, the limit for use"
    return [finding("BP-C08", Level.WARN, what, why=why, variant="pose unknown" if pose_free else "")]


def describe_change(c: CameraDrift) -> str:
    """The change of a camera in words, with its figures."""
    assert c.change is not None
    kind = c.change.kind
    if kind == ZOOMED:
        scale = f"{_signed(c.scale_ppm)} ± {format_number(c.sigma_scale_ppm)} ppm"
        return f"has another focal length ({scale}): focus or zoom changed"
    if kind in (TURNED, TURNED_ZOOMED):
        turn = c.change.delta[:3]
        sigma = np.sqrt(np.maximum(np.diagonal(c.change.covariance)[:3], 0))
        angle = float(np.linalg.norm(turn))
        of_angle = float(np.sqrt((turn / max(angle, 1e-12)) ** 2 @ sigma**2))
        axis = ("its horizontal axis (up or down)", "its vertical axis (sideways)", "its optical axis (rolled)")
        main = axis[int(np.argmax(np.abs(turn)))]
        size = f"{format_number(np.rad2deg(angle))} ± {format_number(np.rad2deg(of_angle), 2)} deg"
        words = f"turned by {size}, mainly about {main}"
        return words + (", and its focal length changed" if kind == TURNED_ZOOMED else "")
    moved = 1e3 * float(np.linalg.norm(c.change.delta[3:6]))
    turned = np.rad2deg(float(np.linalg.norm(c.change.delta[:3])))
    words = f"moved by about {format_number(moved, 2)} mm and turned by about {format_number(turned, 2)} deg"
    return words + (", and its focal length changed" if kind == ALL_CHANGED else "")


def other_findings(others: Sequence[OtherChange], limits: DriftLimits) -> list[Finding]:
    """Findings on wrong points and moved lasers."""
    out = []
    for o in others:
        level, off = level_of(o.px, o.mm, limits), size(o.px, o.mm)
        if o.change.kind == LASER_MOVED:
            what, variant = f"laser {o.change.subject} has moved: its spots are off by {off}", "laser"
        else:
            what, variant = f"one point is wrong: {o.change.subject} is off by {off}, the others are not", "point"
            level = min(level, Level.WARN)  # an error of the point, not of the calibration
        out.append(finding("BP-C09", level, f"{what}, p = {_p(o.change.p_value)}", variant=variant))
    return out


def _p(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1g}"


def _signed(value: float) -> str:
    return ("+" if value > 0 else "") + format_number(value)
