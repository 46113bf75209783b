"""Checks of folders: the compile cache, and the space on the disks that runs write to."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import geometry
from geometry.compilation.compile_cache import cache_folder, is_empty
from lab.doctor.lines import Line, State

FEW_BYTES, TOO_FEW_BYTES = 5 * 10**9, 2 * 10**8  # free space below which to warn, and to fail
_GB = 1e9
_PACKAGES = ("geometry", "tracking", "calibration", "lab")


def check_places(out: Path) -> list[Line]:
    """All checks of this module. out: where results will be written."""
    temporary = Path(tempfile.gettempdir())
    return [check_cache(), check_space(existing(out), "results"), check_space(temporary, "temporary files")]


def compiled_folders() -> list[Path]:
    """The source folders of the program that have compiled functions."""
    root = Path(geometry.__file__).parents[1]
    files = (f for package in _PACKAGES for f in (root / package).rglob("*.py"))
    return sorted({f.parent for f in files if "\n@compiled" in f.read_text("utf-8")})


def check_cache() -> Line:
    """Whether compiled code can be kept, where, and how much of it is there."""
    folders = compiled_folders()
    kept = [cache_folder(f) for f in folders]
    places = {str(k.parent) for k in kept if k is not None}
    if None in kept:
        remedy = "Make one of these writable for you alone: beampose's own folder, ~/.cache, the temporary folder"
        return Line("BP-D07", State.WARN, "compiled code: cannot be kept; each run compiles for a minute", remedy)
    ready = sum(not is_empty(f) for f in folders)
    text = f"compiled code: {ready} of {len(folders)} parts are ready in {', '.join(sorted(places))}"
    if ready < len(folders):
        return Line(
            "BP-D07", State.WARN, text, "The next run compiles the rest (a minute), or: `python -m lab.runs.warm_up`"
        )
    return Line("BP-D07", State.OK, text)


def existing(path: Path) -> Path:
    """The path, or the nearest folder above it that exists."""
    path = Path(path).absolute()
    return next(p for p in (path, *path.parents) if p.exists())


def check_space(folder: Path, what: str) -> Line:
    """The free space of the disk of a folder."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Line("BP-D08", State.FAIL, f"disk: {folder} cannot be read: {error.strerror}", "Choose another folder")
    text = f"disk: {free / _GB:.1f} GB are free for {what} in {folder}"
    if free >= FEW_BYTES:
        return Line("BP-D08", State.OK, text)
    remedy = "Free some space, or write to another disk (--out; TMPDIR for temporary files)"
    return Line("BP-D08", State.WARN if free >= TOO_FEW_BYTES else State.FAIL, text, remedy)
