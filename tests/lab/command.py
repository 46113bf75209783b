"""The program, as a user types it, in the process of a test."""

from __future__ import annotations

from typing import Any

from click.testing import CliRunner, Result

from cli import main


def typed(*arguments: object, **options: Any) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], prog_name="beampose", **options)
