"""Folder on disk that keeps the machine code of compiled functions between processes.

numba's own cache compares only the file of the function that is called, not the files of the functions and constants
that this function uses (docs/decisions/compile-cache.md). Here the cache folder of a source folder is named by a hash
of its compiled sources and of every module of the program that they import, directly or not. Code of an earlier
version is therefore never run, and an edit recompiles only what depends on the edited file.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

import numba

MAX_FOLDERS = 40  # cache folders kept in one place; a version of beampose uses about ten
_MARK = b"@compiled"
_PREFIX = "beampose-compiled-"
_NAMES = r"\w+(?:[ \t]+as[ \t]+\w+)?"
_FROM = re.compile(rf"^[ \t]*from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|{_NAMES}(?:[ \t]*,[ \t]*{_NAMES})*)", re.M)
_IMPORT = re.compile(r"^[ \t]*import[ \t]+(.+)$", re.M)


@cache
def cache_folder(folder: Path) -> Path | None:
    """Cache folder for the functions of a source folder as they are now; None if no folder can be written safely."""
    return private_folder(_sources(folder))


def is_empty(folder: Path) -> bool:
    """Whether no function of a source folder, as it is now, has been compiled yet."""
    kept = cache_folder(folder)
    return kept is None or not any(kept.rglob("*.nbi"))


@cache
def _sources(folder: Path) -> tuple[Path, ...]:
    """The files with compiled functions of a source folder, and all modules that these import, directly or not.

    Modules without compiled functions count too: numba compiles their constants into the machine code.
    """
    found: set[Path] = set()
    waiting = [f for f in folder.glob("*.py") if _MARK in _content(f)]
    while waiting:
        source = waiting.pop()
        if source not in found:
            found.add(source)
            waiting += _imported(source)
    return tuple(sorted(found))


@cache
def _imported(source: Path) -> frozenset[Path]:
    """The files of the same program that a source imports, in any form of `import` and at any indentation.

    Read with regular expressions: parsing the files of all folders would cost every start 0.1 s. A text that only
    looks like an import adds a file at worst.
    """
    package = root = os.path.dirname(source)
    while os.path.isfile(f"{root}/__init__.py"):
        root = os.path.dirname(root)
    text = re.sub(r"#.*", "", _content(source).decode("utf-8")).replace("\\\n", " ")
    modules = {item.split()[0] for line in _IMPORT.findall(text) for item in line.split(",")}
    for module, names in _FROM.findall(text):
        modules |= {module, *(f"{module.rstrip('.')}.{name}" for name in re.findall(r"\w+", names))}
    found = set()
    for module in modules:
        name = module.lstrip(".")
        base = root if name == module else os.path.normpath(f"{package}/{'../' * (len(module) - len(name) - 1)}")
        path = f"{base}/{name.replace('.', '/')}"
        if _exists(f"{base}/{name.split('.')[0]}"):
            found |= {f for f in (f"{path}.py", f"{path}/__init__.py") if _is_in_folder(f)}
    return frozenset(map(Path, found))


@cache
def _content(source: Path) -> bytes:
    return source.read_bytes()


@cache
def _exists(module: str) -> bool:
    """Whether a path without suffix is a package or a module; saves the search for names of other programs."""
    return os.path.isdir(module) or _is_in_folder(f"{module}.py")


def _is_in_folder(path: str) -> bool:
    """Whether a path exists: most of those that are asked for do not, and each folder is read once."""
    folder, name = os.path.split(path)
    return name in _names(folder)


@cache
def _names(folder: str) -> frozenset[str]:
    return frozenset(os.listdir(folder)) if os.path.isdir(folder) else frozenset()


@cache
def private_folder(sources: tuple[Path, ...]) -> Path | None:
    """A writable folder for code compiled from these files: beside this module, or in the user's or a temporary cache.

    None where no such folder is safe: what is in it is executed.
    """
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    for source in sources:
        digest.update(_content(source))
    homes = [Path(__file__).parent / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()]
    for home in (*homes, Path(tempfile.gettempdir())):
        folder = home / f"{_PREFIX}{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_private(folder):
                continue
            with tempfile.TemporaryFile(dir=folder):
                os.utime(folder)  # marks it as used now
        except OSError:
            continue
        _remove_old(home)
        return folder
    return None


def _is_private(folder: Path) -> bool:
    """Whether only this user can put files into a folder: what is read from it is executed.

    The folder itself must be a directory (no symbolic link) of this user that neither group nor others may write.
    Symbolic links above it must belong to this user or to root.
    """
    if not hasattr(os, "getuid"):
        return True
    user, own = os.getuid(), folder.lstat()
    above = [parent.lstat() for parent in folder.absolute().parents]
    return (
        stat.S_ISDIR(own.st_mode)
        and own.st_uid == user
        and not own.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        and all(one.st_uid in (user, 0) for one in above if stat.S_ISLNK(one.st_mode))
    )


def _remove_old(home: Path) -> None:
    """Removes all cache folders but the last used. A process that still uses a removed one compiles again."""

    def last_used(folder: Path) -> float:
        try:
            return folder.stat().st_mtime
        except OSError:  # another process has removed it
            return 0.0

    for folder in sorted(home.glob(f"{_PREFIX}*"), key=last_used, reverse=True)[MAX_FOLDERS:]:
        shutil.rmtree(folder, ignore_errors=True)
