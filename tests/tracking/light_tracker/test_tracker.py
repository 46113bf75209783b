"""Detector and light tracker: hand-over, hidden targets, several targets, and pictures without one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.tracking.light_tracker.targets import SIZE, picture
from tracking.drogue_circle.detectors import CircleCandidate, Window
from tracking.light_tracker.frames import USUAL, DrogueFrame, LightParameters, MeasuredBy
from tracking.light_tracker.tracker import DrogueTracker
from tracking.noise import Picture
from tracking.statuses import Cause, PoseStatus

Circle = tuple[float, float, float]


class Detector:
    """A detector that knows the truth: with noise on the centre, and a count of its calls."""

    def __init__(self, share: float = 0.03, confidence: float = 0.9) -> None:
        self.circles: list[Circle] = []
        self.share, self.confidence = share, confidence
        self.whole = self.windows = 0
        self._rng, self._rng_of_whole = np.random.default_rng(8), np.random.default_rng(8)

    def __call__(self, image: Picture, window: Window | None) -> list[CircleCandidate]:
        self.whole += window is None
        self.windows += window is not None
        found = []
        for u, v, d in self.circles:
            rng = self._rng_of_whole if window is None else self._rng
            du, dv = self.share * d * rng.standard_normal(2)
            if window is None or np.hypot(u + du - window.u_px, v + dv - window.v_px) <= window.gate_px:
                found.append(CircleCandidate(u + du, v + dv, d / 2, self.confidence))
        return found


def path(k: int, diameter: float = 14.0) -> Circle:
    return 40.0 + 1.7 * k, 80 + 12 * np.sin(k / 9), diameter


def followed(
    frames: int,
    detector: Detector,
    hidden: Callable[[int], bool] = lambda k: False,
    diameter: float = 14.0,
    parameters: LightParameters = USUAL,
) -> tuple[list[DrogueFrame], np.ndarray]:
    """The frames, and the errors of the centre in diameters; inf where nothing is known."""
    tracker = DrogueTracker(detector, parameters)
    out, errors = [], []
    for k in range(frames):
        truth = path(k, diameter)
        gone = hidden(k)
        detector.circles = [] if gone else [truth]
        image = picture([truth], seed=k, hidden=(truth[0], truth[1], 2 * diameter) if gone else None)
        frame = tracker.step(image)
        out.append(frame)
        away = np.hypot(*(frame.centre_px - truth[:2])) / diameter
        errors.append(away if np.isfinite(away) else np.inf)
    return out, np.array(errors)


@pytest.mark.parametrize("diameter", [9.0, 30.0])
def test_the_detector_is_asked_in_few_frames_and_the_target_is_never_lost(diameter):
    detector = Detector()
    frames, errors = followed(40, detector, diameter=diameter)
    assert all(f.status is PoseStatus.MEASURED for f in frames)
    assert errors.max() < 0.12
    assert detector.whole <= 6  # the first picture, and every second check
    # Every fifth frame; more often in the first ones, until some checks have confirmed the target.
    assert 7 <= detector.windows <= 16
    assert {f.source for f in frames} == {MeasuredBy.DETECTOR, MeasuredBy.BOTH, MeasuredBy.LIGHT}
    assert frames[0].event == "acquired"
    assert frames[-1].diameter_px == pytest.approx(diameter, rel=0.1)
    assert frames[-1].rate_px[0] == pytest.approx(1.7, abs=0.4)


@pytest.mark.parametrize(("diameter", "confidence", "surer"), [(14.0, 0.97, 0.999), (20.0, 0.6, 0.88)])
def test_another_object_is_given_up_within_ten_frames_of_a_surer_drogue_of_any_size(diameter, confidence, surer):
    """Of one that the detector hardly takes for a drogue, a drogue need not be beyond doubt."""

    def detector(_: Picture, window: Window | None) -> list[CircleCandidate]:
        found = [CircleCandidate(120.0, 40.0, diameter / 2, confidence)]
        if comes <= k:
            found.append(CircleCandidate(40.0, 90.0, 15.0, surer))
        return [c for c in found if window is None or np.hypot(c.u_px - window.u_px, c.v_px - window.v_px) < 30]

    comes, tracker, places = 30, DrogueTracker(detector), []
    for k in range(45):
        shown = [(120.0, 40.0, diameter), *([(40.0, 90.0, 30.0)] if comes <= k else [])]
        places.append(tracker.step(picture(shown, seed=k)).centre_px)
    assert np.hypot(*(places[comes - 1] - (120, 40))) < 2
    assert max(np.hypot(*(p - (40, 90))) for p in places[comes + 10 :]) < 2


def test_the_errors_of_the_detections_average_out():
    frames, errors = followed(60, Detector(share=0.06))
    # A detection alone is wrong by 0.06 per axis: 0.075 in the mean of its length.
    assert errors[20:].mean() < 0.05
    assert np.sqrt(np.diag(frames[-1].covariance)).max() < 0.06 * 14


def test_the_sigma_of_the_centre_is_that_of_the_detections_whatever_their_scatter_is():
    ratios = []
    for share in (0.005, 0.01, 0.03):
        frames, _ = followed(60, Detector(share), parameters=LightParameters(check_every=1))
        ratios.append(np.sqrt(frames[-1].covariance[0, 0]) / (share * 14.0))
    # Of errors without a common part a third would do: that it is not there, no innovation shows.
    assert min(ratios) > 0.7
    assert max(ratios) < 2.0


def test_a_hidden_target_is_predicted_and_found_again():
    def hidden(k: int) -> bool:
        return 20 <= k < 25

    frames, errors = followed(40, Detector(), hidden)
    assert all(f.status is not PoseStatus.MEASURED for f in frames[20:25])
    assert {f.cause for f in frames[20:25]} <= {Cause.NO_MATCH, Cause.UNCERTAIN}
    known = [k for k in range(20, 25) if frames[k].status is not PoseStatus.LOST]
    assert np.all(errors[known] < 0.5)
    confidence = [f.confidence for f in frames[19:25]]
    assert confidence == sorted(confidence, reverse=True)
    assert all(f.status is PoseStatus.MEASURED for f in frames[28:])
    assert errors[28:].max() < 0.12


def test_while_the_target_is_hidden_nothing_that_resembles_it_a_little_is_followed():
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(32):
        circle = path(k)
        gone = k >= 16
        detector.circles = [] if gone else [circle]
        # The other ring correlates with the pattern by about 0.8.
        image = picture([] if gone else [circle], seed=k, alike=(circle[0] + 22, circle[1] + 6, circle[2]))
        frame = tracker.step(image)
        assert gone == (frame.status is not PoseStatus.MEASURED), k


@pytest.mark.parametrize("known", [1, 2, 18])
def test_what_replaces_the_target_in_one_frame_and_looks_different_is_no_measurement(known):
    """Between two checks, and where the pattern has never been found again."""
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(known + 3):
        detector.circles = [path(k)] if k < known else []
        image = picture(detector.circles, seed=k, alike=None if k < known else path(k))
        assert (k < known) == (tracker.step(image).status is PoseStatus.MEASURED), k


@pytest.mark.parametrize("score", [0.6, 0.8, 0.95])
def test_an_object_that_was_detected_once_is_never_surer_than_that_detection(score):
    """Its pattern, cut out of the picture before, is found again whatever it is."""
    detector = Detector(confidence=score)
    tracker = DrogueTracker(detector)
    for k in range(6):
        detector.circles = [path(k)] if k == 0 else []
        frame = tracker.step(picture([path(k)], seed=k))
        assert frame.confidence <= score + 1e-9
    # Below 0.9 the detector is asked again in each frame; it does not see the object any more.
    assert (frame.status is PoseStatus.MEASURED) == (score > 0.9)


def test_a_target_found_again_beside_what_hid_it_is_followed_when_that_has_gone():
    """The detector sees it once, half hidden, and misses it afterwards: it looks as before the occlusion again."""
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(45):
        u, v, d = path(k)
        gone, half = 22 <= k < 30, 30 <= k < 33
        detector.circles = [path(k)] if k < 22 or k == 30 else []
        hidden = (u, v, 2 * d) if gone else (u + 0.62 * d, v, 1.6 * d) if half else None
        frame = tracker.step(picture([path(k)], seed=k, hidden=hidden))
        if k >= 33:
            assert frame.correlation > 0.9, k  # nan without a match
            assert np.hypot(*(frame.centre_px - (u, v))) < 0.1 * d
            assert k > 33 or frame.status is PoseStatus.MEASURED


def test_frames_without_a_picture_are_predicted():
    detector, sigmas = Detector(), []
    tracker = DrogueTracker(detector)
    for k in range(20):
        detector.circles = [path(k)]
        frame = tracker.step(None if k in (10, 11) else picture([path(k)], seed=k))
        if k in (10, 11):
            assert (frame.status, frame.cause) == (PoseStatus.PREDICTED, Cause.NO_IMAGE)
            assert np.hypot(*(frame.centre_px - path(k)[:2])) < 2.0
            sigmas.append(float(np.sqrt(frame.covariance[0, 0])))
    assert sigmas[1] > 1.2 * sigmas[0]
    assert frame.status is PoseStatus.MEASURED
    assert DrogueTracker(detector).step(None).cause is Cause.NO_IMAGE


def test_of_two_targets_none_is_chosen_unless_the_place_is_stated():
    circles = [(50.0, 60.0, 14.0), (140.0, 90.0, 14.0)]
    detector = Detector()
    detector.circles = circles
    image = picture(circles)
    frame = DrogueTracker(detector).step(image)
    assert (frame.status, frame.cause, frame.event) == (PoseStatus.LOST, Cause.AMBIGUOUS, "ambiguous")
    assert np.isnan(frame.centre_px).all()
    assert frame.confidence == 0
    stated = DrogueTracker(detector, near_px=(138.0, 92.0)).step(image)
    assert stated.status is PoseStatus.MEASURED
    assert np.hypot(*(stated.centre_px - circles[1][:2])) < 3


@pytest.mark.parametrize(("second", "chosen"), [(0.9, False), (0.7, True)])
def test_a_second_detection_that_is_sure_by_itself_makes_the_choice_ambiguous(second, chosen):
    """Of two equal drogues the detector may give one .99 and the other .9: before, the first was tracked in silence."""

    def detector(image, window):
        return [CircleCandidate(50.0, 60.0, 7.0, 0.995), CircleCandidate(140.0, 90.0, 7.0, second)]

    frame = DrogueTracker(detector).step(picture([(50.0, 60.0, 14.0), (140.0, 90.0, 14.0)]))
    assert frame.status is (PoseStatus.MEASURED if chosen else PoseStatus.LOST)
    assert frame.cause is (Cause.NONE if chosen else Cause.AMBIGUOUS)


def test_a_second_target_that_appears_later_does_not_matter():
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(25):
        detector.circles = [path(k), (150.0, 20.0, 14.0)][: 1 + (k > 8)]
        frame = tracker.step(picture(detector.circles, seed=k))
    assert np.hypot(*(frame.centre_px - path(24)[:2])) < 2.0


def test_without_a_target_nothing_is_reported():
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(3):
        frame = tracker.step(picture([], seed=k))
        assert (frame.status, frame.cause, frame.event) == (PoseStatus.LOST, Cause.NOT_FOUND, "")


def test_a_false_acquisition_that_no_check_confirms_loses_its_confidence():
    detector = Detector(confidence=0.6)
    tracker = DrogueTracker(detector)
    detector.circles = [(120.0, 60.0, 14.0)]  # there is only texture
    frames = [tracker.step(picture([(40.0, 110.0, 14.0)], seed=0))]
    detector.circles = []
    frames += [tracker.step(picture([(40.0, 110.0, 14.0)], seed=k)) for k in range(1, 15)]
    assert frames[0].status is PoseStatus.MEASURED
    assert all(f.status is not PoseStatus.MEASURED for f in frames[8:])
    assert max(f.confidence for f in frames[8:]) < 0.5


def test_a_target_found_elsewhere_replaces_one_that_is_gone():
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(12):
        detector.circles = [path(k)]
        tracker.step(picture([path(k)], seed=k))
    detector.circles = [(150.0, 130.0, 14.0)]
    frames = [tracker.step(picture(detector.circles, seed=k)) for k in range(6)]
    assert "reacquired" in [f.event for f in frames]
    assert np.hypot(*(frames[-1].centre_px - (150.0, 130.0))) < 2.0


@pytest.mark.parametrize(
    ("diameter", "score", "followed_there"), [(23.0, 0.9, False), (14.0, 0.9, True), (14.0, 0.6, True)]
)
def test_a_hidden_target_is_found_elsewhere_if_the_detection_has_its_size(diameter, score, followed_there):
    """Once it is lost a detection that would start a track will do; a larger object is another one."""
    here, there = (60.0, 60.0, 14.0), (160.0, 130.0, diameter)
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(38):
        detector.circles = [here if k < 20 else there]
        detector.confidence = 0.9 if k < 20 else score
        frame = tracker.step(picture(detector.circles, seed=k))
    assert (np.hypot(*(frame.centre_px - there[:2])) < 2) == followed_there


@pytest.mark.parametrize("score", [0.85, 0.95, 0.99])
@pytest.mark.parametrize("aside", [0.0, 7.0])
def test_what_hides_a_doubtful_target_is_not_taken_for_it_however_sure_the_detector_is(score, aside):
    """It is larger than the target, and lies where the target was last."""
    here, cover = (60.0, 60.0, 14.0), (60.0 + aside, 60.0, 30.0)
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(30):
        detector.circles = [here] if k < 12 else [] if k < 22 else [cover]
        detector.confidence = 0.9 if k < 12 else score
        frame = tracker.step(picture([here] if k < 22 else [cover], seed=k))
        assert k < 22 or frame.status is not PoseStatus.MEASURED, k


def test_what_hides_a_target_of_uncertain_size_is_not_taken_for_it():
    """Its sigma would admit twice the diameter."""
    detector = Detector()
    tracker = DrogueTracker(detector, LightParameters(check_every=1))
    for k in range(40):
        d = 14 * (1.0, 1.35, 0.74)[k % 3]
        detector.circles = [(60.0, 60.0, d if k < 30 else 28.0)]
        detector.confidence = 0.9 if k < 30 else 0.97
        frame = tracker.step(picture([(60.0, 60.0, 14.0 if k < 30 else 28.0)], seed=k))
        assert k < 30 or frame.status is not PoseStatus.MEASURED, k


@pytest.mark.parametrize(("here", "there"), [(0.6, 0.88), (0.8, 0.95), (0.3, 0.9), (0.93, 0.95)])
def test_what_replaces_a_target_that_is_still_seen_is_as_sure_as_the_two_leave_it(here, there):
    """There is one drogue: what speaks for one object speaks against the other."""

    def detector(_: Picture, window: Window | None) -> list[CircleCandidate]:
        found = [CircleCandidate(120.0, 40.0, 10.0, 0.8 if k == 0 else 0.55 if window is not None else here)]
        if k >= 10:
            found.append(CircleCandidate(40.0, 90.0, 15.0, there))
        return [c for c in found if window is None or np.hypot(c.u_px - window.u_px, c.v_px - window.v_px) < 30]

    tracker, frames = DrogueTracker(detector), []
    for k in range(30):
        shown = [(120.0, 40.0, 20.0), *([(40.0, 90.0, 30.0)] if k >= 10 else [])]
        frames.append(tracker.step(picture(shown, seed=k)))
    replaced = [f for f in frames if f.event == "reacquired" and f.centre_px[0] < 80]
    odds = there / (1 - there) / (1 + here / (1 - here))
    assert len(replaced) == (odds > 1)
    assert all(f.confidence <= odds / (1 + odds) + 1e-9 for f in replaced)


@pytest.mark.parametrize("still_seen", [True, False])
def test_what_replaced_a_target_is_doubtful_as_long_as_the_target_is_seen(still_seen):
    """One look at an object that only resembles a drogue can be very sure: it is one of many."""
    replaced_at = None

    def detector(_: Picture, window: Window | None) -> list[CircleCandidate]:
        found = [CircleCandidate(40.0, 90.0, 15.0, 0.998 if replaced_at is None else 0.95)] if k >= 20 else []
        if replaced_at is None or still_seen:
            found.append(CircleCandidate(120.0, 40.0, 10.0, 0.8))
        return [c for c in found if window is None or np.hypot(c.u_px - window.u_px, c.v_px - window.v_px) < 30]

    tracker, sure = DrogueTracker(detector), []
    for k in range(120):
        frame = tracker.step(picture([(120.0, 40.0, 20.0), *([(40.0, 90.0, 30.0)] if k >= 20 else [])], seed=k))
        if replaced_at is None and frame.centre_px[0] < 80:
            replaced_at = k
        if replaced_at is not None:
            sure.append(frame.confidence)
    assert len(sure) > 80
    assert max(sure) < 0.92 if still_seen else min(sure[-10:]) > 0.93


def test_after_a_gap_nothing_is_measured_before_a_detection():
    detector = Detector()
    tracker = DrogueTracker(detector)
    for k in range(34):
        u, v, d = path(k)
        gone, unseen = 20 <= k < 23, 20 <= k < 27
        detector.circles = [] if unseen else [path(k)]
        frame = tracker.step(picture([path(k)], seed=k, hidden=(u, v, 2 * d) if gone else None))
        assert 27 <= k < 30 or (frame.status is PoseStatus.MEASURED) != unseen, k
        assert not 23 < k < 27 or np.hypot(*(frame.centre_px - (u, v))) < 0.15 * d  # a match is followed all the same


def test_a_match_after_a_gap_is_less_sure_than_one_without_until_a_detection():
    """What was in front of the target may be what matches; that it matches in more frames does not change it."""
    confidence: dict[bool, list[float]] = {}
    for hides in (True, False):
        detector = Detector()
        tracker, own = DrogueTracker(detector), []
        for k in range(34):
            u, v, d = path(k)
            gone = hides and 20 <= k < 26
            detector.circles = [] if gone or 26 <= k < 30 else [path(k)]
            own.append(tracker.step(picture([path(k)], seed=k, hidden=(u, v, 2 * d) if gone else None)).confidence)
        confidence[hides] = own
    assert all(confidence[True][k] < confidence[False][k] - 0.02 for k in range(26, 30))
    assert confidence[True][33] > max(confidence[True][26:30])


def test_a_prediction_is_no_surer_than_the_doubtful_match_before_it():
    detector = Detector()
    tracker, confidence = DrogueTracker(detector), []
    for k in range(26):
        u, v, d = path(0)
        detector.circles = [path(0)] if k < 12 else []
        hidden = (u, v, 2 * d) if k >= 22 else None
        frame = tracker.step(picture([path(0)], seed=k, hidden=hidden))
        confidence.append(frame.confidence)
        assert k < 20 or frame.status is PoseStatus.PREDICTED
    assert confidence[20:] == sorted(confidence[20:], reverse=True)


def test_a_target_that_leaves_the_picture_is_out_of_view_then_lost():
    detector = Detector()
    tracker = DrogueTracker(detector)
    causes, last = [], None
    for k in range(60):
        circle = (120.0 + 4.0 * k, 80.0, 14.0)
        detector.circles = [circle] if circle[0] < SIZE[0] else []
        last = tracker.step(picture([circle], seed=k))
        causes.append(last.cause)
    assert Cause.OUT_OF_VIEW in causes
    assert last is not None
    assert last.status is PoseStatus.LOST


@pytest.mark.parametrize("wrong", [{"check_every": 0}, {"smallest_px": 4.0}, {"largest_px": 5.0}])
def test_parameters_without_a_meaning_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LightParameters(**wrong)
