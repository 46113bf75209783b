"""`beampose check`: what the rig can see over a range of poses."""

from __future__ import annotations

import numpy as np

from geometry.pose_prior import PosePrior
from geometry.pose_solver import visibility
from geometry.pose_solver.gauss_newton import SolveLimits
from geometry.rig import Rig
from lab.runs.input_check.findings import Findings, table
from tracking.setup_mistakes.possible import possible_mistakes

FEW_POSES = 100  # with which possible mistakes are tried
MOST_NAMED = 3
SELDOM = 0.5  # a camera that sees no spot in more than this share of the poses is remarked


def check_visibility(findings: Findings, rig: Rig, prior: PosePrior | None, limits: SolveLimits, rig_path: str) -> None:
    """Report how often each spot is in view, over the prior's range or an assumed one.

    A spot, a camera or a pose that is never visible is a problem with a prior, and a remark without one.
    """
    span = visibility.assumed_range(rig) if prior is None else prior
    seen = visibility.visibility_of(rig, span, limits)
    severe = findings.remarks if prior is None else findings.problems
    centre = ", ".join(f"{v + 0.0:.4g}" for v in span.centre.translation)
    turned = ", ".join(f"{v + 0.0:.4g}" for v in np.rad2deg(span.centre.ypr))
    findings.facts += [
        "",
        f"Seen from {visibility.POSES} poses, "
        + ("the prior's range: " if prior is not None else "an assumed range, since there is no prior: ")
        + f"within {span.within_m:g} m of ({centre}), within {np.rad2deg(span.within_rad):.4g} deg of yaw, pitch,"
        + f" roll ({turned})",
    ]
    rows = [
        (camera, spot, _percent(seen.in_picture[i]), _percent(seen.outside[i]), _percent(seen.off_screen[i]))
        for i, (camera, spot) in enumerate(seen.views)
    ]
    findings.facts += table(("camera", "spot", "in picture", "outside", "off screen"), rows)
    few = np.percentile(seen.spots_in_view, [0, 50, 100]).astype(int) if seen.views else (0, 0, 0)
    findings.facts.append(f"spots in view of all cameras: {few[0]} to {few[2]}, median {few[1]}")
    line = f"pose observable from one frame: {_percent(seen.observable)} of the poses"
    if seen.observable > 0:
        good = (seen.sigma_m <= limits.max_sigma_m) & (seen.sigma_rad <= limits.max_sigma_rad)
        line += (
            f"; worst axis with {visibility.NOISE_PX:g} px of noise, median:"
            f" {np.median(seen.sigma_m[good]) * 1e3:.3g} mm,"
            f" {np.rad2deg(np.median(seen.sigma_rad[good])):.3g} deg"
        )
    else:
        severe.append(f"{rig_path}: the pose is observable in none of {visibility.POSES} poses of the range")
    findings.facts.append(line)

    never = [
        f"{rig_path}: target.spots.{spot}: never hits its screen {rig.spots[spot].screen!r}"
        for spot, share in seen.on_screen.items()
        if share == 0
    ]
    never += [f"{rig_path}: cameras.{camera}: never sees a spot" for camera, share in seen.blind.items() if share == 1]
    if never:
        severe += never
        severe.append(f"{rig_path}: {_without_mistake(rig, span, limits)}")
    findings.remarks += [
        f"{rig_path}: cameras.{camera}: sees no spot in {_percent(share)} of the poses"
        for camera, share in seen.blind.items()
        if SELDOM < share < 1
    ]


def _without_mistake(rig: Rig, span: PosePrior, limits: SolveLimits) -> str:
    """The mistakes without which every spot hits its screen and every camera sees spots, as a question."""
    found = []
    for mistake in possible_mistakes(rig):
        if mistake.rig is rig:
            continue
        seen = visibility.visibility_of(mistake.rig, span, limits, FEW_POSES)
        if min(seen.on_screen.values()) > 0 and max(seen.blind.values()) < SELDOM:
            found.append(mistake)
    if not found:
        return "compare camera_from_world, camera_matrix and world_from_screen with the lab"
    return f"it would be otherwise if {', or if '.join(m.what for m in found[:MOST_NAMED])}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
