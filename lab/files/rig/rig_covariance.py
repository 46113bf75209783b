"""The covariance blocks of a rig.yaml as one joint covariance of the rig's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from geometry.arrays import Array, symmetric
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, is_known, split_name
from lab.errors import InputError
from lab.files.rig.camera_block import Covariance, covariance_error

TARGET = "target"


def joint_covariance(rig: Rig, blocks: Mapping[str, Covariance], path: Path | str) -> RigCovariance | None:
    """The joint covariance of the parameters of this rig in the blocks; None where there are none.

    blocks: by `cameras.NAME`, `screens.NAME`, `target`. The target's block may also name parameters of cameras and
    screens (as a joint solve writes it): then it is complete, and the other blocks, excerpts of it, are not used.
    Unknown names are ignored, as the contract of the files defines.

    Raises:
        InputError: a matrix is not a covariance.
    """
    target = blocks.get(TARGET)
    if target is not None and any(n.startswith(("cameras.", "screens.")) for n in target.parameters):
        used = {TARGET: target}
    else:
        used = dict(blocks)
    names: list[str] = []
    pieces: list[Array] = []
    for where, block in used.items():
        full = [n if where == TARGET else f"{where}.{n}" for n in block.parameters]
        known = [i for i, n in enumerate(full) if is_known(rig, n)]
        if not known:
            continue
        matrix = block.matrix[np.ix_(known, known)]
        mistake = covariance_error(Covariance(tuple(block.parameters[i] for i in known), matrix))
        if mistake:
            raise InputError(f"{path}: {where}.covariance.matrix: {mistake}")
        names += [full[i] for i in known]
        pieces.append(symmetric(matrix))
    if not names:
        return None
    joint = np.zeros((len(names), len(names)))
    at = 0
    for piece in pieces:
        joint[at : at + len(piece), at : at + len(piece)] = piece
        at += len(piece)
    return RigCovariance(tuple(names), joint)


def covariance_blocks(covariance: RigCovariance) -> dict[str, Covariance]:
    """A joint covariance as blocks of a rig.yaml: complete for the target, an excerpt for each camera and screen."""
    out: dict[str, Covariance] = {}
    of: dict[str, list[int]] = {}
    for i, name in enumerate(covariance.names):
        kind, thing, _ = split_name(name)
        if kind in ("cameras", "screens"):
            of.setdefault(f"{kind}.{thing}", []).append(i)
    for where, rows in of.items():
        names = tuple(split_name(covariance.names[i])[2] for i in rows)
        out[where] = Covariance(names, symmetric(covariance.matrix[np.ix_(rows, rows)]))
    out[TARGET] = Covariance(covariance.names, symmetric(covariance.matrix))
    return out
