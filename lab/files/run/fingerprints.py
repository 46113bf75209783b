"""Fingerprints of the inputs of a run, recorded with its results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from lab.files.run.run_file import LiveDevice, Run

MAX_HASHED_BYTES = 64 * 2**20  # bytes: larger files (videos) are sampled: this many bytes and the size
MAX_PICTURE_BYTES = 64 * 2**10  # bytes: larger pictures of a folder are sampled in the same way
_SAMPLES = 16  # blocks of a sampled file, evenly spaced from its first byte to its last
_BLOCK = 2**20


def fingerprints(run: Run, full: bool = False) -> list[dict[str, Any]]:
    """Path, SHA-256 and size of every input, the tables of the truth included.

    A folder of pictures has one entry, with a digest of the names, sizes and contents of its files. Reading gigabytes a
    second time takes too long, therefore large files are sampled unless `full`. `covers` describes what each digest
    covers. Raises OSError: a file cannot be read.
    """
    files = [run.path, run.rig_path, *run.times_paths]
    files += [p for p in (run.folder / "truth" / name for name in ("pose.csv", "spots.csv")) if p.is_file()]
    sources = [s.path for s in run.cameras.values() if not isinstance(s, LiveDevice)]
    return fingerprints_of(files, sources, full)


def fingerprints_of(files: Iterable[Path], sources: Iterable[Path], full: bool = False) -> list[dict[str, Any]]:
    """Path, SHA-256 and size of files and of sources, each a file or a folder of pictures; each path once.

    Raises OSError: a file cannot be read.
    """
    paths = dict.fromkeys((*files, *sources))
    return [_of_folder(p, full) if p.is_dir() else _of_file(p, full) for p in paths]


def _of_file(path: Path, full: bool) -> dict[str, Any]:
    size = path.stat().st_size
    digest = hashlib.sha256()
    with path.open("rb") as file:
        sampled = _read_into(digest, file, size, size if full else MAX_HASHED_BYTES)
    covers = f"{_SAMPLES} samples, {MAX_HASHED_BYTES} bytes in all" if sampled else "contents"
    return {"path": str(path), "sha256": digest.hexdigest(), "bytes": size, "covers": covers}


def _of_folder(path: Path, full: bool) -> dict[str, Any]:
    digest = hashlib.sha256()
    total, any_sampled = 0, False
    for file in sorted(p for p in path.iterdir() if p.is_file()):
        size = file.stat().st_size
        total += size
        digest.update(file.name.encode("utf-8", "surrogateescape") + f"\0{size}\n".encode())
        with file.open("rb") as content:
            any_sampled |= _read_into(digest, content, size, size if full else MAX_PICTURE_BYTES)
    covers = "names, sizes and samples of the contents" if any_sampled else "names, sizes and contents"
    return {"path": str(path), "sha256": digest.hexdigest(), "bytes": total, "covers": covers}


def _read_into(digest: Any, file: BinaryIO | Any, size: int, most: int) -> bool:
    """Add a file's bytes to a digest: all of them up to `most`, else evenly spaced samples. Returns whether sampled."""
    if size <= most:
        while block := file.read(_BLOCK):
            digest.update(block)
        return False
    length = max(most // _SAMPLES, 1)
    for i in range(_SAMPLES):
        file.seek((size - length) * i // (_SAMPLES - 1))
        digest.update(file.read(length))
    return True
