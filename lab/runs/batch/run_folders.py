"""The runs of a batch and their result folders."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.json_text import read_json
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


# The result folder of every run of a batch. It stays the same in later batches into the same folder.


FILE_NAME = ".batch-folders.json"
SCHEMA = "beampose/batch-folders/1"
RESERVED = ("batch.csv", "index.html", "errors", "parquet")  # names in the batch's folder that no run may have


def displayed(path: str | os.PathLike[str]) -> str:
    """A path as printable UTF-8 text; other bytes and control characters as `\\xe9`."""
    text = os.fsencode(path).decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def allotted(out: Path, folders: Sequence[Path], resumable: Mapping[str, str]) -> list[str]:
    """The name of the result folder in `out` for each run folder; recorded in `out`. To be called under the lock.

    It is the name of the run folder, with that of its parent where two runs of the batch have one name, and with a
    digest of its place where another run has that name already. A run that has a result folder keeps it. resumable:
    result folders by run folder, of runs that have been moved: the run takes over the results.

    Raises:
        InputError: the record is damaged or cannot be written.
    """
    record = _read(out / FILE_NAME)
    owners = {name.casefold(): place for place, name in record.items()}
    places = [displayed(os.path.realpath(f)) for f in folders]
    simple = [_simple(p) for p in folders]
    names = []
    for place, folder, name in zip(places, folders, simple, strict=True):
        if place not in record and place in resumable:
            taken = resumable[place]
            record = {p: n for p, n in record.items() if n != taken}
            record[place], owners[taken.casefold()] = taken, place
        if place not in record:
            parent = _simple(Path(os.path.realpath(folder)).parent)
            digest = hashlib.sha256(place.encode()).hexdigest()[:8]
            choices = [f"{parent}-{name}", f"{name}-{digest}", f"{name}-{digest}-2"]
            if simple.count(name) == 1:
                choices.insert(0, name)
            record[place] = next(c for c in choices if c.casefold() not in owners and c not in RESERVED)
            owners[record[place].casefold()] = place
        names.append(record[place])
    atomic_write_text(json.dumps({"schema": SCHEMA, "folders": record}, indent=1) + "\n", out / FILE_NAME)
    return names


def moved_runs(out: Path, folders: Sequence[Path]) -> dict[str, tuple[Path, str]]:
    """Runs without a result folder, where one of the same name belongs to a run folder that is gone.

    Returns the run folder and the name of the results, by place.
    """
    record = _read(out / FILE_NAME)
    gone = {name: place for place, name in record.items() if not os.path.isdir(place)}
    found = {}
    for folder in folders:
        place, name = displayed(os.path.realpath(folder)), _simple(folder)
        if place not in record and name in gone:
            found[place] = (folder, name)
    return found


def _simple(folder: Path) -> str:
    """The folder's own name, such that every file system and table can hold it."""
    name = os.fsencode(os.path.basename(os.path.realpath(folder))).decode("utf-8", "replace").replace("\ufffd", "_")
    return "".join(c if c.isprintable() else "_" for c in name) or "run"


def _read(path: Path) -> dict[str, str]:
    try:
        content = read_json(path)
        folders = content["folders"]
        if content["schema"] != SCHEMA or not all(isinstance(v, str) for v in folders.values()):
            raise ValueError
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path}: expected the result folders of a batch, found another file; delete it") from None
    return dict(folders)
