"""Detects the spots of a folder of pictures, a picture or a video; writes table, contact sheet, page and summary.

`beampose pick`: photographs with their detected points as one page, on which the points get their names.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lab.errors import InputError
from lab.files.project.point_files import POINTS
from lab.files.rig.rig_file import load_rig
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder, atomic_write_text, earlier_results
from lab.files.text.csv_text import csv_word, read_table
from lab.files.text.dataclass_fields import with_overrides
from lab.files.text.error_text import printable_line
from lab.files.text.json_text import write_json
from lab.findings.finding import Done
from lab.number_format import format_count, format_some
from lab.packages import versions
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.pictures.source import PictureSource, Video, open_inputs, pictures
from lab.progress import Progress
from lab.report.page import as_script, environment
from lab.report.plot.svg import grey_limits, image_uri
from lab.runs.detect.detect_page import ContactSheet, write_detect_page
from lab.runs.detect.picture_series import PictureSeries
from lab.runs.frames.sensor_noise import noise_pictures
from lab.runs.processed import quantiles
from lab.runs.tables import detection_rows
from tracking.detection.detect import limit_that_admits
from tracking.parameters import DetectParameters, TrackerParameters

SCHEMA = "beampose/detect/1"
SHEET = "contact-sheet.png"


@dataclass(frozen=True, slots=True)
class DetectOptions:
    """Which pictures to search, and with which parameters."""

    camera: str | None = None  # name in the table; None: the folder's or file's
    every: int = 1  # search every n-th picture
    limit: int | None = None  # largest number of pictures
    overrides: Mapping[str, Any] = field(default_factory=dict)  # of TrackerParameters, such as detect.threshold_sigma

    def parameters(self) -> DetectParameters:
        """The parameters of the detection. Raises InputError: an override is not a parameter of the detection."""
        others = [name for name in self.overrides if not name.startswith("detect.")]
        if others:
            raise InputError(
                f"--set: {others[0]}: expected a parameter of detection, such as detect.threshold_sigma; this command"
                " does not track"
            )
        return with_overrides(TrackerParameters(), self.overrides).detect


def detect_pictures(
    given: list[Path], out: Path, options: DetectOptions = DetectOptions(), progress: Progress | None = None
) -> Done[PictureSeries]:
    """Search pictures for spots, and write detections.csv, a contact sheet, report.html and summary.json into `out`.

    Positions are centroids of the light: without a rig they cannot be corrected to the beams' axes. Raises InputError:
    the pictures or an option cannot be used, or no picture can be read; `out` is then unchanged.
    """
    started = time.perf_counter()
    parameters = options.parameters()
    inputs = open_inputs(given, options.camera)
    source = str(inputs.path if isinstance(inputs, Video) else given[0] if len(given) == 1 else f"{len(given)} files")
    series = PictureSeries(inputs.camera, source, parameters, notes=list(inputs.notes))
    with atomic_folder(out, earlier_results(SCHEMA)) as folder:
        series.estimate_noise(noise_pictures(inputs))
        sheet = ContactSheet(_total(inputs, options))
        _search_all(inputs, series, sheet, folder / "detections.csv", options, progress)
        _add_notes(series)
        sheet.write(folder / SHEET)
        write_json(_summary(series, options, time.perf_counter() - started), folder / "summary.json")
        write_detect_page(series, sheet, folder)
    bad = sum(map(len, series.unreadable.values()))
    unread = f" ({bad} more cannot be read)" if bad else ""
    each = series.spots.total / max(series.pictures, 1)
    found = f"{series.camera}: {series.spots.total} spots in {_counted(series.pictures)}{unread}, {each:.3g} each"
    return Done(series, (f"{found} -> {out}",))


def _search_all(
    inputs: PictureSource,
    series: PictureSeries,
    sheet: ContactSheet,
    table: Path,
    options: DetectOptions,
    progress: Progress | None,
) -> None:
    total, camera = _total(inputs, options), csv_word(series.camera)
    with table.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join([*columns.DETECTIONS, columns.LIKENESS]) + "\n")
        chosen = islice(pictures(inputs, every=options.every), options.limit)
        for done, (frame, picture) in enumerate(chosen, start=1):
            if isinstance(picture, MissingPicture):
                series.unreadable.setdefault(picture.reason, []).append(frame)
            else:
                found, likeness = series.search(frame, picture)
                rows = detection_rows([(frame, camera, found)])
                file.writelines(f"{row[:-1]},{like:.3f}\n" for row, like in zip(rows, likeness, strict=True))
                sheet.offer(done - 1, frame, picture, found, likeness)
            if progress is not None:
                progress(done, total)


def _total(inputs: PictureSource, options: DetectOptions) -> int | None:
    count = None if inputs.count is None else -(-inputs.count // options.every)
    return count if count is None or options.limit is None else min(count, options.limit)


def _add_notes(series: PictureSeries) -> None:
    """Add notes on unreadable pictures and mixed kinds. Raises InputError if no picture could be read."""
    if not series.pictures:
        most_frequent = max(series.unreadable, key=lambda r: len(series.unreadable[r]), default="")
        why = f": {most_frequent}" if most_frequent else ""
        raise InputError(f"{series.source}: expected pictures, got none that can be read{why}")
    for reason, frames in series.unreadable.items():
        series.notes.append(f"{_counted(len(frames))} {reason} (frame {format_some(frames)})")
    if len(series.groups) > 1:
        most = sorted(series.groups.values(), key=lambda g: -g.pictures)
        kinds = "; ".join(f"{_counted(g.pictures)} of {g.text()}" for g in most[:6])
        more = f"; and {len(most) - 6} further kinds" if len(most) > 6 else ""
        series.notes.append(f"pictures of different sizes or depths, each kind with its own noise model: {kinds}{more}")
    if series.overlooked:
        widest = max(series.overlooked, key=lambda light: light.sigma_px)
        series.notes.append(
            f"{_counted(len(series.overlooked))} with a bright light wider than detect.max_sigma_px ="
            f" {series.parameters.max_sigma_px:g}, which is not reported: the widest has a sigma of"
            f" {widest.sigma_px:.0f} px, in frame {widest.frame} at ({widest.uv_px[0]:.0f}, {widest.uv_px[1]:.0f}) px;"
            f" --set detect.max_sigma_px={limit_that_admits(widest.sigma_px)} reports it"
        )
    series.notes += list(dict.fromkeys(note for g in series.groups.values() for note in g.noise.notes))


def _summary(series: PictureSeries, options: DetectOptions, wall_s: float) -> dict[str, Any]:
    table = series.spots.table()
    counts = np.array([n for _, n in series.spots.per_frame])

    return {
        "schema": SCHEMA,
        "camera": series.camera,
        "source": series.source,
        "counts": {
            "pictures": series.pictures,
            "unreadable": {reason: len(frames) for reason, frames in series.unreadable.items()},
            "spots": series.spots.total,
            "spots_per_picture": quantiles(counts),
            "pictures_without_spots": int(np.count_nonzero(counts == 0)),
        },
        "sizes_px": {"major": quantiles(table[:, 3]), "minor": quantiles(table[:, 4])},
        "snr": quantiles(table[:, 5]),
        "noise": [
            {"size_px": g.size_px, "bits": g.bits, "pictures": g.pictures, **g.noise.as_mapping()}
            for g in series.groups.values()
        ],
        "parameters": {"detect": asdict(series.parameters), "every": options.every, "limit": options.limit},
        "timings": {"wall_s": wall_s},
        "versions": versions(),
        "notes": series.notes,
    }


def _counted(pictures: int) -> str:
    return format_count(pictures, "picture")


# `beampose pick`: photographs with their detected points as one page, on which the points get their names.


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
