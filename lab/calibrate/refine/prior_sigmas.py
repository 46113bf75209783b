"""What is known of a rig before a refinement: the covariance of its file, and sigmas given for some of its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from geometry.arrays import Array, skew
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import (
    CLOCK,
    DIRECTION,
    POINT,
    POSE,
    ROW_TIME,
    TIME_OFFSET,
    RigCovariance,
    split_name,
)
from lab.errors import InputError
from lab.files.text.error_text import suggest_name

CAMERAS, SCREENS, BEAMS, LENS, CLOCKS, SHUTTER = "cameras", "screens", "beams", "lens", "clocks", "shutter"
GROUPS = (CAMERAS, SCREENS, BEAMS, LENS, CLOCKS, SHUTTER)
_OF_PARAMETER = {TIME_OFFSET: CLOCKS, ROW_TIME: SHUTTER}
_WHAT = {
    CAMERAS: ("position_m", "rotation_deg"),
    SCREENS: ("position_m", "rotation_deg"),
    BEAMS: ("point_m", "direction_deg"),
}


def free_group(name: str) -> str:
    """The group of `--free` to which a parameter belongs."""
    kind, _, parameter = split_name(name)
    if parameter in _OF_PARAMETER:
        return _OF_PARAMETER[parameter]
    return LENS if kind == CAMERAS and parameter not in POSE else kind


def stated_covariance(rig: Rig, stated: RigCovariance | None, sigmas: Mapping[str, Any], path: Path) -> RigCovariance:
    """The covariance of the file with the parts for which sigmas are given replaced.

    sigmas: by `cameras.position_m` (of all cameras), `cameras.left.rotation_deg` (of one), and so on; per axis, of a
    camera or screen about its own place, of a beam across its direction; `cameras.time_offset_s` and
    `cameras.row_time_s`. A part with sigmas has no correlation with others. Where the offset of every camera has one,
    that of the first is known: recordings show offsets from each other only. Raises InputError: for a name or value
    that is none, or if nothing is stated at all.
    """
    chosen = _chosen(rig, sigmas)
    names: list[str] = []
    blocks: list[Array] = []
    if stated is not None:
        kept = [i for i, n in enumerate(stated.names) if _part_of(n) not in chosen]
        kept = [i for i in kept if stated.matrix[i, i] > 0]
        names += [stated.names[i] for i in kept]
        blocks.append(stated.matrix[np.ix_(kept, kept)])
    for (kind, part), values in chosen.items():
        new, block = _block(rig, kind, part, values)
        names += new
        blocks.append(block)
    matrix, offsets = block_diag(*blocks), [f"{CAMERAS}.{name}.{TIME_OFFSET}" for name in rig.cameras]
    if set(offsets) <= set(names):
        kept = [i for i, n in enumerate(names) if n != offsets[0]]
        names, matrix = [names[i] for i in kept], matrix[np.ix_(kept, kept)]
    if not names:
        raise InputError(
            f"{path}: expected the covariance of its parameters, or sigmas, got neither; write the covariances, or add"
            " options such as --sigma cameras.position_m=0.005 --sigma cameras.rotation_deg=0.2"
        )
    return RigCovariance(tuple(names), matrix)


def _part_of(name: str) -> tuple[str, str]:
    """The part to whose sigmas a parameter belongs: a kind and a name, or a number and the name of its camera."""
    kind, part, parameter = split_name(name)
    return (LENS if free_group(name) == LENS else parameter if parameter in CLOCK else kind), part


def _chosen(rig: Rig, sigmas: Mapping[str, Any]) -> dict[tuple[str, str], dict[str, float]]:
    """The sigmas of each part, by kind and name; those of one part replace those of all."""
    parts: dict[str, Sequence[str]] = {CAMERAS: list(rig.cameras), SCREENS: list(rig.screens), BEAMS: list(rig.beams)}
    out: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in sorted(sigmas.items(), key=lambda item: item[0].count(".")):
        kind, _, rest = name.partition(".")
        part, _, what = rest.rpartition(".")
        clock = kind == CAMERAS and what in CLOCK
        if kind not in parts or (what not in _WHAT[kind] and not clock):
            known = [f"{k}.{w}" for k, of in (*_WHAT.items(), (CAMERAS, CLOCK)) for w in of]
            raise InputError(f"--sigma: expected one of {', '.join(known)}, got {name!r}{suggest_name(name, known)}")
        if part and part not in parts[kind]:
            raise InputError(
                f"--sigma {name}: expected one of the rig's {kind}, got {part!r}{suggest_name(part, parts[kind])}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 100:
            raise InputError(f"--sigma {name}: expected a number above 0 in m, deg or s, got {value!r}")
        for one in [part] if part else parts[kind]:
            out.setdefault((what if clock else kind, one), {})[what] = float(value)
    for (kind, part), values in out.items():
        missing = [w for w in _WHAT.get(kind, ()) if w not in values]
        if missing:
            raise InputError(
                f"--sigma: expected {kind}.{missing[0]} beside {kind}.{next(iter(values))}, got none for {part!r}"
            )
    return out


def _block(rig: Rig, kind: str, part: str, values: Mapping[str, float]) -> tuple[list[str], Array]:
    """Names and covariance of one part with these sigmas."""
    if kind in CLOCK:
        return [f"{CAMERAS}.{part}.{kind}"], np.array([[values[kind] ** 2]])
    length, angle = (values[w] for w in _WHAT[kind])
    angle = float(np.deg2rad(angle))
    if kind == BEAMS:
        d = rig.beams[part].direction
        across = np.eye(3) - np.outer(d, d)
        return [f"beams.{part}.{n}" for n in (*DIRECTION, *POINT)], block_diag(angle**2 * across, length**2 * across)
    own = np.diag(np.repeat([length**2, angle**2], 3))
    if kind == CAMERAS:
        pose = rig.cameras[part].camera_from_world
        # The camera turns about its own centre, as in calibration/model_check/faults.py.
        D = np.block([[np.eye(3), -skew(pose.translation)], [np.zeros((3, 3)), pose.rotation.T]])
        own = D @ own @ D.T
    return [f"{kind}.{part}.{n}" for n in POSE], own
