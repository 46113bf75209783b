"""The output for a scene compared with its truth: identity, wrong labels, covariances, and the class of a failure.

A label is correct if its point is that of the spot, or lies within SAME_SPOT_PX or SAME_SPOT_SIGMAS of its true
position and no other spot is nearer (the rule of lab/runs/verdict/score.py). Identity counts visible spots with a
picture, except where another point lies within TOGETHER_SIGMAS of the true position, since either may be the spot.

A pose is confidently wrong if its Mahalanobis distance from the truth is above 10 (NEES above 100; with 6 degrees of
freedom and correct covariances this does not occur in 1e9 poses).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.random_scenes.answers import LOST, MEASURED, PREDICTED, Answers, Pass
from bench.random_scenes.oracle import Oracle
from bench.random_scenes.scene import CLUTTER, Scene
from geometry.arrays import Array, Bools

SAME_SPOT_PX, SAME_SPOT_SIGMAS = 3.0, 5.0
TOGETHER_SIGMAS, TOGETHER_PX = 6.0, 0.1
CONFIDENTLY_WRONG = 100.0  # NEES
CHI2_95 = 12.592  # of 6 degrees of freedom
LEAST_IDENTITY, MOST_NEES = 0.995, 12.0
LASTS, LEAST_LASTING = 10, 0.8  # a track is locked in if this share of this number of frames is found
LEAST_LOCKED = 0.5  # identity below which the tracker counts as never locked
SAME_POINT_PX = 1e-3  # between the point of a label and the detection, since files round

CLASSES = (
    "crash",
    "never locked",
    "lost after occlusion",
    "wrong labels",
    "confidently wrong measured",
    "confidently wrong predicted",
    "NEES",
    "labels missing",
    "exit status",
    "numeric warnings",
)
CLEAN = "clean"


@dataclass(frozen=True, slots=True)
class PassFigures:
    """One pass (causal or smoothed) compared with truth."""

    identity: float
    countable: int  # spot-frames that count for identity
    wrong: int  # labels on another spot or on clutter
    near: int  # labels on another point, within SAME_SPOT_PX of the spot but beyond SAME_SPOT_SIGMAS
    measured: int  # frames
    predicted: int
    lost: int
    nees: float  # mean over measured and predicted poses ...
    nees_median: float
    nees_measured: float  # ... and of each
    nees_predicted: float
    nees_max: float
    poses: int  # number of poses with NEES ...
    independent: float  # ... and the equivalent number of independent poses
    coverage: float  # share of poses inside the 95 % ellipsoid
    wrong_measured: int  # confidently wrong poses
    wrong_predicted: int
    beyond_6: int  # poses with an error above 6 sigma in one of the six components
    not_definite: int  # covariances that are not positive definite
    first_labels: int  # the first frame with a label; -1: none ...
    first_wrong: int  # ... and its number of wrong labels
    locked_in: int  # the first frame of a lasting series of measured poses that are not confidently wrong; -1: none
    worst_deg: float  # largest attitude error of a measured pose
    worst_m: float


@dataclass(frozen=True, slots=True)
class Judgement:
    """The scores of a scene."""

    seed: int
    counts: bool
    why_not: str
    classes: tuple[str, ...]  # classes of failure, the first is the leading one; empty: clean
    smoothed: PassFigures
    causal: PassFigures | None
    oracle_nees: float  # /6
    solvable: float  # share of frames
    lost_though_solvable: int  # frames without a measured pose (smoothed) that the oracle can solve
    exit_status: int
    reasons: str
    warnings: int
    first_warning: str
    ms_per_frame: float  # process time of both passes
    ms_causal: float
    ms_slowest: float
    rounds: int
    text: str

    @property
    def clean(self) -> bool:
        """No class of failure applies."""
        return not self.classes

    @property
    def failure(self) -> str:
        """The leading class, or CLEAN."""
        return self.classes[0] if self.classes else CLEAN


def judge(scene: Scene, oracle: Oracle, answers: Answers) -> Judgement:
    """All figures of one scene."""
    smoothed = figures(scene, answers.smoothed, oracle.solvable)
    causal = None if answers.causal is None else figures(scene, answers.causal, oracle.solvable)
    missing = oracle.solvable & (answers.smoothed.status != MEASURED)
    return Judgement(
        seed=scene.seed,
        counts=oracle.counts,
        why_not=oracle.why_not,
        classes=classes_of(scene, oracle, answers, smoothed, causal),
        smoothed=smoothed,
        causal=causal,
        oracle_nees=_mean(oracle.nees) / 6,
        solvable=float(oracle.solvable.mean()),
        lost_though_solvable=int(missing.sum()),
        exit_status=answers.exit_status,
        reasons="; ".join(answers.reasons),
        warnings=answers.warnings_count,
        first_warning=answers.warnings[0] if answers.warnings else "",
        ms_per_frame=answers.ms_per_frame,
        ms_causal=answers.ms_causal,
        ms_slowest=answers.ms_slowest,
        rounds=answers.rounds,
        text=scene.text,
    )


def figures(scene: Scene, answer: Pass, solvable: Bools) -> PassFigures:
    """One pass compared with truth. solvable (T,): frames whose spots determine a pose."""
    right, wrong, near = label_verdicts(scene, answer)
    countable = scene.shining & ~_together(scene)
    whitened = whitened_errors(scene, answer)
    nees = np.sum(whitened**2, axis=1)
    known = answer.status != LOST
    measured, predicted = answer.status == MEASURED, answer.status == PREDICTED
    good = known & ~np.isnan(nees)
    off = nees > CONFIDENTLY_WRONG
    labelled = np.flatnonzero(answer.labelled.any(axis=1))
    delta = scene.poses.minus(answer.poses)
    with np.errstate(invalid="ignore"):
        components = np.abs(delta / np.sqrt(np.diagonal(answer.covariance, axis1=1, axis2=2))).max(axis=1)
    return PassFigures(
        identity=float((right & countable).sum() / max(countable.sum(), 1)),
        countable=int(countable.sum()),
        wrong=int(wrong.sum()),
        near=int(near.sum()),
        measured=int(measured.sum()),
        predicted=int(predicted.sum()),
        lost=int((~known).sum()),
        nees=_mean(nees[good]),
        nees_median=float(np.median(nees[good])) if good.any() else float("nan"),
        nees_measured=_mean(nees[good & measured]),
        nees_predicted=_mean(nees[good & predicted]),
        nees_max=float(nees[good].max(initial=0.0)),
        poses=int(good.sum()),
        independent=independent_poses(whitened),
        coverage=_mean((nees[good] <= CHI2_95).astype(float)),
        wrong_measured=int((off & measured).sum()),
        wrong_predicted=int((off & predicted).sum()),
        beyond_6=int((known & ~(components <= 6.0)).sum()),
        not_definite=int((known & np.isnan(nees)).sum()),
        first_labels=int(labelled[0]) if labelled.size else -1,
        first_wrong=int(wrong[labelled[0]].sum()) if labelled.size else 0,
        locked_in=_locked_in(measured & good & ~off, solvable),
        worst_deg=float(np.rad2deg(np.linalg.norm(delta[measured, 3:], axis=1)).max(initial=0.0)),
        worst_m=float(np.linalg.norm(delta[measured, :3], axis=1).max(initial=0.0)),
    )


def _locked_in(found: Bools, solvable: Bools) -> int:
    """The first found frame (T,) after which most solvable ones of the next LASTS frames are also found."""
    for k in np.flatnonzero(found):
        expected = solvable[k : k + LASTS]
        if (found[k : k + LASTS] & expected).sum() >= LEAST_LASTING * expected.sum():
            return int(k)
    return -1


def label_verdicts(scene: Scene, answer: Pass) -> tuple[Bools, Bools, Bools]:
    """For each label (T, n): correct; wrong; and on another point too near to be called wrong."""
    frames, views = answer.labelled.shape
    right, wrong, near = (np.zeros((frames, views), dtype=bool) for _ in range(3))
    for k, v in zip(*np.nonzero(answer.labelled), strict=True):
        c, at, true = scene.camera_of[v], answer.uv_px[k, v], scene.uv_px[k]
        points = scene.detections[k][c].uv_px
        gap = np.linalg.norm(points - at, axis=-1) if len(points) else np.zeros(0)
        origin = scene.origin[k][c][int(np.argmin(gap))] if gap.size and gap.min() < SAME_POINT_PX else CLUTTER
        if origin == v:
            right[k, v] = True
            continue
        away = float(np.linalg.norm(at - true[v]))
        others = np.flatnonzero((scene.camera_of == c) & (np.arange(views) != v))
        others_away = np.nan_to_num(np.linalg.norm(true[others] - at, axis=-1), nan=np.inf).min(initial=np.inf)
        tolerance = SAME_SPOT_SIGMAS * scene.sigma_px[v]
        if away <= max(SAME_SPOT_PX, tolerance) and away - others_away <= tolerance:
            right[k, v] = True
            near[k, v] = away > tolerance
        else:
            wrong[k, v] = True
    return right, wrong, near


def _together(scene: Scene) -> Bools:
    """(T, n): another point lies at the position of the spot."""
    out = np.zeros(scene.in_view.shape, dtype=bool)
    limit = np.maximum(TOGETHER_SIGMAS * scene.sigma_px, TOGETHER_PX)
    for k in range(len(scene)):
        for v in np.flatnonzero(scene.shining[k]):
            c = scene.camera_of[v]
            gap = np.linalg.norm(scene.detections[k][c].uv_px - scene.uv_px[k, v], axis=-1)
            out[k, v] = bool(np.any((gap < limit[v]) & (scene.origin[k][c] != v)))
    return out


def nees_of(scene: Scene, answer: Pass) -> Array:
    """(T,): e^T P^-1 e of the poses; nan where lost, or where P is not positive definite."""
    return np.asarray(np.sum(whitened_errors(scene, answer) ** 2, axis=1))


def whitened_errors(scene: Scene, answer: Pass) -> Array:
    """(T, 6): whitened errors of the poses, with unit covariance if theirs is correct; nan as in `nees_of`."""
    delta = scene.poses.minus(answer.poses)
    out = np.full((len(scene), 6), np.nan)
    for k in np.flatnonzero(answer.status != LOST):
        P = answer.covariance[k]
        variance = np.diagonal(P)
        if not (np.isfinite(P).all() and (variance > 0).all() and np.isfinite(delta[k]).all()):
            continue
        scale = np.sqrt(variance)
        C = P / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(C)
        if values[0] > 0:
            # The symmetric root varies smoothly with C, so that the errors of successive frames can be compared.
            out[k] = vectors @ ((vectors.T @ (delta[k] / scale)) / np.sqrt(values))
    return out


def independent_poses(whitened: Array) -> float:
    """The number of independent errors in (T, 6): T over the sum of their autocorrelation up to its first zero.

    A smoothed pose at rest has nearly the same error in all frames; the mean NEES of such a scene scatters like that of
    one or two poses.
    """
    w = whitened[~np.isnan(whitened).any(axis=1)]
    power = float(np.mean(np.sum(w**2, axis=1))) if len(w) else 0.0
    if power == 0.0:
        return float(len(w))
    total = 1.0
    for lag in range(1, len(w) // 2):
        correlation = float(np.mean(np.sum(w[lag:] * w[:-lag], axis=1))) / power
        if correlation <= 0:
            break
        total += 2 * correlation * (1 - lag / len(w))
    return len(w) / total


def classes_of(
    scene: Scene, oracle: Oracle, answers: Answers, smoothed: PassFigures, causal: PassFigures | None
) -> tuple[str, ...]:
    """The classes of failure, most serious first; empty for a clean scene.

    never locked: no pose, or less than half of the labels without an occlusion as the cause. lost after occlusion: most
    frames without a pose whose spots determine one follow directly on occluded ones.
    """
    found = []
    labels_missing = smoothed.identity < LEAST_IDENTITY
    locked = smoothed.locked_in if causal is None else causal.locked_in
    if labels_missing and locked >= 0 and _after_darkness(scene, oracle, answers.smoothed):
        found.append("lost after occlusion")
    elif locked < 0 or smoothed.identity < LEAST_LOCKED:
        found.append("never locked")
    if smoothed.wrong:
        found.append("wrong labels")
    if smoothed.wrong_measured or smoothed.not_definite:
        found.append("confidently wrong measured")
    if smoothed.wrong_predicted:
        found.append("confidently wrong predicted")
    if not smoothed.nees <= MOST_NEES:
        found.append("NEES")
    if labels_missing and not found:
        found.append("labels missing")
    if answers.exit_status:
        found.append("exit status")
    if answers.warnings_count:
        found.append("numeric warnings")
    return tuple(found)


def _after_darkness(scene: Scene, oracle: Oracle, answer: Pass) -> bool:
    """Most frames without a measured pose, but with one of the oracle, follow directly on an occluded frame.

    Occluded: the oracle has no pose, or less than half of the usual number of spots are visible.
    """
    missing = oracle.solvable & (answer.status != MEASURED)
    shining = scene.shining.sum(axis=1)
    occluded = ~oracle.solvable | (shining < 0.5 * np.median(shining))
    after = np.zeros(len(scene), dtype=bool)
    for k in range(1, len(scene)):
        after[k] = missing[k] and (occluded[k - 1] or after[k - 1])
    return bool(missing.any() and after.sum() > 0.5 * missing.sum())


def _mean(values: Array) -> float:
    values = values[~np.isnan(values)]
    return float(values.mean()) if values.size else float("nan")
