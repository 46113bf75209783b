"""All codes with their explanations. Codes are stable: a text may change, a code keeps its meaning."""

from __future__ import annotations

import re

from lab.errors import InputError
from lab.explain import calibrations, circles, drogues, lenses, program, runs, stereo, tracks
from lab.explain.explanation import Explanations, as_text
from lab.files.text.error_text import suggest_name

SECTIONS: dict[str, Explanations] = {
    "Verdict of a run": runs.VERDICT,
    "Model check of a run": runs.MODEL_CHECK,
    "Track of one target": tracks.POINT,
    "Errors": program.ERRORS,
    "Installation (`beampose doctor`)": program.DOCTOR,
    "Inputs of a calibration": calibrations.INPUTS,
    "Lens of a camera": lenses.LENSES,
    "Cameras and screens": calibrations.SCREENS,
    "Beams": calibrations.BEAMS,
    "Joint calibration of the rig": calibrations.RIG,
    "Drift check of a calibration": calibrations.DRIFT,
    "Plan of a rig": program.PLAN,
    "Stereo pose (`beampose stereo`)": stereo.STEREO,
    "Calibration of a stereo pair": stereo.PAIR,
    "Tracked circle": circles.CIRCLES,
    "Tracked drogue (`beampose track drogue`)": drogues.DROGUES,
}
EXPLANATIONS: Explanations = {code: text for section in SECTIONS.values() for code, text in section.items()}


def explain(code: str) -> str:
    """The explanation of a code, as lines; `V03`, `v3` and `bp-v03` are read as BP-V03.

    Raises:
        InputError: there is no such code.
    """
    name = code.strip().upper()
    name = name if name.startswith("BP-") else f"BP-{name}"
    if parts := re.fullmatch(r"BP-([A-Z])(\d)", name):
        name = f"BP-{parts[1]}0{parts[2]}"
    if name not in EXPLANATIONS:
        near = suggest_name(name, EXPLANATIONS)
        hint = near if "did you mean" in near else ""
        raise InputError(f"expected a code such as BP-V03, got {code!r}{hint}; `beampose explain` lists all codes")
    return as_text(name, EXPLANATIONS[name])


def listed() -> list[str]:
    """A line for each code, under the title of its section."""
    lines: list[str] = []
    for title, section in SECTIONS.items():
        lines += ["", title] if lines else [title]
        lines += [f"  {code}  {text.title}" for code, text in section.items()]
    return lines
