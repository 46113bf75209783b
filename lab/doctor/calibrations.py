"""Checks of calibration files: verdict, age and expiry."""

from __future__ import annotations

import datetime
from pathlib import Path

from lab.doctor.lines import Line, State
from lab.errors import CalibrationError, InputError
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.camera_file import load_camera
from lab.files.rig.rig_file import load_rig_file
from lab.files.rig.screens_file import load_screens
from lab.files.run.run_file import load_run
from lab.files.text.yaml_text import read_mapping

EXPIRES_SOON = 14  # days before the expiry from which to warn
OLD = 365  # days after which a calibration without an expiry date is reported
_AGAIN = "Confirm it with `beampose calibrate check`, or calibrate again (`beampose calibrate rig`)"


def check_calibration(path: Path, today: datetime.date) -> Line:
    """The calibration of a rig.yaml, camera.yaml or screens.yaml, or of the rig of a run folder."""
    try:
        state = _state_of(Path(path))
    except InputError as error:
        text = str(error).splitlines()[0]
        remedy = "Correct the file: `beampose check` names all its mistakes"
        return Line("BP-D10", State.FAIL, f"calibration: {text}", remedy, InputError.exit_status)
    return _line(path, state, today)


def _state_of(path: Path) -> CalibrationState | None:
    """None: the file states no date or no verdict."""
    if path.is_dir() or path.name == "run.yaml":
        return load_run(path).calibration
    schema = str(read_mapping(path).get("schema", ""))
    if schema.startswith("beampose/camera/"):
        return _state_of_camera(path)
    return load_screens(path).calibration if schema.startswith("beampose/screens/") else load_rig_file(path).calibration


def _state_of_camera(path: Path) -> CalibrationState | None:
    known = load_camera(path).calibration
    if known is None or not known.date:
        return None
    try:
        date = datetime.datetime.fromisoformat(known.date).date()
        until = datetime.datetime.fromisoformat(known.valid_until).date() if known.valid_until else None
    except ValueError:
        raise InputError(
            f"{path}: calibration: expected dates such as 2026-03-14, got {known.date!r}, {known.valid_until!r}"
        ) from None
    return CalibrationState(date, known.verdict or "PASS", until, known.reasons)


def _line(path: Path, state: CalibrationState | None, today: datetime.date) -> Line:
    if state is None:
        return Line("BP-D09", State.WARN, f"calibration: {path} states no date of calibration", _AGAIN)
    days = (today - state.date).days
    text = f"calibration: {path}: {state.verdict}, {days} days old"
    failed = CalibrationError.exit_status
    if state.verdict == "FAIL":
        why = f" ({state.reasons[0]})" if state.reasons else ""
        return Line("BP-D09", State.FAIL, text + why, "Correct the cause and calibrate again", failed)
    if days < 0:
        remedy = "Check the clock of this computer and the date in the file"
        return Line("BP-D09", State.WARN, f"calibration: {path}: its date {state.date} is in the future", remedy)
    if state.valid_until is None:
        if days > OLD:
            return Line("BP-D09", State.WARN, f"{text}, without an expiry date", _AGAIN)
        text += ", without an expiry date"
    else:
        left = (state.valid_until - today).days
        if left < 0:
            return Line("BP-D09", State.FAIL, f"{text}, expired on {state.valid_until}", _AGAIN, failed)
        text += f", valid until {state.valid_until}"
        if left <= EXPIRES_SOON:
            return Line("BP-D09", State.WARN, f"{text}, in {left} days", _AGAIN)
    if state.verdict != "PASS":
        why = f" ({state.reasons[0]})" if state.reasons else ""
        return Line("BP-D09", State.WARN, text + why, "Read the report beside the file before using it")
    return Line("BP-D09", State.OK, text)
