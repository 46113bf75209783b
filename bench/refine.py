"""Rigs refined from recordings, against the true rig: `python -m bench.refine --seeds 1:41`.

Each seed is a random lab (bench/random_scenes) and four recordings of points. The program is given a rig that is off by
a draw of its stated sigmas, refines it from three recordings, and measures a fourth with the result. The offsets of
all cameras but the first, whose instants are the recordings' own, are off as well. Printed per rig: RMS of the poses of
the fourth recording over that with the true rig, NEES of the rig and of the poses, and the verdict.
The projection and the errors of the rig (about each camera's own centre) share no code with the program.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag

from bench.random_scenes.draw.motions import sines
from bench.random_scenes.draw.nuisances import draw_false_points, draw_hidden, draw_missing
from bench.random_scenes.draw.rigs import Lab, draw_lab
from bench.random_scenes.projection import spot_pixels
from bench.random_scenes.scene import Scene, composed, draw_prior, fitted_motion, view_indices
from bench.random_scenes.write_folder import write_run_folder
from calibration.least_squares.adjustment import AdjustmentError
from calibration.model_check.linearised_frames import ModelCheckRecording
from calibration.rig.recordings import RecordingTerm
from calibration.rig.refinement import FEWEST_SPOTS, Refinement, refine
from calibration.terms.rig_blocks import rig_of, stacks_of
from geometry import rotations
from geometry.arrays import Array, skew
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.refine.refine import RefinedRig, refine_findings, refine_rig
from lab.errors import BeamposeError
from lab.files.rig.rig_file import load_rig
from lab.files.run.results import read_poses
from lab.findings.finding import Level, verdict
from lab.runs.model_check.check import check_model
from lab.runs.process import process_run
from tracking.detections import Detections
from tracking.statuses import PoseStatus

POSE_NAMES = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")
LINE_NAMES = tuple(f"{kind}_{axis}{unit}" for kind, unit in (("direction", ""), ("point", "_m")) for axis in "xyz")
LAB, RIG, MOTION, NUISANCE, PRIOR, CLOCKS = range(6)
NOISE_PX = (0.03, 0.3)
FASTEST_PX = 30.0


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Of the rig that is given: of each part's position, m, and rotation or direction, rad, per axis."""

    cameras: tuple[float, float] = (5e-3, 3e-3)
    screens: tuple[float, float] = (2e-3, 1e-3)
    beams: tuple[float, float] = (1e-3, 1e-3)
    clocks: float = 2e-3  # s


def rig_covariance(rig: Rig, s: Sigmas) -> RigCovariance:
    """The covariance of rig.yaml's numbers: cameras turn about their centres, screens about their origins."""
    names: list[str] = []
    blocks: list[Array] = []
    for n, c in rig.cameras.items():
        R, t = c.camera_from_world.rotation, c.camera_from_world.translation
        # A turn phi (in the camera's frame) about the centre: R' = Exp(phi) R = R Exp(R^T phi), t' = t + phi x t.
        D = np.block([[np.eye(3), -skew(t)], [np.zeros((3, 3)), R.T]])
        names += [f"cameras.{n}.{p}" for p in POSE_NAMES]
        blocks.append(D @ np.diag(np.repeat(np.square(s.cameras), 3)) @ D.T)
    for n in rig.screens:
        names += [f"screens.{n}.{p}" for p in POSE_NAMES]
        blocks.append(np.diag(np.repeat(np.square(s.screens), 3)))
    for n, b in rig.beams.items():
        across = np.eye(3) - np.outer(b.direction, b.direction)
        names += [f"beams.{n}.{p}" for p in LINE_NAMES]
        blocks.append(block_diag(s.beams[1] ** 2 * across, s.beams[0] ** 2 * across))
    if s.clocks:
        names += [f"cameras.{n}.time_offset_s" for n in list(rig.cameras)[1:]]
        blocks.append(s.clocks**2 * np.eye(len(rig.cameras) - 1))
    return RigCovariance(tuple(names), block_diag(*blocks))


def drawn_rig(rng: np.random.Generator, true: Rig, s: Sigmas, only: tuple[str, str] | None = None) -> Rig:
    """A rig that is off by a draw of the sigmas. only: the kind and name of the one part that is."""

    def off(kind: str, name: str, sigmas: tuple[float, float]) -> tuple[Array, Array]:
        shift, turn = rng.normal(size=3) * sigmas[0], rng.normal(size=3) * sigmas[1]
        return (shift, turn) if only is None or only == (kind, name) else (np.zeros(3), np.zeros(3))

    cameras, screens, beams = {}, {}, {}
    for n, c in true.cameras.items():
        shift, turn = off("cameras", n, s.cameras)
        R = rotations.exp(turn) @ c.camera_from_world.rotation
        place = Pose(R, -R @ (_centre(c.camera_from_world) + shift))
        cameras[n] = replace(c, camera_from_world=place, time_offset_s=0.0)
    for n, screen in true.screens.items():
        shift, turn = off("screens", n, s.screens)
        place = screen.world_from_screen
        if only is not None:  # a motion in its own plane shows nowhere, and changes no pose
            shift, turn = place.rotation[:, 2] * (place.rotation[:, 2] @ shift), turn * [1.0, 1.0, 0.0]
        screens[n] = replace(
            screen, world_from_screen=Pose(place.rotation @ rotations.exp(turn), place.translation + shift)
        )
    for n, b in true.beams.items():
        shift, turn = off("beams", n, s.beams)
        beams[n] = Beam(n, rotations.exp(turn) @ b.direction, b.point + shift)
    return Rig(screens, cameras, beams, true.spots)


def _centre(camera_from_world: Pose) -> Array:
    return -camera_from_world.rotation.T @ camera_from_world.translation


def with_clocks(lab: Lab, rng: np.random.Generator, sigma_s: float) -> Lab:
    """The lab with an offset of every camera but the first."""
    cameras = dict(lab.rig.cameras)
    for name in list(cameras)[1:]:
        cameras[name] = replace(cameras[name], time_offset_s=float(rng.normal() * sigma_s))
    return replace(lab, rig=replace(lab.rig, cameras=cameras))


def campaign(
    seed: int, frames: int = 600, recordings: int = 4, clocks_s: float = 0.0, case: str = "all"
) -> tuple[Lab, list[Scene], str]:
    """A lab with recordings in which all six coordinates move. clocks_s: sigma of the offsets of the clocks."""
    attempt = 0
    while True:
        key = [seed, attempt]
        lab = with_clocks(draw_lab(np.random.default_rng([*key, LAB])), np.random.default_rng([seed, CLOCKS]), clocks_s)
        if case in FEW:
            lab = replace(lab, rig=_few_spots(lab.rig, case))
        scenes = [_scene([*key, r], seed, lab, frames) for r in range(recordings)]
        if (len(lab.rig.cameras) > 1 or case in FEW) and all(s is not None for s in scenes):
            return lab, [s for s in scenes if s is not None], lab.text
        attempt += 1


def _scene(key: list[int], seed: int, lab: Lab, frames: int) -> Scene | None:
    rng = np.random.default_rng([*key, MOTION])
    rate = 100.0
    motion = sines(rng, np.arange(frames) / rate)
    amplitudes = np.minimum(lab.reach_m * rng.uniform(0.4, 1.0, 6) * np.repeat([0.8, 1 / lab.lever_m], 3), 0.5)
    q = fitted_motion(lab, motion, amplitudes, FASTEST_PX, 0.8)
    if q is None:
        return None
    poses = lab.poses(q)
    uv = spot_pixels(lab.rig, poses)
    camera_of, spot_of = view_indices(lab.rig)
    instants, curve = np.arange(frames) / rate, CubicSpline(np.arange(frames) / rate, q)
    for c, camera in enumerate(lab.rig.cameras.values()):
        if camera.time_offset_s:
            late = spot_pixels(lab.rig, lab.poses(curve(instants + camera.time_offset_s)))
            uv[:, camera_of == c] = late[:, camera_of == c]
    noise = float(np.exp(np.random.default_rng([seed, NUISANCE]).uniform(*np.log(NOISE_PX))))
    rng = np.random.default_rng([*key, NUISANCE])
    false = draw_false_points(rng, lab.rig, uv, camera_of)
    hidden, hidden_text = draw_hidden(rng, frames, camera_of, spot_of, motion.corners_s * rate)
    has_image, _ = draw_missing(rng, frames, len(lab.rig.cameras))
    text = f"{motion.text}; noise {noise:.2g} px; {false.text}; {hidden_text}"
    return composed(
        key, seed, lab.rig, poses, rate, np.full(len(camera_of), noise), false, hidden, has_image, motion.corners_s,
        text, draw_prior(np.random.default_rng([*key, PRIOR]), poses[0]), uv,
    )  # fmt: skip


REST, LATE, SLIPPED, EXCHANGED, MIRRORED, WRONG_LENS, MOVED = (
    "rest", "late", "slipped", "exchanged", "mirrored", "wrong-lens", "moved",
)  # fmt: skip
FEW = TWO_BEAMS, ONE_SCREEN = "two-beams", "one-screen"
CASES = ("all", MOVED, REST, *FEW, LATE, SLIPPED, EXCHANGED, MIRRORED, WRONG_LENS)
MOVED_SIGMAS = 10.0  # by which one part has moved, in the stated sigmas per axis
WRONG_FOCUS = 0.03  # of the focal length, relative, with the lens of another camera


def _few_spots(rig: Rig, case: str) -> Rig:
    """The part of a rig with one spot of each of two beams, or with the screen of most spots."""
    spots = list(rig.spots.values())
    if case == TWO_BEAMS:
        spots = [next(s for s in spots if s.beam == beam) for beam in list(rig.beams)[:2]]
    else:
        screens = [s.screen for s in spots]
        spots = [s for s in spots if s.screen == max(screens, key=screens.count)]
    screens, beams = {s.screen for s in spots}, {s.beam for s in spots}
    return Rig(
        {n: s for n, s in rig.screens.items() if n in screens},
        {n: c for n, c in rig.cameras.items() if c.screen in screens},
        {n: b for n, b in rig.beams.items() if n in beams},
        {s.name: s for s in spots},
    )


def changed(case: str, known: Rig, scenes: list[Scene], rng: np.random.Generator) -> tuple[Rig, list[Scene]]:
    """The rig and the recordings that are given, in a case that cannot be refined."""
    cameras = dict(known.cameras)
    first = next(iter(cameras))
    c = cameras[first]
    if case == REST:
        scenes = [_at(s, np.zeros(len(s), dtype=int), rng) for s in scenes]
    elif case in (LATE, SLIPPED):
        by = 1 if case == LATE else 7
        scenes = [_late(s, by) for s in scenes]
    elif case == EXCHANGED:
        a, b = list(cameras)[:2]
        cameras[a], cameras[b] = (
            replace(cameras[x], camera_from_world=cameras[y].camera_from_world, screen=cameras[y].screen)
            for x, y in ((a, b), (b, a))
        )
    elif case == MIRRORED:
        scenes = [_mirrored(s, c.image_size_px[0]) for s in scenes]
    elif case == WRONG_LENS:
        matrix = c.matrix.copy()
        matrix[[0, 1], [0, 1]] *= 1 + WRONG_FOCUS
        cameras[first] = replace(c, matrix=matrix)
    return replace(known, cameras=cameras), scenes


def _at(s: Scene, rows: Array, rng: np.random.Generator) -> Scene:
    """The recording with the vehicle at rest at its first pose."""
    uv = s.uv_px[rows]
    new = []
    for k in range(len(s)):
        points = []
        for found, origin in zip(s.detections[k], s.origin[k], strict=True):
            there = origin >= 0
            moved = found.uv_px.copy()
            moved[there] += uv[k, origin[there]] - s.uv_px[k, origin[there]]
            points.append(replace(found, uv_px=moved)[np.isfinite(moved).all(axis=1)])
        new.append(tuple(points))
    return replace(s, detections=tuple(new), poses=s.poses[rows], uv_px=uv)


def _late(s: Scene, by: int) -> Scene:
    """The pictures of the first camera numbered as later frames."""
    rows = [max(k - by, 0) for k in range(len(s))]
    return replace(
        s,
        detections=tuple((s.detections[rows[k]][0], *s.detections[k][1:]) for k in range(len(s))),
        origin=tuple((s.origin[rows[k]][0], *s.origin[k][1:]) for k in range(len(s))),
    )


def _mirrored(s: Scene, width: int) -> Scene:
    """The pictures of the first camera mirrored."""

    def flipped(found: Detections) -> Detections:
        uv = found.uv_px.copy()
        uv[:, 0] = width - 1 - uv[:, 0]
        return replace(found, uv_px=uv)

    return replace(s, detections=tuple((flipped(d[0]), *d[1:]) for d in s.detections))


def with_true_labels(s: Scene) -> ModelCheckRecording:
    """The points of a recording with their true labels, as a perfect tracker would give them."""
    uv = np.full((*s.in_view.shape, 2), np.nan)
    for k in range(len(s)):
        for found, origin in zip(s.detections[k], s.origin[k], strict=True):
            uv[k, origin[origin >= 0]] = found.uv_px[origin >= 0]
    cov = np.broadcast_to(s.sigma_px[:, None, None] ** 2 * np.eye(2), (*s.in_view.shape, 2, 2)).copy()
    return ModelCheckRecording(s.t_s, np.isfinite(uv[..., 0]), uv, cov, s.poses)


def refined_with_true_labels(known: Rig, covariance: RigCovariance, scenes: list[Scene]) -> RefinedRig:
    """What the command computes behind the tracker."""
    recordings = [with_true_labels(s) for s in scenes]
    found = refine(known, covariance, recordings, refine(known, covariance, recordings))
    checks = tuple(check_model(found.rig, r, found.covariance) for r in recordings)
    runs: Any = tuple(
        SimpleNamespace(run=SimpleNamespace(name=f"run{i}"), recording=r, unlabelled=())
        for i, r in enumerate(recordings)
    )
    return RefinedRig(found, covariance, runs, checks)


def rig_errors(refined: Refinement, true: Rig) -> Array:
    """True minus refined numbers of the rig (p,)."""
    stacks = stacks_of(true)
    one = [stacks[n].pick(np.array([i])).minus(refined.values[n].pick(np.array([i])))[0] for n, i in refined.at]
    return np.concatenate(one)


def rig_nees(refined: Refinement, true: Rig) -> tuple[float, int]:
    """Mean squared error of the rig per number in sigmas of the result, and the count of numbers."""
    white = np.linalg.lstsq(refined.after.root, rig_errors(refined, true), rcond=1e-12)[0]
    return float(np.mean(white**2)), len(white)


def pose_errors(folder: Path, scene: Scene) -> tuple[Array, Array, Array]:
    """Frames (k,) measured, errors (k, 6) of their poses, and their NEES/6 (k,)."""
    track = read_poses(folder)
    rows = np.flatnonzero(track.has(PoseStatus.MEASURED))
    true = scene.poses[track.frames[rows]]
    e = true.minus(track.world_from_body[rows])
    nees = np.sum(e * np.linalg.solve(track.covariance[rows], e[..., None])[..., 0], axis=1) / 6
    return track.frames[rows], e, nees


def without_frames(e: Array, poses: Pose) -> Array:
    """Errors (k, 6) without those that one motion of world and one of body explain: conventions of a refined rig."""
    R, t = poses.rotation, poses.translation
    k = len(t)
    eye, zero = np.broadcast_to(np.eye(3), (k, 3, 3)), np.zeros((k, 3, 3))
    world = np.concatenate(
        [np.concatenate([eye, -skew(t)], axis=2), np.concatenate([zero, np.swapaxes(R, 1, 2)], axis=2)], axis=1
    )
    body = np.concatenate([np.concatenate([R, zero], axis=2), np.concatenate([zero, eye], axis=2)], axis=1)
    J = np.concatenate([world, body], axis=2)
    scale = 1 / np.sqrt(np.array([np.mean(e[:, :3] ** 2)] * 3 + [np.mean(e[:, 3:] ** 2)] * 3))
    fit = np.linalg.lstsq((J * scale[:, None]).reshape(-1, 12), (e * scale).ravel(), rcond=1e-10)[0]
    return np.asarray(e - J @ fit)


def rms(values: Array) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


NAMINGS = NAMED, AMONG, UNNAMED, WRONG_PART = "named alone", "named among others", "not named", "WRONG PART NAMED"


def naming(moved: tuple[str, str], refined: Refinement) -> str:
    """How the part that has moved is named, and which parts are."""
    named = {(f"{e.fault.component}s", e.fault.name) for m in refined.moved for e in m.explanations}
    word = UNNAMED if not named else NAMED if named == {moved} else AMONG if moved in named else WRONG_PART
    return f"{' '.join(moved)} {word} ({', '.join(' '.join(part) for part in sorted(named))})"


def described(refined: Refinement, true: Rig, used: bool) -> str:
    """The rig's figures. used: it did not fail."""
    nees, count = rig_nees(refined, true)
    wrong = used and nees * count > chi2_limit(1e-4, count)
    determined = f"determined {int(np.sum(refined.gain > 1))} and {refined.conventions} conventions"
    return f"{', CONFIDENT AND WRONG' * wrong}, rig NEES {nees:.3f} of {count}, {determined}"


def one(seed: int, case: str, frames: int, true_labels: bool, clocks_s: float, recordings: int = 3) -> str:
    """A rig refined by so many recordings and used in another one; a line of figures."""
    s = Sigmas(clocks=clocks_s)
    lab, scenes, _ = campaign(seed, frames, recordings + 1, s.clocks, case)
    rng = np.random.default_rng([seed, RIG])
    true, only = lab.rig, None
    if case == MOVED:
        parts = [(kind, n) for kind in ("cameras", "screens", "beams") for n in getattr(true, kind)]
        only = parts[rng.integers(len(parts))]
    by = MOVED_SIGMAS if case == MOVED else 1.0
    cameras, screens, beams = ((by * length, by * angle) for length, angle in (s.cameras, s.screens, s.beams))
    off = Sigmas(cameras, screens, beams)
    known = drawn_rig(rng, true, off, only)
    known, scenes = changed(case, known, scenes, rng)
    covariance = rig_covariance(known, s)
    if true_labels:
        started = time.process_time()
        try:
            result = refined_with_true_labels(known, covariance, [*scenes[:3], *scenes[4:]])
        except AdjustmentError as error:
            return f"refused in {time.process_time() - started:.1f} s: {error}"
        findings = refine_findings(result)
        level = verdict(findings)
        moved = "" if only is None else f" {naming(only, result.refined)}"
        reported = "; ".join(f"{f.code} {f.what}" for f in findings if f.level > 0)[:160]
        text = f"{level.name} in {time.process_time() - started:.1f} s{moved}"
        text += described(result.refined, true, level < Level.FAIL)
        if case == "all" and level < Level.FAIL:
            r = result.refined
            given = replace(scenes[3], known_rig=r.rig, covariance=r.covariance)
            with tempfile.TemporaryDirectory() as name:
                text += fourth(Path(name), scenes[3], true, given, r)
        return f"{text} {reported}"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for i, scene in enumerate(scenes[:3]):
            write_run_folder(replace(scene, known_rig=known, covariance=covariance), folder / f"run{i}")
        started = time.process_time()
        try:
            outcome = refine_rig([folder / f"run{i}" for i in range(3)], folder / "run0" / "rig.yaml", folder / "new")
        except BeamposeError as error:
            return f"refused in {time.process_time() - started:.1f} s: {str(error)[:160]}".replace(name, "")
        seconds = time.process_time() - started
        refined = outcome.result.refined
        reported = "; ".join(f"{f.code} {f.what}" for f in outcome.findings if f.level > 0)[:300]
        out = f"{outcome.level.name} in {seconds:.1f} s" + (f", moved {only[0]} {only[1]}" if only else "")
        written = (folder / "new" / "rig.yaml").is_file()
        out += described(refined, true, written)
        if written:
            given = replace(scenes[3], known_rig=true, covariance=None)
            out += fourth(folder, scenes[3], true, given, refined, folder / "new" / "rig.yaml")
    return f"{out} {reported}"


def fourth(folder: Path, last: Scene, true: Rig, given: Scene, refined: Refinement, rig: Path | None = None) -> str:
    """Figures of the fourth recording with the true and the refined rig. rig: a file that replaces that of `given`."""
    write_run_folder(replace(last, known_rig=true, covariance=None), folder / "true")
    write_run_folder(given, folder / "refined")
    if rig is not None:
        (folder / "refined" / "rig.yaml").write_bytes(rig.read_bytes())
        load_rig(folder / "refined" / "rig.yaml")
    for name in ("true", "refined"):
        process_run(folder / name, folder / f"{name}-out")
    (at, best, _), (with_it, ours, nees) = (pose_errors(folder / f"{n}-out", last) for n in ("true", "refined"))
    both, i, k = np.intersect1d(at, with_it, return_indices=True)
    poses = last.poses[both]
    raw = rms(ours[k][:, 3:]) / rms(best[i][:, 3:])
    a, b = without_frames(ours[k], poses), without_frames(best[i], poses)
    ratios = np.array([rms(a[:, n]) / rms(b[:, n]) for n in ANGLE_AND_PLACE])
    drawn, own = errors_by_rig(refined, last, true)
    noise = np.array([rms(b[:, n]) for n in ANGLE_AND_PLACE])
    expected, share = np.sqrt(1 + np.mean(drawn**2, axis=0) / noise**2), np.mean(drawn < own, axis=0)
    return (
        f", attitude ratio {ratios[0]:.3f} position {ratios[1]:.3f} (expected {expected[0]:.3f}, {expected[1]:.3f};"
        f" the rig's errors cause more than {share[0]:.2f}, {share[1]:.2f} of draws of its covariance;"
        f" with conventions {raw:.1f}), NEES/6 {np.mean(nees):.3f}, frames {len(with_it)} of {len(at)}"
    )


ANGLE_AND_PLACE = np.s_[3:], np.s_[:3]  # of pose errors
_DRAWS = 200


def errors_by_rig(r: Refinement, last: Scene, true: Rig) -> tuple[Array, Array]:
    """RMS of attitude, rad, and position, m, that errors of the rig cause in a recording, without conventions.

    Of draws of its covariance (d, 2), and of the rig's own errors (2,).
    """
    recording = with_true_labels(last)
    free = {name: np.zeros((len(v), v.dof), dtype=bool) for name, v in r.values.items()}
    for stack, i in r.at:
        free[stack][i] = True
    frames = np.flatnonzero(recording.usable.sum(axis=1) >= FEWEST_SPOTS)
    term = RecordingTerm(r.given, recording.at(frames), free)
    lin = term.reduced(r.values).lin
    D = lin.pose_shift(lin.W @ term._derivatives(SpotModel.of(rig_of(r.given, r.values)), lin, r.values))
    draws = np.random.default_rng(1).normal(size=(_DRAWS, r.after.root.shape[1])) @ r.after.root.T
    errors = [without_frames(D @ e, last.poses[frames]) for e in (*draws, rig_errors(r, true))]
    sizes = np.array([[rms(e[:, part]) for part in ANGLE_AND_PLACE] for e in errors])
    return sizes[:-1], sizes[-1]


def main() -> None:
    """Run the seeds and print a line for each."""
    parser = argparse.ArgumentParser(prog="bench.refine", description=__doc__)
    parser.add_argument("--seeds", default="1:41", metavar="A:B")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--case", default="all", choices=CASES)
    parser.add_argument("--true-labels", action="store_true", help="without the tracker, and without clocks")
    parser.add_argument("--clocks", type=float, default=2e-3, metavar="SECONDS", help="sigma of the clocks' offsets")
    parser.add_argument("--recordings", type=int, default=3, help="that refine, with --true-labels")
    a = parser.parse_args()
    first, _, last = a.seeds.partition(":")
    count: Counter[str] = Counter()
    for seed in range(int(first), int(last) if last else int(first) + 1):
        clocks_s = 0.0 if a.true_labels or a.case != "all" else a.clocks
        text = one(seed, a.case, a.frames, a.true_labels, clocks_s, a.recordings)
        count.update(
            f"{kind} {word}" for kind in ("cameras", "screens", "beams") for word in NAMINGS
            if f" {kind} " in text.split("(")[0] and f" {word} (" in text
        )  # fmt: skip
        print(f"{seed} {a.case}: {text}", flush=True)
    for words, times in sorted(count.items()):
        print(f"{words}: {times}")


if __name__ == "__main__":
    main()
