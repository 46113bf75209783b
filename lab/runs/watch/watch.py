"""Processes a run while it is recorded: poses as frames arrive, and the usual results when the recording ends."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.errors import InputError, RunError
from lab.files.run.results import are_results
from lab.files.run.run_file import LiveDevice, Run
from lab.files.text.atomic_write import atomic_folder
from lab.findings.finding import Outcome
from lab.pictures.picture_file import GreyPicture
from lab.progress import Progress
from lab.runs.frames.pipeline import Pipeline, tracker_of
from lab.runs.frames.sensor_noise import VIDEO_FRAMES, CameraNoise
from lab.runs.process import ready_run, write_results
from lab.runs.smoothing_pass import TRACKING
from lab.runs.verdict.run_statistics import FrameChecks, RunStatistics
from lab.runs.watch.background import FunctionProcess, LiveBackground
from lab.runs.watch.live_frames import LiveFrames, WatchOptions
from lab.runs.watch.live_output import LiveOutput, is_live_table, opened
from tracking.background.estimation import PICTURES
from tracking.detections import Detections
from tracking.parameters import DetectParameters

if TYPE_CHECKING:
    from lab.runs.watch.board import Board

_log = logging.getLogger("beampose")
_SWITCH_INTERVAL_S = 0.0005
# Share of a frame interval and of a camera's part of the cores that a search without a background may take. Pictures
# that take longer wait for the first background: a backlog of searches costs more time than the background.
_BUSY = 0.5


def watch_run(
    run_folder: Path,
    out: Path,
    *,
    udp: str | None = None,
    streams: Sequence[str] = (),
    page: str | None = None,
    reprocess: bool = False,
    line: Callable[[str], None] | None = None,
    options: WatchOptions = WatchOptions(),  # noqa: B008  (frozen)
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Outcome[RunStatistics]:
    """Process a run folder whose cameras are folders that are being filled, or devices.

    During the recording `out` contains attitude_live.csv: a row per frame by the causal tracker, flushed at once. udp:
    HOST:PORT that receives the same as a line of JSON. streams: further receivers, `KIND:ADDRESS`. page: PORT or
    HOST:PORT of the page that shows it meanwhile. line: called with a line of status every second. The recording ends
    when nothing has come for `options.idle_s`, when all devices have ended, or when `stop` is set; then `out` receives
    the results of `beampose run`, computed from the received detections. These differ from those of a run by the
    pictures that the noise and the static background are estimated from (here each camera's first ones; of the
    background, those before each picture) and by pictures that came too late. reprocess: computes the results from the
    finished folders instead, as `beampose run` does, which takes longer. provenance: added to summary.json, such as the
    command. Raises BeamposeError: the run cannot be watched, or no picture came.
    """
    started = time.perf_counter()
    run = ready_run(run_folder, overrides, recording=True)
    if reprocess and any(isinstance(source, LiveDevice) for source in run.cameras.values()):
        raise InputError(
            f"{run.path}: cameras: expected folders of pictures to reprocess, got a device, which keeps none"
        )
    with contextlib.ExitStack() as stack:
        work = stack.enter_context(atomic_folder(out, may_replace=lambda p: are_results(p) or is_live_table(p)))
        sending = stack.enter_context(opened(udp, streams, run.frame_rate_hz))
        frames = LiveFrames(run, options, stop or threading.Event())
        board = None if page is None else _served(run, frames, page, stack, line)
        output = LiveOutput(Path(out), frames, FrameChecks(run.rig, run.covariance), sending, board, line)
        stack.callback(output.close)
        with frames, _low_latency():
            pipeline, finders = _started(run, frames, output, stack.enter_context(FunctionProcess(True)))
            if reprocess:
                for done, _ in enumerate(pipeline.records(), start=1):
                    if progress is not None:
                        progress(done, None, TRACKING)
                pipeline = Pipeline.of(run)
            for finder in finders.values():
                finder.background.finish()

            def more() -> dict[str, Any]:
                if not reprocess:
                    pipeline.timings.detection += sum(finder.seconds for finder in finders.values())
                return {**(provenance or {}), **output.finish(work)}

            outcome = write_results(pipeline, work, Path(out), started, progress=progress, more=more)
    return replace(outcome, more=output.latency.lines())


def _served(
    run: Run, frames: LiveFrames, page: str, stack: contextlib.ExitStack, line: Callable[[str], None] | None
) -> Board:
    """The content of the live page, and its server. Raises InputError: the address cannot be used."""
    from lab.runs.watch.board import Board, PageServer, page_html

    # A process of its own: that of the backgrounds may be busy for seconds.
    board = Board(run, frames, stack.enter_context(FunctionProcess()).call)
    server = stack.enter_context(PageServer(page, page_html(run), board.state, board.picture))
    if line is not None:
        line(f"page: {server.url}")
    return board


def _started(
    run: Run, frames: LiveFrames, output: LiveOutput, process: FunctionProcess
) -> tuple[Pipeline, dict[str, _Finder]]:
    """The pipeline, after the noise is estimated from the first pictures. Raises RunError if none come."""
    _load_compiled_code(run)
    _log.info("ready: waiting for the first picture")
    first = frames.begin()
    if not first:
        raise RunError(f"{run.path}: expected pictures while the run was watched, got none")
    noise = {name: CameraNoise(name, camera.noise, optics=camera) for name, camera in run.rig.cameras.items()}
    detect = run.tracker.detect
    backgrounds = {
        name: LiveBackground(own, detect, process.call, lambda: frames.caught_up) for name, own in noise.items()
    }
    longest_s = _BUSY / run.frame_rate_hz * min((os.cpu_count() or 1) / len(noise), 1.0)
    with ThreadPoolExecutor(max(len(first), 1)) as pool:  # in parallel, since pictures queue up meanwhile
        list(pool.map(lambda name: noise[name].estimate_from(first[name]), first))
        slow = [name for name, own in noise.items() if _search_s(own, first.get(name, ()), detect) > longest_s]
        more = frames.more(slow, VIDEO_FRAMES) if slow else {}
        list(pool.map(lambda name: backgrounds[name].begin(more[name]), more))
    if any(own.shows_structure for own in noise.values()):
        process.start()
    pipeline = Pipeline(run, frames, tracker_of(run), noise, output.write)
    board = output.board
    if board is not None:
        board.pipeline = pipeline
    finders = {name: _Finder(pipeline, name, background, board) for name, background in backgrounds.items()}
    frames.inbox.set_finders(finders)
    return pipeline, finders


def _search_s(noise: CameraNoise, pictures: Sequence[GreyPicture], parameters: DetectParameters) -> float:
    """Process time of a search without a background, s; 0 where none can be made."""
    if not (noise.shows_structure and len(pictures)):
        return 0.0
    clock = time.thread_time()
    noise.detect(pictures[-1], parameters)
    return time.thread_time() - clock


@dataclass(slots=True)
class _Finder:
    """Detects the points of one camera's pictures, in that camera's thread."""

    pipeline: Pipeline
    camera: str
    background: LiveBackground
    board: Board | None = None
    seconds: float = 0.0

    def __call__(self, picture: GreyPicture) -> Detections:
        clock = time.perf_counter()
        found = self.pipeline.spots_in(self.camera, picture)
        self.seconds += time.perf_counter() - clock
        self.background.add(picture)
        if self.board is not None:
            self.board.show(self.camera, picture, found)
        return found


def _load_compiled_code(run: Run) -> None:
    """Load the compiled code before the first picture arrives, by processing a few synthetic frames."""
    tracker, model = tracker_of(run), SpotModel.of(run.rig)
    for width, height in {camera.image_size_px for camera in run.rig.cameras.values()}:
        v, u = np.mgrid[:height, :width]
        grey = 8.0 + ((7 * u + 13 * v) % 5) + 90 * np.exp(-((u - width / 2) ** 2 + (v - height / 2) ** 2) / 8)
        pictures = [(grey + k).astype(np.uint8) for k in range(2)]
        noise = CameraNoise("synthetic")
        noise.estimate_from(pictures)
        noise.detect(pictures[0], run.tracker.detect)
        moving = [
            np.roll(pictures[0], 8 * k, axis=1)[:: height // 128, :: width // 128].copy() for k in range(PICTURES)
        ]
        noise = CameraNoise("small")
        noise.estimate_from(moving[:2])
        noise.make_background(moving, run.tracker.detect)
    uv_px, _ = model.project(Pose.identity() if run.prior is None else run.prior.centre)
    seen = np.isfinite(uv_px).all(axis=1) & ((uv_px > 0) & (uv_px < model.image_size_px)).all(axis=1)
    found = []
    for camera in range(len(run.rig.cameras)):
        uv = uv_px[seen & (model.camera_of == camera)]
        found.append(Detections.at(uv, np.tile(0.01 * np.eye(2), (len(uv), 1, 1))))
    for frame in range(4):
        tracker.step(1 / run.frame_rate_hz if frame else 0.0, found)


@contextlib.contextmanager
def _low_latency() -> Iterator[None]:
    """Threads switch after 0.5 ms instead of 5, and the garbage collector ignores existing objects.

    Otherwise a thread with a new picture waits for most of a tracking step, and a full collection takes several frames.
    What is garbage already stays until the end: little, and the collection delays the start.
    """
    switch_interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(switch_interval_s)
