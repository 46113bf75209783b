"""Run one job in this process and print the process time of each stage and the peak memory as JSON.

`python -m bench.throughput.stages run RUN OUT`, `report OUT`, `read RUN`, `imread RUN`, `video RUN`. A stage is a
function of the program (STAGES). Its time is that of the calling thread, without other stages called inside. "start-up"
is everything before the first picture is read, and all imports, but not the loading of compiled code.
"""

from __future__ import annotations

import functools
import importlib
import json
import resource
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.cycle_search import search_rarely

STAGES = (
    ("decode", "lab.pictures.source", "read_picture"),
    ("decode", "lab.pictures.source", "_VideoReader._read"),
    ("detect", "lab.runs.frames.pipeline", "Pipeline._detect"),
    ("track", "tracking.rigid_body.rigid_tracker", "RigidTracker.step"),
    ("smooth", "lab.runs.smoothing_pass", "smooth"),
    ("smooth", "tracking.smoothing.smoothed", "Smoothed.frame"),
    ("tables", "lab.runs.tables", "TableWriter.write"),
    ("tables", "lab.runs.tables", "TableWriter.__exit__"),
    ("model check", "lab.runs.model_check.check", "check_sampled_frames"),
    ("report", "lab.report.run.page", "write_report"),
    ("load compiled", "geometry.compilation.numba_internals", "_Cache.load_overload"),
    ("compile", "numba.core.dispatcher", "_FunctionCompiler.compile"),
)


class Clock:
    """Sums of the times of the stages, each without the stages inside it."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._inside = threading.local()

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function with its time counted."""

        @functools.wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            outer = getattr(self._inside, "of_others", 0.0)
            self._inside.of_others = 0.0
            begun = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                whole = time.thread_time() - begun
                with self._lock:
                    self.spent[stage] += whole - self._inside.of_others
                self._inside.of_others = outer + whole

        return wrapped


def watch(clock: Clock) -> None:
    """Count the time of all STAGES from now on.

    Raises:
        AttributeError: a function was renamed.
    """
    for stage, module, name in STAGES:
        owner: Any = importlib.import_module(module)
        *classes, last = name.split(".")
        for part in classes:
            owner = getattr(owner, part)
        setattr(owner, last, clock.timed(stage, getattr(owner, last)))


def _run(folder: Path, out: Path) -> Counter[str]:
    from lab.runs import process
    from lab.runs.frames import frames

    search_rarely()  # as the command does
    clock = Clock()
    watch(clock)  # also imports the report and the model check, which a run imports at its end
    started: list[float] = []
    reading = frames.FrameReader.__iter__

    def first_read(reader: frames.FrameReader) -> Any:
        loaded = clock.spent["load compiled"] + clock.spent["compile"]
        started.append(time.process_time() - loaded)
        return reading(reader)

    frames.FrameReader.__iter__ = first_read  # type: ignore[method-assign]  # to time the original
    process.process_run(folder, out)
    return clock.spent + Counter({"start-up": started[0]})


def _report(out: Path) -> Counter[str]:
    from lab.report.run.page import write_report

    begun = time.process_time()
    write_report(out, None)
    return Counter({"report": time.process_time() - begun})


def _read(folder: Path) -> Counter[str]:
    """Read the pictures only, ahead in threads as in a run."""
    from lab.files.run.run_file import load_run
    from lab.runs.frames.frames import open_frames

    reader = open_frames(load_run(folder))
    begun = time.process_time()
    for _ in reader:
        pass
    return Counter({"read": time.process_time() - begun})


def _imread(folder: Path) -> Counter[str]:
    import cv2

    cv2.setNumThreads(1)
    paths = sorted((folder / "frames").rglob("*.*"))
    begun = time.process_time()
    for path in paths:
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return Counter({"read": time.process_time() - begun})


def _video(folder: Path) -> Counter[str]:
    import cv2

    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    begun = time.process_time()
    for path in sorted(folder.glob("*.avi")):
        capture = cv2.VideoCapture(str(path))
        while capture.read()[0]:
            pass
        capture.release()
    return Counter({"read": time.process_time() - begun})


JOBS = {"run": _run, "report": _report, "read": _read, "imread": _imread, "video": _video}


def main() -> None:
    """Run the job of the command line."""
    job, *paths = sys.argv[1:]
    begun = time.perf_counter()
    spent = JOBS[job](*map(Path, paths))
    wall = time.perf_counter() - begun
    usage = resource.getrusage(resource.RUSAGE_SELF)
    total = usage.ru_utime + usage.ru_stime
    megabytes = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    print(json.dumps({"stages": spent, "total": total, "wall": wall, "megabytes": megabytes}))


if __name__ == "__main__":
    main()
