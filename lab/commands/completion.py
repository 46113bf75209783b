"""Words that the shell completes (docs/shell_completion.md): scenarios, rigs and codes."""

from __future__ import annotations

import click


def scenarios(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Scenarios of `simulate` that begin with `begun`."""
    from lab.simulate.scenarios import SCENARIOS

    return [name for name in ("list", *SCENARIOS) if name.startswith(begun)]


def rigs(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Rigs of `calibrate simulate` that begin with `begun`."""
    from lab.simulate.rigs import RIGS

    return [name for name in RIGS if name.startswith(begun)]


def codes(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Codes of `explain` that begin with `begun`, in any case."""
    from lab.explain.catalogue import EXPLANATIONS

    return [code for code in EXPLANATIONS if code.startswith(begun.upper())]
