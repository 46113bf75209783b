"""Settings for the tests of the lab."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def with_page() -> None:
    """The report is drawn, in a folder whose other tests go without (`undrawn`)."""


@pytest.fixture(autouse=True)
def undrawn(request: pytest.FixtureRequest, fast: bool) -> None:
    """No report of a fast test in these folders: drawing it takes a third of the time of a short run.

    `make test-all` draws all.
    """
    folder = request.path.relative_to(Path(__file__).parent).parts[0]
    if fast and folder in ("runs", "setup_check") and "with_page" not in request.fixturenames:
        from lab.report.run import page

        monkeypatch = request.getfixturevalue("monkeypatch")
        monkeypatch.setattr(page, "write_report", lambda folder, *_: (folder / "report.html").write_text(""))
