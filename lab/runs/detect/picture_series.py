"""Detection over a series of pictures: noise by size and depth, the spots, and the unreadable pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array
from lab.pictures.picture_file import GreyPicture
from lab.runs.detect.findings import SizeGroup, SpotCollection, laser_likeness, matched_snr
from lab.runs.frames.sensor_noise import CameraNoise
from tracking.detection.detect import overlooked_lights
from tracking.detections import Detections
from tracking.parameters import DetectParameters


class WideLight(NamedTuple):
    """The brightest light of a picture that max_sigma_px excludes."""

    frame: int
    uv_px: tuple[float, float]
    sigma_px: float


@dataclass(slots=True)
class PictureSeries:
    """The results so far; the page and the summary are made from them."""

    camera: str
    source: str
    parameters: DetectParameters
    groups: dict[tuple[tuple[int, int], int], SizeGroup] = field(default_factory=dict)
    noise_pictures: dict[tuple[tuple[int, int], int], list[GreyPicture]] = field(
        default_factory=dict
    )  # the noise's source
    spots: SpotCollection = field(default_factory=SpotCollection)
    unreadable: dict[str, list[int]] = field(default_factory=dict)  # frames by reason
    overlooked: list[WideLight] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def pictures(self) -> int:
        """Number of pictures searched."""
        return sum(group.pictures for group in self.groups.values())

    def group_of(self, picture: GreyPicture) -> SizeGroup:
        """The group of a picture; a new group estimates its noise from the first picture that is searched."""
        key = _kind(picture)
        if key not in self.groups:
            self.groups[key] = SizeGroup(*key, CameraNoise(self.camera))
        return self.groups[key]

    def estimate_noise(self, pictures: list[GreyPicture]) -> None:
        """Estimate the noise of each size and depth among some pictures."""
        for picture in pictures:
            self.noise_pictures.setdefault(_kind(picture), []).append(picture)
        for some in self.noise_pictures.values():
            self.group_of(some[0]).noise.estimate_from(some)

    def search(self, frame: int, picture: GreyPicture) -> tuple[Detections, Array]:
        """Detect the spots (n) of a picture and add them to the results; with their likeness to a laser's (n,)."""
        group = self.group_of(picture)
        found = group.noise.detect(picture, self.parameters)
        group.pictures += 1
        model = group.noise.model
        assert model is not None  # the search has estimated it
        wide = overlooked_lights(picture, self.parameters, model, found)
        if len(wide):
            i = int(np.argmax(wide.peak))
            self.overlooked.append(WideLight(frame, (wide.uv_px[i, 0], wide.uv_px[i, 1]), float(wide.major_px[i])))
        likeness = laser_likeness(picture, found, group.noise.saturation_dn(picture, self.parameters))
        self.spots.add(frame, found, matched_snr(found, float(np.sqrt(model.of_means.floor_dn2))), likeness)
        return found, likeness


def _kind(picture: GreyPicture) -> tuple[tuple[int, int], int]:
    return (picture.shape[1], picture.shape[0]), 8 * picture.dtype.itemsize
