"""The errors of the program and their exit statuses. The command line prints them as one or two plain lines."""

from __future__ import annotations


class BeamposeError(Exception):
    """An error that the user can correct. The message names the object, what was expected and found, and the remedy."""

    exit_status = 1
    code = "BP-E01"  # `beampose explain CODE`


class RunError(BeamposeError):
    """A run could not be processed."""

    exit_status = 1
    code = "BP-E01"


class InputError(BeamposeError):
    """The command, a file or a configuration is wrong."""

    exit_status = 2
    code = "BP-E02"


class CalibrationError(BeamposeError):
    """The calibration is unusable or out of date."""

    exit_status = 3
    code = "BP-E03"


QUALITY_GATE_FAILED = 4  # processed, but a quality gate failed; not an exception
