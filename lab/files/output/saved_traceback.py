"""An exception that the program did not foresee: its traceback is saved to a file, and a line says where."""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
import sys
import tempfile
import traceback
from pathlib import Path

_LONGEST = 300  # characters of an exception's text in a line


def unexpected_error(error: BaseException, file: Path | None = None) -> str:
    """Save the traceback of an unforeseen exception. Returns one line about it, with the place of the file.

    file: where it is saved, if it can be. Where no file can be written, the traceback itself follows the line. The user
    is asked to report it, unless the system states its reason (a full disk).
    """
    report = _report(error)
    of_system = isinstance(error, OSError) and bool(error.strerror)
    words = "".join(c if c.isprintable() else " " for c in f"{type(error).__name__}: {_text(error)}")
    words = " ".join(words.split()).rstrip(": ")
    words = words if len(words) <= _LONGEST else f"{words[: _LONGEST - 4]} ..."
    place, please = _save(report, file), "" if of_system else "; please report it"
    if place is None:
        return f"unexpected error: {words}{please} with this traceback:\n{report}"
    return f"unexpected error: {words}; the traceback is in {place}{please}"


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # a class whose own __str__ fails
        return "(no text)"


def _report(error: BaseException) -> str:
    """The traceback, and what is needed to repeat the command."""
    from lab.packages import versions  # reads the installed packages: only needed here

    try:
        installed = ", ".join(f"{name} {number}" for name, number in versions().items())
    except Exception:  # the report is written in any case
        installed = "unknown"
    try:
        trace = "".join(traceback.format_exception(error))
    except Exception:
        trace = f"{type(error).__name__} (its traceback cannot be shown)\n"
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    lines = (
        f"time: {now}",
        f"command: {' '.join(map(repr, sys.argv[1:]))}",
        f"system: {platform.platform()}, Python {platform.python_version()}",
        f"versions: {installed}",
    )
    return "\n".join((*lines, "", trace))


def _save(report: str, file: Path | None) -> Path | None:
    """Write a report to a file: the given one, else a new one in the user's cache folder, in that of temporary files,
    or here.
    """
    if file is not None:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(report, "utf-8", "backslashreplace")
            return file
    places = []
    with contextlib.suppress(RuntimeError):  # no home folder
        places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "beampose" / "errors")
    with contextlib.suppress(OSError):
        places.append(Path(tempfile.gettempdir()))
    for place in (*places, Path.cwd()):
        try:
            place.mkdir(parents=True, exist_ok=True)
            number, name = tempfile.mkstemp(
                prefix=f"beampose-error-{datetime.date.today().isoformat()}-", suffix=".txt", dir=place
            )
            with open(number, "w", encoding="utf-8", errors="backslashreplace") as new:
                new.write(report)
        except OSError:
            continue
        return Path(name)
    return None
