"""The block `target:` of a stereo run.yaml: the markers of the vehicle and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.error_text import suggest_name
from lab.files.text.fields import Block, Name, NonNegative, Positive, Vector3, Word, field_error, numbers, validated
from lab.files.text.yaml_text import read_mapping
from tracking.binocular.marker_model import MarkerModel
from tracking.binocular.segmentation import ColourRange
from tracking.binocular.triangulation import pose_of_points

_SYMMETRIC = 0.03  # share of the target's size within which turned markers count as the same


@dataclass(frozen=True, slots=True)
class Target:
    """The markers, and the colours that their `colour` indexes."""

    model: MarkerModel
    colours: tuple[ColourRange, ...]


class _ColourBlock(Block):
    hue_deg: Annotated[list[float], pydantic.PlainValidator(numbers(2))]
    saturation: Annotated[list[float], pydantic.PlainValidator(numbers(2))] = [0.35, 1.0]  # noqa: RUF012 - frozen
    value: Annotated[list[float], pydantic.PlainValidator(numbers(2))] = [0.2, 1.0]  # noqa: RUF012 - frozen

    @pydantic.model_validator(mode="after")
    def _in_range(self) -> _ColourBlock:
        try:
            self.named("")
        except ValueError as error:
            raise field_error(str(error)) from None
        return self

    def named(self, name: str) -> ColourRange:
        """The block as a value."""
        h, s, v = self.hue_deg, self.saturation, self.value
        return ColourRange(name, (h[0], h[1]), (s[0], s[1]), (v[0], v[1]))


class _MarkerBlock(Block):
    position_m: Vector3
    colour: Word
    radius_m: Positive | None = None


class TargetBlock(Block):
    """Colours and markers."""

    colours: dict[Name, _ColourBlock]
    markers: dict[Name, _MarkerBlock]
    sigma_m: NonNegative = 0.0


def load_target(given: Any, folder: Path, path: Path) -> Target:
    """The target of a run.yaml: a block, or the name of a file with one. Raises InputError."""
    where, inside = path, "target"
    if isinstance(given, str):
        where, inside = folder / given, ""
        if not where.is_file():
            raise InputError(f"{path}: target: expected a block or a file with one, found nothing at {where}")
        given = read_mapping(where)
    if not isinstance(given, dict):
        raise InputError(f"{path}: target: expected a mapping with colours and markers, or the name of a file")
    return _target_of(validated(TargetBlock, given, where, inside), f"{where}: {inside}." if inside else f"{where}: ")


def _target_of(block: TargetBlock, where: str) -> Target:
    names = list(block.colours)
    if not names:
        raise InputError(f"{where}colours: expected one or more, got none")
    for name, marker in block.markers.items():
        if marker.colour not in names:
            raise InputError(
                f"{where}markers.{name}.colour: expected one of {', '.join(names)}, got {marker.colour!r}"
                f"{suggest_name(marker.colour, names)}"
            )
    if len(block.markers) < 3:
        raise InputError(f"{where}markers: expected three or more, got {len(block.markers)}; two do not fix a pose")
    x = np.array([m.position_m for m in block.markers.values()])
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * max(spread[0], 1e-12):
        raise InputError(f"{where}markers: expected markers that are not on one line; a turn about it would be free")
    model = MarkerModel(
        names=tuple(block.markers),
        positions=x,
        colour=np.array([names.index(m.colour) for m in block.markers.values()], dtype=np.int64),
        radius_m=np.array([np.nan if m.radius_m is None else m.radius_m for m in block.markers.values()]),
        sigma_m=block.sigma_m,
    )
    if is_symmetric(model):
        raise InputError(
            f"{where}markers: expected markers that look different after every turn, got a symmetric set: its attitude"
            " is ambiguous; give one marker another colour, or move it"
        )
    return Target(model, tuple(block.colours[n].named(n) for n in names))


def is_symmetric(model: MarkerModel) -> bool:
    """Whether a turn maps the markers onto markers of the same colour, within 3 % of the size of the target."""
    x, tolerance = model.positions, _SYMMETRIC * model.extent_m
    first = _widest(x)
    sides = _sides(x[list(first)])
    for other in permutations(range(len(x)), 3):
        same_colours = np.array_equal(model.colour[list(other)], model.colour[list(first)])
        if other == first or not same_colours or np.abs(_sides(x[list(other)]) - sides).max() > 2 * tolerance:
            continue
        turned = pose_of_points(x[list(first)], x[list(other)]).apply(x)
        apart = np.linalg.norm(turned[:, None] - x[None], axis=-1)
        apart[model.colour[:, None] != model.colour[None]] = np.inf
        if apart.min(axis=1).max() < tolerance and len(set(apart.argmin(axis=1).tolist())) == len(x):
            return True
    return False


def _sides(triangle: Array) -> Array:
    return np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1)


def _widest(x: Array) -> Sequence[int]:
    """Three markers of a large triangle."""
    far = int(np.argmax(np.linalg.norm(x - x.mean(axis=0), axis=1)))
    second = int(np.argmax(np.linalg.norm(x - x[far], axis=1)))
    area = np.linalg.norm(np.cross(x - x[far], x[second] - x[far]), axis=1)
    return (far, second, int(np.argmax(area)))
