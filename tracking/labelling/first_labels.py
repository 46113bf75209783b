"""Labels of the points of light of one frame without a track: in the first frame, and after a full occlusion.

Candidate poses come from three spots each, in closed form (candidates.py). Each pose predicts all spots; the points
near the predictions get their labels, and the score is the likelihood of the points given the labels, averaged over the
poses of the prior (completion.py); spots that are expected but not found lower it. If two poses explain the picture
about equally well, both are reported and none is chosen, with the observations that would decide.

Source: ours; the likelihood is the usual one of multi-target data association (Bar-Shalom & Li 1995, sec. 6.2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits, fit_pose_robust, whiten
from geometry.pose_solver.visibility import is_symmetry
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.detections import Detections
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import Labelling, candidate_labellings, crowd_of_unknown_brightness
from tracking.parameters import LabelParameters

FITTED_RAD, FITTED_M = float(np.deg2rad(0.3)), 0.01  # tolerance of the symmetry of two fitted poses
APART_PX = 5.0  # a spot expected farther than this from every spot of the other pose distinguishes the two


def spot_names(model: SpotModel, views: Bools) -> str:
    """The names of the spots of some views (n,), each once."""
    return " ".join(dict.fromkeys(model.views[v][1] for v in np.flatnonzero(views)))


def what_decides(model: SpotModel, one: Labelling, other: Labelling) -> str:
    """A sentence: which spots in view, or which prior, would exclude one of two labellings of the same points."""
    here, there = one.fit.world_from_body, other.fit.world_from_body
    uv_here, uv_there = model.project(here)[0], model.project(there)[0]
    parts = []
    for which, mine, uv, uv_other in (("first", one, uv_here, uv_there), ("second", other, uv_there, uv_here)):
        places = [
            f"{spot} at ({uv[v, 0]:.0f}, {uv[v, 1]:.0f}) px of camera {camera!r}"
            for v, (camera, spot) in enumerate(model.views)
            if mine.point_of[v] == NO_POINT and _only_here(model, v, uv, uv_other)
        ]
        if places:
            parts.append(f"spot {', '.join(places)}, where only the {which} expects one and none was found (hidden?)")
    if is_symmetry(model, here.inverse() @ there, FITTED_RAD, FITTED_M):
        parts.append("no spot of this rig: it is symmetric under the rotation from one pose to the other")
    elif not parts:
        parts.append("another spot in view")
    shift = float(np.abs(here.translation - there.translation).max())
    turn = float(np.rad2deg(rotations.angle(here.rotation.T @ there.rotation)))
    bounds = [f"within_deg below {turn / 2:.1f}"] if turn > 1 else []
    bounds += [f"within_m below {shift / 2:.3f}"] if shift > FITTED_M else []
    if bounds:
        parts.append(
            f"a prior that excludes one: the first two are {shift:.3f} m and {turn:.1f} deg apart, so"
            f" {' or '.join(bounds)} about the true pose"
        )
    return "; or ".join(parts)


def _only_here(model: SpotModel, view: int, uv: Array, uv_other: Array) -> bool:
    """Whether a view is in its picture in one pose, uv (n, 2), and no spot is near it in the other, uv_other (n, 2)."""
    if not model.in_picture(uv)[view]:
        return False
    gap = np.linalg.norm(uv_other[model.camera_of == model.camera_of[view]] - uv[view], axis=-1)
    return not bool(np.any(gap < APART_PX))


__all__ = [
    "NO_POINT",
    "FirstLabels",
    "Labelling",
    "PosePrior",
    "candidate_labellings",
    "find_labels",
]

# A frame is not searched if a camera has more than this multiple of `max_points` points of unknown brightness that may
# be spots: an arbitrary subset would be searched.
MAX_CROWD = 2
# nats: least log evidence of a pose against the hypothesis that all points are false and the vehicle is not seen.
# Measured with five and eight false points per picture and no vehicle: a pose in 0.2 and 0.5 % of the frames without a
# prior, in none of 3000 with one of 1 m and 30 deg. With 3.0: in 0.1 and 0.3 %, and 1 % more of the frames of a vehicle
# stay unlabelled.
MIN_EVIDENCE_NATS = 2.0
SMALL_MODEL_ERROR = 0.2  # share of `model_sigma_px` with which the spots should agree; a larger misfit ...
P_ODD = 1e-3  # ... with a probability below this starts the search for false points
MERGED_PX = 1.0  # spots nearer to each other than this give one point of light
SAME_POSE = 0.01  # share of the picture's diagonal: poses that move no spot by more than this are the same


@dataclass(frozen=True, slots=True)
class FirstLabels:
    """The labels found, or why there are none. `candidates` are best first."""

    chosen: Labelling | None
    candidates: tuple[Labelling, ...]
    reason: str  # "" where chosen

    @property
    def tie(self) -> bool:
        """Whether several poses explain the pictures about equally well."""
        return self.chosen is None and len(self.candidates) > 1

    def in_words(self, model: SpotModel) -> str:
        """The reason, each candidate with its spots and its pose, and what would decide between them."""
        parts = []
        for one in self.candidates:
            ypr = np.rad2deg(one.fit.world_from_body.ypr)
            x, y, z = one.fit.world_from_body.translation
            parts.append(
                f"spots {spot_names(model, one.point_of != NO_POINT)} at x {x:.3f} y {y:.3f} z {z:.3f} m,"
                f" yaw {ypr[0]:.2f} pitch {ypr[1]:.2f} roll {ypr[2]:.2f} deg"
            )
        decides = [what_decides(model, *self.candidates[:2])] if len(self.candidates) > 1 else []
        return f"{self.reason}: " + " | ".join(parts) + "".join(f". What would decide: {text}" for text in decides)


def find_labels(
    rig: Rig,
    model: SpotModel,
    detections: Mapping[str, Detections],
    prior: PosePrior | None = None,
    parameters: LabelParameters | None = None,
    calibration: RigUncertainty | None = None,
) -> FirstLabels:
    """Label the points of all cameras of one frame from a prior alone, or without one.

    Arguments as of `candidate_labellings`. The result is one labelling, a tie with its candidates, or the reason why
    there are no labels.
    """
    parameters = LabelParameters() if parameters is None else parameters
    limit = MAX_CROWD * parameters.max_points
    crowd = crowd_of_unknown_brightness(rig, model, detections, prior, parameters, limit)
    if crowd is not None:
        name, points = crowd
        return FirstLabels(
            None, (), f"{points} points of light of camera {name!r}, without a flux that shows which may be spots"
        )
    count = sum(len(found) for found in detections.values())
    if count < parameters.min_spots:
        return FirstLabels(None, (), f"only {count} points of light, at least {parameters.min_spots} needed")
    best = candidate_labellings(rig, model, detections, prior, parameters, calibration)
    if not best:
        within = "that the rig can see" if prior is None else "within the prior"
        return FirstLabels(None, (), f"no pose {within} explains enough of the points")
    if best[0].score < MIN_EVIDENCE_NATS:
        return FirstLabels(
            None, (), f"false points alone would explain the best pose nearly as well (lead {best[0].score:.1f} nats)"
        )
    first = _without_odd_spots(model, detections, best[0], parameters, calibration)
    return _decide(model, [first, *best[1:]], parameters)


def _without_odd_spots(
    model: SpotModel,
    detections: Mapping[str, Detections],
    one: Labelling,
    parameters: LabelParameters,
    calibration: RigUncertainty | None,
) -> Labelling:
    """A labelling without its odd spots, if the others then agree within their own sigmas.

    The evidence allows for an error of the model, so a false point a pixel beside a spot that was not found may get the
    spot's label. If all points but that one agree without the allowance, it stays unlabelled.
    """
    rows = np.flatnonzero(one.point_of != NO_POINT)
    found = [detections[model.views[v][0]] for v in rows]
    pixels = np.array([f.uv_px[p] for f, p in zip(found, one.point_of[rows], strict=True)])
    covariances = np.array([f.cov_px2[p] for f, p in zip(found, one.point_of[rows], strict=True)])
    covariances = covariances + (SMALL_MODEL_ERROR * parameters.model_sigma_px) ** 2 * np.eye(2)
    W = whiten(covariances)
    misfit = float(np.sum((W @ one.fit.residuals_px[..., None]) ** 2))
    if one.fit.dof <= 2 or misfit <= chi2_limit(P_ODD, one.fit.dof):
        return one
    limits = SolveLimits(p_false_alarm=P_ODD)
    start = one.fit.world_from_body
    fit = fit_pose_robust(model, rows, pixels, covariances, start, limits=limits, calibration=calibration)
    if fit is None or len({int(model.spot_of[r]) for r in fit.rows}) < parameters.min_spots:
        return one
    point_of = np.full_like(one.point_of, NO_POINT)
    point_of[fit.rows] = one.point_of[fit.rows]
    return replace(one, fit=fit, point_of=point_of)


def _decide(model: SpotModel, best: Sequence[Labelling], parameters: LabelParameters) -> FirstLabels:
    """Choose the best labelling, or report a tie. Spots that labellings of about the same pose dispute get no label."""
    first = best[0]
    here = model.project(first.fit.world_from_body)[0]
    near: Array = SAME_POSE * np.linalg.norm(model.image_size_px, axis=-1)
    labels = first.point_of.copy()
    rivals = [first]
    for other in best[1:]:
        if first.score - other.score >= parameters.lead_nats:
            break
        there = model.project(other.fit.world_from_body)[0]
        distance = np.linalg.norm(here - there, axis=-1)
        if np.all(np.isnan(distance) | (distance < near)):
            labels[_disputed(model, labels, other.point_of, here)] = NO_POINT
        else:
            rivals.append(other)
    if len(rivals) > 1:
        lead = first.score - rivals[1].score
        reason = f"{len(rivals)} poses explain the points about equally well (lead {lead:.1f} nats)"
        return FirstLabels(None, tuple(rivals), reason)
    return FirstLabels(replace(first, point_of=labels), (first,), "")


def _disputed(model: SpotModel, labels: Ints, other: Ints, here: Array) -> Bools:
    """Which views (n,) have a point in one labelling but not the same point in another of about the same pose.

    here (n, 2), px: the projected spots. Two spots that are merged into one point of light are not disputed.
    """
    out = (labels != other) & (labels != NO_POINT)
    for v in np.flatnonzero(out):
        same = (other == labels[v]) & (model.camera_of == model.camera_of[v])
        out[v] = not np.any(np.linalg.norm(here[same] - here[v], axis=-1) < MERGED_PX)
    return out
