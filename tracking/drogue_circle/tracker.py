"""Tracks one circle through pictures: Zhou (2014), figure 2, with a rim fit, a sound noise model and acquisition."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array
from tracking.drogue_circle.acquisition import Wanted, acquire
from tracking.drogue_circle.candidates import CircleDetector, Picture
from tracking.drogue_circle.frames import CircleFrame, nothing_known
from tracking.drogue_circle.occlusion import disc_cells, is_clear
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.rim_fit import RimFit
from tracking.drogue_circle.track import WHOLE, Track
from tracking.statuses import Cause, PoseStatus

_CONFIRMED = 3  # measurements after which an acquisition is confirmed
_CHANGED = 4  # searches of the whole picture after which a circle of another appearance is accepted
_FORGOTTEN = 50  # searches for a circle like the lost one, after which any circle is accepted
_NEAR_PX = 20.0  # distance of the first circle from the place that the user states


@dataclass(slots=True)
class CircleTracker:
    """The state between frames. `detector` returns coarse circles; the rim fit is the same for all detectors."""

    detector: CircleDetector
    parameters: CircleParameters = field(default_factory=CircleParameters)
    near_px: tuple[float, float] | None = None  # of the first circle, if the user knows it
    _track: Track | None = None
    _trusted: RimFit | None = None  # the last clear fit of a confirmed circle
    _searches: int = 0  # of the whole picture since the circle was lost
    _ambiguous: bool = False

    def step(self, picture: Picture | None, dt: float = 1.0) -> CircleFrame:
        """The next frame. picture None: there is none. dt: frames since the last step."""
        track = self._track
        if track is None:
            return nothing_known(Cause.NO_IMAGE) if picture is None else self._acquired(picture)
        track.bank = track.bank.predicted(dt)
        predicted = track.bank.state()[0][:3]
        if picture is None:
            track.misses += 1
            return self._unmeasured(track, Cause.NO_IMAGE, predicted, np.nan)
        fit, gamma = track.measure(picture, self.detector, self.parameters)
        if fit is not None and gamma < self.parameters.occluded:
            track.update(fit, gamma, self.parameters)
            if is_clear(gamma) and track.measured > _CONFIRMED:
                self._trusted = fit
            x, P = track.bank.state()
            return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, fit, gamma)
        track.misses += 1
        if track.measured < _CONFIRMED <= track.misses:
            self._track = None  # a false acquisition: no later frame confirms it
            return replace(nothing_known(Cause.NOT_FOUND, "lost"), predicted=predicted)
        if track.misses % self.parameters.search_after == 0:
            again = self._found_elsewhere(track, picture, predicted)
            if again is not None:
                return again
        height, width = picture.shape[:2]
        outside = not (-0.5 <= predicted[0] < width - 0.5 and -0.5 <= predicted[1] < height - 0.5)
        hidden = gamma >= self.parameters.occluded
        cause = Cause.OUT_OF_VIEW if outside else Cause.OCCLUDED if hidden else Cause.NOT_FOUND
        return self._unmeasured(track, cause, predicted, gamma)

    def _acquired(self, picture: Picture) -> CircleFrame:
        """Search the whole picture: for any circle, or for one like that which was lost."""
        self._searches += 1
        before = self._trusted if self._searches <= _FORGOTTEN else None
        wanted = Wanted(
            near_px=self.near_px if self._trusted is None else None,
            within_px=_NEAR_PX,
            radius_px=None if before is None else before.rim.radius_px,
            polarity=0 if before is None else before.polarity,
        )
        search = acquire(picture, self.detector, self.parameters, wanted)
        ambiguous = search.found is None and len(search.circles) > 1
        event = "ambiguous" if ambiguous and not self._ambiguous else ""
        self._ambiguous = ambiguous
        if search.found is None:
            cause = Cause.AMBIGUOUS if ambiguous else Cause.NOT_FOUND
            return replace(nothing_known(cause, event), found=len(search.circles))
        self._track, self._searches = Track.started(picture, search.found, self.parameters), 0
        event = "acquired" if self._trusted is None else "reacquired"
        return self._at_start(self._track, np.full(3, np.nan), len(search.circles), event)

    def _found_elsewhere(self, track: Track, picture: Picture, predicted: Array) -> CircleFrame | None:
        """The circle outside the window, or with a changed appearance: one that is well seen and has its radius."""
        like = track.fit if self._trusted is None else self._trusted
        radius = float(np.clip(predicted[2], 0.7 * like.rim.radius_px, 1.4 * like.rim.radius_px))
        wanted = Wanted(radius_px=radius, radius_factor=1.3, polarity=like.polarity)
        search = acquire(picture, self.detector, self.parameters, wanted)
        if search.found is None:
            return None
        if is_clear(track.appearance.coefficient(*disc_cells(picture, *search.found.circle))):
            track.restart(search.found, self.parameters)
        # After a longer gap the appearance of the own circle may have changed; a partly hidden one is not believed.
        elif track.misses >= _CHANGED * self.parameters.search_after and search.found.coverage > WHOLE:
            self._track = track = Track.started(picture, search.found, self.parameters)
        else:
            return None
        return self._at_start(track, predicted, len(search.circles), "reacquired")

    def _at_start(self, track: Track, predicted: Array, found: int, event: str) -> CircleFrame:
        """The frame of an acquisition. No appearance is known yet: the coefficient is that of the rim."""
        x, P = track.bank.state()
        gamma = float(np.clip(1 - track.fit.coverage, 0.0, 1.0))
        return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, track.fit, gamma, found, event)

    def _unmeasured(self, track: Track, cause: Cause, predicted: Array, gamma: float) -> CircleFrame:
        """A frame without a measurement: predicted, or lost."""
        x, P = track.bank.state()
        sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
        certain = sigma <= self.parameters.lost_sigma_radii * max(float(x[2]), 1.0)
        if certain and x[2] > 2 and track.misses <= self.parameters.most_predicted:
            return CircleFrame(PoseStatus.PREDICTED, cause, x, P, predicted, None, gamma)
        self._track = None
        return replace(nothing_known(cause, "lost"), predicted=predicted, occlusion=gamma)
