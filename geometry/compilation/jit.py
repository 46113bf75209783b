"""The decorator of all compiled functions: numba.njit with machine code kept on disk.

The first call on a new machine compiles; later processes load the code from the folder that compile_cache.py names.
When a process starts to compile, the logger `beampose` gets one line (INFO). With NUMBA_DISABLE_JIT=1 the functions
stay plain Python, for debugging.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import codegen, event
from numba.core.caching import FunctionCache
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]  # written in C, without types
from numba.core.types import unliteral

from geometry.compilation.compile_cache import cache_folder, is_empty

Function = TypeVar("Function", bound=Callable)

_llvm: Any = codegen.ll  # type: ignore[attr-defined]  # llvmlite.binding, as numba imports it; numba has no types
_folders: set[Path] = set()  # source folders that have compiled functions


def compiled(function: Function) -> Function:
    """numba.njit with numpy's division (x / 0 is inf, no exception), cached on disk where a folder can be written."""
    return _compiled(function, release_gil=False)


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


class _Library(codegen.JITCodeLibrary):
    """numba's holder of machine code; for code from disk, LLVM's bitcode is parsed only when it is needed.

    It is needed to compile a caller, which may inline this code. numba parses it in every process: half of the time
    of loading (docs/decisions/compile-cache.md).
    """

    _unparsed: bytes | None = None  # bitcode of code from disk

    @classmethod
    def _unserialize(cls, generator: Any, state: Any) -> _Library:
        name, _, (machine_code, bitcode) = state
        library: Any = cls(generator, name)
        library._unparsed = bitcode
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        out: _Library = library
        return out

    def _get_module_for_linking(self) -> Any:
        if self._unparsed is not None:
            self._shared_module = _llvm.parse_bitcode(self._unparsed)
            self._unparsed = None
        return super()._get_module_for_linking()  # type: ignore[no-untyped-call]  # numba has no types

    def get_pointer_to_function(self, name: str) -> int:
        if self._disable_inspection:  # code from disk: numba knows its symbols only from the bitcode
            address: int = self._codegen._engine.get_function_address(name)
            return address
        return int(super().get_pointer_to_function(name))  # type: ignore[no-untyped-call]  # numba has no types


class _Cache(FunctionCache):
    """numba's cache of one function, for which an unreadable or unwritable file is a missing one.

    It is opened by the first call of the function: a run calls a quarter of all functions.
    """

    def __init__(self, function: Callable, folder: Path) -> None:
        self._function, self._folder, self._is_open = function, folder, False

    def _open(self) -> None:
        settings: Any = numba.config
        before, settings.CACHE_DIR = settings.CACHE_DIR, str(self._folder)
        try:
            super().__init__(self._function)  # type: ignore[no-untyped-call]  # numba has no types
        finally:
            settings.CACHE_DIR = before
        self._is_open = True

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if not self._is_open:
            self._open()
        target_context.codegen()._library_class = _Library
        _name_functions_of_numba()
        try:
            # Not FunctionCache.load_overload: it first imports what numba needs to compile, as numba does again there.
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types
        except Exception:  # unpickling a truncated file raises almost anything
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]  # numba has no types
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # for instance a full disk: the code is compiled, only not kept
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]  # numba has no types


@cache
def _name_functions_of_numba() -> None:
    """Gives the linker the addresses of the functions that machine code calls for the memory of arrays.

    The first half of what numba does before it compiles; the other half compiles functions that machine code from disk
    contains.
    """
    for name, address in _nrt_python.c_helpers.items():
        _llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _compiled(function: Function, release_gil: bool, fastmath: Any = False) -> Function:
    settings: Any = numba.config
    dispatcher = numba.njit(function, error_model="numpy", nogil=release_gil, fastmath=fastmath)
    if settings.DISABLE_JIT:
        return dispatcher
    folder = Path(function.__code__.co_filename).parent
    _folders.add(folder)
    cached = cache_folder(folder)
    if cached is not None:
        dispatcher._cache = _Cache(function, cached)
    _treat_literals_as_numbers(dispatcher)
    return dispatcher


def _treat_literals_as_numbers(dispatcher: Any) -> None:
    """Makes calls with a literal argument, `f(x, 0)`, use the code for any number.

    numba would compile the function once more for each literal, and for the first value of a variable such as
    `count = 0`, and discard some of these versions: a sixth of all compilations (docs/decisions/numba.md).
    """
    of_types = dispatcher.get_call_template
    plain: Any = unliteral

    def of_plain_types(args: Any, kws: Any) -> Any:
        return of_types([plain(a) for a in args], {name: plain(a) for name, a in kws.items()})

    dispatcher.get_call_template = of_plain_types


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
