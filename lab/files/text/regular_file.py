"""Refuses named pipes and devices as files: reading them can wait for ever, or never end."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from lab.errors import InputError

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_regular_file(path: Path) -> None:
    """Raises InputError for a named pipe, a socket or a device. Missing files and folders are left to the reader.

    The pipes of a shell, such as `<(zcat survey.csv.gz)`, have no name on disk and are accepted.
    """
    try:
        mode = Path(os.path.realpath(path)).lstat().st_mode
    except (OSError, ValueError):
        return
    for is_kind, words in _KINDS:
        if is_kind(mode):
            raise InputError(f"{path}: expected a file, found {words}; write its content to a file")


def text_of_file(path: Path, encoding: str = "utf-8", errors: str = "strict") -> str:
    """The text of a file.

    Raises:
        InputError: it is a named pipe, a socket or a device.
        OSError: it cannot be read.
        ValueError: it has another encoding.
    """
    require_regular_file(path)
    return path.read_text(encoding, errors)


def bytes_of_file(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        InputError: it is a named pipe, a socket or a device.
        OSError: it cannot be read.
    """
    require_regular_file(path)
    return path.read_bytes()
