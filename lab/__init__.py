"""The files, commands and reports of the program: from a run folder to tables and reports.

For Python and notebooks (docs/python.md): `lab.load`, `lab.process`, `lab.simulate_run`, `lab.find_spots`, `lab.track`,
`lab.Tracker`, and the errors that they raise. They are imported when they are first used: `import lab` loads nothing.
"""

from __future__ import annotations

import importlib

# Types of these names are in __init__.pyi.
_PLACES = {
    "load": "lab.api.results",
    "Results": "lab.api.results",
    "AnnotatedPicture": "lab.api.results",
    "export": "lab.results.export",
    "process": "lab.api.results",
    "simulate_run": "lab.simulate.write",
    "scenarios": "lab.api.results",
    "find_spots": "lab.api.tracking",
    "track": "lab.api.tracking",
    "Tracker": "lab.api.tracking",
    "BeamposeError": "lab.errors",
    "InputError": "lab.errors",
    "RunError": "lab.errors",
    "CalibrationError": "lab.errors",
}
__all__ = tuple(_PLACES)


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
