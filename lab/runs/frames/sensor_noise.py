"""The noise model that each camera's pictures are searched with: stated in rig.yaml, or estimated from the pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from geometry.camera import SensorNoise
from lab.files.run.run_file import DetectionsTable, FramesFolder, Run
from lab.runs.frames.frames import FrameReader, pictures_at
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise
from tracking.parameters import DetectParameters

VIDEO_PICTURES = (0, 1, 8, 9, 16, 17)  # of a video, whose end cannot be read without reading all of it
_BLANK = 3  # pictures without any point, after which the noise is doubted ...
_BLANK_AGAIN = 50  # ... and again after so many more
_CONTRADICTION = 2.0  # factor between a stated and an estimated variance of the background that is worth a note


@dataclass(slots=True)
class CameraNoise:
    """One camera's noise: what it is searched with and where that comes from."""

    camera: str
    stated: SensorNoise | None = None
    estimate: NoiseEstimate | None = None
    notes: list[str] = field(default_factory=list)
    _overruled: bool = False  # the stated noise finds nothing where there is light
    _blank: int = 0
    _recent: deque[Picture] = field(default_factory=lambda: deque(maxlen=2))

    @property
    def model(self) -> NoiseModel | None:
        """The model in use; None before the first picture."""
        seen = None if self.estimate is None else self.estimate.model
        if self.stated is None or self._overruled:
            return seen
        stated = NoiseModel.of(self.stated)
        # A sensor's data sheet does not know what its pictures show.
        return stated if seen is None else replace(stated, texture=seen.texture, banding_dn=seen.banding_dn)

    def learn(self, pictures: Sequence[Picture]) -> None:
        """Estimate from some pictures, in their order of time; nothing happens without any."""
        if not pictures:
            return
        self.estimate = estimate_noise(pictures)
        if self.stated is not None:
            level = self.estimate.model.black_dn
            stated = float(NoiseModel.of(self.stated).variance(level))
            seen = float(self.estimate.model.variance(level))
            if not 1 / _CONTRADICTION < seen / stated < _CONTRADICTION:
                self.notes.append(
                    f"{self.camera}: rig.yaml states noise of {np.sqrt(stated):.3g} DN at the background's level"
                    f" ({level:.4g} DN), the pictures show {np.sqrt(seen):.3g} DN; correct `noise` in rig.yaml, or"
                    " leave it out"
                )

    def detect(self, picture: Picture, parameters: DetectParameters) -> Detections:
        """The points of one picture. A camera that finds nothing where there is light learns its noise again."""
        if self.model is None:
            self.learn([picture])
        found = self._search(picture, parameters, self.model)
        if len(found):
            self._blank = 0
            self._recent.clear()
            return found
        self._recent.append(picture)
        self._blank += 1
        if self._blank % _BLANK_AGAIN == _BLANK and len(self._search(picture, parameters, guess_noise(picture))):
            return self._learn_again(picture, parameters)
        return found

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        out: dict[str, Any] = {} if self.model is None else asdict(self.model)
        if self.model is not None:
            out["source"] = "pictures" if self.stated is None or self._overruled else "rig"
        if self.estimate is not None:
            seen = asdict(self.estimate)
            model = seen.pop("model")
            out["estimated"] = {**model, **seen}
        return out

    def _search(self, picture: Picture, parameters: DetectParameters, model: NoiseModel | None) -> Detections:
        known = parameters.saturation_dn
        if known is None and self.estimate is not None:
            parameters = replace(parameters, saturation_dn=self.estimate.saturation_dn)
        return find_spots(picture, parameters, model)

    def _learn_again(self, picture: Picture, parameters: DetectParameters) -> Detections:
        estimate = estimate_noise(list(self._recent))
        found = self._search(picture, parameters, estimate.model)
        if len(found):
            self.estimate = estimate
            self._blank = 0
            if self.stated is not None and not self._overruled:
                self._overruled = True
                self.notes.append(
                    f"{self.camera}: with the noise that rig.yaml states no point was found in {_BLANK} pictures that"
                    " show light; the noise of the pictures was used from there on. Correct `noise` in rig.yaml, or"
                    " leave it out"
                )
        return found


def camera_noises(run: Run, reader: FrameReader) -> dict[str, CameraNoise]:
    """Each camera's noise at the start of a run. Tables of points need none and have no entry."""
    out = {}
    for name, camera in run.rig.cameras.items():
        if isinstance(run.cameras[name], DetectionsTable):
            continue
        out[name] = CameraNoise(name, camera.noise)
        if isinstance(run.cameras[name], FramesFolder):
            numbers = reader.listings[name].numbers
            wanted = [int(numbers[i]) for i in frames_to_learn_from(len(numbers))]
        else:
            wanted = list(VIDEO_PICTURES)
        shown = pictures_at(run, name, wanted)
        out[name].learn([p for _, p in sorted(shown.items()) if isinstance(p, np.ndarray)])
    return out


def frames_to_learn_from(pictures: int) -> list[int]:
    """Pairs of neighbours at the start, in the middle and at the end of so many pictures: the same light, in many
    places."""
    last = pictures - 1
    wanted = {0, 1, last // 2, last // 2 + 1, last - 1, last}
    return [i for i in sorted(wanted) if 0 <= i <= last]
