"""The results of a run on pictures compared with the truth: spots, labels, poses, noise model and verdict.

A pair (view, frame) counts if the spot is visible with a matched-filter SNR of at least LEAST_SNR, its sigma at rest is
at most WIDEST_PX (the beams are drawn for the median view; a camera near its screen may see 140 px), its centre is in
the picture, and no other light of the scene lies within the widths of both. It is correct if the reported position is
within max(3 px, 5 sigma / SNR) of the truth. Only scenes count that can be solved with the true labels and such points.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.random_pictures.adapter import reported_model, variance_at
from bench.random_pictures.render import Renderer
from bench.random_pictures.sensors import true_noise
from bench.random_scenes.answers import LOST, MEASURED, pass_of_files
from bench.random_scenes.draw.nuisances import FalsePoints
from bench.random_scenes.judge import CONFIDENTLY_WRONG, whitened_errors
from bench.random_scenes.oracle import ask_oracle
from bench.random_scenes.scene import OUTSIDE, SHINING, Scene, composed
from geometry.arrays import Array, Bools
from lab.files.run.results import read_result_table, read_spots, read_summary

LEAST_SNR = 8.0
WIDEST_PX = 24.0
SAME_SPOT_PX, SAME_SPOT_SIGMAS = 3.0, 5.0
APART_WIDTHS = 4.0  # sigmas of both lights, within which two lights do not count
LEAST_RIGHT, MOST_NEES = 0.97, 2.0  # of a good scene; NEES/6
SEEN = 0.5  # share of pictures of a camera with a spot, above which "nothing detected" is wrong

CLASSES = ("crash", "nothing measured", "confidently wrong", "wrong labels", "spots missing", "wrong diagnosis",
           "exit status", "NEES")  # fmt: skip


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """The noise model of one camera: estimated over true variance."""

    camera: str
    background_dn: float  # true level
    background: float  # ratio there
    half: float  # ratio at half of full scale


@dataclass(frozen=True, slots=True)
class PictureJudgement:
    """The scores of a scene; ratios are nan where they are undefined."""

    seed: int
    family: str
    counts: bool
    why_not: str
    classes: tuple[str, ...]
    pairs: int  # number of counted pairs
    right: float  # share of the pairs that are measured and correct
    recall: float  # share of the pairs with a detection at the correct position
    false_per_picture: float  # detections without a light of the scene near them
    wrong: int  # labels
    measured: float  # share of the frames
    wrong_poses: int  # confidently
    nees: float  # smoothed NEES/6, mean over measured and predicted poses
    nees_max: float
    scatter: float  # rms of the errors of the pairs over their stated sigmas, per coordinate
    error_px: float  # rms, per coordinate
    noise: tuple[NoiseFigures, ...]
    exit_status: int
    verdict: str
    wrong_diagnoses: tuple[str, ...]
    render_s: float  # process time
    run_s: float
    text: str

    @property
    def failure(self) -> str:
        """The leading class, or clean."""
        return self.classes[0] if self.classes else "clean"


def visible(renderer: Renderer) -> Bools:
    """(T, n): visible with LEAST_SNR in an existing picture, and not wider than WIDEST_PX."""
    scene = renderer.ps.scene
    return scene.shining & (np.nan_to_num(renderer.snr) >= LEAST_SNR) & (renderer.width_px <= WIDEST_PX)


def oracle_scene(renderer: Renderer) -> Scene:
    """The recording as points: the visible spots, with the noise of their light."""
    ps = renderer.ps
    scene, seen = ps.scene, visible(renderer)
    sigma = np.full(len(scene.camera_of), 0.05)
    for i in range(len(sigma)):
        if seen[:, i].any():
            sigma[i] = renderer.width_px[i] / float(np.median(renderer.snr[seen[:, i], i]))
    nothing = FalsePoints(0.0, (15.0, 40.0), 0.0, tuple(np.zeros((0, 2)) for _ in scene.rig.cameras))
    return composed(
        ps.key, ps.seed, scene.rig, scene.poses, scene.frame_rate_hz, np.maximum(sigma, 0.01), nothing, ~seen,
        scene.has_image, scene.corner_frames, ps.text, scene.prior,
    )  # fmt: skip


def other_lights(renderer: Renderer, k: int, camera: int, but: int = -1) -> Array:
    """(m, 3) u, v, width (px) of everything in a picture that resembles a spot, without the view `but`."""
    scene = renderer.ps.scene
    views = np.flatnonzero((scene.camera_of == camera) & (scene.in_view[k] == SHINING))
    views = views[views != but]
    spots = np.column_stack([scene.uv_px[k, views], renderer.width_px[views]])
    details = renderer.still[camera].bright * [1, 1, 1 / 3]
    clutter = np.column_stack([renderer.clutter_uv[camera][:, k], renderer.clutter_light[camera][:, 0]])
    return np.concatenate([spots, details, clutter])


def counted_pairs(renderer: Renderer) -> Bools:
    """(T, n): the pairs that count."""
    scene = renderer.ps.scene
    out = visible(renderer)
    for k, i in zip(*np.nonzero(out), strict=True):
        lights = other_lights(renderer, k, int(scene.camera_of[i]), i)
        away = np.linalg.norm(lights[:, :2] - scene.uv_px[k, i], axis=1)
        out[k, i] = not np.any(away < APART_WIDTHS * np.maximum(lights[:, 2], renderer.width_px[i]) + 3)
    return out


def tolerances(renderer: Renderer) -> Array:
    """(T, n): largest error, px, of a correct position."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.fmax(SAME_SPOT_PX, SAME_SPOT_SIGMAS * renderer.width_px / np.fmax(renderer.snr, 1.0)))


def judge(renderer: Renderer, results: Path, exit_status: int, seconds: tuple[float, float]) -> PictureJudgement:
    """All figures of one scene. seconds: process time of rendering and of the run."""
    ps = renderer.ps
    scene = ps.scene
    answer = pass_of_files(scene, results, causal=False)
    summary = read_summary(results)
    pairs, limit = counted_pairs(renderer), tolerances(renderer)
    error = answer.uv_px - scene.uv_px
    away = np.linalg.norm(error, axis=-1)
    right = answer.labelled & (away <= limit)
    wrong = int((answer.labelled & ~(away <= limit)).sum())
    nees = np.sum(whitened_errors(scene, answer) ** 2, axis=1)
    good = (answer.status != LOST) & ~np.isnan(nees)
    recall, false = detections_against(renderer, results, pairs, limit)
    oracle = ask_oracle(oracle_scene(renderer))
    diagnoses = wrong_diagnoses(renderer, summary) if oracle.counts else ()
    share = float((right & pairs).sum() / max(pairs.sum(), 1))
    chosen = right & pairs
    sigma = _claimed(scene, results)
    wrong_poses = int((nees[good] > CONFIDENTLY_WRONG).sum())
    mean_nees = float(nees[good].mean()) / 6 if good.any() else float("nan")
    classes = []
    if not (answer.status == MEASURED).any():
        classes.append("nothing measured")
    if wrong_poses:
        classes.append("confidently wrong")
    if wrong:
        classes.append("wrong labels")
    if share < LEAST_RIGHT and "nothing measured" not in classes:
        classes.append("spots missing")
    if diagnoses:
        classes.append("wrong diagnosis")
    if exit_status:
        classes.append("exit status")
    if mean_nees > MOST_NEES:
        classes.append("NEES")
    return PictureJudgement(
        seed=ps.seed, family=ps.family or "mixed", counts=oracle.counts, why_not=oracle.why_not, classes=tuple(classes),
        pairs=int(pairs.sum()), right=share, recall=recall, false_per_picture=false, wrong=wrong,
        measured=float((answer.status == MEASURED).mean()), wrong_poses=wrong_poses, nees=mean_nees,
        nees_max=float(nees[good].max(initial=0.0)) / 6,
        scatter=_rms(error[chosen] / sigma[chosen]), error_px=_rms(error[chosen]),
        noise=noise_figures(renderer, summary), exit_status=exit_status,
        verdict="; ".join(summary.get("verdict", {}).get("reasons", [])), wrong_diagnoses=diagnoses,
        render_s=seconds[0], run_s=seconds[1], text=ps.text,
    )  # fmt: skip


def detections_against(renderer: Renderer, results: Path, pairs: Bools, limit: Array) -> tuple[float, float]:
    """Share of the pairs with a detection at their position, and detections per picture far from any light."""
    scene = renderer.ps.scene
    table = read_result_table(results / "detections.csv", ("frame", "camera", "u_px", "v_px"))
    cameras = list(scene.rig.cameras)
    frame, uv = table.numbers["frame"], table.stack("u_px", "v_px")
    camera = table.words["camera"].recoded(tuple(cameras))
    found = false = 0
    for c in range(len(cameras)):
        mine = np.flatnonzero(scene.camera_of == c)
        for k in np.flatnonzero(scene.has_image[:, c]):
            points = uv[(frame == k) & (camera == c)]
            points = points[np.isfinite(points).all(axis=1)]
            for i in mine[pairs[k, mine]]:
                found += bool(np.any(np.linalg.norm(points - scene.uv_px[k, i], axis=1) <= limit[k, i]))
            lights = other_lights(renderer, int(k), c)
            gap = np.linalg.norm(points[:, None] - lights[None, :, :2], axis=-1)
            near = gap < np.maximum(5 * lights[:, 2], 5.0)
            false += int((~near.any(axis=1)).sum())
    return found / max(int(pairs.sum()), 1), false / max(int(scene.has_image.sum()), 1)


def wrong_diagnoses(renderer: Renderer, summary: Mapping[str, Any]) -> tuple[str, ...]:
    """The reasons of the verdict that contradict the truth; rig, prior, lasers and cameras of a scene are correct.

    Correct reasons: missing pictures, occluded spots, few measured frames because of these, and errors of the spots
    above their stated sigmas. Wrong reasons: an incorrect rig or prior, or lasers without light.
    """
    scene, seen = renderer.ps.scene, visible(renderer)
    out = []
    for item in summary.get("verdict", {}).get("evidence", []):
        kind, camera = item["kind"], item.get("numbers", {}).get("camera")
        false = kind in (
            "noise_scale",
            "model",
            "not_acquired",
            "few_points",
            "never_found",
            "internal",
        )
        if kind == "model":
            false = not _about_noise_or_hidden(item["what"], scene, seen)
        if camera in scene.rig.cameras:
            c = list(scene.rig.cameras).index(camera)
            mine = np.asarray(seen[:, scene.camera_of == c].any(axis=1))
            pictures = scene.has_image[:, c]
            last = item["numbers"].get("empty_at_end", 0) if "in its last" in item["what"] else 0
            false |= kind == "nothing_detected" and float(mine[pictures][-last:].mean()) > SEEN
            false |= kind == "no_pictures" and bool(pictures.any())
            false |= kind in ("camera_late", "camera_stopped", "missing_pictures") and bool(pictures.all())
        if false:
            out.append(f"{kind}: {item['what']}")
    return tuple(out)


def _about_noise_or_hidden(what: str, scene: Scene, seen: Bools) -> bool:
    """The finding is about sigmas that are too small, a barely visible spot, or a camera with such spots alone."""
    if what.startswith("the spots' residuals are"):
        return True
    never = re.match(r"camera `(.+)`: none of its", what)
    if never is not None and never[1] in scene.rig.cameras:
        mine = scene.camera_of == list(scene.rig.cameras).index(never[1])
        shown = np.count_nonzero(scene.in_view[:, mine] != OUTSIDE)
        return bool(seen[:, mine].sum() < SEEN * shown)
    named = re.match(r"spot (\S+) in camera `(.+)` was measured in", what)
    if named is None:
        return False
    view = scene.rig.views().index((named[2], named[1]))
    return bool(seen[:, view].sum() < SEEN * np.count_nonzero(scene.in_view[:, view] != OUTSIDE))


def noise_figures(renderer: Renderer, summary: Mapping[str, Any]) -> tuple[NoiseFigures, ...]:
    """The ratios of each camera with a model in the results."""
    blocks = summary.get("parameters", {}).get("noise", {})
    return tuple(
        compared(renderer, c, name, reported_model(blocks[name]))
        for c, name in enumerate(renderer.ps.scene.rig.cameras)
        if name in blocks
    )


def compared(renderer: Renderer, camera: int, name: str, model: Any) -> NoiseFigures:
    """A model compared with the sensor, at the level of the background and at half of full scale."""
    look, still = renderer.ps.look, renderer.still[camera]
    rng = np.random.default_rng([*renderer.ps.key, 31, camera])
    unlit = float(np.median((still.ambient_e + still.steady_e)[::4, ::4]))
    ratios, levels = [], []
    for light in (unlit, 0.5 * look.sensor.full_well_e):
        level, variance = true_noise(look.sensor, light, rng)
        levels.append(level)
        # Rounding limits the observable noise: a constant 8-bit background may have no variance at all.
        floor = 4.0**look.sensor.shift / 12
        ratios.append(variance_at(model, level) / max(variance, floor))
    return NoiseFigures(name, levels[0], ratios[0], ratios[1])


def _claimed(scene: Scene, results: Path) -> Array:
    """(T, n, 2) px: the sigmas of spots.csv."""
    spots = read_spots(results)
    out = np.full((len(scene), len(scene.camera_of), 2), np.nan)
    for j, view in enumerate(scene.rig.views()):
        if view in spots.views:
            out[spots.frames, j] = spots.sigma_px[:, spots.views.index(view)]
    return out


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
