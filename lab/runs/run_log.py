"""run.log of a result folder: start, stages, messages of the libraries, warnings and end, each with its time (UTC)."""

from __future__ import annotations

import contextlib
import datetime
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lab.files.run.run_file import Run
from lab.files.text.error_text import printable
from lab.findings.finding import Verdict
from lab.progress import Progress

FILE = "run.log"
NAME = "beampose.run"
LOGGER = logging.getLogger(NAME)  # `--verbose` shows its lines while the run is processed
LOGGER.propagate = False
LOGGER.setLevel(logging.INFO)
LOGGER.addHandler(logging.NullHandler())  # otherwise logging prints warnings where nobody listens
_LIBRARIES = logging.getLogger("beampose")


class RunLog(logging.Handler):
    """Collects the lines of one run; `write` saves them. Lines of the libraries below are among them."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: list[str] = []
        self._stage = ""

    def emit(self, record: logging.LogRecord) -> None:
        """A message of a library."""
        self._add(record.levelname, record.getMessage())

    def start(self, run: Run, versions: Mapping[str, str]) -> None:
        """The first lines: what is processed, and with which versions."""
        self.info(f"start: {run.name}, run folder {run.folder.resolve()}, rig {run.rig_path.resolve()}")
        self.info("versions: " + ", ".join(f"{name} {version}" for name, version in versions.items()))

    def info(self, text: str) -> None:
        """A line without a warning."""
        self._add("INFO", text)

    def _add(self, level: str, text: str) -> None:
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        line = printable(f"{now} {level:<7} {' '.join(text.splitlines())}")
        self._lines.append(line)
        LOGGER.log(logging.getLevelNamesMapping().get(level, logging.INFO), line)

    def progress(self, inner: Progress | None) -> Progress:
        """A callback that notes each new stage and passes everything on to `inner`."""

        def noted(done: int, total: int | None, stage: str = "") -> None:
            if stage and stage != self._stage:
                self._stage = stage
                self.info(f"stage: {stage}")
            if inner is not None:
                inner(done, total, stage)

        return noted

    def conclude(self, verdict: Verdict, content: Mapping[str, Any], seconds: float) -> None:
        """The last lines: notes, the reasons of the verdict with their codes, and the end. content: summary.json."""
        for note in content["notes"]:
            self.info(f"note: {note}")
        for reason in content["verdict"]["evidence"]:
            remedy = f" {reason['remedy']}" if reason["remedy"] else ""
            self._add(
                "ERROR" if reason["level"] == "fail" else "WARNING", f"{reason['code']} {reason['what']}.{remedy}"
            )
        self.info(f"end: {verdict.status.upper()}, {seconds:.1f} s, exit status {verdict.exit_status}")

    def write(self, folder: Path) -> None:
        """Write run.log."""
        text = "\n".join([*self._lines, ""])
        (folder / FILE).write_text(text, encoding="utf-8")


@contextlib.contextmanager
def listening() -> Iterator[RunLog]:
    """A log that also gets the messages of the libraries, such as that they compile, until the block ends."""
    log, level = RunLog(), _LIBRARIES.level
    _LIBRARIES.addHandler(log)
    _LIBRARIES.setLevel(logging.INFO)
    try:
        yield log
    finally:
        _LIBRARIES.removeHandler(log)
        _LIBRARIES.setLevel(level)
