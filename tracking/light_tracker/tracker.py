"""The light tracker: what is known of a drogue while it is followed, and the steps from picture to picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from tracking.drogue_circle.detectors import CircleCandidate, CircleDetector, Window
from tracking.light_tracker.frames import (
    ABSENT_LOGIT,
    USUAL,
    DrogueFrame,
    LightParameters,
    MeasuredBy,
    against,
    features,
    fisher,
    logit,
    nothing_known,
    probability,
    within,
)
from tracking.light_tracker.pattern import WHOLE, Known, Match, Pattern, PatternState, is_clear, is_similar, unexplained
from tracking.noise import Picture
from tracking.statuses import Cause, PoseStatus

# What is known of a drogue while it is followed.

TRUSTED = 4  # detections that confirmed a track
_SIZE_SIGMAS = 3.0  # of the logarithm of the diameter, within which a detection without a match can be the drogue
_MOSTLY = 0.6  # visible share from which the agreement of this share counts


@dataclass(slots=True)
class Track:
    """What is known of the drogue while it is followed."""

    motion: PatternState
    pattern: Pattern
    support: float  # running mean of the log odds of the checks
    usual: float = float("nan")  # running mean of Fisher's z of the matches' correlation
    confirmed: int = 1  # detections
    unconfirmed: int = 0  # checks in a row without a detection
    age: float = 0.0  # frames since the last confirmation
    since_check: int = 0  # frames since the detector searched
    checks: int = 0
    lost: bool = False  # reported as lost
    trusted: float = 1.0  # confidence of the last match
    misses: int = 0  # frames in a row without a measurement
    blind: int = 0  # frames in a row without a match that resembles the pattern
    gap: int = 0  # the same since the last confirmation: what matches afterwards may be another object
    before: Known | None = None  # the appearance before the pattern was cut out again
    against: float = -np.inf  # log odds of the drogue that this one replaced: running mean over the searches

    @property
    def known(self) -> Known | None:
        """The appearance that detections confirmed last."""
        if self.confirmed < TRUSTED or np.isnan(self.usual):
            return self.before
        return Known(self.pattern, self.usual, self.confirmed, self.support, self.motion)

    def take_back(self, known: Known, found: Match, p: LightParameters) -> None:
        """Continue with the appearance from before, found again at a place."""
        self.motion = known.motion.moved(found, p)
        self.pattern, self.usual, self.before = known.pattern, known.usual, None
        self.confirmed, self.support = known.confirmed, known.support

    def count_blind(self) -> None:
        """One more frame without a match."""
        self.blind, self.gap = self.blind + 1, self.gap + 1

    def checked(self, gap: int = 0) -> Array:
        """The inputs of the confidence."""
        return features(self.support, self.confirmed, self.motion.rim_diameter_px, gap)

    def lead(self) -> float:
        """Log odds of the track, or of the drogue before its pattern was cut out again."""
        inputs, before = [self.checked()], self.before
        if before is not None:
            inputs.append(features(before.support, before.confirmed, before.motion.rim_diameter_px))
        return max(logit(probability(x)) for x in inputs)

    def see_others(self, found: Sequence[CircleCandidate]) -> None:
        """The detections of the whole picture: is the drogue that this one replaced still seen?"""
        if np.isfinite(self.against):
            u, v = self.motion.centre_px
            others = [logit(c.score) for c in found if np.hypot(c.u_px - u, c.v_px - v) > self.motion.rim_diameter_px]
            self.against += _SUPPORT_RATE * (max(others, default=ABSENT_LOGIT) - self.against)

    def has_size_of(self, seen: CircleCandidate, p: LightParameters) -> bool:
        """Whether a detection has the size of the drogue, if that is known from enough detections."""
        away = abs(np.log(2 * seen.radius_px / self.motion.rim_diameter_px))
        sigma = np.hypot(self.motion.sigma_diameter_px / self.motion.rim_diameter_px, p.detection_size_sigma)
        return self.confirmed < TRUSTED or bool(away < min(_SIZE_SIGMAS * sigma, np.log(p.size_ratio)))

    def resembles(self, match: Match) -> bool:
        """Whether a match is about as good as the ones before; of a new pattern (nan), whether it is good."""
        return is_similar(self.usual, fisher(match.agreement if match.visible > _MOSTLY else match.correlation))


# Tracks one drogue: the detector acquires it and checks every few frames, the light tracker follows it in between.
#
# Rules of the hand-over (ours; Zhou (2020) only states that a light tracker follows the network):
# - The detector searches the whole picture until it finds one drogue that it is confident of.
# - In each frame the light tracker finds the pattern near its prediction. Every `check_every` frames, after a frame
#   without a match, or as soon as the confidence is low, the detector searches a window around it. A detection there
#   confirms the track and corrects it.
# - After frames without a match, or checks in a row without a detection, the detector searches the whole picture.


_NEAR_PX = 20.0  # distance of the first drogue from the place that the user states
_MOST_SUPPORT = 3.5  # of one detection that replaces a track: one look of many at an object is the surest
_SUPPORT_RATE = 0.25  # of the running mean of the log odds of the checks
_USUAL_RATE = 0.1  # of the running mean of the correlation
_OFF_CENTRE, _OFF_SIZE = 0.12, 0.2  # offset of the pattern, in diameters and as a logarithm, that cuts it out again
_MORE_PX = 2.0  # radius of a window beyond 3 sigma


@dataclass(slots=True)
class DrogueTracker:
    """The state between frames. `detector`: of drogues; the score of its candidates is a probability."""

    detector: CircleDetector
    parameters: LightParameters = USUAL
    near_px: tuple[float, float] | None = None  # of the first drogue, if the user knows it
    _track: Track | None = None
    _last: PatternState | None = None  # of the drogue that was lost
    _ambiguous: bool = False
    trace: list[tuple[Array, Array]] | None = None  # if a list: gets inputs of the confidence, and the centre, px

    def step(self, picture: Picture | None, dt: float = 1.0) -> DrogueFrame:
        """The next frame. picture None: there is none. dt: frames since the last step."""
        track = self._track
        if track is None:
            return nothing_known(Cause.NO_IMAGE) if picture is None else self._acquired(picture)
        track.motion = track.motion.predicted(dt, track.blind, self.parameters)
        predicted = track.motion
        track.age += dt
        if picture is None:
            track.count_blind()
            return self._unmeasured(track, Cause.NO_IMAGE)
        height, width = picture.shape
        u, v = track.motion.x[:2].tolist()
        if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
            track.count_blind()
            return self._missed(track, picture, Cause.OUT_OF_VIEW)
        match = self._matched(track, picture)
        if match is not None:
            track.motion = track.motion.matched(match, self.parameters, track.blind == 0)
        elif track.before is not None:
            match = track.before.found(picture, u, v, 3 * track.motion.sigma_px + _MORE_PX)
            if match is not None:
                track.take_back(track.before, match, self.parameters)
        track.since_check += 1
        searched, found, source = "", 0, MeasuredBy.LIGHT
        confidence = self._confidence(track, match)
        p = self.parameters
        # Something in front of the drogue can match in part: what looks different needs the detector's word.
        different = match is not None and not track.resembles(match)
        due = track.since_check >= p.check_every or track.gap > 0 or different
        if match is None or due or confidence < p.hand_back_confidence:
            seen = self._seen(track, picture)
            searched, found, track.since_check, track.checks = "window", len(seen), 0, track.checks + 1
            best = self._confirming(track, seen, match)
            if best is not None:
                match = self._confirm(track, picture, best, match)
                source = MeasuredBy.BOTH
            elif different:
                match = None
            elif match is not None:
                track.unconfirmed += 1
                track.support += _SUPPORT_RATE * (ABSENT_LOGIT - track.support)
            confidence = self._confidence(track, match)
        # After a gap, what was in front of the drogue may match.
        if match is None or confidence < p.measured_confidence or track.gap > 0:
            cause = Cause.NO_MATCH if match is None else Cause.UNCERTAIN
            if match is not None and track.resembles(match):
                track.blind, track.trusted = 0, confidence  # it may be the drogue: later frames decide
            else:
                track.count_blind()
                track.motion = predicted.with_offset_of(track.motion)
            return self._missed(track, picture, cause, match, searched, found)
        doubted = track.unconfirmed > 0 and track.unconfirmed % p.most_unconfirmed == 0
        if track.since_check == 0 and (doubted or track.checks % p.picture_every == 0):
            again = self._found_elsewhere(track, picture, matched=True)
            if again is not None:
                return again
            searched = "both"
        event, track.lost = "reacquired" if track.lost else "", False
        track.misses, track.blind, track.trusted = 0, 0, confidence
        self._learn(track, picture, match)
        return self._frame(
            track, PoseStatus.MEASURED, Cause.NONE, source, confidence, searched, found, event, match.correlation
        )

    def _matched(self, track: Track, picture: Picture) -> Match | None:
        """The pattern near the prediction."""
        motion = track.motion
        reach = 3 * motion.sigma_px + _MORE_PX
        usual = unexplained(float(np.tanh(track.usual))) if np.isfinite(track.usual) else np.inf
        match = track.pattern.find(picture, float(motion.x[0]), float(motion.x[1]), motion.diameter_px, reach, usual)
        if match is None or match.correlation < self.parameters.least_correlation:
            return None
        # After a gap, what is in front of the drogue has a weak correlation too, as have many places of a wide window.
        if track.gap and not (track.resembles(match) and is_clear(match)):
            return None
        limit = np.log(self.parameters.size_ratio)
        return match if abs(np.log(match.diameter_px) - motion.log_diameter) < limit else None

    def _seen(self, track: Track, picture: Picture) -> list[CircleCandidate]:
        """What the detector finds around the track, of about its size."""
        motion, p = track.motion, self.parameters
        diameter = motion.rim_diameter_px
        gate = p.window_diameters * diameter + 3 * motion.sigma_px
        u, v = motion.centre_px.tolist()
        low, high = diameter / 2 / p.size_ratio, diameter / 2 * p.size_ratio
        # From an eighth of the diameter on: the network sees large drogues at a finer scale, and places them better.
        window = Window(u, v, gate + 0.6 * diameter, gate, diameter / 8, high)
        return [
            c for c in self.detector(picture, window)
            if c.score >= p.confirm_confidence and low <= c.radius_px <= high
        ]  # fmt: skip

    def _confirming(self, track: Track, seen: Sequence[CircleCandidate], match: Match | None) -> CircleCandidate | None:
        """The detection of the tracked drogue: at the match, or, without one, where the drogue can be."""
        motion, p = track.motion, self.parameters
        near = p.agree_diameters * motion.rim_diameter_px + (3 * motion.sigma_px if match is None else 1.0)
        u, v = motion.centre_px.tolist()
        own = [c for c in seen if np.hypot(c.u_px - u, c.v_px - v) <= near]
        if match is None:
            own = [c for c in own if c.score >= p.acquire_confidence and track.has_size_of(c, p)]
        return max(own, key=lambda c: c.score, default=None)

    def _confirm(self, track: Track, picture: Picture, seen: CircleCandidate, match: Match | None) -> Match | None:
        """Take a detection into the track. Returns the match, found again at the detection where there was none."""
        p = self.parameters
        if match is None:
            track_at = track.motion
            u, v = (np.array([seen.u_px, seen.v_px]) - track_at.diameter_px * track_at.offset[:2]).tolist()
            diameter = 2 * seen.radius_px / float(np.exp(track_at.offset[2]))
            match = track.pattern.find(picture, u, v, diameter, 0.2 * diameter + 1)
            if match is not None and match.correlation >= p.least_correlation:
                track.motion = track.motion.matched(match, p, learn=False)
            elif seen.score >= p.elsewhere_confidence and track.misses >= p.search_after:
                return self._cut_again(track, picture, seen)
            else:
                return None
        track.motion = track.motion.detected(seen.u_px, seen.v_px, 2 * seen.radius_px, p)
        track.support += _SUPPORT_RATE * (logit(seen.score) - track.support)
        track.confirmed, track.unconfirmed, track.age, track.gap = track.confirmed + 1, 0, 0.0, 0
        return match

    def _cut_again(self, track: Track, picture: Picture, seen: CircleCandidate) -> Match | None:
        """A new pattern at a detection: the drogue does not look as before."""
        diameter = 2 * seen.radius_px
        pattern = Pattern.started(picture, seen.u_px, seen.v_px, diameter)
        match = None if pattern is None else pattern.find(picture, seen.u_px, seen.v_px, diameter, 0.0)
        if pattern is None or match is None:
            return None
        track.before = track.known
        track.motion = PatternState.started(seen.u_px, seen.v_px, diameter, self.parameters)
        track.pattern, track.usual, track.confirmed = pattern, float("nan"), 1
        track.unconfirmed, track.age, track.gap = 0, 0.0, 0
        return match

    def _learn(self, track: Track, picture: Picture, match: Match) -> None:
        """Update the pattern with a good match."""
        z, p = fisher(match.correlation), self.parameters
        whole = match.visible > WHOLE
        if match.correlation >= p.update_correlation and whole:
            track.pattern = track.pattern.updated(match, p.update_rate)
        offset = np.abs(track.motion.offset)
        if whole and track.age == 0 and (offset[:2].max() > _OFF_CENTRE or offset[2] > _OFF_SIZE):
            motion = track.motion.centred()
            pattern = Pattern.started(picture, float(motion.x[0]), float(motion.x[1]), motion.diameter_px)
            if pattern is not None:
                track.motion, track.pattern = motion, pattern
        rate = _USUAL_RATE if whole else _USUAL_RATE / 5
        track.usual = z if np.isnan(track.usual) else track.usual + rate * (z - track.usual)

    def _confidence(self, track: Track, match: Match | None) -> float:
        if match is None:
            return 0.0
        inputs = track.checked(track.gap)
        if self.trace is not None:
            self.trace.append((inputs, track.motion.centre_px))
        return against(probability(inputs), track.against)

    def _acquired(self, picture: Picture) -> DrogueFrame:
        """Search the whole picture."""
        found = self._in_picture(picture)
        best, ambiguous = self._chosen(found)
        event = "ambiguous" if ambiguous and not self._ambiguous else ""
        self._ambiguous = ambiguous
        pattern = None if best is None else Pattern.started(picture, best.u_px, best.v_px, 2 * best.radius_px)
        if best is None or pattern is None:
            cause = Cause.AMBIGUOUS if ambiguous else Cause.NOT_FOUND
            return nothing_known(cause, event, "picture", len(found))
        event = "acquired" if self._last is None else "reacquired"
        return self._start(best, pattern, "picture", len(found), event)

    def _start(self, seen: CircleCandidate, pattern: Pattern, searched: str, found: int, event: str) -> DrogueFrame:
        motion = PatternState.started(seen.u_px, seen.v_px, 2 * seen.radius_px, self.parameters)
        self._track = track = Track(motion, pattern, logit(seen.score), trusted=seen.score)
        by = MeasuredBy.DETECTOR
        return self._frame(track, PoseStatus.MEASURED, Cause.NONE, by, seen.score, searched, found, event)

    def _in_picture(self, picture: Picture) -> list[CircleCandidate]:
        return [c for c in self.detector(picture, None) if c.score >= self.parameters.confirm_confidence]

    def _chosen(self, found: Sequence[CircleCandidate]) -> tuple[CircleCandidate | None, bool]:
        """The drogue among the detections of a picture, and whether several can be it."""
        p = self.parameters
        good = [c for c in found if c.score >= p.acquire_confidence]
        if self.near_px is not None and self._last is None:
            u, v = self.near_px
            good = [c for c in good if np.hypot(c.u_px - u, c.v_px - v) <= max(_NEAR_PX, c.radius_px)]
        good.sort(key=lambda c: -c.score)
        if len(good) > 1:
            as_likely = logit(good[0].score) - logit(good[1].score) < p.ambiguous_logit
            if as_likely or good[1].score > p.elsewhere_confidence:
                return None, True
        return (good[0], False) if good else (None, False)

    def _missed(
        self,
        track: Track,
        picture: Picture,
        cause: Cause,
        match: Match | None = None,
        searched: str = "",
        found: int = 0,
    ) -> DrogueFrame:
        """No measurement: at times the detector searches the whole picture; else the frame is predicted or lost."""
        if (track.misses + 1) % self.parameters.search_after == 0:
            again = self._found_elsewhere(track, picture, match is not None)
            if again is not None:
                return again
            searched = "both" if searched else "picture"
        out = self._unmeasured(track, cause)
        correlation = float("nan") if match is None else match.correlation
        return replace(out, correlation=correlation, searched=searched, found=found)

    def _found_elsewhere(self, track: Track, picture: Picture, matched: bool) -> DrogueFrame | None:
        """A drogue of the tracked size in the whole picture, or one that the detector is surer of than of the track.

        matched: the track has a match; only a drogue of the second kind, away from it, replaces it. Without a match,
        what has another size and covers the predicted place may be what hides the drogue.
        """
        motion, p = track.motion, self.parameters
        found = self._in_picture(picture)
        lead = track.lead()
        track.see_others(found)
        away = {c: np.hypot(*(motion.centre_px - (c.u_px, c.v_px))) - motion.rim_diameter_px / 2 for c in found}
        again = [c for c in found if not matched and track.has_size_of(c, p)]
        surer = [
            c for c in found
            if logit(c.score) > lead + p.sure_logit and away[c] >= (0 if matched else c.radius_px) and c not in again
        ]  # fmt: skip
        best, _ = self._chosen(again + surer)
        if best is None or (best.score < p.elsewhere_confidence and not track.lost):
            return None
        if best in surer:
            # One of the two is the drogue, or none: the odds of the track, or those in this picture, count against it.
            other = max([lead, *(logit(c.score) for c in found if away[c] < 0)])
            if against(best.score, other) < p.acquire_confidence:
                return None
        pattern = Pattern.started(picture, best.u_px, best.v_px, 2 * best.radius_px)
        if pattern is None:
            return None
        known = track.known
        out = self._start(best, pattern, "both", len(found), "reacquired")
        assert self._track is not None
        self._track.before = known
        if best not in surer:
            return out
        self._track.against, self._track.support = other, min(self._track.support, _MOST_SUPPORT)
        self._track.trusted = against(1 / (1 + np.exp(-self._track.support)), other)
        return replace(out, confidence=self._track.trusted)

    def _unmeasured(self, track: Track, cause: Cause) -> DrogueFrame:
        """A frame without a measurement: predicted, or lost."""
        track.misses += 1
        motion, p = track.motion, self.parameters
        if track.misses > p.most_predicted or track.age > p.most_unseen:
            self._last, self._track = motion, None
            return nothing_known(cause, "" if track.lost else "lost")
        if motion.sigma_px > p.lost_sigma_diameters * motion.rim_diameter_px:
            # The track is kept: its pattern may be found again before the detector finds the drogue.
            event = "" if track.lost else "lost"
            track.lost = True
            return nothing_known(cause, event)
        sigma = float(np.sqrt(np.trace(motion.covariance) / 2))
        confidence = track.trusted * within(sigma, motion.rim_diameter_px)
        return self._frame(track, PoseStatus.PREDICTED, cause, MeasuredBy.NONE, confidence)

    @staticmethod
    def _frame(
        track: Track,
        status: PoseStatus,
        cause: Cause,
        source: MeasuredBy,
        confidence: float,
        searched: str = "",
        found: int = 0,
        event: str = "",
        correlation: float = float("nan"),
    ) -> DrogueFrame:
        m = track.motion
        return DrogueFrame(
            status, cause, source, m.centre_px, m.x[2:].copy(), m.rim_diameter_px, m.covariance, m.sigma_diameter_px,
            confidence, correlation, searched, found, event,
        )  # fmt: skip
