"""The page of all tracking parameters, from the fields and comments of tracking/parameters.py."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from calibration.budget import ExpectedErrors
from docs.website.text import cell, code, table
from tracking.parameters import DetectParameters, LabelParameters, TrackerParameters

_CLASSES = (
    ("Tracking", "", TrackerParameters),
    ("Detection", "detect.", DetectParameters),
    ("Labels without a track", "labels.", LabelParameters),
)
# The end of a name states the unit; the longer ends come first.
_UNITS = (
    ("_per_px2", "1/px²"), ("_px_s2", "px/s²"), ("_m_s3", "m/s³ per √Hz"), ("_rad_s3", "rad/s³ per √Hz"),
    ("_rad_s2", "rad/s²"), ("_m_s2", "m/s²"), ("_deg_s", "°/s"), ("_m_s", "m/s"), ("_px", "px"), ("_deg", "°"),
    ("_arcsec", "arcsec"), ("_relative", "share"), ("_m", "m"), ("_s", "s"), ("_dn", "grey levels"),
    ("_sigmas", "sigmas"), ("_sigma", "sigmas"), ("_nats", "nats"),
)  # fmt: skip
_FIELD = re.compile(r"^    (?P<name>\w+): (?P<rest>.*)$")
_HEAD = """# All parameters

Set a parameter in the `tracker` block of `run.yaml`, or for one run with `--set`:

```yaml
tracker:
  method: rigid
  detect: {threshold_sigma: 5}   # the same as detect.threshold_sigma=5
```

```console
$ beampose run sample_runs/sharp-turns --out results/sensitive --set detect.threshold_sigma=5
```

A misspelt name is an error (exit status 2). `summary.json` lists the value of every parameter of a run. The defaults
suit most recordings: change one if the report or the page [Troubleshooting](../troubleshooting.md) gives a reason.

This page is generated from `tracking/parameters.py`.
"""

_EXPECTED = """## Expected calibration errors { #expected-errors }

What `beampose plan` assumes of a rig that is not calibrated yet: standard deviations that a careful calibration
reaches, with the procedure behind each. Errors that rig.yaml states replace them. `--expect NAME=VALUE` sets another
value:

```console
$ beampose plan sample_runs/huo2015/rig.yaml --out plan --expect beam_direction_arcsec=30
```
"""
_COLUMNS = ("parameter", "default", "unit", "meaning")


@dataclasses.dataclass(frozen=True, slots=True)
class Commented:
    """A field of a parameter class with the comments of its source."""

    name: str
    section: str  # the heading above the field, empty before the first one
    meaning: str


def commented_fields(cls: type) -> list[Commented]:
    """The fields of a dataclass with what the comments beside or above them say.

    A comment above a field that has one beside it too, after a blank line, is the heading of the fields below.
    """
    out: list[Commented] = []
    section, above, after_blank = "", "", True
    names = {f.name for f in dataclasses.fields(cls)}
    for statement in _statements(inspect.getsource(cls)):
        match = _FIELD.match(statement[0])
        if match is None or match["name"] not in names:
            text = statement[0].strip()
            if text.startswith("#"):
                above = f"{above} {text.lstrip('# ')}".strip()
            else:
                above, after_blank = "", not text
            continue
        beside = " ".join(line.split("#", 1)[1].strip() for line in statement if "#" in line)
        if above and beside and after_blank:
            section, above = above, ""
        out.append(Commented(match["name"], section, f"{above} {beside}".strip()))
        above, after_blank = "", False
    return out


def _statements(source: str) -> Iterator[list[str]]:
    """The lines of a class, those of a field in several lines together."""
    lines = iter(source.splitlines())
    for line in lines:
        statement = [line]
        while (
            _FIELD.match(line) and sum(s.split("#")[0].count("(") - s.split("#")[0].count(")") for s in statement) > 0
        ):
            statement.append(next(lines))
        yield statement


def unit_of(name: str) -> str:
    """The unit that a parameter's name states, in words for the table."""
    if (name.startswith("p_") and name != "p_norm") or "probability" in name:
        return "probability"
    for end, unit in _UNITS:
        if name.endswith(end):
            return unit
    return ""


def _without_unit(meaning: str) -> str:
    """The meaning without the unit at its beginning, which has a column of its own."""
    return re.sub(
        r"(^|, )(px|s|m|deg|m/s|deg/s|px/s\^2|m/s\^2|rad/s\^2)(?=: )|^(m|rad)/s\^3 per sqrt\(Hz\), ",
        "",
        meaning,
    ).removeprefix(": ")


def _value(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return np.format_float_positional(value, trim="-") if isinstance(value, float) else str(value)


def page() -> str:
    """The page as Markdown."""
    lines = [_HEAD]
    for title, prefix, cls in _CLASSES:
        lines += [f"## {title}", "", cell(" ".join((inspect.getdoc(cls) or "").split())), "", *_tables(cls, prefix)]
    return "\n".join([*lines, _EXPECTED, *_tables(ExpectedErrors, "")])


def _tables(cls: type, prefix: str) -> list[str]:
    """A table of the parameters of a class for each of its sections."""
    defaults = {f.name: f.default for f in dataclasses.fields(cls)}
    lines: list[str] = []
    rows: list[tuple[str, ...]] = []
    section = ""
    for field in commented_fields(cls):
        if defaults[field.name] is dataclasses.MISSING:  # a block of its own
            continue
        if field.section != section:
            lines += table(_COLUMNS, rows) if rows else []
            section, rows = field.section, []
            lines += [f"### {section}", ""]
        meaning = _without_unit(field.meaning)
        name, value = prefix + field.name, defaults[field.name]
        rows.append((code(name), code(_value(value)), unit_of(field.name), cell(meaning)))
    return [*lines, *table(_COLUMNS, rows)]
