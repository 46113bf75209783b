"""Settings for all tests."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable

# Tests start the program hundreds of times: where the caller forbids byte code, each start compiles the sources again.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Before numpy is loaded: on small matrices, the threads of the linear algebra library mostly wait for each other, and
# every test process has its own. One thread instead of two halves the processor time of the calibration's tests. So do
# OpenCV's: a tenth of the time of tests with pictures.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_threads, "1")

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from calibration.screens.clouds import MissingOpen3DError, open3d  # noqa: E402
from lab.cycle_search import search_rarely  # noqa: E402

search_rarely()  # as the program does: with Python's own setting the searches take 4 % of the tests of calibrations

# Waiting for the disk shows only after a power cut, and takes longer than the writing: a run waits for ten files. Tests
# of when it happens replace this function.
os.fsync = lambda file: None

# The same examples every time: a test that failed fails again, and a machine that is busy is no failure.
# `pytest --hypothesis-profile=explore` goes looking for new ones.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile("fixed")


@pytest.fixture(scope="session")
def loaded_open3d() -> None:
    """Skips a test where Open3D cannot be loaded."""
    try:
        open3d()
    except MissingOpen3DError as error:
        pytest.skip(str(error))


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """No search for mistakes of the set-up: it adds findings and changes no pose, and may take longer than all else."""
    from lab.runs import process

    monkeypatch.setattr(process, "mistakes_of_run", lambda *_, **__: ())


@pytest.fixture
def fast(request: pytest.FixtureRequest) -> bool:
    """Whether only the fast tests run; `make test-all` leaves nothing out."""
    return bool(request.config.option.markexpr == "not slow")


@pytest.fixture
def try_only(monkeypatch: pytest.MonkeyPatch, fast: bool) -> Callable[..., None]:
    """Tries only the possible mistakes of a set-up whose `kind: what` matches: the search among all takes seconds.

    Among the fast tests, or always.
    """
    from tracking.setup_mistakes import evidence

    every = evidence.possible_mistakes

    def only(words: str, always: bool = False) -> None:
        if not (fast or always):
            return
        tried = re.compile(words)
        monkeypatch.setattr(
            evidence, "possible_mistakes", lambda *a: [m for m in every(*a) if tried.search(f"{m.kind}: {m.what}")]
        )

    return only
