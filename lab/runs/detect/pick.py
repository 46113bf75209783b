"""`beampose pick`: photographs with their detected points as one page, on which the points get their names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lab.errors import InputError
from lab.files.project.point_files import POINTS
from lab.files.rig.rig_file import load_rig
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.csv_text import read_table
from lab.files.text.error_text import printable_line
from lab.findings.finding import Done
from lab.number_format import format_count
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.pictures.source import open_inputs, pictures
from lab.progress import Progress
from lab.report.page import as_script, environment
from lab.report.plot.svg import grey_limits, image_uri
from lab.runs.detect.detect import DetectOptions
from lab.runs.detect.picture_series import PictureSeries

MOST_PICTURES = 40  # of one page, which holds them all
_MOST_POINTS = 500  # in a picture: a search with so many found more than marks
_SPOTS = ("frame", "camera", "spot", "u_px", "v_px")


@dataclass(frozen=True, slots=True)
class PickOptions:
    """What the page offers beside the pictures."""

    names: Path | None = None  # a survey with a column `point`, or a rig.yaml: the names to choose from
    table: Path | None = None  # a points.csv or spots.csv to go on with
    darker: bool = False  # search marks that are darker than what is around them
    overrides: Mapping[str, Any] = field(default_factory=dict)  # of the detection, such as detect.threshold_sigma


def write_pick_page(
    given: Sequence[str], out: Path, options: PickOptions = PickOptions(), progress: Progress | None = None
) -> Done[Path]:
    """Write the page of some photographs. given: paths, each with the camera's name before it: `left=photo.png`.

    Without a name the camera is called as the folder of several pictures, or as the file of one. Raises InputError: a
    picture, a table or an option cannot be used.
    """
    names, table = _names(options.names), _table(options.table)
    shown, unreadable = _shown(given, options, progress)
    if not shown:
        raise InputError(f"{given[0]}: expected pictures, got none that can be read: {unreadable[0]}")
    data: dict[str, Any] = {"pictures": shown, "names": names, "table": table}
    data["kind"] = "spot" if "*" not in names["point"] and names["spot"] else "point"
    data["id"] = hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]  # of what the browser keeps for this page
    title = shown[0]["camera"] if len({p["camera"] for p in shown}) == 1 else f"{len(shown)} pictures"
    page = environment().get_template("pick.html.j2")
    atomic_write_text(page.render(title=title, pictures=len(shown), data=as_script(data)), out)
    points = sum(len(p["points"]) for p in shown)
    line = f"{points} points in {format_count(len(shown), 'picture')} -> {out}"
    return Done(out, (f"{line}; open it in a browser",), tuple(unreadable))


def _shown(
    given: Sequence[str], options: PickOptions, progress: Progress | None
) -> tuple[list[dict[str, Any]], list[str]]:
    """The pictures for the page, and what could not be read."""
    parameters = DetectOptions(overrides=options.overrides).parameters()
    out: list[dict[str, Any]] = []
    unreadable = []
    for camera, paths in _by_camera(given):
        source = open_inputs(paths, camera)
        series = PictureSeries(source.camera, str(paths[0]), parameters)
        if source.count is None or len(out) + source.count > MOST_PICTURES:
            raise InputError(
                f"{paths[0]}: expected at most {MOST_PICTURES} pictures, got more; name those to pick from"
            )
        for frame, picture in pictures(source):
            if isinstance(picture, MissingPicture):
                unreadable.append(f"{paths[0]}: frame {frame}: {picture.reason}")
                continue
            picture = np.array(picture)
            out.append(_picture(source.camera, frame, picture, series, options.darker))
            if progress is not None:
                progress(len(out), None)
    return out, unreadable


def _picture(camera: str, frame: int, picture: GreyPicture, series: PictureSeries, darker: bool) -> dict[str, Any]:
    """One picture with its points, the most similar to a spot of light first."""
    found, likeness = series.search(frame, np.iinfo(picture.dtype).max - picture if darker else picture)
    keep = np.argsort(-likeness, kind="stable")[:_MOST_POINTS]
    rows = np.column_stack([found.uv_px, np.sqrt(found.variance_px2), found.peak])[keep]
    wide = picture.dtype == np.uint16
    # 16 bits as red and green of a picture, which a browser gives back unchanged.
    split = np.stack([np.zeros_like(picture), picture & 255, picture >> 8], axis=-1) if wide else picture
    low, high = grey_limits(picture)
    top = int(picture.max()) if wide else 255
    return {
        "label": f"{camera} {frame}",
        "camera": camera,
        "frame": frame,
        "w": picture.shape[1],
        "h": picture.shape[0],
        "bits": 16 if wide else 8,
        "top": max(top, 1),
        "black": int(min(low, top)),
        "white": int(min(np.ceil(high), top)),
        "points": [[round(u, 4), round(v, 4), float(f"{s:.3g}"), round(p, 1)] for u, v, s, p in rows.tolist()],
        "src": image_uri(split.astype(np.uint8), "png"),
    }


def _by_camera(given: Sequence[str]) -> list[tuple[str | None, list[Path]]]:
    """Paths of one camera: those with its name, or the files of one folder."""
    out: dict[tuple[str | None, Path | None], list[Path]] = {}
    for text in given:
        name, equals, rest = text.partition("=")
        camera, path = (name.strip(), Path(rest)) if equals and not Path(text).exists() else (None, Path(text))
        of = None if camera is not None else path if path.is_dir() else path.parent
        out.setdefault((camera, of), []).append(path)
    return [(camera, paths) for (camera, _), paths in out.items()]


def _names(path: Path | None) -> dict[str, dict[str, list[str]]]:
    """Names to choose from, by camera ("*": all), for control points and for spots."""
    out: dict[str, dict[str, list[str]]] = {"point": {}, "spot": {}}
    if path is None:
        return out
    if path.suffix.lower() in (".yaml", ".yml"):
        for camera, spot in load_rig(path).views():
            out["spot"].setdefault(camera, []).append(spot)
        return out
    table = read_table(path, ("point",))
    table.require_rows(("point",))
    out["point"]["*"] = list(dict.fromkeys(table.names("point")))
    return out


def _table(path: Path | None) -> dict[str, str] | None:
    """The text of a table with the columns of the contract; the page reads it."""
    if path is None:
        return None
    header = read_table(path, ("camera", "u_px", "v_px"), ("frame", "point", "spot")).header
    if not ({*POINTS} <= {*header} or {*_SPOTS} <= {*header}):
        wanted = f"{','.join(POINTS)} or {','.join(_SPOTS)}"
        raise InputError(f"{path}: expected columns {wanted}, got {printable_line(','.join(header))}")
    return {"name": path.name, "text": path.read_text("utf-8-sig")}
