"""Circles of the second renderer: what the tracker reports where its own renderings do not show it.

python -m bench.related_measurements.second_checks occlusion SEED COUNT     coefficient against the hidden share
python -m bench.related_measurements.second_checks empty SEED COUNT         100 frames of COUNT scenes without a target
python -m bench.related_measurements.second_checks edges SEED COUNT         thin rims: which edge is tracked
python -m bench.related_measurements.second_checks consistency SEED COUNT   errors of centres against their sigmas
python -m bench.related_measurements.second_checks ensemble SEED COUNT      the same, one frame of each video
python -m bench.related_measurements.second_checks approaches SEED COUNT    approaching drogues, by the light tracker
python -m bench.related_measurements.second_checks detector SEED COUNT [WEIGHTS]  COUNT drogues of each scene
python -m bench.related_measurements.second_checks third SEED COUNT [WEIGHTS]  the same with the renderer of validation
python -m bench.related_measurements.second_checks point SEED COUNT [NAME=NUMBER]   discs by the point tracker
python -m bench.related_measurements.second_checks first SEED COUNT      the same before structure: where tracks start
"""

from __future__ import annotations

import itertools
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.related_measurements.learned_detector import drawn, is_right
from bench.related_measurements.renderers import second_renderer, third_renderer
from bench.related_measurements.renderers import second_renderer as render
from geometry.arrays import Array
from lab.targets.circle import CircleOptions
from lab.targets.drogue import DrogueOptions
from lab.targets.point import PointOptions
from tracking.drogue_circle.detectors import Edge
from tracking.learned_detector.detector import WEIGHTS, find_drogues
from tracking.noise import Picture
from tracking.single_target.blobs import find_blobs
from tracking.single_target.point_tracker import PointTracker, track_point
from tracking.statuses import Cause, PoseStatus

_CLEAR, _HELD = 30, 20  # frames before a probe comes, and after it has arrived
_LEAST_CONTRAST = 30.0  # DN between a probe and the greys of the target: another one cannot be seen


@dataclass(frozen=True, slots=True)
class Truth:
    """What a picture shows."""

    circle: Array  # (3,) u, v, radius, px
    hidden: float  # share of the disc
    hub_hidden: float  # share of the middle of a ribbed target: the tracked circle, where ribs alternate with the sky


def motion(rng: np.random.Generator, moving: bool, radius: tuple[float, float] = (30.0, 90.0)) -> Iterator[Array]:
    """Circles (3,) of one target: at rest, or swaying and coming nearer by a sixth in a hundred frames."""
    start = np.array([*rng.uniform((200, 180), (440, 300)), rng.uniform(*radius)])
    amplitude, period = rng.uniform(3, 25, 2), rng.uniform(40, 120, 2)
    phase = rng.uniform(0, 2 * np.pi, 2)
    k = 0
    while True:
        sway = amplitude * np.sin(2 * np.pi * k / period + phase) if moving else np.zeros(2)
        yield start + np.append(sway, start[2] * k / 600 if moving else 0.0)
        k += 1


def probed(seed: int, kind: str) -> Iterator[tuple[Picture, Truth]]:
    """A target that a probe covers by 10 to 60 % within 1 to 100 frames."""
    rng = np.random.default_rng(seed)
    scene, look = render.background(str(rng.choice(["sky", "cloud"])), rng), render.face(kind, rng)
    share, steps = rng.uniform(0.1, 0.6), round(float(np.exp(rng.uniform(0, np.log(100)))))
    rod = render.probe(rng, share)
    greys = np.array([look.bright, look.shade, 0.55 * look.bright + 0.45 * look.shade])
    while np.abs(rod.grey - greys).min() < _LEAST_CONTRAST:
        rod = render.probe(rng, share)
    circles = motion(rng, bool(rng.random() < 0.5))
    outside = 1.0 + rod.half_width
    end = rod.covering(share).tip
    for k in range(_CLEAR + steps + _HELD):
        part = min(max((k - _CLEAR + 1) / steps, 0), 1)
        now = None
        if part > 0:
            now = render.replace(rod, tip=outside + part * (end - outside))
        circle = next(circles)
        shares = (0.0, 0.0) if now is None else (now.share(), now.share(render.HUB))
        yield render.draw(scene, look, *circle, rng, now), Truth(circle, *shares)


def occlusion(seed: int, count: int) -> None:
    """Mean error of the coefficient, and how often it reports a probe that is not there."""
    for kind in ("plain", "ribbed"):
        errors, ends, false, unseen = [], [], [], 0
        for n in range(count):
            tracker = CircleOptions(edge="outer").tracker()
            for k, (picture, truth) in enumerate(probed(1000 * seed + n, kind)):
                frame = tracker.step(picture)
                if k < 5:
                    continue
                if k == 5:
                    hub = frame.state[2] < 0.6 * truth.circle[2]
                hidden = truth.hub_hidden if hub else truth.hidden
                if not np.isfinite(frame.occlusion):
                    unseen += 1
                elif truth.hidden == 0:
                    false.append(frame.occlusion > 0.1)
                else:
                    errors.append(abs(frame.occlusion - hidden))
            ends.append(abs(frame.occlusion - hidden))
        print(
            f"{kind}: mean error {np.mean(errors):.3f}, of the last frames {np.nanmean(ends):.3f}; above .1 without a"
            f" probe {100 * np.mean(false):.2f} % of {len(false)} frames; unknown in {unseen}"
        )


def empty(seed: int, count: int) -> None:
    """Frames of drifting scenes without a target that are measured."""
    for kind in render.BACKGROUNDS:
        measured, ambiguous, radii = 0, 0, []
        for n in range(count):
            rng = np.random.default_rng(1000 * seed + n)
            wide = render.background(kind, rng, (render.SIZE[0] + 110, render.SIZE[1] + 110))
            drift = rng.uniform(0, 1, 2)
            tracker = CircleOptions().tracker()
            for k in range(100):
                left, top = np.floor(drift * k).astype(int)
                scene = wide[top : top + render.SIZE[1], left : left + render.SIZE[0]]
                frame = tracker.step(render.draw(scene, None, 0, 0, 0, rng))
                measured += frame.status is PoseStatus.MEASURED
                ambiguous += frame.cause is Cause.AMBIGUOUS
                if frame.event in ("acquired", "reacquired"):
                    radii.append(float(frame.state[2]))
        print(
            f"{kind}: {measured} of {100 * count} frames measured, {ambiguous} ambiguous; radii of the acquisitions"
            f" {np.round(radii, 1).tolist()}"
        )


def edges(seed: int, count: int) -> None:
    """Thin rims: the error of the radius of the tracked edge, and which one it is."""
    for edge in Edge:
        right, reported, frames, n_measured, away = 0, 0, 0, 0, []
        for n in range(count):
            rng = np.random.default_rng(1000 * seed + n)
            scene, look = render.background(str(rng.choice(["sky", "cloud"])), rng), render.face("thin", rng)
            circles, tracker = motion(rng, n % 2 == 1, (30.0, 120.0)), CircleOptions(edge=edge.value).tracker()
            for _ in range(30):
                circle = next(circles)
                frame = tracker.step(render.draw(scene, look, *circle, rng))
                reported += len(frame.edges_px) > 1
                frames += 1
                if frame.status is PoseStatus.MEASURED:
                    radii = circle[2] * np.array([1.0, 1 - render.THIN, render.OPENING])
                    nearest = int(np.argmin(np.abs(radii - frame.state[2])))
                    n_measured += 1
                    right += edge is Edge.SUPPORTED or nearest == list(Edge).index(edge) - 1
                    away.append(frame.state[2] - radii[nearest])
        print(
            f"{edge.value}: measured {n_measured} of {frames}, the right edge in {right}; several edges reported in"
            f" {reported} of {count} videos; radius: bias {np.mean(away):+.3f} px,"
            f" RMS {np.sqrt(np.mean(np.square(away))):.3f} px"
        )


def consistency(seed: int, count: int) -> None:
    """NEES / 2 of the reported centre by kind: 60 frames of COUNT videos each, the first 10 left out."""
    for kind in ("plain", "ribbed", "textured", "thin"):
        nees, errors, sigmas = [], [], []
        for n in range(count):
            rng = np.random.default_rng(1000 * seed + n)
            scene, look = render.background(str(rng.choice(["sky", "cloud"])), rng), render.face(kind, rng)
            circles, tracker = motion(rng, n % 2 == 1, (30.0, 120.0)), CircleOptions(edge="outer").tracker()
            own = []
            for k in range(60):
                circle = next(circles)
                frame = tracker.step(render.draw(scene, look, *circle, rng))
                if k >= 10 and frame.status is PoseStatus.MEASURED:
                    away = frame.state[:2] - circle[:2]
                    own.append(away @ np.linalg.solve(frame.covariance[:2, :2], away) / 2)
                    errors.append(np.hypot(*away))
                    sigmas.append(np.sqrt(np.trace(frame.covariance[:2, :2])))
            nees.append(np.mean(own) if own else np.nan)
        good = np.mean((np.array(nees) > 0.8) & (np.array(nees) < 1.3))
        print(
            f"{kind}: NEES/2 mean {np.nanmean(nees):.2f}, of videos {np.round(np.nanpercentile(nees, [5, 50, 95]), 2)},"
            f" {100 * good:.0f} % within .8 to 1.3; error RMS {np.sqrt(np.mean(np.square(errors))):.4f} px,"
            f" stated {np.sqrt(np.mean(np.square(sigmas))):.4f}; {len(errors)} frames of {50 * count}"
        )


def ensemble(seed: int, count: int) -> None:
    """NEES / 2 of the centre and NEES of the radius in the first measured frame: one draw of each of COUNT videos."""
    for kind in ("plain", "textured"):
        for scene_kind in ("sky", "cloud"):
            centre, radius = [], []
            for n in range(count):
                rng = np.random.default_rng(1000 * seed + n)
                scene, look = render.background(scene_kind, rng), render.face(kind, rng)
                circles, tracker = motion(rng, False, (30.0, 120.0)), CircleOptions(edge="outer").tracker()
                for circle in itertools.islice(circles, 3):
                    frame = tracker.step(render.draw(scene, look, *circle, rng))
                    if frame.status is PoseStatus.MEASURED:
                        away = frame.state[:3] - circle
                        centre.append(away[:2] @ np.linalg.solve(frame.covariance[:2, :2], away[:2]) / 2)
                        radius.append(away[2] ** 2 / frame.covariance[2, 2])
                        break
            print(
                f"{kind}, {scene_kind}: {len(centre)} of {count} measured; centre NEES/2 {np.mean(centre):.2f} +-"
                f" {len(centre) ** -0.5:.2f}, {100 * np.mean(np.array(centre) > 4.6):.1f} % above 4.6 (1 % if correct),"
                f" largest {np.max(centre):.1f}; radius NEES {np.mean(radius):.2f}"
            )


def approaches(seed: int, count: int) -> None:
    """Drogues that come from 9 to 120 px in 90 frames; something hides them for six of these."""
    for kind in ("cloud", "ground"):
        hidden_measured, hidden_frames, elsewhere, seen, right, errors, nees = 0, 0, [], 0, 0, [], []
        for n in range(count):
            rng = np.random.default_rng(1000 * seed + n)
            scene, look = render.background(kind, rng), render.face("drogue", rng, hose=True)
            plate = render.Probe(rng.uniform(0, 6), 1.4, 0.0, rng.uniform(60, 200), -1.5)
            circles, tracker = motion(rng, True, (4.5, 4.5)), DrogueOptions().tracker()
            away_since, covered = 0, int(rng.integers(25, 70))
            for k in range(90):
                circle = next(circles)
                circle[2] = 4.5 * (120 / 9) ** (k / 89)
                hidden = covered <= k < covered + 6
                picture = render.draw(scene, look, *circle, rng, plate if hidden else None)
                frame = tracker.step(picture)
                measured = frame.status is PoseStatus.MEASURED
                if hidden:
                    hidden_measured, hidden_frames = hidden_measured + measured, hidden_frames + 1
                    continue
                away = frame.centre_px - circle[:2]
                error = float(np.hypot(*away)) / (2 * circle[2])
                seen, right = seen + 1, right + (measured and error < 0.25)
                wrong = measured and error > 0.5
                sure = wrong and any(
                    c.score > 0.99 and np.hypot(c.u_px - circle[0], c.v_px - circle[1]) < circle[2]
                    for c in tracker.detector(picture, None)
                )
                away_since = away_since + 1 if sure else 0
                elsewhere.append(away_since)
                if measured and error < 0.25:
                    errors.append(error)
                    nees.append(away @ np.linalg.solve(frame.covariance, away) / 2)
        print(
            f"{kind}: right in {right} of {seen} frames; elsewhere while the detector is sure for"
            f" {max(elsewhere)} frames at most; hidden frames"
            f" measured {hidden_measured} of {hidden_frames}; error of the centre, RMS"
            f" {100 * np.sqrt(np.mean(np.square(errors))):.2f} % of the diameter, NEES/2 {np.mean(nees):.2f}"
        )


def detector(seed: int, count: int, weights: Path = WEIGHTS, render: Any = second_renderer) -> None:
    """The learned detector at a confidence of .5; half of the drogues have 9 to 15 px, the others 15 to 200."""
    cv2.setNumThreads(1)
    spent, n = 0.0, 0
    for kind in render.BACKGROUNDS:
        hits: dict[bool, list[bool]] = {True: [], False: []}
        false, ratios, away = [0, 0], [], []
        for k in range(2 * count):
            sample = drawn(render, kind, seed, k)
            diameter, shown = sample.diameter_px, bool(np.isfinite(sample.diameter_px))
            start = time.process_time()
            found = find_drogues(sample.image, 9.0, 200.0, 0.5, weights)
            spent, n = spent + time.process_time() - start, n + 1
            right = [c for c in found if is_right(sample, c)]
            false[shown] += len(found) - len(right[:1])
            if shown:
                hits[diameter < 15].append(bool(right))
            ratios += [c.diameter_px / diameter for c in right[:1]]
            away += [np.hypot(*np.subtract((c.u_px, c.v_px), sample.centre_px)) / diameter for c in right[:1]]
        print(
            f"{kind}: recall {np.mean(hits[True] + hits[False]):.3f}, at 9 to 15 px {np.mean(hits[True]):.3f}; diameter"
            f" {100 * (np.median(ratios) - 1):+.1f} % in the median; centre, RMS"
            f" {100 * np.sqrt(np.mean(np.square(away))):.1f} % of the diameter; false per empty picture"
            f" {false[0] / count:.3f}, per picture of a drogue {false[1] / count:.3f}"
        )
    print(f"{1e3 * spent / n:.0f} ms of process time per picture")


def third(seed: int, count: int, weights: Path = WEIGHTS) -> None:
    """The same with the renderer of validation, which chooses between trainings."""
    detector(seed, count, weights, third_renderer)


def point(seed: int, count: int, setting: str = "") -> None:
    """Discs of 3 to 8 px radius, 150 frames each, hidden for 10 and for 20: errors, gaps, false measurements."""
    name, _, value = setting.partition("=")
    overrides = {name: float(value) if "." in value else int(value)} if setting else {}
    gaps, late, false, frames, nees, errors = 0, [], 0, 0, [], []
    for n in range(count):
        rng = np.random.default_rng(1000 * seed + n)
        kind = str(rng.choice(["sky", "cloud"]))
        scene, look = render.background(kind, rng), render.face("plain", rng)
        bright = look.bright > 100 and kind == "sky"  # clouds are as bright as that
        look = render.replace(look, bright=scene.max() + 45 if bright else min(look.bright, 50.0))
        settings = PointOptions("brighter" if bright else "darker", overrides=overrides).settings()
        circles, tracker, waits = motion(rng, True, (3.0, 8.0)), PointTracker(settings.track), None
        for k in range(150):
            circle = next(circles)
            hidden = 50 <= k < 60 or 100 <= k < 120
            picture = render.draw(scene, None if hidden else look, *circle, rng)
            estimate = tracker.step(1.0, find_blobs(picture, settings.blobs))
            frames += 1
            away = estimate.x[:2] - circle[:2]
            measured = estimate.status is PoseStatus.MEASURED
            right = measured and not hidden and float(np.hypot(*away)) < 1.0
            false += measured and not right
            waits = k if hidden else waits
            if right and k >= 10:
                nees.append(away @ np.linalg.solve(estimate.P[:2, :2], away) / 2)
                errors.append(np.hypot(*away))
            if waits is not None and (right or k in (99, 149)) and not hidden:
                late.append(k - waits - 1 if right else np.inf)
                gaps, waits = gaps + 1, None
    print(
        f"{gaps} gaps: recovered at once {np.sum(np.array(late) == 0)}, within 3 frames"
        f" {np.sum(np.array(late) <= 3)}, never {np.sum(np.isinf(late))}; {false} false of {frames} frames;"
        f" NEES/2 {np.mean(nees):.2f}, RMS of the error {np.sqrt(np.mean(np.square(errors))):.3f} px"
    )


def first(seed: int, count: int) -> None:
    """Discs of 3 to 12 px radius, 40 frames: where the first motion starts, before scenes at rest and drifting ones."""
    for kind, way in itertools.product(("cloud", "ground", "water"), ("sways", "rests", "drifts")):
        starts, right, false, found_in = Counter[str](), 0, 0, 0
        for n in range(count):
            rng = np.random.default_rng(1000 * seed + n)
            wide = render.background(kind, rng, (render.SIZE[0] + 50, render.SIZE[1] + 50))
            look = render.face("plain", rng)
            bright = look.bright > 100 and kind != "cloud"  # clouds are as bright as that
            look = look if bright else render.replace(look, bright=min(look.bright, 50.0))
            drift = rng.uniform(0, 1, 2) * (way == "drifts")
            settings = PointOptions("brighter" if bright else "darker").settings()
            circles = list(itertools.islice(motion(rng, way != "rests", (3.0, 12.0)), 40))
            found = []
            for k, circle in enumerate(circles):
                left, top = np.floor(drift * k).astype(int)
                scene = wide[top : top + render.SIZE[1], left : left + render.SIZE[0]]
                found.append(find_blobs(render.draw(scene, look, *circle, rng), settings.blobs))
            near = [0.2 * c[2] + 1 for c in circles]
            pairs = list(zip(found, circles, near, strict=True))
            found_in += sum(bool((np.linalg.norm(f.uv_px - c[:2], axis=1) < r).any()) for f, c, r in pairs)
            track = track_point(np.append(0.0, np.ones(39)), found, settings.track)
            hits = [
                float(np.hypot(*(e.x[:2] - c[:2]))) < r
                for e, c, r in zip(track, circles, near, strict=True)
                if e.status is PoseStatus.MEASURED
            ]
            starts["nowhere" if not hits else "at the disc" if hits[0] else "elsewhere"] += 1
            right, false = right + sum(hits), false + len(hits) - sum(hits)
        print(
            f"{kind}, disc {way if way != 'drifts' else 'sways, scene drifts'}: tracks start {dict(starts)}; of"
            f" {40 * count} frames {right} right, {false} elsewhere; the disc is detected in {found_in}"
        )


if __name__ == "__main__":
    what, *rest = sys.argv[1:] or [""]
    checks = {
        "occlusion": occlusion,
        "empty": empty,
        "edges": edges,
        "approaches": approaches,
        "consistency": consistency,
        "detector": detector,
        "third": third,
        "point": point,
        "first": first,
        "ensemble": ensemble,
    }
    if what in checks and len(rest) == 2:
        checks[what](int(rest[0]), int(rest[1]))
    elif what == "point" and len(rest) == 3:
        point(int(rest[0]), int(rest[1]), rest[2])
    elif what in ("detector", "third") and len(rest) == 3:
        (third if what == "third" else detector)(int(rest[0]), int(rest[1]), Path(rest[2]))
    else:
        sys.exit(__doc__)
