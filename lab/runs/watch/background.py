"""The static background of a camera that is recording: made of the pictures so far, again and again.

It is made in a process of its own, of low priority. In a thread of the watching process it would compete with detection
and tracking for the interpreter, which each of their hundred calls of compiled code per frame releases and needs again.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from geometry.arrays import evenly_spread
from lab.cycle_search import search_rarely
from lab.pictures.picture_file import GreyPicture
from lab.runs.frames.sensor_noise import VIDEO_FRAMES, CameraNoise
from tracking.background.estimation import PICTURES
from tracking.parameters import DetectParameters

_SPACING = VIDEO_FRAMES // PICTURES  # pictures from one that is kept to the next, at first
_UNFIT = 20  # consecutive pictures that do not fit the background after which the camera or the light has changed
_NICE = 10  # priority of the process: a background may come later, a pose may not
ENDED = (OSError, EOFError, pickle.UnpicklingError)
_PROTOCOL = 5  # of pickle: arrays are written and read in place, and the interpreter is free meanwhile


@dataclass(slots=True)
class FunctionProcess:
    """Calls functions in another process, one at a time. Used as a context manager.

    in_idle_time: only while a core is idle, where the system knows such a priority.
    """

    in_idle_time: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _process: subprocess.Popen[bytes] | None = None
    _ended: bool = False

    def __enter__(self) -> FunctionProcess:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process, also in the middle of a call."""
        self._ended = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def start(self) -> None:
        """Start the process, so that it does not load the program while the first background is waited for."""
        with self._lock, suppress(OSError):
            self._started()

    def call(self, function: Callable[..., Any], *given: Any) -> Any:
        """The function's result. Raises one of ENDED where the process has been ended, or killed."""
        with self._lock:
            to, of = self._started()
            pickle.dump((function, *given), to, _PROTOCOL)
            to.flush()
            return pickle.load(of)

    def _started(self) -> tuple[Any, Any]:
        """The pipes to the process and from it; it is started where it does not run. Raises OSError after the end."""
        if self._ended:
            raise OSError("the watch has ended")
        if self._process is None or self._process.poll() is not None:
            # Not multiprocessing, which would run the program's main module again. The imports take a second of a core.
            program = (
                "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN);"  # Ctrl-C: the watch decides
                f" {self.in_idle_time} and hasattr(os, 'SCHED_IDLE')"
                " and os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0));"
                f" hasattr(os, 'nice') and os.nice({_NICE}); sys.path[:] = {sys.path!r};"
                f" from {__name__} import serve; serve()"
            )
            piped = subprocess.PIPE
            self._process = subprocess.Popen([sys.executable, "-c", program], stdin=piped, stdout=piped)
        return self._process.stdin, self._process.stdout


def serve() -> None:
    """Call what comes from standard input until it ends."""
    search_rarely()
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # for whatever prints
    while True:
        try:
            function, *given = pickle.load(sys.stdin.buffer)
            pickle.dump(function(*given), out, _PROTOCOL)
            out.flush()
        except (EOFError, BrokenPipeError):  # the watch has ended
            os._exit(0)


@dataclass(slots=True)
class LiveBackground:
    """Keeps some of a camera's pictures and makes the background of them while others are processed.

    The kept pictures are spread over the time since the start, twice as far apart whenever there are enough: so it
    contains ever less of a light that moves slowly, and the cost per picture falls. After a change of the scene it
    starts again.
    """

    noise: CameraNoise
    parameters: DetectParameters
    call: Callable[..., Any]  # of a function with arguments, in another process
    has_time: Callable[[], bool] = lambda: True  # whether a better one may be made: not while pictures wait
    at_once: bool = False  # without a background pictures come faster than they are searched
    _kept: list[GreyPicture] = field(default_factory=list)
    _spacing: int = _SPACING
    _next: int = 1  # the picture from now on that is kept
    _thread: threading.Thread | None = None  # waits for the background that is being made

    def begin(self, pictures: Sequence[GreyPicture]) -> None:
        """Make the background of the camera's first pictures at once, before `add` receives them.

        For cameras whose pictures come faster than they are searched without a background, also later.
        """
        self.at_once = True
        first = [pictures[i] for i in evenly_spread(np.arange(len(pictures)), PICTURES)]
        self.noise.make_background(first, self.parameters)
        self._kept, self._spacing, self._next = first[::2], 2 * self._spacing, len(pictures) + 1

    def add(self, picture: GreyPicture) -> None:
        """Count a picture after its points have been detected, in the camera's thread."""
        if not self.noise.shows_structure:
            return
        busy = self._thread is not None and self._thread.is_alive()
        if self.noise.unfit >= _UNFIT and not busy:
            self._kept, self._spacing, self._next = [], _SPACING, 1
            self.noise.forget_background()
        self._next -= 1
        if self._next <= 0 and len(self._kept) < PICTURES:
            self._kept.append(picture)
            self._next = self._spacing
        if len(self._kept) < PICTURES or busy:
            return
        if self.at_once and self.noise.background is None:
            self.noise.make_background(self._kept, self.parameters)
        elif self.noise.background is None or self.has_time():
            self._thread = threading.Thread(
                target=self._make, args=(list(self._kept),), name=f"background-{self.noise.camera}", daemon=True
            )
            self._thread.start()
        self._kept, self._spacing = self._kept[::2], 2 * self._spacing

    def _make(self, pictures: list[GreyPicture]) -> None:
        with suppress(*ENDED):  # the earlier background stays
            self.noise.make_background(pictures, self.parameters, self.call)

    def finish(self) -> None:
        """Wait until the background that is being made is complete."""
        if self._thread is not None:
            self._thread.join()
