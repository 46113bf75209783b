"""One writer per output folder: a locked file beside the folder.

The system releases the lock when its process ends in any way. So the holder knows that every part of results beside the
folder is left from a process that no longer runs, on this machine or in another container or machine that shares the
volume, without comparing process ids. `flock` is used directly: the library filelock leaves its file behind.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.errors import InputError
from lab.files.output.part_folder import removed_at_the_end

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


class FolderInUseError(InputError):
    """Another process writes to the output folder. Its end may be waited for."""


class LockedError(Exception):
    """Another process holds the lock. The message names it."""


@contextmanager
def folder_lock(target: Path, name: str) -> Iterator[bool]:
    """Holds the lock of the output folder `target`, an absolute path, during the block.

    name: the folder as the user wrote it. Its parent must exist. Yields whether the lock is held: False where the file
    system has no locks.

    Raises:
        FolderInUseError: another process writes to this folder.
        OSError: the file of the lock cannot be made.
    """
    path = target.parent / f".{target.name}.beampose-lock"
    try:
        file, held = _locked_file(path)
    except LockedError as error:
        raise FolderInUseError(
            f"{name}: expected a folder that nothing else writes to, found one in use{error}; wait for its end, or"
            " choose another --out"
        ) from None
    try:
        if not held:
            yield False
            return
        with removed_at_the_end(path):  # before the unlocking: the next one must not lock a file that is then removed
            with contextlib.suppress(OSError):
                os.ftruncate(file, 0)
                os.write(file, _owner().encode())
            yield True
    finally:
        _unlock(file)


def _locked_file(path: Path) -> tuple[int, bool]:
    """A lock file, opened, and whether it is locked. Raises LockedError, OSError."""
    while True:
        file = _open(path)
        try:
            held = lock(file)
        except BlockingIOError:
            owner = _read_owner(file)
            os.close(file)
            raise LockedError(owner) from None
        if not held or is_at(file, path):
            return file, held
        os.close(file)  # its holder has removed it: not the file that others will find


def _unlock(file: int) -> None:
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough while a forked process has it open
    os.close(file)


def lock(file: int) -> bool:
    """Lock an open file, until it is closed. False: not possible here. Raises BlockingIOError: locked by another."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return False
    return True


def is_at(file: int, path: Path) -> bool:
    """Whether an open file is the one at this path."""
    try:
        return os.path.samestat(os.fstat(file), path.lstat())
    except OSError:
        return False


def _open(path: Path) -> int:
    no_links = getattr(os, "O_NOFOLLOW", 0)
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | no_links, 0o666)
    except PermissionError:  # left by a killed process of another user
        return os.open(path, os.O_RDONLY | no_links)


def _owner() -> str:
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    return f"process {os.getpid()} on {platform.node()} since {now}"


def _read_owner(file: int) -> str:
    try:
        os.lseek(file, 0, os.SEEK_SET)
        text = os.read(file, 200).decode("utf-8", errors="replace")
    except OSError:
        return ""
    text = "".join(c for c in text if c.isprintable())
    return f" by {text}" if text else ""
