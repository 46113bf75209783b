"""The pictures of several frames, one after the other, with a few read ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

from lab.errors import BeamposeError
from lab.files.run.run_file import FramesFolder, Run, VideoFile
from lab.pictures.picture_file import DROPPED, MissingPicture
from lab.runs.frames.frame_sources import FolderSource, Requested, VideoSource, list_folder, result_of
from lab.runs.frames.frames import Picture

_AHEAD = 4  # frames that are read while earlier ones are drawn
_THREADS = 2


def pictures_of(run: Run | None, cameras: Sequence[str], frames: Sequence[int]) -> Iterator[dict[str, Picture]]:
    """For each of the rising frame numbers the pictures of the cameras; those of points are left out.

    A camera whose pictures cannot be opened has none, with the reason. Memory does not grow with the number of frames.
    """
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(_THREADS))
        sources: dict[str, FolderSource | _Skipping | MissingPicture] = {}
        for camera in cameras if run is not None else ():
            source = run.cameras.get(camera) if run is not None else None
            if run is None or not isinstance(source, FramesFolder | VideoFile):
                continue
            size_px = run.rig.cameras[camera].image_size_px
            try:
                if isinstance(source, FramesFolder):
                    sources[camera] = FolderSource(list_folder(source.path), size_px)
                else:
                    video = VideoSource(source.path, size_px)
                    stack.callback(video.close)
                    sources[camera] = _Skipping(video)
            except BeamposeError as error:
                sources[camera] = MissingPicture(str(error))
        waiting: deque[dict[str, Requested]] = deque()
        following = iter(frames)
        while True:
            while len(waiting) < _AHEAD and (frame := next(following, None)) is not None:
                waiting.append(
                    {
                        camera: source if isinstance(source, MissingPicture) else source.request(frame, pool)
                        for camera, source in sources.items()
                    }
                )
            if not waiting:
                return
            got = {camera: result_of(later) for camera, later in waiting.popleft().items()}
            yield {camera: MissingPicture(DROPPED) if p is None else p for camera, p in got.items()}


class _Skipping:
    """A video of which only some pictures are used; they are decoded when requested."""

    def __init__(self, video: VideoSource) -> None:
        self._video = video
        self._at = 0

    def request(self, frame: int, pool: ThreadPoolExecutor) -> Requested:
        """The picture of a frame; frames are requested in rising order."""
        while self._at < frame and self._video.skip():
            self._at += 1
        if self._at != frame:
            return MissingPicture(DROPPED)
        self._at += 1
        picture = self._video.next_picture()
        if picture is None or isinstance(picture, MissingPicture):
            return MissingPicture(DROPPED) if picture is None else picture
        return picture.copy()  # the array may be the capture's own buffer, which the next picture overwrites
