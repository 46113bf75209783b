"""`beampose init` for a rig of one's own: its parts as they were measured, by options or by questions."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import SCHEMA, RigFile, load_rig_file
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import parse_value, write_mapping

Ask = Callable[[str, str], str]  # question and default ("": none) to answer
Parts = Mapping[str, Mapping[str, Any]]  # by name: what is stated about each

_CAMERA = ("screen", "look_at", "field_of_view_deg", "focal_px", "camera_from_world", "image_size_px", "camera_matrix",
           "distortion", "lens", "noise")  # fmt: skip
_BEAM = ("points_m", "direction", "azimuth_elevation_deg", "point_m", "plus", "minus")
_SCREEN = (
    "corner_m",
    "quaternion_wxyz",
    "rotation_matrix",
    "yaw_pitch_roll_deg",
    "translation_m",
    "size_m",
    "bow_per_m",
)


def parts_of(texts: Sequence[str], option: str) -> dict[str, dict[str, Any]]:
    """The parts that NAME={...} options state. Raises InputError."""
    out: dict[str, dict[str, Any]] = {}
    for text in texts:
        name, _, rest = text.partition("=")
        value = parse_value(rest, f"{option} {name}") if rest else None
        if not isinstance(value, dict):
            raise InputError(f"{option}: expected NAME={{...}} with the fields of the part, got {text!r}")
        out[name.strip()] = value
    return out


def rig_of_parts(screens: Parts, cameras: Parts, beams: Parts, image_size_px: tuple[int, int]) -> RigFile:
    """The rig of measured parts, each in a form of rig.yaml.

    A camera has `field_of_view_deg` (of the picture's width) or `focal_px` in place of `camera_matrix`, and may have
    `look_at` beside its screen. A beam names the screens that its ends meet: `plus`, beyond the second of two points,
    and `minus`. Raises InputError: a part is wrong or missing; the message names its place in rig.yaml.
    """
    if not (screens and cameras and beams):
        raise InputError("expected at least one --screen, --camera and --beam each, to describe a rig")
    content: dict[str, Any] = {"schema": SCHEMA, "screens": {}, "cameras": {}, "target": {"beams": {}, "spots": {}}}
    for name, part in screens.items():
        _check_keys("screens", name, part, _SCREEN)
        own = {key: part[key] for key in ("size_m", "bow_per_m") if key in part}
        content["screens"][name] = {"world_from_screen": {k: v for k, v in part.items() if k not in own}, **own}
    for name, part in cameras.items():
        _check_keys("cameras", name, part, _CAMERA)
        content["cameras"][name] = _camera(name, dict(part), image_size_px)
    spots = content["target"]["spots"]
    for name, part in beams.items():
        _check_keys("target.beams", name, part, _BEAM)
        content["target"]["beams"][name] = {k: v for k, v in part.items() if k not in ("plus", "minus")}
        for end, key in (("-", "minus"), ("+", "plus")):
            if part.get(key):
                spots[str(len(spots) + 1)] = {"beam": name, "end": end, "screen": part[key]}
    with tempfile.TemporaryDirectory(prefix="beampose-") as folder:
        path = Path(folder) / "rig.yaml"
        write_mapping(content, path)
        try:
            return load_rig_file(path)
        except InputError as error:
            raise InputError(str(error).replace(str(path), "rig")) from None


def _check_keys(place: str, name: str, part: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in part:
        if key not in known:
            raise InputError(f"{place}.{name}: unknown field {key!r}{suggest_name(key, known)}")


def _camera(name: str, part: dict[str, Any], image_size_px: tuple[int, int]) -> dict[str, Any]:
    """A camera's block from what is stated about it."""
    width, height = part.setdefault("image_size_px", list(image_size_px))
    if "look_at" in part:
        part["camera_from_world"] = {"look_at": part.pop("look_at")}
    field, focal = part.pop("field_of_view_deg", None), part.pop("focal_px", None)
    if "camera_matrix" not in part:
        if (field is None) == (focal is None) or not isinstance(focal or field, int | float):
            raise InputError(f"cameras.{name}: expected field_of_view_deg or focal_px, a number; state one of them")
        if field is not None and not 1 <= field <= 170:
            raise InputError(f"cameras.{name}: field_of_view_deg: expected 1 to 170, got {field}")
        focal = focal if field is None else round(width / 2 / float(np.tan(np.radians(field) / 2)), 1)
        part["camera_matrix"] = {"fx": focal, "fy": focal, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    return {"distortion": [], **part}


# Questions -----------------------------------------------------------------------------------------------------------


def ask_parts(ask: Ask, screens: int, cameras: int, beams: int) -> tuple[Parts, Parts, Parts]:
    """The parts of a rig from answers; each question is repeated until its answer can be used."""
    walls: dict[str, dict[str, Any]] = {}
    for k in range(screens):
        name = _name(ask, f"Name of screen {k + 1}", f"screen-{k + 1}", walls)
        corner = [_numbers(ask, f"{name}: a corner of the screen, x y z in m", 3)]
        corner += [
            _numbers(ask, f"{name}: the next corner along its {side}, x y z in m", 3) for side in ("width", "height")
        ]
        walls[name] = {"corner_m": corner}
    eyes: dict[str, dict[str, Any]] = {}
    for k in range(cameras):
        name = _name(
            ask, f"Name of camera {k + 1}", list(walls)[k % len(walls)] if k < len(walls) else f"camera-{k + 1}", eyes
        )
        screen = _one_of(ask, f"{name}: the screen that it films", list(walls), list(walls)[k % len(walls)])
        eye = _numbers(ask, f"{name}: where its lens is, x y z in m", 3)
        target = _numbers(ask, f"{name}: the point in the middle of its picture, x y z in m", 3)
        field = _numbers(ask, f"{name}: angle of view across the width of the picture, deg", 1)[0]
        eyes[name] = {"screen": screen, "look_at": {"eye_m": eye, "target_m": target}, "field_of_view_deg": field}
        if np.hypot(*np.subtract(target, eye)[:2]) < 1e-3 * np.linalg.norm(np.subtract(target, eye)):
            up = _numbers(ask, f"{name}: it looks up or down: the direction that is up in its picture, x y z", 3)
            eyes[name]["look_at"]["up"] = up
    lines: dict[str, dict[str, Any]] = {}
    for k in range(beams):
        name = _name(ask, f"Name of beam {k + 1}", chr(ord("A") + k), lines)
        points = [_numbers(ask, f"{name}: {one} point on the beam, x y z in m of the vehicle", 3)
                  for one in ("a", "another")]  # fmt: skip
        lines[name] = {"points_m": points}
        for key, point, default in (("plus", "second", next(iter(walls))), ("minus", "first", "none")):
            question = f"{name}: the screen that it meets beyond the {point} point (none: no spot)"
            if (screen := _one_of(ask, question, [*walls, "none"], default)) != "none":
                lines[name][key] = screen
    return walls, eyes, lines


def _name(ask: Ask, question: str, default: str, taken: Mapping[str, Any]) -> str:
    while True:
        name = ask(question, default if default not in taken else "").strip()
        if re.fullmatch(r"\w[\w.-]*", name) and name not in taken:
            return name
        question = f"{name!r} cannot be used or is taken; another name"


def _one_of(ask: Ask, question: str, names: Sequence[str], default: str) -> str:
    shown = f"{question}: {', '.join(names)}"
    while (answer := ask(shown, default).strip()) not in names:
        shown = f"{answer!r} is none of {', '.join(names)}; {question}"
    return answer


def _numbers(ask: Ask, question: str, count: int) -> list[float]:
    shown = question
    while True:
        answer = ask(shown, "")
        try:
            values = [float(word) for word in answer.replace(",", " ").split()]
        except ValueError:
            values = []
        if len(values) == count and np.isfinite(values).all():
            return values
        shown = f"expected {count} number{'s' if count > 1 else ''}, got {answer!r}; {question}"


def understood(rig: Rig) -> list[str]:
    """What a rig is, in words and lengths that can be compared with the lab."""
    out = []
    for name, screen in rig.screens.items():
        at, normal = screen.world_from_screen.translation, screen.world_from_screen.rotation[:, 2]
        size = "of unlimited size" if screen.size_m is None else f"{screen.size_m[0]:.3g} x {screen.size_m[1]:.3g} m"
        out.append(f"screen {name}: {size}, middle at {_words(at)} m, normal {_words(normal)}")
    for name, camera in rig.cameras.items():
        world_from_camera = camera.camera_from_world.inverse()
        middle = rig.screens[camera.screen].world_from_screen.translation
        width = np.degrees(2 * np.arctan(camera.image_size_px[0] / 2 / camera.matrix[0, 0]))
        away = float(np.linalg.norm(middle - world_from_camera.translation))
        out.append(f"camera {name}: at {_words(world_from_camera.translation)} m, looks along"
                   f" {_words(world_from_camera.rotation[:, 2])}, {width:.3g} deg wide, {away:.3g} m from the middle of"
                   f" screen {camera.screen}")  # fmt: skip
    directions = {name: beam.direction / np.linalg.norm(beam.direction) for name, beam in rig.beams.items()}
    for name, direction in directions.items():
        ends = ", ".join(f"{s.screen} (spot {n})" for n, s in rig.spots.items() if s.beam == name) or "no screen"
        out.append(f"beam {name}: along {_words(direction)} of the vehicle, to {ends}")
    return out


def _words(v: Any) -> str:
    return "(" + ", ".join(f"{x + 0.0:.3g}" for x in np.round(v, 6).tolist()) + ")"
