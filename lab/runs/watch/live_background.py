"""The static background of a camera that is recording: made of the pictures so far, again and again."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from lab.pictures.picture_file import GreyPicture
from lab.runs.frames.sensor_noise import VIDEO_FRAMES, CameraNoise
from tracking.background.estimation import PICTURES
from tracking.parameters import DetectParameters

_SPACING = VIDEO_FRAMES // PICTURES  # pictures from one that is kept to the next, at first
_UNFIT = 20  # consecutive pictures that do not fit the background after which the camera or the light has changed


@dataclass(slots=True)
class LiveBackground:
    """Keeps some of a camera's pictures and makes the background of them in a thread of its own.

    The kept pictures are spread over the time since the start, twice as far apart after each background: so it contains
    ever less of a light that moves slowly, and the cost per picture falls. After a change of the scene it starts again.
    """

    noise: CameraNoise
    parameters: DetectParameters
    _kept: list[GreyPicture] = field(default_factory=list)
    _spacing: int = _SPACING
    _since: int = 0  # pictures since the last one that was kept
    _thread: threading.Thread | None = None

    def add(self, picture: GreyPicture) -> None:
        """Count a picture after its points have been detected, in the camera's thread."""
        if not self.noise.shows_structure:
            return
        busy = self._thread is not None and self._thread.is_alive()
        if self.noise.unfit >= _UNFIT and not busy:
            self._kept, self._spacing, self._since = [], _SPACING, 0
            self.noise.background, self.noise.unfit = None, 0
        if self._since % self._spacing == 0 and len(self._kept) < PICTURES:
            self._kept.append(picture)
            self._since = 0
        self._since += 1
        if len(self._kept) == PICTURES and not busy:
            given = (list(self._kept), self.parameters)
            self._thread = threading.Thread(
                target=self.noise.make_background, args=given, name=f"background-{self.noise.camera}", daemon=True
            )
            self._thread.start()
            self._kept, self._spacing = self._kept[::2], 2 * self._spacing

    def finish(self) -> None:
        """Wait until the background that is being made is complete."""
        if self._thread is not None:
            self._thread.join()
