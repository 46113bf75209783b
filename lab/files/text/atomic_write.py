"""A result folder that is complete or absent: written beside its place and renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.errors import InputError


def refuse_foreign(target: Path, may_replace: Callable[[Path], bool]) -> None:
    """Raises InputError where no results could go to `target`; nothing is made.

    For the beginning of what takes long: a mistake in --out then shows before the work and not after it.
    """
    target = Path(target)
    if target.is_symlink() and not target.exists():
        raise InputError(f"{target}: expected a folder for the results, found a broken link; choose another --out")
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder for the results, found a file; choose another --out")
    above = next(p for p in (target, *target.absolute().parents) if p.exists())
    if not above.is_dir():
        raise InputError(f"{target}: the folder cannot be made: {above} is a file; choose another --out")
    # An existing target is replaced by a rename, for which its parent must allow writing.
    place = target.absolute().parent if above == target else above
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(
            f"{target}: the folder cannot be made: {place} may not be written to; choose another --out, or ask for the"
            " right to write there"
        )
    if target.is_dir() and any(target.iterdir()) and not may_replace(target):
        raise InputError(f"{target}: the folder holds something other than earlier results; choose another --out")


@contextmanager
def atomic_folder(target: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields an empty folder beside `target`, which takes its place when the block ends well, and vanishes when not.

    An existing target is replaced only if it is empty or `may_replace` says so of it. Raises InputError otherwise:
    a folder with something else in it is never deleted.
    """
    target = Path(target)
    refuse_foreign(target, may_replace)
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
    """Rename, with an old target out of the way only for the moment between two renames, and then deleted."""
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


def beside_a_good_one(target: Path, failed: bool, good: str) -> Path:
    """Where results go: `target`, or `target-failed` where they failed and `target` holds good ones (a file `good`)."""
    target = Path(target)
    return target.with_name(f"{target.name}-failed") if failed and (target / good).is_file() else target
