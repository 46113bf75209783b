"""Makes the gallery, a page for each sight of sights.toml: `python -m docs.website.gallery [NAME ...]`.

A sight is a recording with one mistake. Its commands are executed when the page is made; the page shows their output
and the findings of the results. Pages are kept in build/gallery until the program or the table changes.

    python -m docs.website.gallery record moved-camera FOLDER

writes the recording of a sight, to try the commands on.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from docs.website.recordings import MISTAKES, photograph_board, record
from docs.website.text import cell, table
from lab.findings.finding import entries, sentence
from lab.runs.verdict.score import measured_errors, normalised_squares

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("sights.toml")
BUILD = ROOT / "build" / "gallery"
SOURCES = ("geometry", "tracking", "calibration", "lab", "docs/website")
WORKERS = 2
_PANEL_PX = (400, 320)  # width and height of one of the two pictures
_GAP_PX = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """One page of the gallery."""

    name: str  # of the page
    title: str
    see: str  # Markdown: what a person sees in the pictures
    do: str  # Markdown: what to do
    recording: Mapping[str, Any] = field(default_factory=dict)  # as recordings.record takes it
    mistake: str = ""  # a name of MISTAKES; empty: the recording itself is the sight
    board: float | None = None  # instead of a recording: photographs of a board with this bow, mm
    commands: tuple[str, ...]  # RUN stands for the folder of the recording; a leading "!" marks one that must fail
    named: tuple[str, ...]  # codes that the findings of the last command must have; none: it must be a PASS
    picture: Mapping[str, Any] = field(default_factory=dict)  # frame, camera, spot or nothing (whole), half_px, levels


@dataclass(frozen=True, slots=True)
class Printed:
    """A command that was executed."""

    command: str
    status: int
    output: str


class SightError(RuntimeError):
    """The program does not report a sight as its page states."""


def sights() -> tuple[Sight, ...]:
    """The table, in its order."""
    rows = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return tuple(
        Sight(**{"name": name, **{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()}})
        for name, row in rows.items()
    )


def names() -> tuple[str, ...]:
    """The names of all pages, that of the overview first."""
    return ("index", *(s.name for s in sights()))


def fingerprint() -> str:
    """Changes with every source of the program, of this folder, and with the table."""
    digest = hashlib.sha256(TABLE.read_bytes())
    for top in SOURCES:
        for path in sorted((ROOT / top).rglob("*")):
            if path.suffix in (".py", ".toml", ".j2", ".css", ".js") and path.is_file():
                digest.update(path.read_bytes())
    return digest.hexdigest()


def make(sight: Sight, work: Path, out: Path) -> str:
    """The page of a sight as Markdown, made in the folder `work`; its picture goes into `out`.

    Raises:
        SightError: the findings are not those that the table states.
    """
    folder = write_recording(sight, work / sight.name)
    printed = [execute(command, sight.name, work) for command in sight.commands]
    evidence = _evidence(work / "results")
    found = {str(e["code"]) for e in evidence}
    said = "\n".join(p.output for p in printed)
    missing = [code for code in sight.named if code not in found and f"({code})" not in said]
    if missing or (not sight.named and found - {""}):
        raise SightError(f"{sight.name}: expected {list(sight.named)}, found {sorted(found)}; printed:\n{said}")
    usual = work / "beside" / "usual"
    if sight.board is None:
        record(usual, _usual(sight))
        (usual / "truth").rename(usual.with_name("truth"))
    cost = () if sight.named else _cost(work, usual)
    picture = draw(sight, folder, usual)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / f"{sight.name}.webp"), picture, [cv2.IMWRITE_WEBP_QUALITY, 85])
    return page(sight, printed, evidence, cost)


def write_recording(sight: Sight, folder: Path) -> Path:
    """The recording of a sight with its mistake, without its truth, which a lab does not have."""
    if sight.board is not None:
        return photograph_board(folder, sight.board)
    record(folder, sight.recording)
    (folder / "truth").rename(folder.with_name("truth"))
    if sight.mistake:
        MISTAKES[sight.mistake](folder)
    return folder


def execute(command: str, run: str, folder: Path) -> Printed:
    """A command of this checkout in a folder, with what it prints."""
    start = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cli import main; main(prog_name='beampose')"
    words = command.replace("RUN", run)
    done = subprocess.run(
        [sys.executable, "-P", "-c", start, *words.split()], cwd=folder, capture_output=True, text=True, check=False
    )
    return Printed(f"beampose {words}", done.returncode, (done.stdout + done.stderr).strip())


def _evidence(results: Path) -> list[dict[str, Any]]:
    """The findings of the results that are not a PASS: level, code, what, why."""
    if not results.is_dir():
        return []
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    return [e for e in summary["verdict"]["evidence"] if e["level"] != "pass"]


def _cost(work: Path, usual: Path) -> list[str]:
    """A table of sigmas and errors of this recording and of the usual one."""
    execute("run RUN --out results", usual.name, usual.parent)
    columns = [_figures(folder / "results", folder) for folder in (usual.parent, work)]
    rows = (
        "frames measured", "sigma of the attitude, median", "sigma of the position, median",
        "error of the attitude, RMS", "error of the position, RMS", "errors over sigmas, RMS",
    )  # fmt: skip
    return table(("", "as it should be", "this recording"), zip(rows, *columns, strict=True))


def _figures(results: Path, true: Path) -> list[str]:
    """What the results claim, and what is true: per axis, of measured frames."""
    delta, covariance = measured_errors(results, true)
    counts = json.loads((results / "summary.json").read_text(encoding="utf-8"))["counts"]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    ratio = np.sqrt(np.mean(normalised_squares(delta, covariance)) / 6)
    numbers = (
        f"{1000 * np.rad2deg(np.median(sigma[:, 3:])):.1f} mdeg", f"{1000 * np.median(sigma[:, :3]):.3f} mm",
        f"{1000 * np.rad2deg(np.sqrt(np.mean(delta[:, 3:] ** 2))):.1f} mdeg",
        f"{1000 * np.sqrt(np.mean(delta[:, :3] ** 2)):.3f} mm", f"{ratio:.2f}",
    )  # fmt: skip
    return [f"{counts['pose_status']['measured']} of {counts['frames']}", *numbers]


def page(
    sight: Sight, printed: Sequence[Printed], evidence: Sequence[Mapping[str, Any]], cost: Sequence[str] = ()
) -> str:
    """The page as Markdown. cost: lines of a table, of a sight that is a PASS."""
    usual = "" if sight.board is not None else "Left: as it should be. Right: this recording."
    if usual and "spot" not in sight.picture:
        usual += " Spots are drawn larger than they are."
    lines = [
        f"# {sight.title}", "", "## What you see", "", sight.see.strip(), "",
        f"![{sight.title}]({sight.name}.webp)", "", f'<p class="caption">{usual}</p>' if usual else "", "",
        "## What beampose reports", "",
    ]  # fmt: skip
    for p in printed:
        status = f"  # exit status {p.status}" if p.status else ""
        lines += ["```console", f"$ {p.command}{status}", *_shown(p.output), "```", ""]
    for e in (e for e in evidence if e["code"] in sight.named):
        code = str(e["code"])
        word = {"check": "CHECK" if sight.board is None else "WARN"}.get(e["level"], "FAIL")
        lines += [
            f"The report, {word}, [{code}](../reference/codes.md#{code.lower()}) "
            f"{cell(entries()[code].title.lower())}:", "",
            *(f"> {cell(sentence(e[part]))}\n>" for part in ("what", "why") if e[part]), "",
        ]  # fmt: skip
    if cost:
        lines += ["What it costs, per axis; the errors are those against the truth of the simulation:", "", *cost]
    lines += ["## What to do", "", sight.do.strip(), ""]
    if sight.board is None:
        lines += [
            '??? note "Make this recording yourself"', "", f"    {_story(sight)} In a clone of the repository:", "",
            "    ```text", f"    python -m docs.website.gallery record {sight.name} {sight.name}", "    ```", "",
        ]  # fmt: skip
    return "\n".join(lines)


def _shown(output: str) -> list[str]:
    """The lines of an output; that of `check` without the description of the recording below its remarks."""
    lines = output.splitlines()
    return [*lines[: lines.index("Rig")], "..."] if "Rig" in lines else lines


def _story(sight: Sight) -> str:
    """How the recording was made, in words."""
    made = f"Simulated: scenario `{sight.recording['scenario']}`, {sight.recording['frames']} frames."
    if not sight.mistake:
        return f"{made} Its light or its vehicle is the sight."
    text = " ".join((MISTAKES[sight.mistake].__doc__ or "").split())
    return f"{made} {text}"


# Pictures ------------------------------------------------------------------------------------------------------------


def draw(sight: Sight, folder: Path, usual: Path) -> np.ndarray:
    """The picture of the usual recording and that of the sight side by side, with the same grey levels."""
    frame, camera = sight.picture.get("frame", 10), sight.picture.get("camera", "left")
    if sight.board is not None:
        shots = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted((folder / "photos").iterdir())[1:3]]
        return _beside([_fit(shot) for shot in shots])
    pictures = [_picture(at, camera, frame) for at in (usual, folder)]
    true = usual.with_name("truth")
    cuts = [_cut(picture, true, sight.picture, camera, frame) for picture in pictures]
    highest = np.max(cuts) / (1 if "spot" in sight.picture else 2)
    low, high = sight.picture.get("levels") or (np.percentile(pictures[0], 5), highest)
    greys = [np.clip((cut.astype(float) - low) / max(high - low, 1.0), 0, 1) for cut in cuts]
    return _beside([_fit(np.round(255 * grey).astype(np.uint8), "spot" in sight.picture) for grey in greys])


def _usual(sight: Sight) -> dict[str, Any]:
    """The recording without what makes it a sight."""
    return {k: v for k, v in sight.recording.items() if k not in ("change", "late")}


def _picture(run: Path, camera: str, frame: int) -> np.ndarray:
    path = next((run / "frames" / camera).glob(f"{frame:06d}.*"))
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None, path
    return picture


def _cut(picture: np.ndarray, true: Path, chosen: Mapping[str, Any], camera: str, frame: int) -> np.ndarray:
    """The surroundings of a spot, by the truth of the usual recording; without one the whole picture, spots widened."""
    if "spot" not in chosen:
        return np.asarray(cv2.dilate(picture, np.ones((7, 7), np.uint8)))  # so that spots can be seen
    half = chosen.get("half_px", 20)
    rows = (line.split(",") for line in (true / "spots.csv").read_text("utf-8").splitlines()[1:])
    u, v = next((float(r[3]), float(r[4])) for r in rows if r[:3] == [str(frame), camera, chosen["spot"]])
    tall = half * _PANEL_PX[1] // _PANEL_PX[0]
    left, top = max(round(u) - half, 0), max(round(v) - tall, 0)
    return picture[top : top + 2 * tall, left : left + 2 * half]


def _fit(picture: np.ndarray, enlarged: bool = False) -> np.ndarray:
    how = cv2.INTER_NEAREST if enlarged else cv2.INTER_AREA
    return np.asarray(cv2.resize(picture, _PANEL_PX, interpolation=how))


def _beside(panels: Sequence[np.ndarray]) -> np.ndarray:
    gap = np.full((_PANEL_PX[1], _GAP_PX), 128, np.uint8)
    return np.hstack([panels[0], gap, panels[1]])


# All pages -----------------------------------------------------------------------------------------------------------


def overview(shown: Sequence[Sight]) -> str:
    """The first page: all sights with their pictures."""
    lines = [
        "# Gallery", "", _OVERVIEW, "", '<div class="gallery" markdown>', "",
        *(f"[![]({s.name}.webp) {s.title}]({s.name}.md)\n" for s in shown), "</div>", "",
    ]  # fmt: skip
    return "\n".join(lines)


_OVERVIEW = """What mistakes and difficulties look like: the picture, what the program reports, and what to do. Every
page is a simulated recording with one mistake. The output is what the commands printed when the page was made."""


def build(out: Path = BUILD, only: Sequence[str] = ()) -> Path:
    """All pages, or those of these names, in a folder; those that are there already and up to date stay.

    Raises:
        SightError: the findings of a sight are not those that the table states.
    """
    version = fingerprint()
    stamp = out / "version"
    if stamp.is_file() and stamp.read_text() == version:
        return out
    if not only:
        shutil.rmtree(out, ignore_errors=True)
    chosen = [s for s in sights() if not only or s.name in only]
    with ProcessPoolExecutor(min(WORKERS, os.cpu_count() or 1)) as pool:
        for sight, text in zip(chosen, pool.map(_made, chosen, [out] * len(chosen)), strict=True):
            (out / f"{sight.name}.md").write_text(text, encoding="utf-8")
    (out / "index.md").write_text(overview([s for s in sights() if (out / f"{s.name}.md").is_file()]), encoding="utf-8")
    if not only:
        stamp.write_text(version)
    return out


def _made(sight: Sight, out: Path) -> str:
    with tempfile.TemporaryDirectory(prefix="beampose-gallery-") as work:
        return make(sight, Path(work), out)


if __name__ == "__main__":
    if sys.argv[1:2] == ["record"]:
        wanted = {s.name: s for s in sights()}
        print(f"recording: {write_recording(wanted[sys.argv[2]], Path(sys.argv[3]))}")
    else:
        print(f"pages: {build(only=sys.argv[1:])}")
