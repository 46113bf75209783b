"""A result folder that is complete or absent: written beside its place and renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.errors import InputError


@contextmanager
def whole_folder(target: Path, may_replace: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields an empty folder beside `target`, which takes its place when the block ends well, and vanishes when not.

    An existing target is replaced only if it is empty or `may_replace` says so of it. Raises InputError otherwise:
    a folder with something else in it is never deleted.
    """
    target = Path(target)
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder for the results, found a file; choose another --out")
    if target.is_dir() and any(target.iterdir()) and not may_replace(target):
        raise InputError(f"{target}: the folder holds something other than earlier results; choose another --out")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = target.parent / f".{target.name}.part-{os.getpid()}"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
    except OSError as error:
        raise InputError(f"{target}: the folder cannot be made: {error.strerror}") from None
    try:
        yield work
        _replace(work, target)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def _replace(work: Path, target: Path) -> None:
    """Rename, with the old results out of the way only for the moment between two renames."""
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
