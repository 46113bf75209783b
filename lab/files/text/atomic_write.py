"""Atomic writing: a result folder or a file is either complete or as it was before.

What a killed process leaves (a hidden part folder or file) is removed by the next one that writes to the same place.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.errors import InputError, RunError
from lab.files.output.part_folder import (
    folder_lock,
    is_at,
    lock,
    part_folder,
    recover,
    removed_at_the_end,
    replace_folder,
)
from lab.files.text.json_text import has_schema

_FULL = (errno.ENOSPC, errno.EDQUOT)
_REMEDIES = {
    IsADirectoryError: "; name a file in it",
    FileNotFoundError: "; make its folder first",
    NotADirectoryError: "; choose another place",
    PermissionError: "; choose another place, or request write permission there",
}


def atomic_write_text(text: str, path: Path) -> None:
    """Write a UTF-8 text file, complete or not at all; bytes of names that are not UTF-8 become `?`.

    Raises InputError.
    """
    atomic_write_bytes(text.encode("utf-8", "replace"), path)


def atomic_write_bytes(content: bytes, path: Path) -> None:
    """Write a file so that `path` is either the whole new file or what it was before. Raises InputError."""
    path = Path(path)
    try:
        while not _written(content, path):
            pass  # another process has taken the part for one that was left
    except OSError as error:
        remedy = next((text for kind, text in _REMEDIES.items() if isinstance(error, kind)), "")
        raise InputError(f"{path}: cannot be written: {error.strerror}{remedy}") from None
    _remove_left_parts(path)


def _written(content: bytes, path: Path) -> bool:
    """Write a file under another name, locked while it is incomplete, and rename it. Raises OSError."""
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    with removed_at_the_end(part):
        with part.open("xb") as file:
            try:
                held = lock(file.fileno())
            except BlockingIOError:
                return False
            if held and not is_at(file.fileno(), part):
                return False
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            if held:
                part.replace(path)
        if not held:  # Windows renames no open file
            part.replace(path)
    return True


def _remove_left_parts(path: Path) -> None:
    """Remove part files of processes that were killed: those that can be locked."""
    name = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]+\.part")
    with contextlib.suppress(OSError):
        for part in [p for p in path.parent.iterdir() if name.fullmatch(p.name)]:
            with contextlib.suppress(OSError), part.open("rb") as file:
                if lock(file.fileno()):
                    part.unlink()


def made_folder(folder: Path) -> Path:
    """A folder, made where it does not exist. Raises InputError."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder for the results, found a file; choose another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: the folder cannot be made: {error.strerror}; choose another --out") from None
    return folder


def check_output_folder(target: Path, may_replace: Callable[[Path], bool]) -> None:
    """Raises InputError where results cannot be written to the folder `target`. Creates nothing.

    To be called before long work, so that a mistake in --out is reported before the work and not after it.
    """
    target = Path(target)
    if target.is_symlink() and not target.exists():
        raise InputError(f"{target}: expected a folder for the results, found a broken link; choose another --out")
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder for the results, found a file; choose another --out")
    kept = "a mounted volume" if os.path.ismount(target) else "the current folder"
    if os.path.ismount(target) or (target.exists() and target.samefile(Path.cwd())):
        raise InputError(f"{target}: expected a folder that can be replaced, found {kept}; name a folder in it")
    above = next(p for p in (target, *target.absolute().parents) if p.exists())
    if not above.is_dir():
        raise InputError(f"{target}: the folder cannot be made: {above} is a file; choose another --out")
    # An existing target is replaced by a rename, which needs write permission in its parent.
    place = _place_of(target).parent if above == target else above
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(
            f"{target}: the folder cannot be made: no write permission in {place}; choose another --out, or request"
            " write permission there"
        )
    if target.is_dir() and any(target.iterdir()) and not may_replace(target):
        raise InputError(f"{target}: the folder holds something other than earlier results; choose another --out")


def earlier_results(*marks: str) -> Callable[[Path], bool]:
    """Whether a folder holds earlier results of a command: all of these files, or schemas (with /) of summary.json."""
    return lambda folder: all(has_schema(folder, m) if "/" in m else (folder / m).is_file() for m in marks)


@contextmanager
def atomic_folder(target: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields an empty folder beside `target`. It replaces `target` when the block succeeds and is deleted otherwise.

    An existing target is replaced only if it is empty or `may_replace(target)` is true. Until the block ends, nothing
    else can write to `target`. What killed processes left there is put back or removed. Raises InputError: the folder
    cannot be made, another process writes to it, or `target` holds something that must not be deleted; RunError: the
    disk is full.
    """
    check_output_folder(target, may_replace)
    place = _place_of(target)
    with contextlib.ExitStack() as stack:
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            if stack.enter_context(folder_lock(place, str(target))):
                recover(place)
            check_output_folder(target, may_replace)
            work = stack.enter_context(part_folder(place))
        except OSError as error:
            raise InputError(f"{target}: the folder cannot be made: {error.strerror}; choose another --out") from None
        try:
            yield work
            replace_folder(work, place)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            what = f"{target}: expected room for the results, found a full disk; free some, or choose another --out"
            raise RunError(what) from None


@contextmanager
def replacement_within(target: Path) -> Iterator[Path]:
    """As `atomic_folder`, for its holder: replaces `target` before the end of the work. Raises OSError."""
    place = _place_of(target)
    with part_folder(place) as work:
        yield work
        replace_folder(work, place)


def _place_of(target: Path) -> Path:
    """The absolute path of a folder, without links: its name and the folder in which it is replaced."""
    return Path(os.path.realpath(target))


def keep_good_results(target: Path, failed: bool, good: str) -> Path:
    """The folder for results: `target`, or `target-failed` where they failed and `target` holds the file `good`."""
    target = Path(target)
    return target.with_name(f"{target.name}-failed") if failed and (target / good).is_file() else target
