"""Atomic writing: a result folder or a file is either complete or as it was before."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.errors import InputError

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
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        remedy = next((text for kind, text in _REMEDIES.items() if isinstance(error, kind)), "")
        raise InputError(f"{path}: cannot be written: {error.strerror}{remedy}") from None


def check_output_folder(target: Path, may_replace: Callable[[Path], bool]) -> None:
    """Raises InputError where results cannot be written to the folder `target`. Creates nothing.

    To be called before long work, so that a mistake in --out is reported before the work and not after it.
    """
    target = Path(target)
    if target.is_symlink() and not target.exists():
        raise InputError(f"{target}: expected a folder for the results, found a broken link; choose another --out")
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder for the results, found a file; choose another --out")
    above = next(p for p in (target, *target.absolute().parents) if p.exists())
    if not above.is_dir():
        raise InputError(f"{target}: the folder cannot be made: {above} is a file; choose another --out")
    # An existing target is replaced by a rename, which needs write permission in its parent.
    place = target.absolute().parent if above == target else above
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(
            f"{target}: the folder cannot be made: no write permission in {place}; choose another --out, or request"
            " write permission there"
        )
    if target.is_dir() and any(target.iterdir()) and not may_replace(target):
        raise InputError(f"{target}: the folder holds something other than earlier results; choose another --out")


@contextmanager
def atomic_folder(target: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields an empty folder beside `target`. It replaces `target` when the block succeeds and is deleted otherwise.

    An existing target is replaced only if it is empty or `may_replace(target)` is true.

    Raises:
        InputError: the folder cannot be made, or `target` holds something that must not be deleted.
    """
    target = Path(target)
    check_output_folder(target, may_replace)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = target.parent / f".{target.name}.part-{os.getpid()}"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
    except OSError as error:
        raise InputError(f"{target}: the folder cannot be made: {error.strerror}; choose another --out") from None
    try:
        yield work
        replace_folder(work, target)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def replace_folder(work: Path, target: Path) -> None:
    """Rename `work` to `target`. An old target is renamed first, restored if the second rename fails, then deleted."""
    if not target.exists():
        work.rename(target)
        return
    old = target.parent / f".{target.name}.old-{os.getpid()}"
    target.rename(old)
    try:
        work.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def keep_good_results(target: Path, failed: bool, good: str) -> Path:
    """The folder for results: `target`, or `target-failed` where they failed and `target` holds the file `good`."""
    target = Path(target)
    return target.with_name(f"{target.name}-failed") if failed and (target / good).is_file() else target
