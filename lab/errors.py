"""What can go wrong, with the exit status that it means. cli.py turns these into one or two plain lines."""

from __future__ import annotations


class BeamposeError(Exception):
    """An error that the user can act on. The message names the thing, what was expected, what was found, what to do."""

    exit_status = 1


class RunError(BeamposeError):
    """A run could not be processed."""

    exit_status = 1


class InputError(BeamposeError):
    """The command, a file or a configuration is wrong."""

    exit_status = 2


class CalibrationError(BeamposeError):
    """The calibration is unusable or out of date."""

    exit_status = 3


QUALITY_GATE_FAILED = 4  # processed, but a quality gate failed: a verdict, not an exception
