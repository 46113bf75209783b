"""The runs of a batch: folders, patterns and lists in files, and the part of them that one shard processes."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lab.errors import InputError
from lab.files.text.regular_file import bytes_of_file


def listed_runs(given: Sequence[str | os.PathLike[str]], lists: Sequence[str | os.PathLike[str]] = ()) -> list[Path]:
    """Run folders of the command line, in order.

    given: folders, patterns such as `data/*/run-*` (`**`: folders at any depth), or `@FILE`. lists: files of runs; `-`
    is standard input. A file names a folder or pattern per line; blank lines and lines with # at the start are
    ignored; paths start at the current folder. A folder that several patterns or lists find is processed once.

    Raises:
        InputError: a folder is given more than once by name, a pattern finds no run, a list cannot be read.
    """
    out: dict[str, Path] = {}
    named: set[str] = set()
    for text in (os.fspath(g) for g in given):
        is_list = text.startswith("@") and len(text) > 1 and not os.path.exists(text)
        for folder in _of_file(text[1:]) if is_list else _of_argument(text):
            place = os.path.realpath(folder)
            by_name = not is_list and str(folder) == str(Path(text))
            if by_name and place in named:
                raise InputError(f"batch: the run folder {text} is given more than once")
            if by_name:
                named.add(place)
            out.setdefault(place, folder)
    for text in (os.fspath(g) for g in lists):
        for folder in _of_file(text):
            out.setdefault(os.path.realpath(folder), folder)
    if not out:
        raise InputError("batch: expected one or more run folders, got none")
    return list(out.values())


def _of_file(path: str) -> Iterator[Path]:
    try:
        data = sys.stdin.buffer.read() if path == "-" else bytes_of_file(Path(path))
    except OSError as error:
        raise InputError(f"{path}: expected a text file with a run folder per line: {error.strerror}") from None
    for number, line in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        text = os.fsdecode(line).strip()
        if "\0" in text:
            raise InputError(f"{path}: line {number}: expected a run folder, got a line with a null byte")
        if text and not text.startswith("#"):
            yield from _of_argument(text)


def _of_argument(text: str) -> list[Path]:
    """The folder, or the run folders that a pattern finds, sorted."""
    if not glob.has_magic(text) or os.path.lexists(text):
        return [Path(text)]
    found = [Path(p) for p in sorted(glob.glob(text, recursive=True)) if os.path.isfile(os.path.join(p, "run.yaml"))]
    if not found:
        raise InputError(f"batch: {text}: no folder with a run.yaml matches this pattern")
    return found


def shard_of(text: str) -> tuple[int, int]:
    """`2/5` as (2, 5): the second of five parts. Raises InputError."""
    number, slash, count = text.partition("/")
    if not (slash and number.isascii() and number.isdigit() and count.isascii() and count.isdigit()):
        raise InputError(f"--shard: expected I/N, such as 2/5 for the second of five parts, got {text!r}")
    if len(count) > 9 or not 1 <= int(number) <= int(count):
        raise InputError(f"--shard: expected I/N with I from 1 to N, got {text!r}")
    return int(number), int(count)
