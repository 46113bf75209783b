"""Cameras that are read while they record, behind one interface: OpenCV's devices, GenICam, replayed pictures."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lab.errors import InputError
from lab.packages import needed
from lab.pictures.opencv import load_cv2, opened
from lab.pictures.picture_file import GreyPicture, MissingPicture, require_format
from lab.pictures.source import Grabbed, formatted, open_inputs, pictures, retrieved

GENICAM, REPLAY = "genicam:", "replay:"
_PRODUCERS = "GENICAM_GENTL64_PATH"  # folders of the cameras' drivers (GenTL producers, *.cti); GenTL standard 1.6
_WAIT_S = 1.0  # for a picture of a GenICam camera
_KEPT = 100  # pictures of a replayed camera in memory
_BUFFERS = 4  # pictures that a replayed camera keeps for a late reader


class LiveSource(Protocol):
    """A camera that delivers picture after picture.

    endless: a camera, which cannot wait; False: a file or a stream with an end, which is read completely.
    """

    endless: bool

    def grab(self) -> bool:
        """Wait for the next picture; False: none came."""

    def clock_s(self) -> float | None:
        """When the grabbed picture was taken, by the camera's own clock, s from any origin; None: it states none."""

    def number(self) -> int | None:
        """The camera's own count of the grabbed picture; None: it has none."""

    def picture(self, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
        """The grey values of the grabbed picture, of this width and height; the array is the caller's own."""

    def release(self) -> None:
        """Close the camera."""


def open_live(source: int | str, size_px: tuple[int, int] | None = None, rate_hz: float | None = None) -> LiveSource:
    """Open a camera: a number or a name that OpenCV opens, `genicam:SERIAL` (or its place in the list), `replay:PATH`.

    size_px, rate_hz: requested from a device. Raises InputError.
    """
    text = str(source)
    if text.startswith(GENICAM):
        return GenicamSource.opened(text.removeprefix(GENICAM), rate_hz)
    if text.startswith(REPLAY):
        return ReplaySource(Path(text.removeprefix(REPLAY)), rate_hz or 25.0)
    return _opencv(int(text) if text.isdigit() else text, size_px, rate_hz)


# Devices, streams and files of OpenCV --------------------------------------------------------------------------------


class Capture(Grabbed, Protocol):
    """The part of cv2.VideoCapture that is used."""

    def grab(self) -> bool: ...

    def get(self, name: int) -> float: ...

    def release(self) -> None: ...


@dataclass(slots=True)
class OpenCvSource:
    """A cv2.VideoCapture."""

    capture: Capture
    endless: bool = True

    def grab(self) -> bool:
        return self.capture.grab()

    def clock_s(self) -> float | None:
        """Of devices the driver's time of the buffer, of files and streams that of the encoder."""
        value = self.capture.get(load_cv2().CAP_PROP_POS_MSEC)
        return value / 1e3 if value >= 0 else None

    def number(self) -> int | None:
        return None

    def picture(self, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
        found = retrieved(self.capture, size_px)
        # Copied, since the device may overwrite its buffer.
        return found if isinstance(found, MissingPicture) else np.array(found)

    def release(self) -> None:
        self.capture.release()


def _opencv(device: int | str, size_px: tuple[int, int] | None, rate_hz: float | None) -> OpenCvSource:
    cv2 = load_cv2()
    capture = opened(device)
    if not capture.isOpened():
        raise InputError(
            f"expected a camera that OpenCV can open, got {device!r}, which it cannot open (missing, in use, or without"
            " read permission?)"
        )
    endless = not capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0
    if endless and size_px is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
    if endless and rate_hz is not None:
        capture.set(cv2.CAP_PROP_FPS, rate_hz)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return OpenCvSource(capture, endless)


# GenICam: GigE Vision and USB3 Vision cameras ------------------------------------------------------------------------


@dataclass(slots=True)
class GenicamSource:
    """A camera of the GenICam standard, by `harvesters` and the GenTL producer of its maker."""

    harvester: Any
    acquirer: Any
    endless: bool = True
    _buffer: Any = None

    @staticmethod
    def opened(which: str, rate_hz: float | None) -> GenicamSource:
        """which: a serial number, or a place in the list of cameras from 0. Raises InputError."""
        folders = [Path(f) for f in os.environ.get(_PRODUCERS, "").split(os.pathsep) if f]
        producers = [p for folder in folders for p in ([folder] if folder.suffix == ".cti" else folder.glob("*.cti"))]
        if not producers:
            raise InputError(f"expected the camera maker's *.cti file in a folder of {_PRODUCERS}, found none")
        harvester = needed("genicam", f"{GENICAM}{which}", "core").Harvester()
        try:
            for producer in producers:
                harvester.add_file(str(producer))
            harvester.update()
            known = [str(info.serial_number) for info in harvester.device_info_list]
            if which not in known and not (which.isdigit() and int(which) < len(known)):
                listed = ", ".join(known) or "no camera"
                raise InputError(f"expected the serial number of a GenICam camera, got {which!r}; found: {listed}")
            acquirer = harvester.create({"serial_number": which} if which in known else int(which))
            if rate_hz is not None:
                with suppress(Exception):  # not every camera has these
                    acquirer.remote_device.node_map.AcquisitionFrameRate.value = rate_hz
            acquirer.start()
        except InputError:
            harvester.reset()
            raise
        except Exception as error:  # of the maker's library
            harvester.reset()
            raise InputError(f"the GenICam camera {which!r} cannot be opened: {error}") from None
        return GenicamSource(harvester, acquirer)

    def grab(self) -> bool:
        self._give_back()
        try:
            self._buffer = self.acquirer.fetch(timeout=_WAIT_S)
        except Exception:  # TimeoutException of the maker's library, or a lost connection
            return False
        return self._buffer is not None

    def clock_s(self) -> float | None:
        try:
            return float(self._buffer.timestamp) / float(self._buffer.timestamp_frequency) or None
        except Exception:  # the camera states none
            return None

    def number(self) -> int | None:
        try:
            return int(self._buffer.module.frame_id)
        except Exception:
            return None

    def picture(self, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
        part = self._buffer.payload.components[0]
        channels = int(part.num_components_per_pixel)
        shape = (part.height, part.width) if channels == 1 else (part.height, part.width, channels)
        values = np.array(part.data.reshape(shape))
        if channels >= 3 and str(part.data_format).startswith("RGB"):
            values[..., :3] = values[..., 2::-1]
        found: GreyPicture | MissingPicture = formatted(values, size_px)
        return found

    def release(self) -> None:
        self._give_back()
        with suppress(Exception):  # of a camera that is gone
            self.acquirer.stop()
            self.acquirer.destroy()
        self.harvester.reset()

    def _give_back(self) -> None:
        if self._buffer is not None:
            with suppress(Exception):
                self._buffer.queue()
            self._buffer = None


# Pictures shown again ------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class ReplaySource:
    """A camera that shows a folder of pictures or a video, forth and back, at a rate: to try a set-up without cameras.

    Like a camera it does not wait: a reader that is late by more than a few pictures misses some.
    """

    path: Path
    rate_hz: float
    endless: bool = True
    _shown: list[GreyPicture | MissingPicture] = field(default_factory=list)
    _start_s: float | None = None
    _number: int = -1

    def __post_init__(self) -> None:
        """Raises InputError: the pictures cannot be read."""
        for _, picture in pictures(open_inputs([self.path])):
            self._shown.append(picture if isinstance(picture, MissingPicture) else np.array(picture))
            if len(self._shown) == _KEPT:
                break

    def grab(self) -> bool:
        now_s = time.perf_counter()
        if self._start_s is None:
            self._start_s = now_s
        taken = int((now_s - self._start_s) * self.rate_hz)  # so many pictures have been taken
        self._number = max(self._number + 1, taken - _BUFFERS)
        time.sleep(max(self._start_s + self._number / self.rate_hz - now_s, 0.0))
        return True

    def clock_s(self) -> float | None:
        return self._number / self.rate_hz

    def number(self) -> int | None:
        return self._number

    def picture(self, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
        last = max(len(self._shown) - 1, 1)
        turn = self._number % (2 * last)
        one = self._shown[min(turn, 2 * last - turn, len(self._shown) - 1)]
        return one if isinstance(one, MissingPicture) else require_format(one, size_px)

    def release(self) -> None:
        self._shown.clear()
