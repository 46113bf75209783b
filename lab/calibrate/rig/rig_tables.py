"""residuals.csv of a joint calibration: the residual of every measurement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from calibration.rig.joint import CORNERS, DOTS, RECORDS, SPOTS, Joint
from calibration.rig.rig_steps import RigCalibration
from calibration.terms.corners import CornerTerm
from calibration.terms.pose_records import RecordTerm
from calibration.terms.surveyed import array_of
from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.csv_text import csv_word

RESIDUALS = "residuals.csv"
COLUMNS = ("kind", "name", "camera", "axis", "residual", "unit", "sigmas", "used")
_AXES = ("x", "y", "z", "rot_x", "rot_y", "rot_z")


def write_residuals(steps: RigCalibration, positions: Sequence[str], path: Path) -> None:
    """Write the table, measured minus adjusted, one row per number. Column sigmas: in units of the stated sigma."""
    lines = [",".join(COLUMNS)]
    for kind, name, camera, axis, residual, unit, sigmas, used in _rows(steps, positions):
        lines.append(f"{kind},{csv_word(name)},{camera},{axis},{residual:.6g},{unit},{sigmas:.4g},{int(used)}")
    atomic_write_text("\n".join(lines) + "\n", path)


_Row = tuple[str, str, str, str, float, str, float, bool]


def _rows(steps: RigCalibration, positions: Sequence[str]) -> Iterator[_Row]:
    joint, measured = steps.joint, steps.measured
    cameras, views = list(joint.rig.cameras), joint.rig.views()
    network = measured.network
    if SPOTS in joint.every:
        spots = measured.spots
        roots = np.linalg.cholesky(spots.covariance)
        residuals = joint.every[SPOTS].linearise(joint.values).residuals
        for i, (r, root) in enumerate(zip(residuals, roots, strict=True)):
            camera, spot = views[spots.view[i]]
            name = f"position {positions[spots.position[i]]} spot {spot}"
            yield from _pixel("spot", name, camera, -(root @ r), r, bool(joint.kept[SPOTS][i]))
    if DOTS in joint.every:
        s = network.point_observations
        residuals = joint.every[DOTS].linearise(joint.values).residuals
        for i, r in enumerate(residuals):
            name = network.control_points.names[s.point_of[i]]
            yield from _pixel("dot", name, cameras[s.camera_of[i]], -r * s.sigma_px[i], r, bool(joint.kept[DOTS][i]))
    if len(network.control_points):
        errors = network.control_points.xyz - array_of(joint.values, "points")
        sigma = np.sqrt(np.diagonal(network.control_points.covariance, axis1=1, axis2=2))
        for name, e, s1 in zip(network.control_points.names, errors, sigma, strict=True):
            for k in range(3):
                yield "survey", name, "", _AXES[k], float(1e3 * e[k]), "mm", float(e[k] / s1[k]), True
    records = joint.every.get(RECORDS)
    if isinstance(records, RecordTerm):
        yield from _records(records, joint, positions)
    corners = joint.every.get(CORNERS)
    if isinstance(corners, CornerTerm):
        for i, r in enumerate(corners.linearise(joint.values).residuals):
            name = f"{network.placements[corners.placement[i]]} corner {i}"
            px = -r * corners.sigma_px[i]
            yield from _pixel("corner", name, cameras[corners.camera[i]], px, r, bool(joint.kept[CORNERS][i]))


def _pixel(kind: str, name: str, camera: str, px: Array, sigmas: Array, used: bool) -> Iterator[_Row]:
    for axis, value, s in zip("uv", px, sigmas, strict=True):
        yield kind, name, camera, axis, float(value), "px", float(-s), used


def _records(term: RecordTerm, joint: Joint, positions: Sequence[str]) -> Iterator[_Row]:
    stated = term.sigmas
    for k, r in enumerate(term.linearise(joint.values).residuals):
        for axis in range(6):
            if np.isfinite(stated[k, axis]) and stated[k, axis] > 0:
                value = -r[axis] * stated[k, axis]
                value, unit = (1e3 * value, "mm") if axis < 3 else (np.rad2deg(value), "deg")
                name = f"position {positions[k]}"
                yield "stand", name, "", _AXES[axis], float(value), unit, float(-r[axis]), bool(joint.kept[RECORDS][k])
