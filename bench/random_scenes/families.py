"""Fixed families of scenes, each for one difficulty: `python -m bench.random_scenes --family NAME --seeds 1:101`.

Unless a family states otherwise, scenes with even seeds use the rig of the paper (a fan of three beams, screens at 2.5
m, 1280x1024 px) and those with odd seeds a random rig.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bench.random_scenes import scene
from bench.random_scenes.drafts import (
    SCREENS_M,
    Draft,
    Draw,
    false_points,
    fan_lab,
    hide_across,
    paper_lab,
    usual_lab,
    zigzag_with_bends,
)
from bench.random_scenes.draw import motions, nuisances
from bench.random_scenes.draw.motions import Motion
from bench.random_scenes.draw.nuisances import CLEAN_FRAMES
from bench.random_scenes.projection import spot_pixels
from bench.random_scenes.scene import Scene, draw_amplitudes, fitted_motion, view_indices
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_rig, rig_names, split_name


@dataclass(frozen=True, slots=True)
class Family:
    """A named family of scenes."""

    make: Callable[[Draw], Scene | None]  # None: the draws are not suitable; others are tried
    frames: int
    goal: str


def family_scene(name: str, seed: int, frames: int | None = None) -> Scene:
    """The scene of a seed in a family."""
    family = FAMILIES[name]
    for attempt in range(1000):
        key = [seed, zlib.crc32(name.encode()), attempt]
        made = family.make(Draw(seed, family.frames if frames is None else frames, key))
        if made is not None:
            return made
    raise RuntimeError(f"family {name}: no scene for seed {seed}")


def _corners(draw: Draw, kind: str) -> Scene | None:
    lab, noise = usual_lab(draw), 0.01
    rng = draw.rng(scene.MOTION)
    hard = kind == "hard" or (kind == "hidden" and rng.random() < 0.5)
    low, high = (120, 6000) if hard else (3, 25)  # in sigmas of the noise
    bend = noise * float(np.exp(rng.uniform(np.log(low), np.log(high))))
    made = zigzag_with_bends(lab, rng, draw.frames, (8, 40), bend, 60.0)
    if made is None:
        return None
    q, corners = made
    rate = float(np.exp(rng.uniform(np.log(50), np.log(300))))
    draft = Draft(draw, lab, q, rate, noise, false_points(lab, beside=0.2), corners, f"corners, bend {bend:.2g} px")
    if kind == "hidden":
        hide_across(draft, draw.rng(scene.NUISANCE), (3, 12), ("one", "two", "screen", "all"))
        draft.text += ", hidden across them"
    return draft.scene()


def _camera_gaps(draw: Draw) -> Scene | None:
    lab = usual_lab(draw)
    rng = draw.rng(scene.MOTION)
    rate = float(np.exp(rng.uniform(np.log(50), np.log(200))))
    kind = (motions.sines, motions.zigzag)[int(rng.integers(2))]
    motion = kind(rng, np.arange(draw.frames) / rate)
    q = fitted_motion(lab, motion, draw_amplitudes(rng, lab), 20.0, 0.95)
    if q is None:
        return None
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    draft = Draft(draw, lab, q, rate, noise, false_points(lab, beside=0.2), motion.corners_s * rate, "camera gap")
    rng = draw.rng(scene.NUISANCE)
    length = int(np.exp(rng.uniform(np.log(3), np.log(40))))
    where = ("start", "end", "middle", "middle")[int(rng.integers(4))]
    first = {"start": 0, "end": draw.frames - length}.get(where, int(rng.integers(CLEAN_FRAMES, draw.frames - length)))
    camera = int(rng.integers(len(lab.rig.cameras)))
    draft.has_image[first : first + length, camera] = False
    draft.text = f"camera {list(lab.rig.cameras)[camera]} without pictures {first}-{first + length - 1} ({where})"
    return replace(draft.scene(), late_start=where == "start")


def _blackout_static(draw: Draw) -> Scene | None:
    lab = usual_lab(draw)
    rng = draw.rng(scene.MOTION)
    rate = float(np.exp(rng.uniform(np.log(50), np.log(200))))
    motion = motions.sines(rng, np.arange(draw.frames) / rate)
    q = fitted_motion(lab, motion, draw_amplitudes(rng, lab), 15.0, 0.95)
    if q is None:
        return None
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    draft = Draft(draw, lab, q, rate, noise, false_points(lab), motion.corners_s, "everything hidden 25 frames")
    rng = draw.rng(scene.NUISANCE)
    first = int(rng.integers(40, draw.frames - 60))
    draft.hidden[first : first + 25] = True
    each = 1 + draw.seed // 2 % 2
    static = []
    for c, camera in enumerate(lab.rig.cameras.values()):
        mine = draft.uv[:, draft.camera_of == c]
        static.append(nuisances.draw_reflections(rng, each, camera.image_size_px, mine, True, first))
    draft.false = replace(draft.false, reflections=tuple(static), reflection_seen=1.0)
    draft.text += f" from {first} beside {each} reflections per picture"
    return draft.scene()


def _three_left(draw: Draw) -> Scene | None:
    lab = usual_lab(draw)
    rng = draw.rng(scene.MOTION)
    motion = motions.sines(rng, np.arange(draw.frames) / 50.0)
    q = fitted_motion(lab, motion, rng.uniform(1, 3) * draw_amplitudes(rng, lab), 30.0, 0.9)
    if q is None:
        return None
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    draft = Draft(draw, lab, q, 50.0, noise, false_points(lab, beside=0.1), np.zeros(0), "three spots left")
    rng = draw.rng(scene.NUISANCE)
    screen_of = {name: s.screen for name, s in lab.rig.spots.items()}
    names = list(lab.rig.spots)
    screens = list(lab.rig.screens)
    rng.shuffle(screens)
    two = [i for i, n in enumerate(names) if screen_of[n] == screens[0]]
    one = [i for i, n in enumerate(names) if screen_of[n] == screens[1]]
    if len(two) < 2 or not one or len(names) < 5:
        return None
    left = [*rng.choice(two, 2, replace=False), rng.choice(one)]
    first = int(rng.integers(30, draw.frames - 110))
    draft.hidden[first : first + 70, ~np.isin(draft.spot_of, left)] = True
    draft.text += f" {first}-{first + 69}: {', '.join(names[i] for i in left)}"
    return draft.scene()


def _screen_corner(draw: Draw) -> Scene | None:
    rng = draw.rng(scene.LAB)
    half = rng.uniform(4, 12)
    lab = fan_lab(rng, np.array([-half, half]), 0.5, (600.0, 2500.0), f"2 beams {2 * half:.0f} deg apart")
    rng = draw.rng(scene.MOTION)
    bend = float(np.exp(rng.uniform(np.log(1), np.log(15))))
    made = zigzag_with_bends(lab, rng, draw.frames, (25, 50), bend, 20.0)
    if made is None:
        return None
    q, corners = made
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.15))))
    text = f"both spots of a screen hidden 16 frames across corners of {bend:.2g} px"
    draft = Draft(draw, lab, q, 100.0, noise, replace(false_points(lab), exactly=1), corners, text)
    hide_across(draft, draw.rng(scene.NUISANCE), (16, 16), ("screen",), share=1.0)
    return draft.scene()


def _fast_close(draw: Draw) -> Scene | None:
    rng = draw.rng(scene.LAB)
    rate = 100.0
    lab = fan_lab(rng, np.array([-4.0, 0.0, 4.0]), 0.6, (700.0, 1300.0), "3 beams 4 deg apart")
    at_rest = spot_pixels(lab.rig, lab.poses(lab.rest[None]))[0]
    camera_of, _ = view_indices(lab.rig)
    spacing = np.median([np.linalg.norm(at_rest[camera_of == c][1] - at_rest[camera_of == c][0]) for c in (0, 1)])
    angle = 4.0 * 28.0 / spacing
    lab = fan_lab(
        draw.rng(scene.LAB), np.array([-angle, 0.0, angle]), 0.6, (700.0, 1300.0), f"3 beams {angle:.1f} deg apart"
    )
    rng = draw.rng(scene.MOTION)
    hz = rng.uniform(3.0, 6.0, 6)
    phase = rng.uniform(0, 2 * np.pi, 6)
    shape = np.sin(2 * np.pi * np.arange(draw.frames)[:, None] / rate * hz + phase)
    amplitudes = draw_amplitudes(rng, lab)
    moved_px = np.diff(spot_pixels(lab.rig, lab.poses(0.2 * amplitudes * shape)), axis=0)
    size = 0.2 * 116.0 / np.nanmax(np.linalg.norm(moved_px, axis=-1))
    q = fitted_motion(lab, Motion(shape, np.zeros(0), "shaking"), size * amplitudes, 125.0, 0.8)
    if q is None:
        return None
    text = f"shaking of {hz.min():.1f} to {hz.max():.1f} Hz, up to 116 px/frame, spots 28 px apart"
    draft = Draft(draw, lab, q, rate, 0.1, false_points(lab, beside=0.2), np.zeros(0), text)
    fastest = np.nanmax(np.linalg.norm(np.diff(draft.uv, axis=0), axis=-1))
    return draft.scene() if fastest > 95 else None


def _shaking_equal_fan(draw: Draw) -> Scene | None:
    rng = draw.rng(scene.LAB)
    count, apart_deg = int(rng.integers(2, 6)), rng.uniform(2.0, 5.0)
    largest = np.deg2rad(rng.uniform(8.0, 25.0))
    angles = apart_deg * np.arange(0.5 * (1 - count), 0.5 * count)
    name = f"{count} beams {apart_deg:.1f} deg apart"
    lab = fan_lab(rng, angles, SCREENS_M * float(np.tan(largest)), (600.0, 2500.0), name)
    rng = draw.rng(scene.MOTION)
    rate = float(np.exp(rng.uniform(np.log(50), np.log(200))))
    hz = rng.uniform(4.0, 9.0, 2)
    amplitudes = np.zeros(6)
    axes = [3, 3 + int(rng.integers(1, 3))]  # yaw moves the spots along the line that they lie on
    amplitudes[axes] = largest * np.array([1.0, rng.uniform(0.2, 1.0)])
    shape = np.zeros((draw.frames, 6))
    shape[:, axes] = np.sin(2 * np.pi * (np.arange(draw.frames)[:, None] / rate * hz + rng.random(2)))
    at_rest = spot_pixels(lab.rig, lab.poses(lab.rest[None]))[0]
    spacing = float(np.median(np.linalg.norm(np.diff(at_rest.reshape(2, count, 2), axis=1), axis=-1)))
    in_view = 1.0 if count == 2 else 0.8  # three spots leave the labels open
    q = fitted_motion(lab, Motion(shape, np.zeros(0), "shaking"), amplitudes, 4.2 * spacing, in_view)
    if q is None:
        return None
    reached = np.rad2deg(np.abs(q[:, axes]).max(axis=0))
    moved = np.nanmax(np.linalg.norm(np.diff(spot_pixels(lab.rig, lab.poses(q)), axis=0), axis=-1))
    noise = float(np.exp(rng.uniform(np.log(0.01), np.log(0.2))))
    false = false_points(lab, beside=float(rng.choice([0.0, 0.0, 0.2, 1.0])))
    text = (
        f"shaking by {reached[0]:.0f} and {reached[1]:.0f} deg at {hz[0]:.1f} and {hz[1]:.1f} Hz,"
        f" spots {spacing:.0f} px apart move up to {moved:.0f} px per frame"
    )
    return Draft(draw, lab, q, rate, noise, false, np.zeros(0), text).scene()


def _two_beams_25hz(draw: Draw) -> Scene | None:
    rng = draw.rng(scene.LAB)
    lab = fan_lab(rng, np.array([-5.0, 5.0]), float(rng.uniform(0.06, 0.3)), (2500.0, 6000.0), "2 beams 10 deg apart")
    rng = draw.rng(scene.MOTION)
    t = np.arange(draw.frames) / 25.0
    motion = motions.rest(rng, t) if rng.random() < 0.5 else motions.slow(rng, t)
    q = fitted_motion(lab, motion, draw_amplitudes(rng, lab), 15.0, 1.0)
    if q is None:
        return None
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    clutter = float(rng.choice([0.0, 0.2]))
    return Draft(draw, lab, q, 25.0, noise, false_points(lab, clutter), np.zeros(0), motion.text).scene()


def _uniform(draw: Draw) -> Scene | None:
    rng = draw.rng(scene.LAB)
    if draw.seed % 2:
        lab = fan_lab(rng, np.array([-10.0, 10.0]), 0.5, (800.0, 2500.0), "2 beams 20 deg apart")
    else:
        lab = paper_lab()
    rng = draw.rng(scene.MOTION)
    bend = float(np.exp(rng.uniform(np.log(0.3), np.log(30))))
    made = zigzag_with_bends(lab, rng, draw.frames, (20, 70), bend, 30.0)
    if made is None:
        return None
    q, corners = made
    if rng.random() < 0.3:  # at rest from some corner on
        k = int(corners[int(rng.integers(len(corners)))]) + 1
        q[k:] = q[k]
    false = false_points(lab, beside=float(rng.choice([0.0, 0.2])))
    return Draft(draw, lab, q, 200.0, 0.012, false, corners, f"uniform between bends of {bend:.2g} px").scene()


def _quiet_then_turn(draw: Draw) -> Scene | None:
    lab = usual_lab(draw)
    rng = draw.rng(scene.MOTION)
    start = rng.uniform(0.5, 0.75) * draw.frames
    length = rng.uniform(0.1, 0.25) * draw.frames
    shape = motions.smooth_step((np.arange(draw.frames) - start) / length)[:, None] * rng.uniform(-1, 1, 6)
    motion = Motion(shape, np.array([start, start + length]), "rest")
    q = fitted_motion(lab, motion, 2 * draw_amplitudes(rng, lab), 20.0, 0.9)
    if q is None:
        return None
    text = f"rest, then an eased turn over {length:.0f} frames from {start:.0f} on"
    return Draft(draw, lab, q, 401.0, 0.011, false_points(lab, beside=0.2), motion.corners_s, text).scene()


def _no_prior(draw: Draw) -> Scene | None:
    name = ("unequal-fan", "four-skew-beams")[draw.seed % 2]
    lab = paper_lab(name)
    rng = draw.rng(scene.MOTION)
    lab = replace(lab, rest=np.concatenate([rng.uniform(-0.6, 0.6, 3), np.deg2rad(rng.uniform(-20, 20, 3))]))
    motion = motions.sines(rng, np.arange(draw.frames) / 100.0)
    q = fitted_motion(lab, motion, draw_amplitudes(rng, lab), 10.0, 0.7)
    if q is None:
        return None
    false = replace(false_points(lab, beside=0.0), exactly=5)
    draft = Draft(draw, lab, q, 100.0, 0.1, false, np.zeros(0), "no prior")
    return replace(draft.scene(), prior=None)


# One sigma of each kind of parameter after a careful calibration: the spots move by some tenths of a pixel.
RIG_SIGMAS = {
    "fx": 0.4, "fy": 0.4, "cx": 0.6, "cy": 0.6, "k1": 3e-4, "k2": 1e-3, "p1": 5e-5, "p2": 5e-5, "k3": 1e-3,
    "direction_x": 7e-5, "direction_y": 7e-5, "direction_z": 7e-5,
    "point_x_m": 1e-4, "point_y_m": 1e-4, "point_z_m": 1e-4,
}  # fmt: skip


def rig_covariance(rig: Rig) -> RigCovariance:
    """Errors of all parameters of a rig, correlated within each camera, screen and beam."""
    names = rig_names(rig)
    sigma = np.array([RIG_SIGMAS.get(split_name(n)[2], 1e-4 if n.endswith("_rad") else 3e-4) for n in names])
    things = [split_name(n)[:2] for n in names]
    same = np.array([[a == b for b in things] for a in things])
    return RigCovariance(names, np.where(same, 0.2, 0.0) * np.outer(sigma, sigma) + 0.8 * np.diag(sigma**2))


def _drawn_rig(draw: Draw) -> Scene | None:
    names = ("fan", "four-skew-beams", "two-cameras-per-screen", "unequal-fan")
    known = paper_lab(names[draw.seed % len(names)])
    covariance = rig_covariance(known.rig)
    rng = draw.rng(scene.LAB)
    delta = np.linalg.cholesky(covariance.matrix) @ rng.normal(size=len(covariance.names))
    lab = replace(known, rig=perturbed_rig(known.rig, covariance.names, delta))
    rng = draw.rng(scene.MOTION)
    motion = motions.sines(rng, np.arange(draw.frames) / 100.0)
    q = fitted_motion(lab, motion, 2 * draw_amplitudes(rng, lab), 20.0, 0.8)
    if q is None:
        return None
    draft = Draft(draw, lab, q, 100.0, 0.05, false_points(lab, beside=0.2), np.zeros(0), "rig off by its covariance")
    return replace(draft.scene(), known_rig=known.rig, covariance=covariance)


FAMILIES: dict[str, Family] = {
    "corners-hard": Family(
        lambda d: _corners(d, "hard"), 300, "labels kept >= .9995; NEES/6 .85 to 1.3; coverage >= .93"
    ),
    "corners-soft": Family(lambda d: _corners(d, "soft"), 300, "the same"),
    "corners-hidden": Family(lambda d: _corners(d, "hidden"), 300, "the same"),
    "camera-gaps": Family(_camera_gaps, 150, "poses beyond 6 sigma 0; negative variances 0"),
    "blackout-static": Family(_blackout_static, 150, "no wrong label, no confidently wrong pose"),
    "three-left": Family(_three_left, 160, "no wrong label, no confidently wrong pose"),
    "screen-corner": Family(_screen_corner, 200, "no wrong label, no confidently wrong pose"),
    "fast-close": Family(_fast_close, 300, "identity causal / smoothed >= .995 / .999"),
    "shaking-equal-fan": Family(
        _shaking_equal_fan, 300, "identity causal and smoothed >= .9995; no confidently wrong pose"
    ),
    "two-beams-25hz": Family(_two_beams_25hz, 40, "locked in frame <= 3, in all"),
    "no-prior": Family(_no_prior, 20, "first labels right / wrong >= .97 / <= .01; <= 3 s"),
    "drawn-rig": Family(_drawn_rig, 100, "smoothed NEES/6 .85 to 1.2"),
    "uniform": Family(_uniform, 300, "no confidently wrong pose"),
    "quiet-then-turn": Family(_quiet_then_turn, 400, "no confidently wrong pose"),
}
