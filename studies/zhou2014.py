"""`beampose study zhou2014`: circles in rendered pictures and behind a probe, compared with the published figures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from lab.report.page import Section
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, VERMILLION, axes, frame, line_path, plot_area, svg_of, text
from lab.targets.circle import CircleOptions
from studies.comparison import Comparison, ComparisonRow
from studies.drogue.render import render_drogue, rim_of
from studies.drogue.scene import LIGHTS, DrogueBackground, DrogueScene, Occluder, ellipse_through
from tracking.drogue_circle.detectors import CircleCandidate, CircleParameters, Window, classical_detector
from tracking.drogue_circle.printed import printed_measurement
from tracking.drogue_circle.rim_fit import RimFit, fit_rim, smooth_crop
from tracking.noise import Picture

# The experiment of Zhou (2014), section 4, with rendered drogues: an approach from 10 m in three lights.
#
# Nobody publishes pictures of a refuelling drogue, so they are rendered. A drogue has several circles: the rim of the
# canopy, its inner edge and the opening of the basket. The tracker follows the one that it acquires; the truth is the
# image of that circle.

PAPER_PERCENT = {"front": 92.2, "side": 96.7, "overcast": 96.7}  # table 1
RADIUS_M, FAR_M, NEAR_M = 0.3, 10.0, 2.0
FOCAL_PX, SIZE = 600.0, (640, 512)
RATE_HZ, EXPOSURE_S = 25.0, 0.004
TRACKED = 0.1  # largest error of the centre, as a share of the radius of the rim, of a tracked frame
_PERIOD, _PROBE = 120, 24  # frames: the probe enters once in each period, for this long
_TILT_DEG = 8.0
_LEAST_FRAMES = 150  # of the whole approach: in fewer frames it would be a jump


@dataclass(frozen=True, slots=True)
class DrogueFrame:
    """One rendered picture and its circles."""

    picture: NDArray[np.uint8]  # (h, w) grey
    circles: Array  # (3, 3): u, v and semi-major axis of the rim, the inner edge of the canopy, the basket's opening
    hidden: float  # share of the rim


@dataclass(frozen=True, slots=True)
class LightFigures:
    """A tracker on the frames of one light."""

    frames: int
    errors_px: Array  # (m,) of the tracked frames: measured or predicted, with a centre within a tenth of the radius

    @property
    def percent(self) -> float:
        """Share of tracked frames."""
        return 100 * len(self.errors_px) / self.frames


def approach(seed: int, light: str, frames: int, scale: int = 1) -> Iterator[DrogueFrame]:
    """A drogue that comes nearer, sways and tilts, before moving clouds; a probe covers a part of it at times.

    scale: 2 renders pictures of twice the width, with twice the focal length.
    """
    width, height, focal = scale * SIZE[0], scale * SIZE[1], scale * FOCAL_PX
    rng = np.random.default_rng([seed, 4, sorted(LIGHTS).index(light)])
    camera = Camera(
        name="camera", screen="", image_size_px=(width, height),
        matrix=np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]),
        distortion=(), camera_from_world=Pose(np.eye(3), np.zeros(3)),
    )  # fmt: skip
    phase = rng.uniform(0, 2 * np.pi, 7)
    kind = ("sky", "clouds", "ground")[int(rng.integers(3))]
    look = int(rng.integers(2**31))
    drift = rng.uniform(-1.5, 1.5, 2)
    side = rng.uniform(0, 2 * np.pi, frames // _PERIOD + 1)
    for k in range(frames):
        pose, rate = _pose(k / RATE_HZ, k / max(frames, _LEAST_FRAMES), phase)
        distance = float(pose.translation[2])
        moved = focal / distance * rate[:2] * EXPOSURE_S
        # The texture is mirrored at its edges: the background moves to and fro, by whole pixels, which are copied.
        shift = np.rint(60 * np.sin(drift * k / 60))
        scene = DrogueScene(
            camera, pose, RADIUS_M, light=LIGHTS[light], blur_px=0.8, noise_dn=2.0,
            background=DrogueBackground(kind, look, (float(shift[0]), float(shift[1]))),
            motion_px=(float(moved[0]), float(moved[1])),
            occluders=_probe(camera, pose, k, float(side[k // _PERIOD])),
        )  # fmt: skip
        drawn = render_drogue(scene, rng, grey=True)
        yield DrogueFrame(drawn.image, _circles(scene), drawn.hidden)


def _pose(t_s: float, share: float, phase: Array) -> tuple[Pose, Array]:
    """The drogue in the camera's frame, and its velocity, m/s. share: part of the approach that is done."""
    turn = 2 * np.pi * np.array([0.2, 0.17, 0.6, 0.55])
    size = np.array([0.25, 0.15, 0.02, 0.02])
    angle = turn * t_s + phase[:4]
    sway, rate = size * np.sin(angle), size * turn * np.cos(angle)
    distance = FAR_M * (NEAR_M / FAR_M) ** share
    tilt = np.radians(_TILT_DEG) * np.sin(2 * np.pi * np.array([0.25, 0.21, 0.1]) * t_s + phase[4:])
    place = np.array([sway[0] + sway[2], sway[1] + sway[3], distance])
    velocity = np.array([rate[0] + rate[2], rate[1] + rate[3], 0.0])
    return Pose(Rotation.from_rotvec(tilt).as_matrix(), place), velocity


def _probe(camera: Camera, pose: Pose, k: int, side_rad: float) -> tuple[Occluder, ...]:
    """The probe: once in each period it covers up to about a fifth of the drogue, from one side."""
    into = k % _PERIOD - (_PERIOD - _PROBE)
    if into < 0:
        return ()
    u, v = camera.project(pose.translation)
    radius = float(camera.matrix[0, 0]) * RADIUS_M / float(pose.translation[2])
    depth = np.sin(np.pi * (into + 0.5) / _PROBE)  # how far it reaches in: to half of the radius
    along = np.array([np.cos(side_rad), np.sin(side_rad)])
    end, start = [u, v] + (1.3 - 0.8 * depth) * radius * along, [u, v] + 900 * along
    return (Occluder((float(end[0]), float(end[1])), 0.35 * radius, (float(start[0]), float(start[1]))),)


def _circles(scene: DrogueScene) -> Array:
    look = scene.look
    opening = look.canopy_inner + (look.rear - look.canopy_inner) * look.lining_from
    places = ((1.0, 0.0), (look.canopy_inner, 0.0), (opening, look.lining_from * look.depth))
    ellipses = [ellipse_through(rim_of(scene, r * scene.radius_m, z * scene.radius_m)) for r, z in places]
    return np.array([[*e.centre_px, e.major_px] for e in ellipses])


def followed(seed: int, light: str, frames: int, forms: tuple[str, ...] = ("sound", "printed")) -> list[LightFigures]:
    """Track the approach with each form of the tracker; both get the same pictures and no place of the first circle."""
    trackers = [CircleOptions(form=form, min_radius_px=10.0).tracker() for form in forms]
    own = [0] * len(forms)
    errors: list[list[float]] = [[] for _ in forms]
    for drawn in approach(seed, light, frames):
        for i, tracker in enumerate(trackers):
            frame = tracker.step(drawn.picture)
            if not np.isfinite(frame.state[:3]).all():
                errors[i].append(np.inf)
                continue
            if frame.event:  # acquired: which circle it follows from here on
                own[i] = int(np.argmin(np.abs(drawn.circles - frame.state[:3]).sum(axis=1)))
            error = float(np.hypot(*(frame.state[:2] - drawn.circles[own[i], :2])))
            errors[i].append(error if error < TRACKED * drawn.circles[0, 2] else np.inf)
    return [LightFigures(len(of_form), np.array([e for e in of_form if np.isfinite(e)])) for of_form in errors]


# Pictures of a ring with known centre, partly behind a straight edge: what the detectors are compared on.

STILL_SIZE = (240, 200)  # width, height, px
_SAMPLES = 4  # per pixel and axis
_TEXTURE = ((3.0, 8.0), (12.0, 16.0), (40.0, 20.0))  # sigma (px) and amplitude (DN) of the background


@dataclass(frozen=True, slots=True)
class Still:
    """A picture and its truth."""

    picture: NDArray[np.uint8]  # (h, w)
    circle: Array  # (3,) u, v, radius of the inner rim, px


def textured(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """A background (h, w), DN: smooth noise of several sizes, about 110 DN."""
    out = np.full(size_px[::-1], 110.0, np.float32)
    for sigma, amplitude in _TEXTURE:
        grain = cv2.GaussianBlur(rng.standard_normal(size_px[::-1], dtype=np.float32), (0, 0), sigma)
        out += np.float32(amplitude / max(float(grain.std()), 1e-9)) * grain
    return out


def ring_still(
    rng: np.random.Generator,
    radius_px: float,
    hidden: float,
    *,
    centre_px: tuple[float, float] | None = None,
    background: NDArray[np.float32] | None = None,
    blur_px: float = 1.0,
    noise_dn: float = 2.0,
) -> Still:
    """A bright ring with a black inside on a textured background; `hidden` is the covered share of the inner rim.

    The occluder is a plain rectangle on one side: the hardest case for the centre, since all that is left of the rim
    lies on the other side.
    """
    width, height = STILL_SIZE
    if centre_px is None:
        centre_px = (width / 2 + float(rng.uniform(-8, 8)), height / 2 + float(rng.uniform(-8, 8)))
    u, v = centre_px
    x = ((np.arange(width * _SAMPLES) + 0.5) / _SAMPLES - 0.5 - u).astype(np.float32)[None, :]
    y = ((np.arange(height * _SAMPLES) + 0.5) / _SAMPLES - 0.5 - v).astype(np.float32)[:, None]
    distance = np.hypot(x, y)
    below = textured(rng, STILL_SIZE) if background is None else background
    fine = cv2.resize(below, None, fx=_SAMPLES, fy=_SAMPLES, interpolation=cv2.INTER_LINEAR)
    outer = radius_px * (1 + float(rng.uniform(0.25, 0.5)))
    ribs = np.float32(rng.uniform(170, 230)) + 10 * np.cos(16 * np.arctan2(y, x))
    fine = np.where(distance < outer, ribs, fine)
    fine = np.where(distance < radius_px, np.float32(rng.uniform(20, 70)), fine)
    if hidden > 0:
        angle = float(rng.uniform(0, 2 * np.pi))
        along = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        covered = (along > radius_px * np.cos(np.pi * hidden)) & (np.abs(across) < 2.2 * radius_px)
        fine = np.where(covered, np.float32(rng.uniform(60, 200)), fine)
    coarse = cv2.resize(np.asarray(fine, np.float32), STILL_SIZE, interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(coarse, (0, 0), blur_px) + rng.normal(0, noise_dn, (height, width))
    return Still(np.clip(np.rint(seen), 0, 255).astype(np.uint8), np.array([u, v, radius_px]))


# The measurements behind `beampose study zhou2014`: stills, a full occlusion, cost. Ours; the paper has none of them.
#
# Each method gets the same pictures. OpenCV's HoughCircles searches the whole picture for its strongest circle; the
# paper's method and ours search the window around the same uncertain prediction.


RADII_PX = (12.0, 45.0)
BLUR_PX, NOISE_DN = (0.7, 1.8), (2.0, 8.0)
HIDDEN = (0.0, 0.2, 0.4)  # shares of the rim
PREDICTION_PX = 1.5  # 1 sigma of the predicted centre; a third of it for the radius
_FAILED_PX = 8.0  # a centre farther away is a failure: the gate of the paper
_LARGE = (1280, 1024)
_WARM_UP = 8  # pictures before the time is measured


@dataclass(frozen=True, slots=True)
class StillErrors:
    """Errors of the centre, px, n stills; nan where a method finds nothing."""

    hidden: Array  # (n,) share of the rim
    opencv: Array
    printed: Array
    ours: Array
    nees_centre: Array  # (n,) squared error of our centre over its covariance, 2 degrees of freedom
    nees: Array  # (n,) the same with the radius, 3 degrees of freedom

    def median(self, method: str, hidden: float | None = None) -> float:
        """Median error of a method (`opencv`, `printed`, `ours`); failures count as infinite."""
        errors: Array = getattr(self, method)
        chosen = errors if hidden is None else errors[self.hidden == hidden]
        return float(np.median(np.where(np.isfinite(chosen), chosen, np.inf)))

    def failures(self, method: str) -> float:
        """Share of the stills without a centre within 8 px."""
        errors: Array = getattr(self, method)
        return float(np.mean(~(errors < _FAILED_PX)))


def still_errors(seed: int, count: int) -> StillErrors:
    """`count` stills of each hidden share."""
    rng = np.random.default_rng([seed, 1])
    parameters = CircleParameters()
    rows = []
    for hidden in HIDDEN:
        for _ in range(count):
            blur, noise = float(rng.uniform(*BLUR_PX)), float(rng.uniform(*NOISE_DN))
            still = ring_still(rng, float(rng.uniform(*RADII_PX)), hidden, blur_px=blur, noise_dn=noise)
            prior = still.circle + PREDICTION_PX * rng.standard_normal(3) * [1, 1, 1 / 3]
            fit = measured_once(still.picture, prior, parameters)
            away = np.full(3, np.nan) if fit is None else fit.centre_and_radius - still.circle
            nees = (
                [np.nan, np.nan]
                if fit is None
                else [float(away[:n] @ np.linalg.solve(fit.covariance_px2[:n, :n], away[:n])) for n in (2, 3)]
            )
            errors = [
                _distance(c, still.circle)
                for c in (strongest(still.picture), printed_measurement(still.picture, prior, parameters))
            ]
            rows.append([hidden, *errors, float(np.hypot(*away[:2])), *nees])
    return StillErrors(*np.array(rows).T)


def measured_once(picture: Picture, prior: Array, parameters: CircleParameters) -> RimFit | None:
    """Our measurement without a filter: the best rim in the window around a predicted circle (3,)."""
    u, v, radius = (float(x) for x in prior)
    change = parameters.radius_gate * radius
    half = max(0.5 * parameters.window_radii * radius, 1.15 * radius + parameters.gate_px)
    window = Window(u, v, half, parameters.gate_px, radius - change, radius + change)
    crop = smooth_crop(picture, window, parameters.blur_px)
    coarse = [CircleCandidate(u, v, radius, np.inf), *classical_detector(parameters)(picture, window)]
    fits = [fit_rim(crop, c, parameters.min_coverage) for c in coarse[: 1 + parameters.candidates]]
    good = [f for f in fits if f is not None and abs(f.rim.radius_px / radius - 1) < parameters.radius_gate]
    return max(good, key=lambda f: f.score - abs(f.rim.radius_px / radius - 1), default=None)


def strongest(picture: Picture) -> Array | None:
    """The strongest circle (3,) of cv2.HoughCircles; its threshold is lowered until it finds one."""
    for threshold in (60, 40, 25, 15, 8):
        found = cv2.HoughCircles(
            picture, cv2.HOUGH_GRADIENT, 1, 20, param1=100, param2=threshold, minRadius=10, maxRadius=60
        )
        if found is not None:
            return np.asarray(found, dtype=float).reshape(-1, 3)[0]
    return None


def _distance(circle: Array | None, truth: Array) -> float:
    return np.nan if circle is None else float(np.hypot(*(circle[:2] - truth[:2])))


@dataclass(frozen=True, slots=True)
class HiddenRun:
    """A circle that is fully hidden for some frames: the error of the centre over time."""

    frame: Array  # (n,)
    hidden: Array  # (n,) 1 where it is fully hidden
    ours_px: Array  # (n,) error of the reported centre
    printed_px: Array

    def largest(self, errors_px: Array) -> float:
        """The largest error of the fully hidden frames; infinite where a frame has no position."""
        chosen = errors_px[self.hidden > 0]
        return float(np.where(np.isfinite(chosen), chosen, np.inf).max())


def hidden_run(seed: int) -> HiddenRun:
    """A ring on a smooth path of 60 frames, behind a plate for eight of them."""
    frames, first, count = 60, 40, 8
    rng = np.random.default_rng([seed, 2])
    background = textured(rng, STILL_SIZE)
    phase, radius = rng.uniform(0, 2 * np.pi, 4), float(rng.uniform(16, 30))
    trackers = [CircleOptions(form=form).tracker() for form in ("sound", "printed")]
    look = int(rng.integers(2**31))
    errors = np.full((frames, 2), np.nan)
    for k in range(frames):
        t = k / 25  # s; a pendulum of 4 s and a faster sway; a slow approach
        u = STILL_SIZE[0] / 2 + 18 * np.sin(2 * np.pi * 0.25 * t + phase[0]) + np.sin(2 * np.pi * 0.6 * t + phase[1])
        v = STILL_SIZE[1] / 2 + 12 * np.sin(2 * np.pi * 0.2 * t + phase[2]) + np.sin(2 * np.pi * 0.5 * t + phase[3])
        still = ring_still(
            np.random.default_rng(look), radius * (1 + 0.004 * k), 0.0, centre_px=(u, v), background=background
        )
        # The look is that of one random state; the noise is another one in each frame.
        picture = still.picture.astype(float) + rng.normal(0, 2.0, still.picture.shape)
        if first <= k < first + count:
            half = 1.7 * still.circle[2]
            rows = slice(max(int(v - half), 0), int(v + half))
            picture[rows, max(int(u - half), 0) : int(u + half)] = 95 + rng.normal(0, 2.0)
        image = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        for i, tracker in enumerate(trackers):
            errors[k, i] = np.hypot(*(tracker.step(image).state[:2] - [u, v]))
    frame = np.arange(frames, dtype=float)
    hidden = ((frame >= first) & (frame < first + count)).astype(float)
    return HiddenRun(frame, hidden, errors[:, 0], errors[:, 1])


def cost_ratio(seed: int, pictures: Sequence[Picture] | None = None) -> tuple[float, float]:
    """Process time, ms per frame of 1280 x 1024 px, of the tracker and of HoughCircles on the whole picture.

    One thread for both, since idle threads of OpenCV count as process time. pictures: consecutive ones with a circle,
    of which the first eight are not timed; None: a ring on a textured background.
    """
    given = list(_large_pictures(seed) if pictures is None else pictures)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = []
    try:
        for _ in range(5):
            tracker = CircleOptions().tracker()
            for picture in given[:_WARM_UP]:
                tracker.step(picture)
            begun = time.process_time()
            for picture in given[_WARM_UP:]:
                tracker.step(picture)
            middle = time.process_time()
            for picture in given[_WARM_UP:]:
                cv2.HoughCircles(picture, cv2.HOUGH_GRADIENT, 1, 50, param1=100, param2=30, minRadius=10, maxRadius=60)
            times.append((middle - begun, time.process_time() - middle))
    finally:
        cv2.setNumThreads(threads)
    ours, opencv = 1000 * np.median(times, axis=0) / (len(given) - _WARM_UP)
    return float(ours), float(opencv)


def _large_pictures(seed: int) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng([seed, 3])
    below = textured(rng, _LARGE)
    look, radius = int(rng.integers(2**31)), float(rng.uniform(*RADII_PX))
    left, top = 500, 400
    patch = below[top : top + STILL_SIZE[1], left : left + STILL_SIZE[0]]
    out = []
    for k in range(24):
        centre = (STILL_SIZE[0] / 2 + 0.5 * k, STILL_SIZE[1] / 2 + 0.3 * k)
        still = ring_still(np.random.default_rng(look), radius, 0.0, centre_px=centre, background=patch)
        picture = np.clip(np.rint(below + rng.normal(0, 2.0, below.shape)), 0, 255).astype(np.uint8)
        picture[top : top + STILL_SIZE[1], left : left + STILL_SIZE[0]] = still.picture
        out.append(picture)
    return out


# Zhou (2014): table 1 beside our figures, and the measurements that the paper does not print.


METHODS = ("HoughCircles", "as printed", "beampose")
STILLS, RUNS, FRAMES = 40, 8, 150  # stills of each hidden share; runs with a full occlusion; frames of each light
_NAMES = (("opencv", "HoughCircles", GREEN), ("printed", "as printed", VERMILLION), ("ours", "beampose", BLUE))


def compare_zhou2014(seed: int = 1, stills: int = STILLS, runs: int = RUNS, frames: int = FRAMES) -> Comparison:
    """The table and the figures of Zhou (2014). With more pictures: bench/related_measurements/circle.py."""
    errors = still_errors(seed, stills)
    hidden = [hidden_run(1000 * seed + k) for k in range(runs)]
    with ThreadPoolExecutor(len(PAPER_PERCENT)) as pool:
        tracked = pool.map(lambda light: followed(seed, light, frames), PAPER_PERCENT)
        lights = dict(zip(PAPER_PERCENT, tracked, strict=True))
    cost = cost_ratio(seed)
    return Comparison(
        title="Zhou, Sun, Bing & Yang (2014): tracking of an aerial refuelling drogue",
        setting=f"{len(errors.hidden)} stills · {runs} full occlusions · {frames} rendered frames of each light ·"
        f" seed {seed}",
        methods=METHODS,
        rows=(*_light_rows(lights), *_still_rows(errors), *_hidden_rows(hidden), _cost_row(*cost)),
        explanation="HoughCircles: OpenCV, strongest circle of the whole picture. As printed: the equations of the"
        " paper, with whole pixels as centres and eqs. (4) to (6). Beampose: corrected equations, rim fit, bank of"
        " filters. All get the same pictures. The paper's own pictures are not published: its column is its table 1,"
        " measured on a cart; ours are rendered.",
        figures=(
            Section(
                "Errors of the centre",
                f"Stills with a radius of {RADII_PX[0]:g} to {RADII_PX[1]:g} px, up to {100 * HIDDEN[-1]:g} % of the"
                f" rim hidden on one side, blur of {BLUR_PX[0]:g} to {BLUR_PX[1]:g} px and noise of {NOISE_DN[0]:g} to"
                f" {NOISE_DN[1]:g} DN.",
                [_distribution(errors)],
            ),
            Section(
                "Eight fully hidden frames",
                "Error of the reported centre. Shaded: the target is hidden. As printed, a clear target is not filtered"
                " (R = 0), so that the rates have the noise of whole pixels and the prediction leaves the target.",
                [_hidden_panel(run, k) for k, run in enumerate(hidden[:2])],
            ),
        ),
        source="X. Zhou, X. Sun, Y. Bing, B. Yang, Journal of Data Acquisition and Processing 29(6), 1041 (2014), in"
        " Chinese.",
    )


def _light_rows(lights: dict[str, list[LightFigures]]) -> list[ComparisonRow]:
    rows = []
    for light, (ours, printed) in lights.items():
        paper = PAPER_PERCENT[light]
        note = f"{ours.frames} frames; tracked: centre within a tenth of the radius"
        rows.append(ComparisonRow(f"tracked frames, {light}", "%", paper, (None, printed.percent, ours.percent), note))
    for light, (ours, printed) in lights.items():
        medians = [float(np.median(r.errors_px)) if len(r.errors_px) else None for r in (printed, ours)]
        rows.append(
            ComparisonRow(f"centre, {light}: median error", "px", None, (None, *medians), "of the tracked frames")
        )
    return rows


def _still_rows(errors: StillErrors) -> list[ComparisonRow]:
    rows = []
    for hidden in HIDDEN:
        medians = tuple(_or_none(errors.median(name, hidden)) for name, _, _ in _NAMES)
        name = f"centre of a still, {100 * hidden:g} % hidden: median error"
        rows.append(ComparisonRow(name, "px", None, medians))
    lost = tuple(100 * errors.failures(name) for name, _, _ in _NAMES)
    rows.append(ComparisonRow("stills without a centre within 8 px", "%", None, lost))
    nees = (float(np.nanmean(errors.nees_centre)) / 2, float(np.nanmean(errors.nees)) / 3)
    note = "1: the covariance is right; the paper has no covariance of its measurements"
    rows.append(ComparisonRow("centre of a still: NEES / 2", "", None, (None, None, nees[0]), note))
    rows.append(ComparisonRow("circle of a still: NEES / 3", "", None, (None, None, nees[1])))
    return rows


def _hidden_rows(runs: list[HiddenRun]) -> list[ComparisonRow]:
    printed = np.array([run.largest(run.printed_px) for run in runs])
    ours = np.array([run.largest(run.ours_px) for run in runs])
    rows = []
    for name, summary in (("median", np.median), ("largest", np.max)):
        values = (None, _or_none(float(summary(printed))), _or_none(float(summary(ours))))
        rows.append(ComparisonRow(f"8 hidden frames, largest error: {name} of the runs", "px", None, values))
    return rows


def _cost_row(ours_ms: float, opencv_ms: float) -> ComparisonRow:
    note = "1280 x 1024 px, process time, one thread; HoughCircles on the whole picture"
    return ComparisonRow("cost of a frame, HoughCircles = 1", "", None, (1.0, None, ours_ms / opencv_ms), note)


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _distribution(errors: StillErrors) -> str:
    """Share of the stills (%) with an error below a limit, by method; logarithm of the limit along x."""
    p = plot_area((-2.5, 1.0), (0.0, 100.0), height=300)
    out = axes(p, "Share of the stills with a smaller error", "error of the centre, log10 of px", "%")
    for i, (name, label, colour) in enumerate(_NAMES):
        values = np.sort(np.where(np.isfinite(getattr(errors, name)), getattr(errors, name), 1e3))
        x = np.clip(np.log10(np.maximum(values, 1e-9)), -2.5, 1.0)
        y = 100 * (np.arange(len(values)) + 1) / len(values)
        at = p.at(np.stack([x, y], axis=-1)[x < 1.0])
        out.append(f'<path d="{line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
        out.append(text(p.box[0] + 10, p.box[1] + 18 + 16 * i, label, "", f"fill:{colour};font-weight:600"))
    return svg_of(p, "Share of the stills with a smaller error", [*out, frame(p)])


def _hidden_panel(run: HiddenRun, number: int) -> str:
    return time_panel(
        run.frame, f"Run {number + 1}: error of the centre, blue: beampose, orange: as printed", "px",
        lines=(Line(run.ours_px, BLUE, "beampose"), Line(run.printed_px, VERMILLION, "as printed")),
        shades=(Shade(run.hidden > 0, "predicted", "hidden"),), y_range=(0.0, 12.0), time_name="frame",
    )  # fmt: skip
