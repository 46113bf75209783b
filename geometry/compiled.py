"""Numerics compiled to machine code by numba, with the code kept on disk.

The first call on a new machine compiles (about half a minute for a whole run); later processes load it. numba's own
cache looks only at the file of the function asked for and not at those that it calls, so here the cache's folder is
named by what all compiled sources of the package say: an edited or upgraded file never meets old code.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.types import unliteral

Function = TypeVar("Function", bound=Callable)

_MARK = "@compiled"


def compiled(function: Function) -> Function:
    """numba.njit with numpy's division (x / 0 is inf, no exception) and the cache on disk where there is a place."""
    folder = _cache_folder(_sources(Path(function.__code__.co_filename).parent))
    settings: Any = numba.config  # numba looks there while it decorates
    before = settings.CACHE_DIR
    settings.CACHE_DIR = folder or before
    try:
        dispatcher = numba.njit(function, cache=folder is not None, error_model="numpy")
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


@cache
def _sources(package: Path) -> tuple[Path, ...]:
    """The files with compiled functions of a package and of this one, on which the others stand."""
    folders = sorted({package, Path(__file__).parent})
    return tuple(f for folder in folders for f in sorted(folder.glob("*.py")) if _MARK in f.read_text("utf-8"))


@cache
def _cache_folder(sources: tuple[Path, ...]) -> str | None:
    """A folder for just this code that can be written: beside it, else the user's, else none."""
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    name = f"beampose-compiled-{digest.hexdigest()[:16]}"
    homes = [Path(__file__).parent / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()]
    for home in (*homes, Path(tempfile.gettempdir())):
        folder = home / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except OSError:
            continue
    return None
