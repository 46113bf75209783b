"""The parameters of detection, labelling and tracking, each with unit, meaning and the reason for its default."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

_SHARES = frozenset({"p_detect", "p_blend", "p_manoeuvre", "min_label_probability", "min_explained"})  # at most 1
_OF_ANY_SIZE = frozenset({"eps1", "eps2"})  # g3 of a motion that turns back may be negative


class _InRange:
    """Parameters whose numbers are 0 or more, whose counts are 1 or more, and whose probabilities are at most 1."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Raises ValueError: the first number outside its range."""
        for one in fields(self):  # type: ignore[arg-type]  # of the dataclasses below
            value = getattr(self, one.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or one.name in _OF_ANY_SIZE:
                continue
            least, most = int(one.type == "int"), 1.0 if one.name in _SHARES else float("inf")
            if not least <= value <= most:
                expected = f"a number from {least} to {most:g}" if most == 1 else f"a number of {least} or more"
                raise ValueError(f"{one.name}: expected {expected}, got {value!r}")


@dataclass(frozen=True, slots=True)
class DetectParameters(_InRange):
    """Finding and measuring points of light in one picture (tracking/detection)."""

    threshold_sigma: float = 6.0  # detection threshold above the local background, in sigmas of its noise
    max_detections: int = 400  # largest number of detections per picture; the brightest are kept
    saturation_dn: float | None = None  # grey value at which the sensor clips; None: the largest of the picture's type
    min_sigma_px: float = 0.25  # minor half axis; below it is a hot pixel: a spot one pixel wide has 0.42
    max_sigma_px: float = 30.0  # major half axis; above it is a reflection or a lit screen: a spot 70 px wide has 30
    min_explained: float = 0.5  # least share of a candidate's light above the background that a Gaussian explains


@dataclass(frozen=True, slots=True)
class LabelParameters(_InRange):
    """Labels without a track: the first frame and after a blackout (tracking/labelling/first_labels.py)."""

    model_sigma_px: float = 0.3  # px: 1-sigma error of the calibrated model, in addition to every point's own sigma
    p_detect: float = 0.95  # probability that a spot in the picture is found: one missing spot gives a tie, two do not
    # False points per px^2; a picture with more points raises it (20 % clutter near spots: 1e-5 to 2e-4).
    clutter_per_px2: float = 2e-5
    lead_nats: float = 3.0  # a pose must be exp(3) = 20 times as likely as the next one, otherwise it is a tie
    min_spots: int = 4  # three spots fit any labels exactly: only a fourth can contradict them
    max_points: int = 30  # points per camera that are used; those with the best signal to noise
    max_refined: int = 96  # candidate poses that are completed to all points; enough for 30 points per camera
    max_triples: int = 60_000  # sets of three points that are tried: 0.5 s; five false points per picture give 10,000


@dataclass(frozen=True, slots=True)
class TrackerParameters(_InRange):
    """Tracking (rigid_tracker.py, spot_tracker.py). Symbols: Huo, Yang & Yang 2015, sections 3 and 4.1."""

    # rigid: one filter for the vehicle with all spots | spots: the paper's method, a filter per spot
    method: Literal["rigid", "spots"] = "rigid"
    detect: DetectParameters = field(default_factory=DetectParameters)
    labels: LabelParameters = field(default_factory=LabelParameters)

    # The rigid tracker (ours)
    p_detect: float = 0.98  # probability that a spot which is in the picture and not hidden is found
    p_blend: float = 0.02  # probability that it is merged with a neighbour; needs the detections' shapes
    min_label_probability: float = 0.8  # a less probable label is not assigned: the status is occluded
    learn_jerk: bool = True  # estimate the jerk of the steady motion from the innovations
    jerk_m_s3: float = 20.0  # m/s^3 per sqrt(Hz), of the translation; the initial value if estimated
    jerk_rad_s3: float = 60.0  # rad/s^3 per sqrt(Hz), of the rotation; the initial value if estimated
    p_manoeuvre: float = 0.02  # initial probability per frame that the velocities jump; estimated with the jerk

    # Matching, section 4.1 (spots)
    r1_px: float = 10.0  # r1, px: radius of the first search, around the prediction (flat from 4 to 30 on bends)
    r2_px: float = 30.0  # r2, px: radius of the second search, around the last position (flat from 15 to 45)
    eps1: float = 0.4  # epsilon1: least g3 of the first search
    eps2: float = 0.3  # epsilon2: least g3 of the second search; a full reversal has about 0.5, so it must be lower
    omega1: float = 0.6  # omega1: weight of nearness to the prediction, g1
    omega2: float = 0.2  # omega2: weight of the direction, first half of g2
    omega3: float = 0.2  # omega3: weight of the speed, second half of g2
    p_norm: float = 2.0  # p: the norm of eqs. (7) and (9)
    # Denominator of g1; the paper's image diagonal makes g1 almost constant.
    g1_scale: Literal["search radius", "paper"] = "search radius"
    min_vector_px: float = 1.0  # px: floor of vector lengths in g2, g3; shorter ones have a noisy direction
    radius_sigmas: float = 5.0  # r1 grows to this many sigmas of the predicted position (0: constant r1) ...
    max_radius_px: float = 120.0  # px: ... up to this limit, which also bounds r2; r2 grows with the last displacement

    # Prediction, section 3
    sigma_a_px_s2: float = 5000.0  # px/s^2: 1-sigma white acceleration of a spot; the initial value if estimated
    learn_sigma_a: bool = True  # estimate it from the innovations, per spot
    sigma_model_px: float = 0.0005  # px: added to every detection's own sigma
    curve_switch: bool = True  # eq. (6): restart the filter at a bend; off: the conventional filter
    image_margin_px: float = 4.0  # px: spots predicted up to this far outside the picture are searched as well

    # Constraints of one rigid body (ours)
    rigid_check: bool = True  # a match that contradicts the others is dropped, and the pose gives the spot's position
    blend_px: float = 3.0  # px: a detection this near to its spot's place stays labelled but is excluded from the pose
    # Position of a hidden spot: from the other spots | from its own filter (the paper)
    estimate: Literal["rigid", "prediction"] = "rigid"
    # Position outside the picture: from the pose of all spots | from eqs. (10) to (14)
    out_of_view: Literal["rigid", "quadratic"] = "rigid"
    max_coast_s: float = 1.0  # s: an unseen track is lost after this time without a pose
    reacquire_deg_s: float = 60.0  # deg/s: a lost vehicle may rotate this much faster than ever observed ...
    reacquire_m_s: float = 1.5  # m/s: ... and move this much faster
    pose_sigma_a_m_s2: float = 3.0  # m/s^2: initial white acceleration of the vehicle while its pose is predicted
    pose_sigma_a_rad_s2: float = 6.0  # rad/s^2: the same of its rotation
    max_sigma_m: float = 0.25  # m: a pose with a larger sigma in any direction is not `measured` ...
    max_sigma_deg: float = 5.0  # deg: ... nor one with a larger sigma of its rotation
