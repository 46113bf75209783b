"""The decorator of all compiled functions: numba.njit with machine code kept on disk.

The first call on a new machine compiles; later processes load the code from the folder that compile_cache.py names.
When a process starts to compile, the logger `beampose` gets one line (INFO). With NUMBA_DISABLE_JIT=1 the functions
stay plain Python, for debugging.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event

from geometry.compilation.compile_cache import cache_folder, is_empty

try:
    from geometry.compilation import numba_internals
except ImportError:  # a numba without one of them: its public cache
    numba_internals = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable)

_folders: set[Path] = set()  # source folders that have compiled functions


def compiled(function: Function) -> Function:
    """numba.njit with numpy's division (x / 0 is inf, no exception), cached on disk where a folder can be written."""
    return _compiled(function, release_gil=False)


def compiled_in_caller(function: Function) -> Function:
    """As `compiled`, for a large function that is called in one place: it becomes a part of its caller there.

    A function that is called is compiled once more in each of its callers: with all that it calls, twice as long.
    """
    return _compiled(function, release_gil=False, inline="always")


def compiled_for_threads(function: Function) -> Function:
    """As `compiled`, but releases the GIL: for functions that run for a tenth of a millisecond or more.

    A thread that releases the GIL may wait long to get it back, so this does not pay for short functions.
    """
    return _compiled(function, release_gil=True)


def compiled_for_sums(function: Function) -> Function:
    """As `compiled`, but the terms of its sums are added in any order, since loops with sums are vectorised only so.

    The last digits of the sums depend on the processor.
    """
    return _compiled(function, release_gil=False, fastmath={"reassoc"})


def _compiled(function: Function, release_gil: bool, fastmath: Any = False, inline: str = "never") -> Function:
    settings: Any = numba.config
    options: Any = {"error_model": "numpy", "nogil": release_gil, "fastmath": fastmath, "inline": inline}
    options["no_cfunc_wrapper"] = True  # nothing written in C calls them
    if settings.DISABLE_JIT:
        return numba.njit(function, **options)
    folder = Path(function.__code__.co_filename).parent
    _folders.add(folder)
    cached = cache_folder(folder)
    if numba_internals is None and cached is not None:
        before, settings.CACHE_DIR = settings.CACHE_DIR, str(cached)
        try:
            return numba.njit(function, cache=True, **options)
        finally:
            settings.CACHE_DIR = before
    dispatcher = numba.njit(function, **options)
    if numba_internals is not None:
        if cached is not None:
            numba_internals.keep_on_disk(dispatcher, function, cached)
        numba_internals.compile_as_needed(dispatcher)
    return dispatcher


class _Notice(event.Listener):
    """Reports once per process that code is being compiled and nothing was cached: the first call takes long."""

    def __init__(self) -> None:
        self._reported = False

    def on_start(self, begun: Any) -> None:
        folder = Path(begun.data["dispatcher"].py_func.__code__.co_filename).parent
        if not self._reported and folder in _folders and is_empty(folder):
            self._reported = True
            how_often = "once" if cache_folder(folder) else "each time, since no folder can be written to keep it"
            logging.getLogger("beampose").info("compiling for this machine, %s (about half a minute)", how_often)

    def on_end(self, ended: Any) -> None:
        pass


_register: Any = event.register
_register("numba:compile", _Notice())
