"""Fingerprints of the inputs of a run, recorded with its results."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from lab.files.run.run_file import FramesFolder, LiveDevice, Run

MAX_HASHED_BYTES = 64 * 2**20  # bytes: of a larger file (a video), only this many bytes and the size are used
_BLOCK = 2**20


def fingerprints(run: Run) -> list[dict[str, Any]]:
    """Path, SHA-256 and size of every input.

    A folder of pictures has one entry, with a digest of the names and sizes of its files: reading gigabytes a second
    time would take too long. `covers` describes what each digest covers.
    """
    files = [run.path, run.rig_path]
    if run.times_path is not None:
        files.append(run.times_path)
    out = [_of_file(f) for f in files]
    done: set[Path] = set()
    for source in run.cameras.values():
        if isinstance(source, LiveDevice) or source.path in done:
            continue
        done.add(source.path)
        out.append(_of_folder(source.path) if isinstance(source, FramesFolder) else _of_file(source.path))
    return out


def _of_file(path: Path) -> dict[str, Any]:
    size = path.stat().st_size
    digest = hashlib.sha256()
    left = min(size, MAX_HASHED_BYTES)
    with path.open("rb") as file:
        while left > 0 and (block := file.read(min(_BLOCK, left))):
            digest.update(block)
            left -= len(block)
    covers = "contents" if size <= MAX_HASHED_BYTES else f"the first {MAX_HASHED_BYTES} bytes"
    return {"path": str(path), "sha256": digest.hexdigest(), "bytes": size, "covers": covers}


def _of_folder(path: Path) -> dict[str, Any]:
    digest = hashlib.sha256()
    total = 0
    for file in sorted(p for p in path.iterdir() if p.is_file()):
        size = file.stat().st_size
        total += size
        digest.update(f"{file.name}\0{size}\n".encode())
    return {"path": str(path), "sha256": digest.hexdigest(), "bytes": total, "covers": "names and sizes"}
