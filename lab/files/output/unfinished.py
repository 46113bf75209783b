"""Paths that this process removes when it stops: parts of results that are not complete, and lock files."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_unfinished: dict[Path, int] = {}  # and the process that made it: a forked process must not remove it


@contextmanager
def removed_at_the_end(path: Path) -> Iterator[None]:
    """Removes a file or folder, if it is still there, when the block ends in any way but a kill."""
    _unfinished[path] = os.getpid()
    try:
        yield
    finally:
        try:
            _remove_own(path)
        except BaseException:  # a signal in the middle of it
            _remove_own(path)
            raise
        _unfinished.pop(path, None)


def remove_unfinished() -> None:
    """Remove all such paths of this process. For a process that ends without unwinding its blocks."""
    for _ in range(3):  # other threads may still write into the folders
        for path in list(_unfinished):
            _remove_own(path)


def _remove_own(path: Path) -> None:
    if _unfinished.get(path) == os.getpid():
        remove(path)


def remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it, as far as possible. Never raises OSError."""
    with contextlib.suppress(OSError):
        if path.is_symlink() or not path.is_dir():
            path.unlink(missing_ok=True)
        else:
            shutil.rmtree(path, ignore_errors=True)
