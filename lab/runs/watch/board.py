"""The live page of a watched run: the newest picture of each camera and figures of the last seconds; its server.

http.server with events and pictures, on the loopback address unless stated otherwise; decision and measurements:
docs/decisions/live-server.md.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from lab.errors import InputError
from lab.files.run.run_file import Run
from lab.files.text.json_text import plain_value
from lab.findings.finding import Level, first_sentence, verdict
from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import GreyPicture
from lab.report.frames.canvas import ground
from lab.report.page import environment
from lab.report.plot.svg import grey_limits, stretched
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from lab.runs.model_check.check import check_sampled_frames
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.tables import pose_numbers
from lab.runs.watch.background import ENDED
from lab.runs.watch.live_frames import LiveFrames
from tracking.detections import CLIPPED, Detections
from tracking.statuses import PoseStatus

_INTERVAL_S = 0.25  # between two states sent to a browser
_MOST_READERS = 8  # browsers at the same time
_STALLED_S = 10.0  # after which a browser that reads nothing is given up
_PROTECTED = (
    ("Cache-Control", "no-store"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
)


@dataclass(slots=True)
class PageServer:
    """Serves one page, its states and its pictures, each browser in its own thread.

    A browser gets the state of the moment as soon as it has taken the one before, so nothing queues up for a slow one.

    page: the HTML. state: of the moment, as JSON; called with whether it is the last. picture: of a camera, as JPEG,
    and what is drawn on it; None: not yet.
    """

    address: str  # PORT, or HOST:PORT
    page: str
    state: Callable[[bool], str]
    picture: Callable[[str], tuple[bytes, dict[str, Any]] | None]
    token: str = ""  # empty: only this computer can connect
    _server: ThreadingHTTPServer = field(init=False)
    _stop: threading.Event = field(default_factory=threading.Event)
    _readers: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(_MOST_READERS))

    def __post_init__(self) -> None:
        """Raises InputError: the address is wrong or in use."""
        host, _, port = (self.address if ":" in self.address else f"127.0.0.1:{self.address}").rpartition(":")
        host = host.strip("[]")
        if not (host and port.isascii() and port.isdigit() and int(port) < 65536):
            raise InputError(f"--page: expected PORT or HOST:PORT such as 8080, got {self.address!r}")
        try:
            found = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0]
            kind = type("Server", (ThreadingHTTPServer,), {"address_family": found[0], "daemon_threads": True})
            self._server = kind(found[4][:2], _handler_of(self))
        except OSError as error:
            raise InputError(f"--page: {self.address}: {error.strerror}; choose another port") from None
        if not ipaddress.ip_address(found[4][0]).is_loopback:
            self.token = secrets.token_urlsafe(16)

    def __enter__(self) -> PageServer:
        threading.Thread(target=self._server.serve_forever, args=(0.05,), name="page", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._server.shutdown()
        self._server.server_close()

    @property
    def url(self) -> str:
        """The page's address, with the token where one is needed."""
        host, port = self._server.server_address[:2]
        shown = f"[{host!s}]" if ":" in str(host) else str(host)
        shown = socket.gethostname() if shown in ("0.0.0.0", "[::]") else shown
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def allows(self, host: str, token: str) -> bool:
        """Whether a request may be answered. host: its header, which another site's page cannot choose."""
        if self.token:
            return hmac.compare_digest(token, self.token)
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or (_is_address(name) and ipaddress.ip_address(name).is_loopback)


def _is_address(text: str) -> bool:
    with suppress(ValueError):
        ipaddress.ip_address(text)
        return True
    return False


def _handler_of(page: PageServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _STALLED_S

        def log_message(self, *_: object) -> None:
            """Nothing: the terminal shows the recording."""

        def do_GET(self) -> None:
            where = urlsplit(self.path)
            given = parse_qs(where.query)
            with suppress(OSError, ValueError):  # the browser has gone
                if not page.allows(self.headers.get("Host", ""), given.get("token", [""])[0]):
                    self._answer(403, "text/plain", b"the address of the page contains a token that this one lacks\n")
                elif where.path == "/":
                    self._answer(200, "text/html; charset=utf-8", page.page.encode())
                elif where.path == "/state":
                    self._states()
                elif where.path == "/picture":
                    self._picture(given.get("camera", [""])[0])
                else:
                    self._answer(404, "text/plain", b"not here\n")

        def _answer(self, status: int, kind: str, content: bytes, more: tuple[tuple[str, str], ...] = ()) -> None:
            self._head(status, kind, (*more, ("Content-Length", str(len(content)))))
            self.wfile.write(content)

        def _head(self, status: int, kind: str, more: tuple[tuple[str, str], ...]) -> None:
            self.send_response(status)
            for name, value in (("Content-Type", kind), *_PROTECTED, *more):
                self.send_header(name, value)
            self.end_headers()

        def _picture(self, camera: str) -> None:
            found = page.picture(camera)
            if found is None:
                self._answer(204, "text/plain", b"")
            else:
                self._answer(200, "image/jpeg", found[0], (("X-Marks", json.dumps(found[1])),))

        def _states(self) -> None:
            if not page._readers.acquire(blocking=False):
                return self._answer(503, "text/plain", b"too many browsers\n")
            try:
                self._head(200, "text/event-stream", ())
                while True:
                    over = page._stop.is_set()
                    self.wfile.write(f"data: {page.state(over)}\n\n".encode())
                    self.wfile.flush()
                    if over:
                        return None
                    page._stop.wait(_INTERVAL_S)
            finally:
                page._readers.release()

    return Handler


_EVERY_S = 0.05  # between two poses of the curves
_WINDOW_S = 20.0  # of the curves
_CHECK_S = 5.0  # between two model checks ...
_CHECKED = 200  # ... of so many frames, those of the curves' last ten seconds
_SHOWN_PX = 960  # largest width of a picture on the page
_KEPT = 8  # pictures of a camera from which that of the latest frame is taken
_MOST_MARKS = 60  # points of a picture that are drawn
_DIM, _GOOD = 0.3, 0.65  # of the range above black: peaks below the first are dim; the second is where they should be
_BRIGHT = 0.25  # of the sensor's range: a background above it costs precision


@dataclass(slots=True)
class Board:
    """Collects what the page shows. `show` and `add` only store references; the rest is done when a browser asks."""

    run: Run
    frames: LiveFrames
    check: Callable[..., Any]  # calls a function in another process
    pipeline: Pipeline | None = None
    measured: int = 0
    processed: int = 0
    _pictures: dict[str, deque[tuple[GreyPicture, Detections]]] = field(default_factory=dict)
    _came_s: dict[str, deque[float]] = field(default_factory=dict)
    _latest: dict[str, tuple[GreyPicture, Detections, dict[int, str]]] = field(default_factory=dict)
    _curves: deque[str] = field(default_factory=lambda: deque(maxlen=round(_WINDOW_S / _EVERY_S)))
    _latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=500))
    _sampled: deque[FrameRecord] = field(default_factory=lambda: deque(maxlen=_CHECKED))
    _word: dict[str, Any] = field(default_factory=dict)
    _model: SpotModel = field(init=False)
    _next_s: float = 0.0
    _begun_s: float = field(default_factory=time.perf_counter)
    _checking: threading.Thread | None = None
    _checked_s: float = 0.0

    def __post_init__(self) -> None:
        self._model = SpotModel.of(self.run.rig)
        for name in self.run.cameras:
            self._pictures[name], self._came_s[name] = deque(maxlen=_KEPT), deque(maxlen=400)

    # While the run is recorded

    def show(self, camera: str, picture: GreyPicture, found: Detections) -> None:
        """A picture whose points have been detected; in the camera's thread."""
        self._pictures[camera].append((picture, found))
        self._came_s[camera].append(time.perf_counter())

    def add(self, record: FrameRecord, latency_ms: float | None) -> None:
        """A frame that has been written."""
        tracked = record.tracked
        self.processed += 1
        self.measured += tracked.pose_status is PoseStatus.MEASURED
        if latency_ms is not None:
            self._latency_ms.append(latency_ms)
        now_s = time.perf_counter()
        if now_s < self._next_s:
            return
        self._next_s = now_s + _EVERY_S
        for c, (name, found) in enumerate(zip(self.run.rig.cameras, record.detections, strict=True)):
            labels = {
                int(tracked.point[v]): self._model.views[v][1]
                for v in np.flatnonzero(self._model.camera_of == c)
                if tracked.status[v].measured
            }
            kept = list(self._pictures[name])
            if found is None and record.moment is not None:  # a camera of another rate has no picture of this row
                continue
            of_frame = next((one for one in kept if found is not None and one[1].uv_px is found.uv_px), None)
            if of_frame is not None:
                self._latest[name] = (*of_frame, labels)
            elif kept:  # the frames come late: the newest picture is shown before it has labels
                self._latest[name] = (*kept[-1], {})
        numbers = np.full(16, np.nan)
        if tracked.pose is not None and tracked.pose_covariance is not None:
            numbers = pose_numbers(tracked.pose, tracked.pose_covariance)
        # As text at once: that of all rows, four times a second, would keep the tracker waiting.
        shown = ",".join("null" if v != v else f"{v:.7g}" for v in (*numbers[:3].tolist(), *numbers[7:].tolist()))
        self._curves.append(f'[{record.t_s:.4f},"{tracked.pose_status.value}",{shown}]')
        self._sampled.append(record)

    # When a browser asks

    def state(self, over: bool) -> str:
        """Figures of the last seconds, as JSON. over: whether the recording has ended."""
        self._check_again()
        latency = list(self._latency_ms)
        known = {
            "over": over,
            "seconds": time.perf_counter() - self._begun_s,
            "frames": self.processed,
            "measured": self.measured,
            "latency_ms": [float(p) for p in np.percentile(latency, [50, 99])] if latency else None,
            "cameras": [self._camera(name) for name in self.run.cameras],
            "check": self._word,
        }
        return f'{json.dumps(plain_value(known))[:-1]}, "curves": [{",".join(list(self._curves))}]}}'

    def picture(self, camera: str) -> tuple[bytes, dict[str, Any]] | None:
        """The newest picture of a camera as JPEG with stretched grey values, and the marks on it in its own pixels."""
        if camera not in self._latest:
            return None
        picture, found, labels = self._latest[camera]
        height, width = picture.shape
        if picture.dtype != np.uint8:
            picture = np.asarray(load_cv2().convertScaleAbs(picture, alpha=255.0 / max(int(picture.max()), 1)))
        scale = min(_SHOWN_PX / width, 1.0)
        small = np.ascontiguousarray(
            ground(picture.astype(np.uint8, copy=False), (round(width * scale), round(height * scale)), scale)[..., 0]
        )
        marks = [[round(float(u), 1), round(float(v), 1), labels.get(i, "")] for i, (u, v) in enumerate(found.uv_px)]
        marks.sort(key=lambda mark: not mark[2])
        shades = stretched(small, *grey_limits(small))
        jpeg = load_cv2().imencode(".jpg", shades)[1].tobytes()
        return jpeg, {"width": width, "height": height, "marks": marks[:_MOST_MARKS]}

    def _camera(self, name: str) -> dict[str, Any]:
        queue, came = self.frames.inbox.queues[name], list(self._came_s[name])
        recent = [t for t in came if t > came[-1] - 2.0] if came else []
        out: dict[str, Any] = {
            "name": name,
            "pictures": queue.given,
            "rate_hz": (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 2 else None,
            "dropped": sum(self.frames.missing(name).values()),
            "lost": self.frames.lost(name),
            "offset_ms": self._offset_ms(name),
            "spots": [],
            "advice": "waiting for its first picture",
            "level": Level.WARN.word,
        }
        if name not in self._latest or self.pipeline is None:
            return out
        picture, found, labels = self._latest[name]
        noise = self.pipeline.noise[name]
        top = noise.saturation_dn(picture, self.run.tracker.detect)
        black = 0.0 if noise.model is None else float(noise.model.black_dn)
        expected = int(np.count_nonzero(self._model.camera_of == list(self.run.rig.cameras).index(name)))
        rows = sorted(labels, key=lambda i: labels[i]) or np.argsort(-found.peak)[:expected].tolist()
        rows = [i for i in rows if i < len(found)]
        peaks = found.peak[rows] / max(top - black, 1.0)
        out["spots"] = [
            [labels.get(i, ""), *(round(float(x), 2) for x in found.uv_px[i]), round(float(found.peak[i]), 1),
             round(float(found.major_px[i]), 2), bool(p > CLIPPED)]
            for i, p in zip(rows, peaks, strict=True)
        ]  # fmt: skip
        out["advice"], level = exposure_advice(peaks, float(np.median(picture[::8, ::8])) / top, expected)
        out["level"] = level.word
        return out

    def _offset_ms(self, name: str) -> float | None:
        """How much later than the first camera this one's pictures of a frame came, median of the last frames."""
        first = next(iter(self.run.cameras))
        if name == first:
            return None
        both = [a[name] - a[first] for a in list(self.frames.arrivals) if name in a and first in a]
        return float(1e3 * np.median(both)) if both else None

    def _check_again(self) -> None:
        """Test the last seconds against the rig, in another process, while browsers look."""
        now_s = time.perf_counter()
        if now_s - self._checked_s < _CHECK_S or (self._checking is not None and self._checking.is_alive()):
            return
        self._checked_s = now_s
        self._checking = threading.Thread(target=self._checked, args=(list(self._sampled),), daemon=True)
        self._checking.start()

    def _checked(self, frames: Sequence[FrameRecord]) -> None:
        sampler = FrameSampler(_CHECKED)
        for frame in frames:
            sampler.add_record(frame, self._model.camera_of, self.run.tracker)
        with suppress(*ENDED):
            found = self.check(check_sampled_frames, self.run.rig, sampler, self.run.covariance)
            worst = max(found.findings, key=lambda f: f.level, default=None)
            words = found.why_not or "the last seconds fit the rig" if worst is None else first_sentence(worst.what)
            level = "" if found.why_not else verdict(found.findings).word
            self._word = {"words": words, "level": level, "remedy": "" if worst is None else worst.remedy}


def exposure_advice(peaks: Array, background: float, expected: int) -> tuple[str, Level]:
    """What to change so that the spots are bright and not clipped, and how severe it is.

    peaks (n,): of the spots, share of the sensor's range above black. background: share of the range. expected: spots.
    """
    clipped = int(np.count_nonzero(peaks > CLIPPED))
    if not len(peaks):
        why = "no point found: are the lasers on, and is the lens open?"
        return (why, Level.FAIL) if expected else ("", Level.PASS)
    if clipped:
        return f"{clipped} of {len(peaks)} spots clipped: halve the exposure", Level.FAIL
    if background > _BRIGHT:
        return f"background at {100 * background:.0f} % of the range: less light in the room, or a filter", Level.WARN
    if peaks.max() < _DIM:
        return (
            f"brightest spot at {100 * peaks.max():.0f} % of the range: expose {_GOOD / peaks.max():.1f} times as long",
            Level.WARN,
        )
    return f"brightest spot at {100 * peaks.max():.0f} % of the range: good", Level.PASS


def page_html(run: Run) -> str:
    """The page that shows a board."""
    return environment().get_template("live.html.j2").render(run=run.name, cameras=list(run.cameras))
