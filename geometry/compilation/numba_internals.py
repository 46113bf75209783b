"""Faster loading of machine code from disk, with parts of numba that its releases may change.

All uses of numba's undocumented interfaces are here (docs/decisions/compile-cache.md). Where one of them is missing,
importing this module raises ImportError and `geometry.compilation.jit` uses numba's public cache: slower, same results.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from itertools import islice
from pathlib import Path
from sys import modules
from typing import Any
from weakref import WeakValueDictionary

import numba
from numba.core import codegen, environment
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]  # written in C, without types
from numba.core.sigutils import normalize_signature
from numba.core.types import unliteral

_NEEDED = {
    "codegen": (codegen, ("ll", "JITCodeLibrary")),
    "JITCodeLibrary": (
        getattr(codegen, "JITCodeLibrary", None),
        (
            "add_linking_library", "enable_object_caching", "get_pointer_to_function", "serialize_using_object_code",
            "_ensure_finalized", "_finalize_final_module", "_get_module_for_linking", "_set_compiled_object",
        ),
    ),
    "FunctionCache": (
        FunctionCache,
        ("_guard_against_spurious_io_errors", "_load_overload", "flush", "load_overload", "save_overload"),
    ),
    "_nrt_python": (_nrt_python, ("c_helpers",)),
    "environment": (environment, ("Environment", "_rebuild_env", "lookup_environment")),
    "dispatcher": (type(numba.njit(lambda: None)), ("add_overload", "compile", "get_call_template")),
}  # fmt: skip
_missing = [
    f"{place}.{name}" for place, (found, names) in _NEEDED.items() for name in names if not hasattr(found, name)
]
if _missing:
    raise ImportError(f"numba {numba.__version__} has no {', '.join(_missing)}")

_llvm: Any = codegen.ll  # type: ignore[attr-defined]  # llvmlite.binding, as numba imports it; numba has no types

_LARGE = 150  # instructions; LLVM inlines up to 45 (225 / 5 each), more where arguments are constants
_WRAPPERS = ("_ZN7cpython", "cfunc.")  # names of the functions by which Python and C call a compiled function
_OF_NUMBA = "_ZN5numba"
_ENVIRONMENT = "_ZN08NumbaEnv"


class _Library(codegen.JITCodeLibrary):
    """numba's holder of a function's machine code, with two differences (docs/decisions/compile-cache.md).

    A large function is called where it is. numba copies it into each function that calls it, and optimises and
    translates the copies again, although LLVM inlines small functions only.

    For code from disk, LLVM's bitcode is parsed only when it is needed: to compile a caller, which may inline this
    code. numba parses it in every process, half of the time of loading.
    """

    def __init__(self, generator: Any, name: str) -> None:
        super().__init__(generator, name)  # type: ignore[no-untyped-call]  # numba has no types
        self._called: dict[str, _Library] = {}  # large functions that this code calls; each after those that it calls
        self._unparsed: bytes | None = None  # bitcode of code from disk
        self._stored: tuple[Any, ...] | None = None  # what the disk has of large code

    @cached_property
    def _large(self) -> str | None:
        """The function's symbol if it is large; None if it is small, or one of numba's own."""
        own = [
            f
            for f in self._final_module.functions
            if not f.is_declaration and f.linkage == _llvm.Linkage.external and not f.name.startswith(_WRAPPERS)
        ]
        if len(own) != 1 or own[0].name.startswith(_OF_NUMBA):
            return None
        instructions = (one for block in own[0].blocks for one in block.instructions)
        return str(own[0].name) if sum(1 for _ in islice(instructions, _LARGE)) == _LARGE else None

    def add_linking_library(self, library: Any) -> None:
        library._ensure_finalized()
        if isinstance(library, _Library):
            # numba numbers functions by process: two versions of a function may have one name, and call functions of
            # different names. The first version stays, since it stands after those that it calls.
            for symbol, called in library._called.items():
                self._called.setdefault(symbol, called)
            if library._large is not None:
                _callable[library._large] = self._called.setdefault(library._large, library)
                self._reload_init.update(library._reload_init)
                return
        super().add_linking_library(library)  # type: ignore[no-untyped-call]  # numba has no types

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        return self.name, "object", ([one._state() for one in self._called.values()], self._state())

    def _state(self) -> tuple[Any, ...]:
        """What is kept of this code: name, symbol if it is large, machine code, environments (constants), bitcode."""
        if self._stored is not None:
            return self._stored
        state: Any = super().serialize_using_object_code()  # type: ignore[no-untyped-call]  # numba has no types
        name, _, (machine_code, bitcode) = state
        names = [v.name for v in self._final_module.global_variables if v.name.startswith(_ENVIRONMENT)]
        lookup: Any = environment.lookup_environment
        used = [lookup(one) for one in names]
        environments = tuple(one for one in used if one is not None and one.can_cache())
        return name, self._large, machine_code, environments, None if self._large else bitcode

    @classmethod
    def _unserialize(cls, generator: Any, state: Any) -> _Library:
        called, own = state[2]
        loaded: dict[str, _Library] = {}
        for one in called:
            loaded[one[1]] = cls._of(generator, one, loaded)
        return cls._of(generator, own, loaded)

    @classmethod
    def _of(cls, generator: Any, state: tuple[Any, ...], called: dict[str, _Library]) -> _Library:
        """The code of a state, made ready; the functions that it calls are."""
        name, symbol, machine_code, environments, bitcode = state
        known = _callable.get(symbol)
        if known is not None and known._state()[2] == machine_code:
            return known
        library: Any = cls(generator, name)
        library._called, library._large, library._unparsed = dict(called), symbol, bitcode
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        for one in environments:
            generator.set_env(one.env_name, one)
        if symbol is not None:
            library._stored = state
            _callable[symbol] = library
        else:
            library._environments = environments  # numba refers to them weakly
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
        self.for_python = True  # whether the code that is looked for must have what a call by Python needs

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
        if not isinstance(target_context.get_abi_sizeof, _Sizes):
            target_context.get_abi_sizeof = _Sizes(target_context.get_abi_sizeof)
        _name_functions_of_numba()
        try:
            # Not FunctionCache.load_overload: it first imports what numba needs to compile, as numba does again there.
            with self._guard_against_spurious_io_errors():
                found = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types
        except Exception:  # unpickling a truncated file raises almost anything
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]  # numba has no types
            return None
        args, _ = normalize_signature(sig)  # type: ignore[no-untyped-call]  # numba has no types
        # Of two processes that keep code at once, one may overwrite the file of the other, for other types.
        if found is None or tuple(found.signature.args) != tuple(args):
            return None
        return None if self.for_python and not _is_for_python(found) else found

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # for instance a full disk: the code is compiled, only not kept
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]  # numba has no types


_callable: WeakValueDictionary[str, _Library] = WeakValueDictionary()  # large functions of this process, by symbol


class _Sizes:
    """Sizes of LLVM's types, each computed once. numba parses a module for the type of each variable."""

    def __init__(self, size_of: Callable) -> None:
        self._size_of, self._known = size_of, dict[str, int]()

    def __call__(self, kind: Any) -> int:
        name = str(kind)
        if name not in self._known:
            self._known[name] = self._size_of(kind)
        return self._known[name]


@cache
def _name_functions_of_numba() -> None:
    """Gives the linker the addresses of the functions that machine code calls for the memory of arrays.

    The first half of what numba does before it compiles; the other half compiles functions that machine code from disk
    contains.
    """
    for name, address in _nrt_python.c_helpers.items():
        _llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """The namespace that machine code from disk has of a function, without an import of the function's module.

    Compiled code reads only the constants. numba imports the module, and with that of a mean or a sort scipy.linalg.
    """
    known: Any = environment.lookup_environment(name)  # type: ignore[no-untyped-call]  # numba has no types
    if known is not None:
        return known
    made: Any = environment.Environment(modules[module].__dict__ if module in modules else {"__name__": module})
    made.consts[:], made.env_name = constants, name
    environment.Environment._memo[name] = made
    return made


# Files of machine code contain the name of numba's own function.
_environment.__module__, _environment.__qualname__ = environment.__name__, "_rebuild_env"
environment._rebuild_env = _environment


def keep_on_disk(dispatcher: Any, function: Callable, folder: Path) -> None:
    """Makes a compiled function (numba's dispatcher) keep its machine code in a folder and load it from there."""
    dispatcher._cache = _Cache(function, folder)


class _Calls:
    """Compiles a function for its callers, which differ in what they need (docs/decisions/numba.md).

    A call with a literal argument, `f(x, 0)`, uses the code for any number. numba would compile the function once more
    for each literal, and for the first value of a variable such as `count = 0`, and discard some of these versions.

    Compiled code does not need the code by which Python calls the function (converted arguments, its lock); numba
    compiles that too, for each function. Here it is compiled, with the function, when Python calls the function.
    """

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher, self._by_compiled_code = dispatcher, False
        self._template, self._compile = dispatcher.get_call_template, dispatcher.compile
        self._add = dispatcher.add_overload
        dispatcher.get_call_template, dispatcher.compile = self.template, self.compile
        dispatcher.add_overload = self.add

    def template(self, args: Any, kws: Any) -> Any:
        """For a call by code that is being compiled."""
        plain: Any = unliteral
        with global_compiler_lock:
            self._by_compiled_code = True
            try:
                return self._template([plain(a) for a in args], {name: plain(a) for name, a in kws.items()})
            finally:
                self._by_compiled_code = False

    def compile(self, signature: Any) -> Any:
        """For a call by Python, and within `template`."""
        dispatcher = self._dispatcher
        with global_compiler_lock:
            for_python = not self._by_compiled_code
            args, _ = normalize_signature(signature)  # type: ignore[no-untyped-call]  # numba has no types
            if for_python and args in dispatcher.overloads and not _is_for_python(dispatcher.overloads[args]):
                del dispatcher.overloads[args]
            dispatcher.targetoptions["no_cpython_wrapper"] = not for_python
            if isinstance(dispatcher._cache, _Cache):
                dispatcher._cache.for_python = for_python
            return self._compile(signature)

    def add(self, compiled: Any) -> None:
        if _is_for_python(compiled):
            self._add(compiled)
        else:
            self._dispatcher.overloads[tuple(compiled.signature.args)] = compiled


def _is_for_python(compiled: Any) -> bool:
    """Whether Python can call a compiled version of a function."""
    return bool(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cpython_wrapper_name))


def compile_as_needed(dispatcher: Any) -> None:
    """Makes a compiled function (numba's dispatcher) compile what its callers need, and no more."""
    _Calls(dispatcher)
