"""Compiled templates kept on disk: to compile those of one report takes 0.05 s."""

from __future__ import annotations

import contextlib
from importlib import metadata
from pathlib import Path

import jinja2
from jinja2.bccache import Bucket

from geometry.compilation.compile_cache import private_folder


class _TemplateCache(jinja2.FileSystemBytecodeCache):
    """Jinja's cache, for which a file that cannot be read or written is a missing one."""

    def load_bytecode(self, bucket: Bucket) -> None:
        try:
            super().load_bytecode(bucket)
        except Exception:  # unpickling a truncated file raises almost anything
            bucket.reset()

    def dump_bytecode(self, bucket: Bucket) -> None:
        with contextlib.suppress(OSError):  # for instance a full disk
            super().dump_bytecode(bucket)


def template_cache(sources: tuple[Path, ...]) -> jinja2.BytecodeCache | None:
    """Where templates are kept that were compiled from these files; None where no folder can be written safely."""
    folder = private_folder(sources)
    if folder is None:
        return None
    return _TemplateCache(str(folder), f"%s-{metadata.version('jinja2')}.template")
