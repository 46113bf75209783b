"""One random recording as run folders: with clocks of the cameras' own, and with one clock for all.

The scenes are those of bench/random_scenes. The motion is evaluated at the instant of every picture, of a rolling
shutter at that of every spot, so nothing here predicts or interpolates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bench.random_scenes.draw.motions import Motion, draw_motion
from bench.random_scenes.draw.nuisances import FalsePoints, draw_false_points, draw_hidden
from bench.random_scenes.draw.rigs import Lab, draw_lab
from bench.random_scenes.projection import in_picture, spot_pixels
from bench.random_scenes.scene import (
    FASTEST_PX,
    HIDDEN,
    LEAST_IN_VIEW,
    OUTSIDE,
    SHINING,
    draw_amplitudes,
    draw_prior,
    fitted_motion,
    one_picture,
    view_indices,
)
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.files.rig.rig_file import RigFile, save_rig
from lab.files.run.run_file import save_run
from lab.files.text import columns
from lab.files.text.csv_text import write_table
from tracking.detections import Detections

KINDS = ("offsets", "drift", "100 and 97 Hz", "100 and 30 Hz")
LARGEST_OFFSET, DRIFT, ROW_TIME_S = 1.5, 200e-6, (5e-6, 30e-6)  # frames; relative; of half of the recordings
LONGEST_READOUT = 0.9  # of the time between two pictures
LEAD = 4  # frames of motion before frame 0, and after the last
CLOCKS, LAB, MOTION, NUISANCE, POINTS, PRIOR = range(6)
Truth = dict[tuple[int, int], tuple[Array, Array, Array]]  # see write_recording


@dataclass(frozen=True, slots=True)
class Clock:
    """When a camera takes its pictures."""

    numbers: Ints  # (m,)
    instants_s: Array  # (m,) at mid-exposure of the middle row
    offset_s: float
    row_time_s: float
    own: bool  # its times are in a table of its own
    late_s: float = 0.0  # what `estimate` has to find: the offset, or what all times of the table have in common


@dataclass(frozen=True, slots=True)
class Recording:
    """A drawn recording of T frames."""

    seed: int
    rig: Rig
    rate_hz: float
    prior: PosePrior
    pose_at: Callable[[Array], Pose] = field(repr=False)
    sigma_px: Array  # (n,)
    hidden: Bools  # (T, n)
    false: FalsePoints
    clocks: tuple[Clock, ...]
    corners: Array  # (c,) frames, with fractions, at which the velocity jumps
    text: str

    @property
    def rows_s(self) -> Array:
        """(T,)"""
        return np.arange(len(self.hidden)) / self.rate_hz

    def with_one_clock(self) -> Recording:
        """The same with all pictures at the instants of frames; a slower camera keeps its number of pictures."""
        clocks = []
        for clock in self.clocks:
            frame = np.unique(np.clip(np.round(clock.instants_s * self.rate_hz), 0, len(self.hidden) - 1).astype(int))
            every = np.arange(len(self.hidden)) if not clock.own else frame
            clocks.append(Clock(every, every / self.rate_hz, 0.0, 0.0, False))
        return replace(self, clocks=tuple(clocks))


def random_recording(seed: int, frames: int = 200) -> Recording:
    """The recording of a seed."""
    attempt = 0
    while (drawn := _attempt([seed, attempt], seed, frames)) is None:
        attempt += 1
    return drawn


def _attempt(key: list[int], seed: int, frames: int) -> Recording | None:
    lab = draw_lab(np.random.default_rng([*key, LAB]))
    rng = np.random.default_rng([*key, MOTION])
    rate = float(np.exp(rng.uniform(np.log(25), np.log(500)))) if seed % 2 else 100.0
    every = np.arange(-LEAD, frames + LEAD) / rate
    state = rng.bit_generator.state
    motion = _motion_at(rng, every, every)
    fastest = FASTEST_PX[int(rng.random() < 1 / 7)]
    in_view = 1.0 if rng.random() < 0.5 else float(rng.uniform(LEAST_IN_VIEW, 1.0))
    amplitudes = draw_amplitudes(rng, lab) * (1.0 if in_view == 1.0 else rng.uniform(1.0, 3.0))
    q = fitted_motion(lab, motion, amplitudes, fastest, in_view)
    if q is None or len(lab.rig.cameras) < 2:
        return None
    moved = amplitudes * motion.shape
    scale = float(np.sum((q - lab.rest) * moved) / max(np.sum(moved**2), 1e-300))

    def pose_at(t_s: Array) -> Pose:
        again = np.random.default_rng()
        again.bit_generator.state = state
        shape = _motion_at(again, every, t_s).shape
        return lab.poses(lab.rest + scale * amplitudes * shape)

    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.3))))
    poses = pose_at(np.arange(frames) / rate)
    uv = spot_pixels(lab.rig, poses)
    camera_of, spot_of = view_indices(lab.rig)
    rng = np.random.default_rng([*key, NUISANCE])
    false = draw_false_points(rng, lab.rig, uv, camera_of)
    corners = (motion.corners_s + every[0]) * rate
    hidden, hidden_text = draw_hidden(rng, frames, camera_of, spot_of, corners)
    kind = KINDS[seed % len(KINDS)]
    clocks, clock_text = _draw_clocks(np.random.default_rng([*key, CLOCKS]), lab, kind, rate, frames)
    step = np.nanmedian(np.linalg.norm(np.diff(uv, axis=0), axis=-1))
    text = f"{kind}{clock_text}; {lab.text}; {rate:.0f} Hz, {motion.text}, {step:.2g} px/frame; noise {noise:.2g} px"
    return Recording(
        seed, lab.rig, rate, draw_prior(np.random.default_rng([*key, PRIOR]), poses[0]), pose_at,
        np.full(len(camera_of), noise), hidden, false, clocks, corners, f"{text}; {false.text}; {hidden_text}",
    )  # fmt: skip


def _motion_at(rng: np.random.Generator, every: Array, t_s: Array) -> Motion:
    """The motion that is drawn for the times `every`, at other times (m,): the draw depends on three of the former."""
    since = every - every[0]
    asked = np.concatenate([since[:2], t_s - every[0], since[-1:]])
    motion = draw_motion(rng, asked)
    return replace(motion, shape=motion.shape[2:-1])


def _draw_clocks(
    rng: np.random.Generator, lab: Lab, kind: str, rate: float, frames: int
) -> tuple[tuple[Clock, ...], str]:
    rolling = rng.random() < 0.5
    clocks, words = [], []
    for c, camera in enumerate(lab.rig.cameras.values()):
        offset = float(rng.uniform(-LARGEST_OFFSET, LARGEST_OFFSET)) / rate
        own_rate = rate
        if c > 0 and "and" in kind:
            own_rate = rate * (0.97 if "97" in kind else 0.3)
        row_time = 0.0
        if rolling:
            longest = LONGEST_READOUT / own_rate / camera.image_size_px[1]
            row_time = min(float(rng.uniform(*ROW_TIME_S)), longest)
        if kind == "offsets":
            numbers = np.arange(frames)
            clocks.append(Clock(numbers, numbers / rate + offset, offset, row_time, False, offset))
        else:
            speed = 1 + (rng.uniform(-DRIFT, DRIFT) if kind == "drift" else 0.0)
            numbers = np.arange(int(np.ceil(frames * own_rate / rate)) + 2)
            clocks.append(Clock(numbers, numbers / own_rate * speed + offset, 0.0, row_time, True, offset))
        words.append(f"{offset * rate:+.2f} fr" + (f" {row_time * 1e6:.0f} us" if row_time else ""))
    return tuple(clocks), f" ({', '.join(words)})"


def pictured(r: Recording, c: int) -> tuple[Array, Ints]:
    """True pixels (m, n, 2) of a camera's pictures, each spot at the instant of its row, and the nearest rows (m,)."""
    clock, camera = r.clocks[c], list(r.rig.cameras.values())[c]
    uv = spot_pixels(r.rig, r.pose_at(clock.instants_s))
    if clock.row_time_s:
        middle = (camera.image_size_px[1] - 1) / 2
        for view in range(uv.shape[1]):
            for _ in range(12):
                row = np.clip(np.nan_to_num(uv[:, view, 1], nan=middle), -0.5, 2 * middle + 0.5)
                at = clock.instants_s + (row - middle) * clock.row_time_s
                uv[:, view] = spot_pixels(r.rig, r.pose_at(at))[:, view]
    nearest = np.clip(np.round(clock.instants_s * r.rate_hz), 0, len(r.hidden) - 1).astype(int)
    return uv, nearest


def write_recording(r: Recording, folder: Path, estimate: bool = False) -> Truth:
    """Write a run folder; by camera and picture number the true pixels (n, 2), the visibility (n,) and points (m, 2).

    estimate: run.yaml leaves the offsets of all cameras but the first, and all row times, to be estimated.
    """
    folder.mkdir(parents=True)
    save_rig(RigFile(r.rig, {}), folder / "rig.yaml")
    camera_of, _ = view_indices(r.rig)
    sizes = np.array([c.image_size_px for c in r.rig.cameras.values()], dtype=float)
    truth: Truth = {}
    blocks: dict[str, dict[str, object]] = {}
    rows = []
    for c, name in enumerate(r.rig.cameras):
        clock = r.clocks[c]
        uv, nearest = pictured(r, c)
        for number, at, row in zip(clock.numbers.tolist(), uv, nearest, strict=True):
            inside = in_picture(at, sizes[camera_of])
            in_view = np.where(inside, np.where(r.hidden[row], HIDDEN, SHINING), OUTSIDE)
            rng = np.random.default_rng([r.seed, POINTS, c, number])
            points, _ = one_picture(rng, c, at, in_view, camera_of, r.sigma_px, sizes[c], r.false)
            truth[c, number] = at, in_view == SHINING, points.uv_px
            rows += _rows(number, name, points)
        if not clock.own:  # a picture that is missing
            rows += [(n, name, *[""] * 10) for n in np.setdiff1d(np.arange(len(r.hidden)), clock.numbers).tolist()]
        block: dict[str, object] = {"detections": "detections.csv"}
        if clock.own:
            unknown_s = clock.late_s if estimate and c else 0.0
            times = zip(clock.numbers.tolist(), (f"{t:.12g}" for t in clock.instants_s - unknown_s), strict=True)
            write_table(folder / f"times-{c}.csv", columns.TIMES, times)
            block["timestamps"] = f"times-{c}.csv"
        if clock.offset_s:
            block["time_offset_s"] = clock.offset_s
        if clock.row_time_s:
            block["row_time_s"] = clock.row_time_s
        if estimate and c:
            block["time_offset_s"] = "estimate"
        if estimate and clock.row_time_s:
            block["row_time_s"] = "estimate"
        blocks[name] = block
    write_table(folder / "detections.csv", columns.DETECTIONS, rows)
    p = r.prior
    prior = {
        "position_m": p.centre.translation.tolist(),
        "yaw_pitch_roll_deg": np.rad2deg(p.centre.ypr).tolist(),
        "within_m": p.within_m,
        "within_deg": float(np.rad2deg(p.within_rad)),
    }
    if all(clock.own for clock in r.clocks):  # the tables' rows are those of the scene
        row_times = ((k, f"{t:.12g}") for k, t in enumerate(r.rows_s))
        write_table(folder / "times.csv", columns.TIMES, row_times)
    content = {
        "name": f"seed-{r.seed}",
        "rig": "rig.yaml",
        "frame_rate_hz": r.rate_hz,
        "cameras": blocks,
        "prior": prior,
    }
    save_run(content | ({"timestamps": "times.csv"} if (folder / "times.csv").exists() else {}), folder)
    return truth


def _rows(number: int, camera: str, found: Detections) -> list[tuple[object, ...]]:
    out: list[tuple[object, ...]] = []
    for uv, cov in zip(found.uv_px, found.cov_px2, strict=True):
        su, sv = np.sqrt(np.diagonal(cov))
        out.append((number, camera, f"{uv[0]:.9f}", f"{uv[1]:.9f}", f"{su:.12g}", f"{sv:.12g}", *[""] * 5, "0"))
    return out
