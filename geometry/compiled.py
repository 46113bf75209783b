"""Numerics compiled to machine code by numba, with the code kept on disk.

The first call on a new machine compiles (about half a minute for a whole run); later processes load it. numba's own
cache looks only at the file of the function asked for and not at those that it calls, so here the cache's folder is
named by what all compiled sources of the package say: an edited or upgraded file never meets old code.

Whoever waits can be told: the logger `beampose` gets one line (INFO) when a process begins to compile.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.types import unliteral

Function = TypeVar("Function", bound=Callable)

MOST_FOLDERS = 10  # of code kept in one place, two for each version of beampose: more pile up only where it is edited
_MARK = "@compiled"
_PREFIX = "beampose-compiled-"
_packages: set[Path] = set()  # that have compiled functions


def compiled(function: Function) -> Function:
    """numba.njit with numpy's division (x / 0 is inf, no exception) and the cache on disk where there is a place."""
    return _compiled(function, release_gil=False)


def compiled_for_threads(function: Function) -> Function:
    """As `compiled`, and other threads go on meanwhile: for functions that work for a tenth of a millisecond or more.

    A thread that releases the GIL may wait long to get it back, so it does not pay for short functions.
    """
    return _compiled(function, release_gil=True)


def _compiled(function: Function, release_gil: bool) -> Function:
    package = Path(function.__code__.co_filename).parent
    _packages.add(package)
    folder = cache_folder(package)
    settings: Any = numba.config  # numba looks there while it decorates
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before if folder is None else str(folder)
    try:
        dispatcher = numba.njit(function, cache=folder is not None, error_model="numpy", nogil=release_gil)
    finally:
        settings.CACHE_DIR = before
    _take_literals_for_plain(dispatcher)
    return dispatcher


def _take_literals_for_plain(dispatcher: Any) -> None:
    """Let a compiled function that is called with a literal, `f(x, 0)`, be the same as for any other number.

    numba would compile it once more for each literal; also for the first value of a variable that begins as one, as
    in `count = 0`, and throw that away: a sixth of all compiling here.
    """
    of_types = dispatcher.get_call_template
    plain: Any = unliteral

    def of_plain_types(args: Any, kws: Any) -> Any:
        return of_types([plain(a) for a in args], {name: plain(a) for name, a in kws.items()})

    dispatcher.get_call_template = of_plain_types


def cache_folder(package: Path) -> Path | None:
    """Where the machine code of a package's sources, as they are now, is kept; None: no folder can be written."""
    return _writable_folder(_sources(package))


def cold(package: Path) -> bool:
    """Whether nothing of a package, as it is now, is compiled yet: the next call takes its time."""
    folder = cache_folder(package)
    return folder is None or not any(folder.rglob("*.nbi"))


@cache
def _sources(package: Path) -> tuple[Path, ...]:
    """The files with compiled functions of a package and of this one, on which the others stand."""
    folders = sorted({package, Path(__file__).parent})
    return tuple(f for folder in folders for f in sorted(folder.glob("*.py")) if _MARK in f.read_text("utf-8"))


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
            # What is read from it will be executed: not what somebody else has put into a folder open to all.
            if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
                continue
            with tempfile.TemporaryFile(dir=folder):
                os.utime(folder)  # used just now
        except OSError:
            continue
        _clear_out(home)
        return folder
    return None


def _clear_out(home: Path) -> None:
    """Remove all but the folders last used. A process that still works with one of the others only compiles again."""

    def used(folder: Path) -> float:
        try:
            return folder.stat().st_mtime
        except OSError:  # another process was faster
            return 0.0

    for folder in sorted(home.glob(f"{_PREFIX}*"), key=used, reverse=True)[MOST_FOLDERS:]:
        shutil.rmtree(folder, ignore_errors=True)


class _Notice(event.Listener):
    """Says once that code is being compiled, if none was there: a call that stands still for half a minute."""

    def __init__(self) -> None:
        self._told = False

    def on_start(self, begun: Any) -> None:
        package = Path(begun.data["dispatcher"].py_func.__code__.co_filename).parent
        if not self._told and package in _packages and cold(package):
            self._told = True
            again = "once" if cache_folder(package) else "each time, since no folder can be written to keep it"
            logging.getLogger("beampose").info("compiling for this machine, %s (about half a minute)", again)

    def on_end(self, ended: Any) -> None:
        pass


_register: Any = event.register
_register("numba:compile", _Notice())
