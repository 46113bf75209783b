"""`beampose init`: a plausible rig from a few numbers, or one's own from its measured parts; files of a first run."""

from __future__ import annotations

import dataclasses
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose, look_at
from geometry.pose_solver.visibility import assumed_range
from geometry.rig import Beam, Rig, Screen, Spot
from lab.errors import InputError
from lab.files.rig.rig_file import SCHEMA, RigFile, load_rig, load_rig_file, save_rig
from lab.files.run.run_file import load_run, save_run
from lab.files.text.atomic_write import atomic_folder, atomic_write_text
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import parse_value, with_comments, write_mapping
from lab.findings.finding import Done
from lab.number_format import format_count
from lab.results.view.page import read_content, view_of, write_page
from lab.simulate.scenarios import SCENARIOS
from lab.simulate.write import simulate

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
        content["cameras"][name] = _camera_block(name, dict(part), image_size_px)
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


def _camera_block(name: str, part: dict[str, Any], image_size_px: tuple[int, int]) -> dict[str, Any]:
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
        shown = f"expected {format_count(count, 'number')}, got {answer!r}; {question}"


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


# A plausible rig from a few numbers; the lab replaces its poses and directions by measurements.

# Name of a screen, where it stands as seen from the vehicle, and the rotation world_from_screen.
_SCREENS = (
    ("left", (-1.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    ("right", (1.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    ("front", (0.0, 1.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))),
    ("back", (0.0, -1.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))),
)
_HALF_FAN_DEG = 20.0  # between the middle and the outermost beam of a fan
_UNEQUAL = 1.25  # ratio of neighbouring angles: beams at unequal angles can be distinguished
_TILT = 0.08  # tangent by which every second beam leaves the plane of its fan: coplanar beams determine less
_VIEW_M = 2.6  # width of the picture at a screen 2.5 m away


@dataclass(frozen=True, slots=True)
class Layout:
    """What the user states about the rig."""

    cameras: int = 2
    screens: int = 2
    beams: int = 3
    distance_m: float = 2.5  # from the vehicle to each screen
    image_size_px: tuple[int, int] = (1280, 1024)  # width, height


def rig_of(layout: Layout) -> Rig:
    """The rig of a layout. Raises InputError: it cannot measure a pose."""
    _check(layout)
    used = _SCREENS[: layout.screens] if layout.screens > 1 else _SCREENS[1:2]
    d = layout.distance_m
    screens = {
        name: Screen(name, Pose(np.array(axes), d * np.array(normal)), (1.6 * d, 1.2 * d))
        for name, normal, axes in used
    }
    cameras: dict[str, Camera] = {}
    for i in range(layout.cameras):
        name, normal, _ = used[i % len(used)]
        number, several = i // len(used), layout.cameras > len(used)
        own = f"{name}-{number + 1}" if several else name
        cameras[own] = _camera(own, name, np.array(normal), number, layout)
    beams, spots = _beams_and_spots(layout.beams, [name for name, _, _ in used])
    return Rig(screens, cameras, beams, spots)


def _check(layout: Layout) -> None:
    if layout.cameras < layout.screens:
        raise InputError(
            f"cameras: expected at least one per screen ({layout.screens}), got {layout.cameras}; add cameras, or take"
            " fewer screens"
        )
    least = 3 if layout.screens == 1 else 4 if layout.screens > 2 else 2
    if layout.beams < least:
        raise InputError(
            f"beams: expected at least {least} for {format_count(layout.screens, 'screen')}, got"
            f" {layout.beams}; fewer do not determine a pose"
        )


def _camera(name: str, screen: str, normal: Array, number: int, layout: Layout) -> Camera:
    """A camera on the far side of the vehicle and above it, beside it by turns on either side."""
    d = layout.distance_m
    aside = np.array([-normal[1], normal[0], 0.0]) * (0.24 + 0.2 * (number // 2)) * (-1) ** number
    position = d * (-0.64 * normal + aside + np.array([0.0, 0.0, 0.6]))
    width, height = layout.image_size_px
    target = d * normal
    focal = round(width * float(np.linalg.norm(target - position)) / (_VIEW_M * d / 2.5 * 1.6), 1)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(name, screen, (width, height), matrix, (0.0,) * 5, look_at(position, target))


def _fan(count: int, axis: Array) -> list[Array]:
    """Directions of `count` beams about a horizontal axis, at unequal angles."""
    steps = _UNEQUAL ** np.arange(max(count - 1, 0))
    places = np.concatenate([[0.0], np.cumsum(steps)]) if count > 1 else np.zeros(1)
    angles = np.deg2rad(_HALF_FAN_DEG) * (2 * places / places[-1] - 1) if count > 1 else places
    across = np.array([-axis[1], axis[0], 0.0])
    out = []
    for i, angle in enumerate(angles):
        d = np.cos(angle) * axis + np.sin(angle) * across + np.array([0.0, 0.0, _TILT * (-1) ** i])
        out.append(np.round(d / np.linalg.norm(d), 6))
    return out


def _beams_and_spots(count: int, screens: list[str]) -> tuple[dict[str, Beam], dict[str, Spot]]:
    along_y = count // 2 if len(screens) > 2 else 0
    directions = [(d, "x") for d in _fan(count - along_y, np.array([1.0, 0.0, 0.0]))]
    directions += [(d, "y") for d in _fan(along_y, np.array([0.0, 1.0, 0.0]))] if along_y else []
    beams: dict[str, Beam] = {}
    spots: dict[str, Spot] = {}
    ends = {"x": (("left", -1), ("right", 1)), "y": (("back", -1), ("front", 1))}
    for i, (direction, along) in enumerate(directions):
        name = chr(ord("A") + i)
        beams[name] = Beam(name, direction, np.zeros(3))
        for screen, sign in ends[along]:
            if screen in screens:
                number = str(len(spots) + 1)
                spots[number] = Spot(number, name, sign, screen)
    return beams, spots


# The files of `beampose init`: rig.yaml and run.yaml with comments, and simulated points to try them with.


EXAMPLE = "example-points.csv"
FRAMES = 100  # of the simulated points

# A comment before the first line that has this key.
_RIG_COMMENTS = {
    "screens": "Screens. The world frame is yours to choose: right-handed, metres. Poses are a_from_b:\n# coordinates"
    " in b to coordinates in a.",
    "screens.*.world_from_screen": "Origin and x, y axes of the screen lie in its surface. Measured by"
    " `beampose calibrate screen`.",
    "screens.*.size_m": "Extent along x and y, centred on the origin; leave it out for an unlimited screen.",
    "cameras": "Cameras, each with the screen that it observes.",
    "cameras.*.image_size_px": "Width, height, in pixels.",
    "cameras.*.camera_matrix": "Lens, in pixels; (0, 0) is the centre of the top-left pixel. Measured by"
    " `beampose calibrate camera`.",
    "cameras.*.camera_from_world": "Pose: x right, y down, z forward. Measured by `beampose calibrate screen`.",
    "target": "Lasers of the vehicle, in its own (body) frame. Measured by `beampose calibrate beams`.",
    "target.beams": "A beam is a line: a direction and a point on it.",
    "target.spots": "A spot is where one end of a beam (+ along its direction, - against it) meets a screen.",
}
_RUN_COMMENTS = {
    "name": "Shown in reports.",
    "rig": "Path of the rig file; paths start at the folder of this file.",
    "frame_rate_hz": "Pictures per second. For an uneven rate add `timestamps: times.csv` with columns frame,t_s.",
    "cameras": f"Simulated points, to try `beampose run` at once. For your recording replace `detections: {EXAMPLE}`"
    " by\n# `frames: frames/NAME` (a folder of pictures, the number in a name is the frame) or `frames: NAME.avi` (a"
    " video).",
    "prior": "Where the vehicle is in the first frame, and how far it may be from there. Leave it out if unknown.",
    "notes": "Optional, shown in the report.",
}
_OWN = "As it was stated; the comments have the numbers that were measured."
_START = "A start, not a measurement: replace the numbers by those of your lab."
_OPTIONAL_RIG = (
    "# Optional, in each camera: noise: {gain_e_per_dn: 38.0, read_noise_e: 6.0, black_dn: 4.0}; estimated if absent.\n"
    "# Optional: calibration: {date: 2026-03-14, verdict: PASS, valid_until: 2026-09-14}\n"
)
_OPTIONAL_RUN = (
    "# Optional: exposure_s: 0.0005; recorded: 2026-03-14\n"
    "# Optional: tracker: {method: rigid}, and any parameter that summary.json lists under parameters.tracker.\n"
)


def start(folder: Path, layout: Layout | RigFile, frame_rate_hz: float) -> Done[Path]:
    """Write rig.yaml, rig.html with its drawing, run.yaml and simulated points into a new or empty folder.

    layout: of a typical rig, or a rig of one's own. Raises InputError: the folder holds files, or the rig cannot
    measure a pose.
    """
    folder = Path(folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: expected a new or empty folder, found files in it; name another one")
    own = layout if isinstance(layout, RigFile) else None
    rig = layout.rig if isinstance(layout, RigFile) else rig_of(layout)
    centre = assumed_range(rig).centre
    with atomic_folder(folder, may_replace=lambda _: False) as work:
        rig_path = work / "rig.yaml"
        save_rig(own or rig, rig_path)
        head = _OWN if own is not None else _START
        _comment(rig_path, _RIG_COMMENTS, f"{head}\n# Check it with `beampose check rig.yaml`.", _OPTIONAL_RIG)
        content = read_content(rig_path, None)
        write_page(view_of(content, content.at_frame(None)), content.at_frame(None), work / "rig.html")
        _points(work, frame_rate_hz)
        run = {
            "name": "first-run",
            "rig": "rig.yaml",
            "frame_rate_hz": float(frame_rate_hz),
            "cameras": {name: {"detections": EXAMPLE} for name in rig.cameras},
            "prior": {
                "position_m": centre.translation.round(4).tolist(),
                "yaw_pitch_roll_deg": np.rad2deg(centre.ypr).round(3).tolist(),
                "within_m": 0.5 if isinstance(layout, RigFile) else min(0.5, 0.2 * layout.distance_m),
                "within_deg": 25.0,
            },
            "notes": "Simulated points of an example rig.",
        }
        _comment(save_run(run, work), _RUN_COMMENTS, "One recording.", _OPTIONAL_RUN)
        load_rig(rig_path)
        load_run(work)
    shown = [] if own is None else understood(rig)
    following = f"Next: beampose check {folder}; beampose run {folder} --out {folder / 'results'}"
    files = (f"rig: {folder / 'rig.yaml'}", f"drawing: {folder / 'rig.html'}", f"run: {folder / 'run.yaml'}")
    return Done(folder, (*shown, *files, following))


def _points(work: Path, frame_rate_hz: float) -> None:
    """Simulated points of the rig in `work`, a slow motion."""
    scenario = dataclasses.replace(
        SCENARIOS["clean"],
        motion=SCENARIOS["small-motion"].motion,
        always_in_view=(),
        leaves_and_returns=(),
        frame_rate_hz=frame_rate_hz,
    )
    with tempfile.TemporaryDirectory(prefix="beampose-") as name:
        made = simulate(scenario, Path(name) / "run", frames=FRAMES, points=True, clutter=0.0, rig=work / "rig.yaml")
        shutil.copyfile(made / "detections.csv", work / EXAMPLE)


def _comment(path: Path, comments: Mapping[str, str], head: str, tail: str) -> None:
    """Add comments to a YAML file: by the place of their key, before the file, and behind it."""
    atomic_write_text("\n".join([f"# {head}", with_comments(path.read_text("utf-8"), comments) + tail]), path)
