"""Which point of light is which spot, when nothing is known but a prior: the first frame, and after a blackout.

Hypotheses come from whole beams (two spots of one beam are a line; one more spot then fixes the pose in closed form)
and, for rigs or pictures without a whole beam, from three spots by Gauss-Newton. Each pose predicts all spots; the
points near the predictions are its labels. The likelihood of the points given the labels decides, spots that should be
seen but are not count against a pose, and where two poses explain the picture about equally well both are reported and
none is chosen.

Source: ours; the likelihood is the usual one of multi-target data association (Bar-Shalom & Li 1995, sec. 6.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from geometry import rotations
from geometry.arrays import Array, Bools, Ints, normalised
from geometry.calibration_spread import CalibrationSpread
from geometry.closed_form import poses_from_line_and_spot
from geometry.outliers import fit_pose_robust
from geometry.planes import meet_plane, screen_to_world
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.solve import PoseFit, SolveLimits, fit_pose
from geometry.spots import SpotModel
from tracking.detections import Detections
from tracking.parameters import LabelParameters

NO_POINT = -1
# Chance that a right set of labels is refused by its misfit: the points' sigmas already hold the model's error.
P_MISFIT = 1e-6
# A camera with so many times `max_points` points of unknown brightness is not searched: the points looked at would be
# anyone's, and such a search fails after 3 s (400 points per camera).
HOPELESS = 2
# nats: how much likelier a pose must be than that all points are false and the vehicle is not seen. Without it four of
# thirty false points per picture made a pose by chance in the second of 40 frames. A likelihood ratio has the mean 1
# where there is nothing, so that chance is below exp(-7) = 1e-3.
OVER_NOTHING = 7.0
# Of more than `max_points` only so many of the brightest take part in triples: 3 s become 0.5 s, and spots that are
# brighter than nearly all else are found as before.
BRIGHTEST_OF_MANY = 6
MOST_REPEATS = 4  # more starts than this are tried only where none has led to any pose


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Where the vehicle may be: every coordinate and the angle are within these of the centre."""

    centre: Pose
    within_m: float
    within_rad: float

    def holds(self, poses: Pose, slack: float = 1.02) -> Bools:
        """Which of a stack of poses (...) lie in it; a little more is allowed, as poses are noisy. nan does not."""
        near = np.all(np.abs(poses.translation - self.centre.translation) <= slack * self.within_m + 0.005, axis=-1)
        trace = np.einsum("ij,...ij->...", self.centre.rotation, poses.rotation)
        limit = min(slack * self.within_rad + np.deg2rad(0.25), np.pi)
        return np.asarray(near & ((trace - 1) / 2 >= np.cos(limit) - 1e-12))


@dataclass(frozen=True, slots=True)
class Labelling:
    """A pose and the points that it explains."""

    fit: PoseFit
    point_of: Ints  # (n views,) row in its camera's detections, or NO_POINT
    score: float  # log-likelihood, nats
    expected: int  # how many views it puts in the picture


@dataclass(frozen=True, slots=True)
class LabelResult:
    """The labels found, or why there are none. `candidates` are best first."""

    chosen: Labelling | None
    candidates: tuple[Labelling, ...]
    reason: str  # "" where chosen

    @property
    def tie(self) -> bool:
        """Whether several poses explain the pictures about equally well."""
        return self.chosen is None and len(self.candidates) > 1

    def in_words(self, model: SpotModel) -> str:
        """The reason and the two best candidates: which spots they name and where they put the vehicle."""
        parts = []
        for one in self.candidates[:2]:
            ypr = np.rad2deg(one.fit.world_from_body.ypr)
            x, y, z = one.fit.world_from_body.translation
            names = " ".join(model.views[v][1] for v in np.flatnonzero(one.point_of != NO_POINT))
            parts.append(
                f"spots {names} at x {x:.3f} y {y:.3f} z {z:.3f} m,"
                f" yaw {ypr[0]:.2f} pitch {ypr[1]:.2f} roll {ypr[2]:.2f} deg"
            )
        return f"{self.reason}: " + " | ".join(parts)


def find_labels(
    rig: Rig,
    model: SpotModel,
    detections: Mapping[str, Detections],
    prior: PosePrior,
    parameters: LabelParameters | None = None,
    calibration: CalibrationSpread | None = None,
) -> LabelResult:
    """Label the points of all cameras of one frame from a prior alone.

    detections: by camera name; a camera without a picture is absent. The rig is the one that `model` was made of.
    calibration: what its errors do to the spots, where that is known.
    """
    parameters = LabelParameters() if parameters is None else parameters
    for name, found in detections.items():
        if len(found) > HOPELESS * parameters.max_points and not np.isfinite(found.flux).any():
            return LabelResult(
                None, (), f"{len(found)} points of light of camera {name!r}, and no flux that tells which may be spots"
            )
    scene = _Scene.of(rig, model, detections, parameters, calibration)
    if len(scene.camera) < parameters.min_spots:
        return LabelResult(
            None, (), f"only {len(scene.camera)} points of light, at least {parameters.min_spots} needed"
        )
    best: list[Labelling] = []
    for tried, poses in enumerate(_hypotheses(scene, prior), start=1):
        best = _refined(scene, poses, prior, best)
        if best and (tried > MOST_REPEATS or best[0].fit.rows.size == best[0].expected):
            break  # everything is explained, or hardly anything new can come: the rest could only repeat it
    if not best:
        return LabelResult(None, (), "no pose within the prior explains enough of the points")
    lead = _over_nothing(scene, best[0], prior)
    if lead < OVER_NOTHING:
        return LabelResult(
            None, (), f"false points alone would explain the best pose nearly as well (lead {lead:.1f} nats)"
        )
    return _decided(scene, best)


@dataclass(frozen=True, slots=True)
class _Scene:
    """The points of all cameras of a frame in one list (m), with what the labelling needs of them."""

    model: SpotModel
    parameters: LabelParameters
    camera: Ints  # (m,) index into model.camera_names
    row: Ints  # (m,) row in that camera's detections
    pixels: Array  # (m, 2)
    covariances: Array  # (m, 2, 2), with the model's own error added
    world: Array  # (m, 3), m: where on the screen it is
    seen: Bools  # (n,) views whose camera has a picture
    log_clutter: Array  # (cameras,) log density of false points, 1/px^2
    crowded: Bools  # (cameras,) there are more points than are looked at, and their brightness is known
    calibration: CalibrationSpread | None

    @staticmethod
    def of(
        rig: Rig,
        model: SpotModel,
        detections: Mapping[str, Detections],
        parameters: LabelParameters,
        calibration: CalibrationSpread | None,
    ) -> _Scene:
        camera, row, pixels, covariances, world = [], [], [], [], []
        log_clutter = np.zeros(len(model.camera_names))
        crowded = np.zeros(len(model.camera_names), dtype=bool)
        for c, name in enumerate(model.camera_names):
            found = detections.get(name)
            if found is None:
                continue
            width, height = rig.cameras[name].image_size_px
            log_clutter[c] = np.log(max(parameters.clutter_per_px2, len(found) / (width * height)))
            crowded[c] = len(found) > parameters.max_points and bool(np.isfinite(found.flux).any())
            brightest = np.argsort(-np.nan_to_num(found.flux, nan=0.0), kind="stable")[: parameters.max_points]
            screen = rig.screens[rig.cameras[name].screen].world_from_screen
            origin, rays = rig.cameras[name].rays(found.uv_px[brightest])
            on_screen = meet_plane(origin, rays, screen)
            usable = ~np.isnan(on_screen).any(axis=-1)
            kept = brightest[usable]
            camera.append(np.full(len(kept), c))
            row.append(kept)
            pixels.append(found.uv_px[kept])
            covariances.append(found.cov_px2[kept] + parameters.model_sigma_px**2 * np.eye(2))
            world.append(screen_to_world(on_screen[usable], screen))
        if not camera:
            empty = np.zeros(0, dtype=np.int64)
            camera, row, pixels = [empty], [empty], [np.zeros((0, 2))]
            covariances, world = [np.zeros((0, 2, 2))], [np.zeros((0, 3))]
        return _Scene(
            model,
            parameters,
            np.concatenate(camera).astype(np.int64),
            np.concatenate(row).astype(np.int64),
            np.concatenate(pixels),
            np.concatenate(covariances),
            np.concatenate(world),
            np.array([model.camera_names[c] in detections for c in model.camera_of]),
            log_clutter,
            crowded,
            calibration,
        )

    def points_of(self, view: int) -> Ints:
        """The points (indices into this scene) of a view's camera."""
        return np.flatnonzero(self.camera == self.model.camera_of[view])


def _hypotheses(scene: _Scene, prior: PosePrior) -> Iterator[Pose]:
    """Stacks of poses within the prior, the cheap and certain kind first."""
    whole = [p for p in _from_whole_beams(scene, prior) if len(p.translation)]
    if whole:
        yield Pose(np.concatenate([p.rotation for p in whole]), np.concatenate([p.translation for p in whole]))
    yield from _from_three_spots(scene, prior)


def _from_whole_beams(scene: _Scene, prior: PosePrior) -> Iterator[Pose]:
    """Poses from a beam's two spots and one spot of another beam, all points in all roles."""
    model = scene.model
    for i, j in permutations([int(v) for v in np.flatnonzero(scene.seen)], 2):
        # ray_j = -ray_i: the two ends of one beam; i < j, as the other order is the same line
        if i > j or model.beam_of[i] != model.beam_of[j] or model.ray[i] @ model.ray[j] > 0:
            continue
        a, b = (m.ravel() for m in np.meshgrid(scene.points_of(i), scene.points_of(j), indexing="ij"))
        if not len(a):
            continue
        start, direction = scene.world[a], normalised(scene.world[b] - scene.world[a])
        expected = prior.centre.turn(model.ray[j])
        turned = np.arccos(np.clip(direction @ expected, -1, 1)) <= prior.within_rad * 1.02 + np.deg2rad(0.25)
        gap = prior.centre.translation - start
        off = np.linalg.norm(gap - np.sum(gap * direction, axis=-1)[:, None] * direction, axis=-1)
        near = off <= np.sqrt(3) * prior.within_m * 1.02 + 0.01 + np.linalg.norm(model.point[i])
        lines = np.flatnonzero(turned & near)
        for k in np.flatnonzero(scene.seen & (model.beam_of != model.beam_of[i])):
            points = scene.points_of(int(k))
            if not len(points) or not len(lines):
                continue
            poses = poses_from_line_and_spot(
                model.point[j],
                model.ray[j],
                start[lines][:, None],
                direction[lines][:, None],
                model.point[k],
                model.ray[k],
                scene.world[points][None, :],
            )
            yield poses[prior.holds(poses)]


def _from_three_spots(scene: _Scene, prior: PosePrior) -> Iterator[Pose]:
    """Poses from three spots of three beams by Gauss-Newton, from the prior's centre and turns about it."""
    model, limit = scene.model, scene.parameters.max_triples
    views = np.flatnonzero(scene.seen)
    projected, J = model.project(prior.centre)
    triples: list[tuple[float, tuple[int, int, int]]] = []
    for triple in combinations([int(v) for v in views], 3):
        if len({int(model.spot_of[v]) for v in triple}) < 3:
            continue
        A = J[list(triple)].reshape(6, 6)
        if np.isnan(projected[list(triple)]).any():
            continue
        s = np.linalg.svd(A, compute_uv=False)
        if s[-1] > 1e-6 * s[0]:
            triples.append((-float(s[-1]), triple))
    starts = _starts(prior)
    for triple in _that_leave_out_every_pair([t for _, t in sorted(triples)]):
        grids = np.meshgrid(*[_for_triples(scene, v) for v in triple], indexing="ij")
        points = np.stack([g.ravel() for g in grids], axis=-1)
        # One point serves one spot.
        points = points[(np.diff(np.sort(points, axis=1), axis=1) > 0).all(axis=1)][:limit]
        if not len(points):
            continue
        many = np.repeat(np.arange(len(starts.translation)), len(points))
        targets = np.tile(points, (len(starts.translation), 1))
        poses = _gauss_newton(model.subset(np.array(triple)), scene.pixels[targets], starts[many])
        yield poses[prior.holds(poses)]


def _for_triples(scene: _Scene, view: int) -> Ints:
    """The points of a view's camera that may be one of three spots: of a crowd its brightest."""
    points = scene.points_of(view)
    return points[:BRIGHTEST_OF_MANY] if scene.crowded[scene.model.camera_of[view]] else points


def _that_leave_out_every_pair(triples: Sequence[tuple[int, int, int]]) -> Iterator[tuple[int, int, int]]:
    """The first few triples of views, then each that avoids two views together which none before it did.

    Any two spots may be hidden, and often a beam's pair is out of the picture: a start that needs one of them is none.
    """
    views = sorted({v for t in triples for v in t})
    avoided: set[tuple[int, int]] = set()
    for i, triple in enumerate(triples):
        new = set(combinations([v for v in views if v not in triple], 2)) - avoided
        if i < 4 or new:
            avoided |= new
            yield triple


def _starts(prior: PosePrior) -> Pose:
    """The prior's centre, and for a wide prior also turns by half its width about each axis."""
    turns = [np.zeros(3)]
    if prior.within_rad > np.deg2rad(12):
        turns += [s * 0.5 * prior.within_rad * e for e in np.eye(3) for s in (-1, 1)]
    R = prior.centre.rotation @ rotations.exp(np.array(turns))
    return Pose(R, np.broadcast_to(prior.centre.translation, (len(turns), 3)))


def _gauss_newton(model: SpotModel, pixels: Array, poses: Pose, iterations: int = 10) -> Pose:
    """Many three-spot problems (h, 3, 2) at once, undamped but with short steps; those that fail come back as nan."""
    for _ in range(iterations):
        projected, J = model.project(poses)
        residual = (pixels - projected).reshape(-1, 6)
        A = J.reshape(-1, 6, 6)
        dead = np.asarray(~(np.isfinite(residual).all(-1) & np.isfinite(A).all((-1, -2))))
        A = np.where(dead[:, None, None], np.eye(6), A + 1e-9 * np.eye(6))
        residual = np.where(dead[:, None], np.nan, residual)
        try:
            step = np.linalg.solve(A, residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            step = np.linalg.lstsq(A[0], residual[0], rcond=None)[0] if len(A) == 1 else np.zeros_like(residual)
        size = np.linalg.norm(step, axis=-1, keepdims=True)
        poses = poses.plus(step * np.minimum(1.0, 0.5 / np.maximum(size, 1e-12)))
    return poses


def _refined(scene: _Scene, poses: Pose, prior: PosePrior, known: Sequence[Labelling]) -> list[Labelling]:
    """The best labellings that a stack of poses leads to, together with those known, best first, no two alike."""
    if not len(poses.translation):
        return list(known)
    found = {tuple(k.point_of): k for k in known}
    tried: set[tuple[int, ...]] = set()
    coarse, assigned = _coarse(scene, poses)
    order = np.argsort(-coarse, kind="stable")
    for h in order:
        if len(tried) >= scene.parameters.max_refined or coarse[h] < coarse[order[0]] - 40.0:
            break
        labels = tuple(assigned[h])
        if labels in tried:
            continue
        tried.add(labels)
        labelling = _fitted(scene, poses[h], prior)
        if labelling is not None:
            key = tuple(labelling.point_of)
            if key not in found or found[key].score < labelling.score:
                found[key] = labelling
    return sorted(found.values(), key=lambda one: -one.score)


def _coarse(scene: _Scene, poses: Pose) -> tuple[Array, Ints]:
    """For poses (h): a rough score (h,) and the nearest point of each view (h, n) or NO_POINT, in bounded memory."""
    p, model = scene.parameters, scene.model
    scores, nearest = [], []
    for first in range(0, len(poses.translation), 2000):
        projected, _ = model.project(poses[first : first + 2000])
        expected = model.in_picture(projected) & scene.seen
        score = np.where(expected, np.log(1 - p.p_detect), 0.0)
        assigned = np.full(score.shape, NO_POINT)
        for view in np.flatnonzero(scene.seen):
            points = scene.points_of(int(view))
            if not len(points):
                continue
            gap2 = np.sum((projected[:, view, None, :] - scene.pixels[points]) ** 2, axis=-1)
            gap2 = np.where(np.isnan(gap2), np.inf, gap2)
            best = np.argmin(gap2, axis=1)
            d2 = gap2[np.arange(len(best)), best]
            hit = d2 < p.gate_px**2
            # A coarse sigma of a third of the gate: the pose rests on three noisy spots only.
            value = np.log(p.p_detect) - 0.5 * d2 / (p.gate_px / 3) ** 2 - scene.log_clutter[scene.camera[points[0]]]
            score[:, view] = np.where(hit, value - np.log(2 * np.pi * (p.gate_px / 3) ** 2), score[:, view])
            assigned[:, view] = np.where(hit, points[best], NO_POINT)
        scores.append(score.sum(axis=1))
        nearest.append(assigned)
    return np.concatenate(scores), np.concatenate(nearest)


def _fitted(scene: _Scene, pose: Pose, prior: PosePrior) -> Labelling | None:
    """Labels and pose in turn, with a gate that narrows, until the labels stay; None if too few or out of the prior."""
    p, model = scene.parameters, scene.model
    labels: Ints | None = None
    fit: PoseFit | None = None
    for gate in (p.gate_px, p.gate_px / 2, p.gate_px / 4, p.gate_px / 4):
        projected = model.project(pose)[0]
        new = _assign(scene, projected, gate)
        rows = np.flatnonzero(new != NO_POINT)
        if len({int(model.spot_of[r]) for r in rows}) < p.min_spots:
            return None
        if labels is None or np.any(new != labels):
            fit = fit_pose(
                model, rows, scene.pixels[new[rows]], scene.covariances[new[rows]], pose, calibration=scene.calibration
            )
        if fit is None or not fit.observable:
            return None
        labels, pose = new, fit.world_from_body
    assert labels is not None
    assert fit is not None
    if not fit.consistent(P_MISFIT):
        # A false point beside a spot that was not found: it goes, the others stay.
        rows = fit.rows
        limits = SolveLimits(p_false_alarm=P_MISFIT)
        fit = fit_pose_robust(
            model,
            rows,
            scene.pixels[labels[rows]],
            scene.covariances[labels[rows]],
            pose,
            limits=limits,
            calibration=scene.calibration,
        )
        if fit is None or len({int(model.spot_of[r]) for r in fit.rows}) < p.min_spots:
            return None
        labels[np.setdiff1d(rows, fit.rows)] = NO_POINT
        pose = fit.world_from_body
    if not bool(prior.holds(pose)):
        return None
    projected = model.project(pose)[0]
    expected = model.in_picture(projected) & scene.seen
    used = labels != NO_POINT
    clutter = scene.log_clutter[scene.camera[labels[used]]]
    # The likelihood of the used points, against that of as many false ones.
    score = len(clutter) * (np.log(p.p_detect) - np.log(2 * np.pi)) - float(np.sum(clutter))
    score -= 0.5 * (fit.log_det + fit.chi2)
    score += np.log(1 - p.p_detect) * np.count_nonzero(expected & ~used)
    return Labelling(fit, labels, float(score), int(np.count_nonzero(expected | used)))


def _assign(scene: _Scene, projected: Array, gate_px: float) -> Ints:
    """Points to views (n,), nearest in sum, one point one view, none beyond the gate."""
    out = np.full(len(scene.model), NO_POINT)
    for c in range(len(scene.model.camera_names)):
        views = np.flatnonzero((scene.model.camera_of == c) & ~np.isnan(projected[:, 0]))
        points = np.flatnonzero(scene.camera == c)
        if not len(views) or not len(points):
            continue
        gap = np.linalg.norm(projected[views][:, None] - scene.pixels[points][None], axis=-1)
        cost = np.minimum(gap, gate_px) - gate_px
        for v, q in zip(*linear_sum_assignment(cost), strict=True):
            if cost[v, q] < 0:
                out[views[v]] = points[q]
    return out


def _over_nothing(scene: _Scene, one: Labelling, prior: PosePrior) -> float:
    """How much likelier a labelling is than that all points are false, nats.

    The likelihood is averaged over the prior, not only taken at its best pose (Laplace's approximation), since many
    poses were free to fit. The density of false points is that of the points looked at which are left over.
    """
    used = np.flatnonzero(one.point_of != NO_POINT)
    camera = scene.camera[one.point_of[used]]
    area = np.array([np.prod(scene.model.image_size_px[scene.model.camera_of == c][0]) for c in camera])
    left = np.array([np.count_nonzero(scene.camera == c) - np.count_nonzero(camera == c) for c in camera])
    density = np.log(np.maximum(left, 1) / area)
    _, log_det = np.linalg.slogdet(one.fit.covariance)
    volume = 3 * np.log(2 * prior.within_m) + np.log(4 / 3 * np.pi * prior.within_rad**3)
    averaged = min(0.0, 3 * np.log(2 * np.pi) + 0.5 * float(log_det) - float(volume))
    return one.score + averaged + float(np.sum(scene.log_clutter[camera] - density))


def _decided(scene: _Scene, best: Sequence[Labelling]) -> LabelResult:
    """Choose, or report a tie. Labellings of about the same pose are no rivals: only their odd spots are left open."""
    p, model = scene.parameters, scene.model
    first = best[0]
    here = model.project(first.fit.world_from_body)[0]
    labels = first.point_of.copy()
    rivals = [first]
    for other in best[1:]:
        if first.score - other.score >= p.lead_nats:
            break
        there = model.project(other.fit.world_from_body)[0]
        apart = np.linalg.norm(here - there, axis=-1)
        if np.nanmax(np.where(np.isnan(apart), 0.0, apart)) < p.gate_px:
            labels[labels != other.point_of] = NO_POINT
        else:
            rivals.append(other)
    as_rows = [_with_rows(scene, r) for r in rivals]
    if len(rivals) > 1:
        lead = first.score - rivals[1].score
        return LabelResult(
            None, tuple(as_rows), f"{len(rivals)} poses explain the points about equally well (lead {lead:.1f} nats)"
        )
    chosen = Labelling(first.fit, labels, first.score, first.expected)
    return LabelResult(_with_rows(scene, chosen), tuple(as_rows), "")


def _with_rows(scene: _Scene, labelling: Labelling) -> Labelling:
    """Scene indices turned into rows of each camera's detections."""
    rows = np.where(labelling.point_of == NO_POINT, NO_POINT, scene.row[np.maximum(labelling.point_of, 0)])
    return Labelling(labelling.fit, rows, labelling.score, labelling.expected)
