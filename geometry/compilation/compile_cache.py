"""Where the machine code of compiled functions is kept between processes.

numba's own cache looks only at the file of the function called and not at those that it calls. Here the cache folder
of a source folder is named by a hash of every compiled source that it imports, directly or not: an edited or
upgraded file never meets old code, and an edit compiles only what depends on it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path

import numba

MOST_FOLDERS = 40  # of code kept in one place, some ten for each version of beampose: more only where it is edited
_MARK = "@compiled"
_PREFIX = "beampose-compiled-"
_IMPORT = re.compile(r"^\s*(?:from ([\w.]+) import ([\w, ]+|\([^)]*\))|import ([\w.]+))", re.MULTILINE)


def cache_folder(folder: Path) -> Path | None:
    """Where the machine code of a source folder's functions, as they are now, is kept; None: nothing can be written."""
    return _writable_folder(_sources(folder))


def is_empty(folder: Path) -> bool:
    """Whether nothing of a source folder, as it is now, is compiled yet."""
    kept = cache_folder(folder)
    return kept is None or not any(kept.rglob("*.nbi"))


@cache
def _sources(folder: Path) -> tuple[Path, ...]:
    """The files with compiled functions of a source folder and of all that it imports."""
    found: set[Path] = set()
    waiting = [f for f in folder.glob("*.py") if _MARK in f.read_text("utf-8")]
    while waiting:
        source = waiting.pop()
        if source not in found:
            found.add(source)
            waiting += [f for f in _imported(source) if _MARK in f.read_text("utf-8")]
    return tuple(sorted(found))


def _imported(source: Path) -> list[Path]:
    """The files of the same program that a source imports."""
    root = source.parent
    while (root / "__init__.py").is_file():
        root = root.parent
    names = set()
    for module, imported, plain in _IMPORT.findall(source.read_text("utf-8")):
        base = module or plain
        names |= {base, *(f"{base}.{name}" for name in re.findall(r"\w+", imported))}
    files = (root.joinpath(*name.split(".")).with_suffix(".py") for name in names)
    return [f for f in files if f.is_file()]


@cache
def _writable_folder(sources: tuple[Path, ...]) -> Path | None:
    """A folder for just this code that can be written: beside it, else the user's, else none."""
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    homes = [Path(__file__).parent / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()]
    for home in (*homes, Path(tempfile.gettempdir())):
        folder = home / f"{_PREFIX}{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # What is read from it is executed: nothing that another user has put into a folder open to all.
            if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
                continue
            with tempfile.TemporaryFile(dir=folder):
                os.utime(folder)  # used just now
        except OSError:
            continue
        _remove_old(home)
        return folder
    return None


def _remove_old(home: Path) -> None:
    """Remove all but the folders last used. A process that still works with one of the others only compiles again."""

    def used(folder: Path) -> float:
        try:
            return folder.stat().st_mtime
        except OSError:  # another process was faster
            return 0.0

    for folder in sorted(home.glob(f"{_PREFIX}*"), key=used, reverse=True)[MOST_FOLDERS:]:
        shutil.rmtree(folder, ignore_errors=True)
