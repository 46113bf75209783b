"""Damage to files: to bytes of any file, to values of YAML files, to cells of tables, and to the path itself."""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from bench.fuzz.hostile import CSV_FIELDS, YAML_TEXTS, some_bytes

_VALUE = re.compile(r"(?<=: )[^\s\[\]{},][^,\]}\n]*|(?<=[\[,] )[^\s\[\]{},][^,\]}\n]*|\[[^\[\]\n]*\]")
_KEY = re.compile(r"[\w.'\"+-]+(?=:(?:\s|$))", re.MULTILINE)


def damage_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to four random edits of bytes."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        span = min(len(data) - at, int(2 ** rng.uniform(0, 10)))
        kind = rng.randrange(7)
        if kind == 0 and at < len(data):
            data = data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + data[at + span :]
        elif kind == 2:
            data = data[:at] + data[at : at + span] * 2 + data[at + span :]
        elif kind == 3:
            data = data[:at] + some_bytes(rng) + data[at:]
        elif kind == 4:
            data = data[:at]
        elif kind == 5:
            data = data[:at] + some_bytes(rng) + data[at + span :]
        else:
            data = data[:at] + rng.randbytes(span) + data[at + span :]
    return data


def damage_yaml(data: bytes, rng: random.Random) -> bytes:
    """One or two values, keys or lines replaced, doubled or removed."""
    text = data.decode("utf-8")
    for _ in range(rng.choice((1, 1, 1, 2))):
        kind = rng.randrange(8)
        places = list((_KEY if kind == 5 else _VALUE).finditer(text))
        if kind <= 5 and places:
            found = rng.choice(places)
            new = rng.choice(YAML_TEXTS)
            if kind in (3, 4):
                new = _scaled(found[0], rng)
            text = text[: found.start()] + new + text[found.end() :]
            continue
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        lines[at : at + 1] = [lines[at]] * 2 if kind == 6 else []
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass")


def _scaled(text: str, rng: random.Random) -> str:
    """The first number of a text times a factor; a list may lose or gain an element."""
    if text.startswith("[") and rng.random() < 0.3:
        return text.replace("[", "[1, ", 1) if rng.random() < 0.5 else re.sub(r"\[[^,]*, ", "[", text, count=1)
    factor = rng.choice((-1.0, 0.0, 1e-3, 1e3, 1e6, 1e-6, 1e9, 1e12, 1e14, 1e-14))
    return re.sub(r"-?\d[\d.]*(e[-+]?\d+)?", lambda m: repr(float(m[0]) * factor), text, count=1)


def damage_table(data: bytes, rng: random.Random) -> bytes:
    """Some cells, rows or columns of a CSV table changed."""
    rows = [line.split(",") for line in data.decode("utf-8").splitlines()]
    for _ in range(rng.choice((1, 1, 3))):
        at = rng.randrange(len(rows))
        row = rows[at]
        cell = rng.randrange(len(row)) if row else 0
        kind = rng.randrange(9)
        if kind <= 3 and row:
            row[cell] = rng.choice(CSV_FIELDS)
        elif kind == 4:
            rows.insert(at, list(row))
        elif kind == 5 and len(rows) > 1:
            del rows[at]
        elif kind == 6:
            del row[cell:]
        elif kind == 7:
            row += [""] * rng.choice((1, 3)) + ["1"]
        elif kind == 8:
            column = rng.randrange(len(rows[0])) if rows[0] else 0
            for other in rows:
                other[column : column + 1] = rng.choice(([], [rng.choice(CSV_FIELDS)])) if rng.random() < 0.9 else []
    text = rng.choice(("\n", "\n", "\n", "\r\n", "\r")).join(",".join(row) for row in rows) + rng.choice(("\n", ""))
    return text.encode("utf-8")


def damage_path(path: Path, rng: random.Random) -> None:
    """The file replaced by nothing, an empty file, a folder, a pipe, a broken link or a link to itself."""
    kind = rng.randrange(6)
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    if kind == 1:
        path.write_bytes(b"")
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        os.mkfifo(path)
    elif kind == 4:
        path.symlink_to("nowhere")
    elif kind == 5:
        path.symlink_to(path.name)


def damage_file(path: Path, rng: random.Random) -> None:
    """Damage a file by its type, sometimes as bytes of no type, rarely its path."""
    by_type: dict[str, Callable[[bytes, random.Random], bytes]] = {
        ".yaml": damage_yaml,
        ".yml": damage_yaml,
        ".csv": damage_table,
    }
    chosen = rng.random()
    if chosen < 0.04:
        damage_path(path, rng)
        return
    damage = damage_bytes if chosen < 0.25 else by_type.get(path.suffix, damage_bytes)
    path.write_bytes(damage(path.read_bytes(), rng))
