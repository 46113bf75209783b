"""What a folder is that has no run.yaml, and what its user may have meant."""

from __future__ import annotations

from pathlib import Path

from lab.errors import InputError
from lab.files.text.error_text import name_of_path
from lab.files.text.json_text import read_json

_MOST_NAMES = 3
_PICTURES = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg")


def no_run_error(folder: Path) -> InputError:
    """The error for a folder without a run.yaml: what was found in it, and what to name instead.

    Raises:
        InputError: a summary.json in it is a named pipe, a socket or a device.
    """
    start = f"{folder}: expected a run folder, with a run.yaml,"
    if (folder / "summary.json").is_file() and (run := _run_of_results(folder)):
        return InputError(f"{start} found results; they are of the run {run}")
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        return InputError(f"{folder}: cannot be read: {error.strerror}")
    runs = [path for path in entries if (path / "run.yaml").is_file()]
    if runs:
        names = ", ".join(name_of_path(path) for path in runs[:_MOST_NAMES])
        more = f" and {len(runs) - _MOST_NAMES} more" if len(runs) > _MOST_NAMES else ""
        return InputError(f"{start} found run folders in it: {names}{more}; name one, or give all to `beampose batch`")
    above = next((path for path in list(folder.resolve().parents)[:2] if (path / "run.yaml").is_file()), None)
    if above is not None:
        return InputError(f"{start} found a part of one; name the run folder {name_of_path(above)}")
    if any(path.suffix.lower() in _PICTURES for path in entries):
        return InputError(
            f"{start} found pictures; `beampose detect` needs no run.yaml, and `beampose init` writes one to start from"
        )
    return InputError(f"{start} found none; check the path, or write one with `beampose init`")


def _run_of_results(folder: Path) -> str:
    """The run folder that a summary.json names; empty where it names none."""
    try:
        summary = read_json(folder / "summary.json")
        return str(summary.get("run_folder") or "")
    except (OSError, ValueError, AttributeError):
        return ""
