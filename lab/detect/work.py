"""A series of pictures in work: each size and depth with its noise, the spots found, what could not be read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lab.detect.findings import SizeGroup, SpotCollection, matched_snr
from lab.pictures.picture_file import Grey
from lab.runs.frames.sensor_noise import CameraNoise
from tracking.detections import Detections
from tracking.parameters import DetectParameters


@dataclass(slots=True)
class Work:
    """What is known so far; the report is made of it."""

    camera: str
    source: str
    parameters: DetectParameters
    groups: dict[tuple[tuple[int, int], int], SizeGroup] = field(default_factory=dict)
    learnt: dict[tuple[tuple[int, int], int], list[Grey]] = field(default_factory=dict)  # pictures behind the noise
    spots: SpotCollection = field(default_factory=SpotCollection)
    unreadable: dict[str, list[int]] = field(default_factory=dict)  # frames by reason
    notes: list[str] = field(default_factory=list)

    @property
    def pictures(self) -> int:
        """How many were searched."""
        return sum(group.pictures for group in self.groups.values())

    def group_of(self, picture: Grey) -> SizeGroup:
        """The group of a picture, made where it is new; its noise is learnt from the picture when that is searched."""
        key = _kind(picture)
        if key not in self.groups:
            self.groups[key] = SizeGroup(*key, CameraNoise(self.camera))
        return self.groups[key]

    def learn(self, pictures: list[Grey]) -> None:
        """The noise of each size and depth among some pictures."""
        for picture in pictures:
            self.learnt.setdefault(_kind(picture), []).append(picture)
        for some in self.learnt.values():
            self.group_of(some[0]).noise.learn(some)

    def search(self, frame: int, picture: Grey) -> Detections:
        """The spots of a picture, which are counted."""
        group = self.group_of(picture)
        found = group.noise.detect(picture, self.parameters)
        group.pictures += 1
        model = group.noise.model
        assert model is not None  # learnt at the latest by the search
        self.spots.add(frame, found, matched_snr(found, float(np.sqrt(model.floor_dn2))))
        return found


def _kind(picture: Grey) -> tuple[tuple[int, int], int]:
    return (picture.shape[1], picture.shape[0]), 8 * picture.dtype.itemsize
