"""The mistakes, each as an edit of the files of a correct run folder. Shares no code with the program's own list."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Rows = list[dict[str, str]]
MM = 1000.0


@dataclass
class Files:
    """The content of a run folder, to be edited."""

    rig: dict[str, Any]
    run: dict[str, Any]
    rows: Rows  # of detections.csv

    @property
    def cameras(self) -> list[str]:
        return list(self.rig["cameras"])

    @property
    def pair(self) -> tuple[str, str]:
        """Two cameras, of different screens where there are several."""
        names = self.cameras
        first = self.rig["cameras"][names[0]]["screen"]
        others = [n for n in names[1:] if self.rig["cameras"][n]["screen"] != first]
        return names[0], (others or names[1:])[0]

    def pixels(self, camera: str, change: Callable[[np.ndarray, tuple[int, int]], np.ndarray]) -> None:
        """Change the pixels (n, 2) of a camera; the function also gets width and height. Others are left out."""
        size = tuple(self.rig["cameras"][camera]["image_size_px"])
        mine = [r for r in self.rows if r["camera"] == camera and r["u_px"]]
        uv = change(np.array([[float(r["u_px"]), float(r["v_px"])] for r in mine]), size)
        for row, (u, v) in zip(mine, uv, strict=True):
            row["u_px"], row["v_px"] = f"{u:.9f}", f"{v:.9f}"
        gone = {id(r) for r, p in zip(mine, uv, strict=True) if not np.isfinite(p).all()}
        self.rows = [r for r in self.rows if id(r) not in gone]


def read(folder: Path) -> Files:
    with (folder / "detections.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rig, run = (yaml.safe_load((folder / n).read_text()) for n in ("rig.yaml", "run.yaml"))
    return Files(rig, run, rows)


def write(files: Files, folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "rig.yaml").write_text(yaml.safe_dump(files.rig, sort_keys=False))
    (folder / "run.yaml").write_text(yaml.safe_dump({**files.run, "rig": "rig.yaml"}, sort_keys=False))
    with (folder / "detections.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(files.rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(files.rows)
    return folder


@dataclass(frozen=True)
class Case:
    """One mistake."""

    name: str
    words: str  # a regular expression that a line which names it must match
    make: Callable[[Files], None]


def _exchange_cameras(f: Files) -> None:
    a, b = f.pair
    other = {a: b, b: a}
    for row in f.rows:
        row["camera"] = other.get(row["camera"], row["camera"])


def _picture(change: Callable[[np.ndarray, tuple[int, int]], np.ndarray], which: int = 0) -> Callable[[Files], None]:
    return lambda f: f.pixels(f.pair[which], change)


def _scaled(factor: float) -> Callable[[np.ndarray, tuple[int, int]], np.ndarray]:
    return lambda uv, size: (uv + 0.5) * factor - 0.5


def _cropped(left: float, top: float) -> Callable[[np.ndarray, tuple[int, int]], np.ndarray]:
    """The half of the width and height whose corner is at this share of both."""

    def change(uv: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        corner = np.array([int(size[0] * left), int(size[1] * top)])
        moved = uv - corner
        inside = np.all((moved >= -0.5) & (moved < np.array(size) // 2 - 0.5), axis=1)
        return np.where(inside[:, None], moved, np.nan)

    return change


def _in_all(change: Callable[[np.ndarray, tuple[int, int]], np.ndarray]) -> Callable[[Files], None]:
    def make(f: Files) -> None:
        for name in f.cameras:
            f.pixels(name, change)

    return make


def _numbered_later(which: int) -> Callable[[Files], None]:
    def make(f: Files) -> None:
        for row in f.rows:
            if row["camera"] == f.pair[which]:
                row["frame"] = str(int(row["frame"]) + 1)

    return make


def _poses(
    change: Callable[[dict[str, Any]], None], cameras: bool, screens: bool, every: bool
) -> Callable[[Files], None]:
    def make(f: Files) -> None:
        for name, c in f.rig["cameras"].items():
            if cameras and (every or name == f.pair[0]):
                change(c["camera_from_world"])
        for s in f.rig["screens"].values():
            if screens:
                change(s["world_from_screen"])

    return make


def _invert(pose: dict[str, Any]) -> None:
    w, *v = pose["quaternion_wxyz"]
    x, y, z = v
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose["quaternion_wxyz"] = [w, -x, -y, -z]
    pose["translation_m"] = (-R.T @ np.array(pose["translation_m"])).tolist()


def _xyzw(pose: dict[str, Any]) -> None:
    w, x, y, z = pose["quaternion_wxyz"]
    pose["quaternion_wxyz"] = [x, y, z, w]


def _millimetres(pose: dict[str, Any]) -> None:
    pose["translation_m"] = [MM * v for v in pose["translation_m"]]


def turned_aside(pose: dict[str, Any]) -> None:
    """The camera's frame turned by 35 deg about its own y axis: a pose of another day."""
    w, x, y, z = pose["quaternion_wxyz"]
    c, s = np.cos(np.deg2rad(17.5)), np.sin(np.deg2rad(17.5))
    pose["quaternion_wxyz"] = [float(q) for q in (c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x)]


def _rig_in_millimetres(f: Files) -> None:
    _poses(_millimetres, True, True, True)(f)
    for beam in f.rig["target"]["beams"].values():
        beam["point_m"] = [MM * v for v in beam["point_m"]]


def _beams_exchanged(f: Files) -> None:
    beams = f.rig["target"]["beams"]
    a, b = list(beams)[:2]
    beams[a], beams[b] = beams[b], beams[a]


def _spots_exchanged(f: Files) -> None:
    """The first two spots of one screen."""
    spots = f.rig["target"]["spots"]
    names = list(spots)
    a = names[0]
    b = next((n for n in names[1:] if spots[n]["screen"] == spots[a]["screen"]), names[1])
    spots[a], spots[b] = spots[b], spots[a]


def _ends_exchanged(f: Files) -> None:
    """Both ends of a beam, or of the first beam that has two spots."""
    spots = f.rig["target"]["spots"]
    beam = spots[next(iter(spots))]["beam"]
    for spot in spots.values():
        if spot["beam"] == beam:
            spot["end"] = "-" if spot["end"] == "+" else "+"


def _lens_of_other(f: Files) -> None:
    a, b = (f.rig["cameras"][n] for n in f.pair)
    a["camera_matrix"], a["distortion"] = dict(b["camera_matrix"]), list(b.get("distortion", []))


def _exchanged(*keys: str) -> Callable[[Files], None]:
    def make(f: Files) -> None:
        a, b = (f.rig["cameras"][n] for n in f.pair)
        for key in keys:
            a[key], b[key] = b[key], a[key]

    return make


def _focal_in_millimetres(f: Files) -> None:
    matrix = f.rig["cameras"][f.pair[0]]["camera_matrix"]
    matrix["fx"], matrix["fy"] = matrix["fx"] * 0.0048, matrix["fy"] * 0.0048


def _prior_in_millimetres(f: Files) -> None:
    if "prior" in f.run:
        p = f.run["prior"]
        p["position_m"], p["within_m"] = [MM * v for v in p["position_m"]], MM * p["within_m"]


def _prior_in_radians(f: Files) -> None:
    if "prior" in f.run:
        p = f.run["prior"]
        p["yaw_pitch_roll_deg"] = np.deg2rad(p["yaw_pitch_roll_deg"]).tolist()
        p["within_deg"] = float(np.deg2rad(p["within_deg"]))


CASES = (
    Case("two cameras' names exchanged", "exchanged", _exchange_cameras),
    Case("mirrored left-right", "mirrored left to right", _picture(lambda uv, s: [s[0] - 1, 0] + uv * [-1, 1])),
    Case("mirrored up-down", "mirrored upside down", _picture(lambda uv, s: [0, s[1] - 1] + uv * [1, -1], 1)),
    Case(
        "mirrored left-right, all cameras",
        "all cameras are mirrored left",
        _in_all(lambda uv, s: [s[0] - 1, 0] + uv * [-1, 1]),
    ),
    Case("turned by 180 deg", "turned by 180", _picture(lambda uv, s: [s[0] - 1, s[1] - 1] - uv)),
    Case("turned by 90 deg", "turned by 90", _picture(lambda uv, s: [s[1] - 1, 0] + uv[:, ::-1] * [-1, 1], 1)),
    Case("turned by -90 deg", "turned by 90", _picture(lambda uv, s: [0, s[0] - 1] + uv[:, ::-1] * [1, -1])),
    Case("transposed", "transposed", _picture(lambda uv, s: uv[:, ::-1])),
    Case("half resolution, one camera", "half the resolution", _picture(_scaled(0.5), 1)),
    Case("half resolution, all cameras", "half the resolution", _in_all(_scaled(0.5))),
    Case("cropped to the middle half", "cropped", _picture(_cropped(0.25, 0.25))),
    Case("cropped elsewhere", "cropped", _picture(_cropped(0.3, 0.15), 1)),
    Case("numbered from 1, one camera", "numbers one too|numbered (wrongly|from)", _numbered_later(0)),
    Case("numbered from 1, another camera", "numbers one too|numbered (wrongly|from)", _numbered_later(1)),
    Case("camera_from_world inverted, one", "inverse", _poses(_invert, True, False, False)),
    Case("camera_from_world inverted, all", "inverse", _poses(_invert, True, False, True)),
    Case("world_from_screen inverted, all", "inverse", _poses(_invert, False, True, True)),
    Case("xyzw quaternion, one camera", "x, y, z, w", _poses(_xyzw, True, False, False)),
    Case("xyzw quaternions, all", "x, y, z, w", _poses(_xyzw, True, True, True)),
    Case("two beams exchanged", "names of beams|beams .* are exchanged", _beams_exchanged),
    Case("two spots exchanged", "two spots of a screen", _spots_exchanged),
    Case("the ends of a beam exchanged", "ends? .*(exchanged|right)", _ends_exchanged),
    Case("lens of another camera", "same lens|has a wrong lens", _lens_of_other),
    Case("two lenses exchanged", "each other's lens|wrong lens", _exchanged("camera_matrix", "distortion")),
    Case("two cameras' places exchanged", "each other's (place|lens)", _exchanged("camera_from_world", "screen")),
    Case("millimetres, one camera", "millimetres", _poses(_millimetres, True, False, False)),
    Case("millimetres, all lengths", "millimetres", _rig_in_millimetres),
    Case("fx in millimetres", "millimetres", _focal_in_millimetres),
    Case("prior in millimetres", "millimetres", _prior_in_millimetres),
    Case("prior in radians", "radians", _prior_in_radians),
    Case(
        "camera pose of another day",
        "(none of its|camera_from_world|camera .*moved)",
        _poses(turned_aside, True, False, False),
    ),
)
