"""The experiments of Fu (2016) on simulated lamps and rendered pictures: the table beside the published figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rotations import ypr_jacobian
from lab.report.page import PageTable, Section
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, ORANGE, VERMILLION, picture_uri, robust_range
from lab.targets.stereo.lamps import spots
from studies.comparison import Comparison, ComparisonRow
from tracking.binocular.lamp_tracker import LampFrame, LampTracker, harris_corners
from tracking.binocular.marker_model import MarkerModel
from tracking.statuses import PoseStatus
from tracking.unscented import (
    P0,
    SPREAD,
    STATES,
    X0,
    Function,
    Observability,
    PrintedFilter,
    Q,
    R,
    Rule,
    bearings,
    full_weight,
    gate,
    observability,
    predict,
    process,
    selection,
    student_t,
    update,
)

# The experiment of Fu (2016), section 4: 20 s at 0.1 s with a disturbance from 6 to 8 s.
#
# The paper gives the filter's numbers, but neither the motion nor the disturbance ("complex additive noise" of high
# order). Both are stated here. Motion: the mean of the paper's first state, with a sway of 0.3 to 0.4 m and 2 degrees.
# Disturbances: noise whose size depends on the state, around an offset; and a smooth error that starts and ends
# slowly.

DT_S, STEPS = 0.1, 201
FROM_S, TO_S = 6.0, 8.0  # the disturbance
RECOVERED_S = 9.0  # peaks are searched from FROM_S to here
SETTLED_S = 3.0  # from here on the filters have found the first state
SIZE = np.array([2.0, 2.0, np.deg2rad(5.0), np.deg2rad(5.0)])  # of the disturbance, m and rad
SWAY = np.array([0.4, 0.35, 0.3, np.deg2rad(2.0), np.deg2rad(2.0)])  # amplitudes: x, y, z, m; yaw, pitch, rad
PERIOD_S = np.array([25.0, 20.0, 16.0, 12.0, 14.0])
DISTURBANCES = ("none", "burst", "smooth bias")
FILTERS = ("standard", "as printed", "gate", "Student-t")
POSITION, VELOCITY, ANGLE = [1, 2], [4, 5], [6, 7]  # the observed states: lateral and vertical, and the angles


@dataclass(frozen=True, slots=True)
class Recording:
    """A simulated recording of T steps."""

    t_s: Array  # (T,)
    states: Array  # (T, 8) true states
    measured: Array  # (T, 4)
    disturbed: Bools  # (T,)


def simulate(seed: int, number: int, disturbance: str) -> Recording:
    """Recording `number` of a seed; the disturbances of one number have the same motion and the same noise.

    Raises ValueError: no such disturbance.
    """
    if disturbance not in DISTURBANCES:
        raise ValueError(f"disturbance: expected one of {', '.join(DISTURBANCES)}, got {disturbance!r}")
    rng = np.random.default_rng([seed, number])
    t: Array = DT_S * np.arange(STEPS, dtype=float)
    rate = 2 * np.pi / PERIOD_S
    phase = rate * t[:, None] + rng.uniform(0, 2 * np.pi, 5)
    sway, speed = SWAY * np.sin(phase), SWAY * rate * np.cos(phase)
    states = np.concatenate([X0[:3] + sway[:, :3], speed[:, :3], X0[6:] + sway[:, 3:]], axis=1)
    noise, burst = rng.standard_normal((2, STEPS, 4))
    measured = selection(states) + noise @ np.sqrt(R)
    disturbed = (t > FROM_S - 0.5 * DT_S) & (t < TO_S + 0.5 * DT_S)
    if disturbance == "burst":  # eq. (14): F = j(X) + m(X) V, with m of second order
        second_order = 0.5 * (1 + (sway[:, [1, 2, 3, 4]] / SWAY[1:]) ** 2)
        measured[disturbed] += (SIZE * (0.5 + second_order * burst))[disturbed]
    if disturbance == "smooth bias":
        bump = np.sin(np.pi * (t - FROM_S) / (TO_S - FROM_S)) ** 2
        measured[disturbed] += (SIZE * bump[:, None])[disturbed]
    return Recording(t, states, measured, disturbed)


def estimate(recording: Recording, name: str) -> Array:
    """The states (T, 8) that one of FILTERS estimates. Raises KeyError for any other name."""
    if name == "as printed":
        printed = PrintedFilter()
        return np.array([printed.step(z, DT_S).x for z in recording.measured])
    rule = _RULES[name]
    x, P, out = X0, P0, []
    for z in recording.measured:
        x, P = predict(x, P, process(DT_S), Q, SPREAD)
        step = update(x, P, z, selection, R, SPREAD, rule)
        x, P = step.x, step.P
        out.append(x)
    return np.array(out)


_RULES: dict[str, Rule] = {"standard": full_weight, "gate": gate, "Student-t": student_t}


def peaks(recording: Recording, states: Array) -> tuple[float, float, float]:
    """Largest errors from 6 to 9 s: position, m, velocity, m/s, and angle, degrees, of the observed states."""
    window = (recording.t_s >= FROM_S - 0.5 * DT_S) & (recording.t_s <= RECOVERED_S + 0.5 * DT_S)
    error = np.abs(states - recording.states)[window]
    largest = (error[:, of].max() for of in (POSITION, VELOCITY, ANGLE))
    position, velocity, angle = largest
    return float(position), float(velocity), float(np.rad2deg(angle))


def quiet_rms(recording: Recording, states: Array) -> tuple[float, float, float, float]:
    """RMS errors from 3 s on: position, m, velocity, m/s, angle, degrees, of the observed states; and of x, m."""
    error = (states - recording.states)[recording.t_s > SETTLED_S]
    rms = [float(np.sqrt(np.mean(error[:, of] ** 2))) for of in (POSITION, VELOCITY, ANGLE, [0])]
    return rms[0], rms[1], float(np.rad2deg(rms[2])), rms[3]


# Rendered pictures of a tanker with five lamps: two on the wing and three on the fuselage, as in Fu (2016).
#
# The paper gives neither the places of the lamps nor the camera. World is the paper's navigation frame: x ahead, y to
# the right, z down; the camera looks ahead.


SIZE_PX, FOCAL_PX = (640, 512), 500.0
# In body, m: x ahead, y right, z down. Left and right wing tip; fuselage: tail, spine, belly.
MARKERS = np.array([[-0.6, -3.0, 0.0], [-0.6, 3.0, 0.0], [-3.2, 0.0, -1.0], [0.8, 0.0, -0.1], [-0.4, 0.0, 0.75]])
NOISE_DN, LAMP_DN, LAMP_SIGMA_PX = 2.0, 130.0, 1.2
_WING = np.array([[0.6, 0.0, 0.0], [-0.5, 3.2, 0.0], [-0.9, 3.2, 0.0], [-0.9, -3.2, 0.0], [-0.5, -3.2, 0.0]])
_BODY = np.array([[3.5, 0.0, 0.0], [0.0, 0.0, -0.5], [-3.2, 0.0, -0.9], [-3.4, 0.0, -0.2], [0.0, 0.0, 0.5]])
_BELLY = np.array([[3.5, 0.0, 0.0], [0.0, 0.45, 0.0], [-3.4, 0.1, 0.0], [-3.4, -0.1, 0.0], [0.0, -0.45, 0.0]])


def camera() -> Camera:
    """The receiver's camera: world y, z, x are its x, y, z."""
    K = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2 - 0.5], [0, FOCAL_PX, SIZE_PX[1] / 2 - 0.5], [0, 0, 1.0]])
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    return Camera("receiver", "", SIZE_PX, K, (), Pose(turn, np.zeros(3)))


def lamp_model() -> MarkerModel:
    """The five lamps."""
    n = len(MARKERS)
    names = tuple(str(k + 1) for k in range(n))
    return MarkerModel(names, MARKERS, np.zeros(n, dtype=np.int64), np.full(n, np.nan))


def lamp_tracker() -> LampTracker:
    """A tracker of the lamps in the pictures of the camera."""
    return LampTracker(camera(), lamp_model(), spots, DT_S)


def projected(points: Array, pose: Pose) -> Array:
    """Pixels (n, 2) of points of the body (n, 3), m; nan behind the camera."""
    return camera().project(pose.apply(points))


def pose_of(state: Array) -> Pose:
    """world_from_body of a state (8,) of tracking/unscented.py; the roll is 0."""
    return Pose.from_ypr(np.array([state[6], state[7], 0.0]), state[:3])


@dataclass(frozen=True, slots=True)
class Difficulty:
    """What makes a picture harder than a clear one."""

    false_lights: int = 6  # glints at random places
    p_hidden: float = 0.03  # probability that a lamp is hidden
    blur_px: float = 0.0  # length of the motion blur


CLEAR, GUST = Difficulty(), Difficulty(false_lights=16, p_hidden=0.1, blur_px=3.0)


def render(state: Array, difficulty: Difficulty, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture (h, w) of a tanker in a state (8,) of tracking/unscented.py: sky, body, lamps, noise."""
    w, h = SIZE_PX
    cloud = rng.standard_normal((8, 10)).astype(np.float32)
    sky: NDArray[np.float32] = np.empty((h, w), np.float32)
    sky[:] = (
        95
        + np.linspace(18, 0, h, dtype=np.float32)[:, None]
        + 7 * cv2.resize(cloud, SIZE_PX, interpolation=cv2.INTER_CUBIC)
    )
    pose = pose_of(state)
    for outline, grey in ((_WING, 62.0), (_BELLY, 55.0), (_BODY, 50.0)):
        places = projected(outline, pose)
        if np.isfinite(places).all():
            cv2.fillPoly(sky, [np.round(16 * places).astype(np.int32)], grey, cv2.LINE_AA, 4)
    lamps = projected(MARKERS, pose)
    lit = lamps[(rng.random(len(lamps)) >= difficulty.p_hidden) & np.isfinite(lamps).all(axis=1)]
    false = rng.uniform((0, 0), SIZE_PX, (difficulty.false_lights, 2))
    about = lamps[rng.integers(len(lamps), size=difficulty.false_lights // 2)]
    false[: len(about)] = about + rng.normal(0, 40.0, about.shape)  # glints of the tanker itself
    light = np.zeros((h, w), np.float32)
    for place in np.concatenate([lit, false[np.isfinite(false).all(axis=1)]]):
        _add_lamp(light, place)
    if difficulty.blur_px > 1:
        light[:] = cv2.filter2D(light, -1, _line(difficulty.blur_px, rng.uniform(0, np.pi)))
    picture = sky + light + NOISE_DN * rng.standard_normal((h, w)).astype(np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _add_lamp(light: NDArray[np.float32], place: Array) -> None:
    """Add a Gaussian spot at a place (2,), px."""
    h, w = light.shape
    u, v = np.round(place).astype(int).tolist()
    reach = 7
    u0, u1, v0, v1 = max(u - reach, 0), min(u + reach + 1, w), max(v - reach, 0), min(v + reach + 1, h)
    if u0 >= u1 or v0 >= v1:
        return
    du, dv = np.arange(u0, u1) - place[0], np.arange(v0, v1) - place[1]
    light[v0:v1, u0:u1] += LAMP_DN * np.exp(-(du**2 + dv[:, None] ** 2) / (2 * LAMP_SIGMA_PX**2))


def _line(length_px: float, angle: float) -> NDArray[np.float32]:
    """A kernel of motion blur."""
    n = 2 * int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((n, n), np.float32)
    for s in np.linspace(-length_px / 2, length_px / 2, 8 * n):
        kernel[round(n // 2 + s * np.sin(angle)), round(n // 2 + s * np.cos(angle))] += 1
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


# The experiment of Fu (2016) with pictures: Harris corners, RANSAC, the pose of five lamps, and the filter on it.
#
# From 6 to 8 s the pictures are blurred, with more false lights and more hidden lamps. Lamps are searched where the
# measured poses predict them, so a wrong pose would also spoil the next search.


START_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.1, 0.1])  # of X0, from GPS and INS: m, m/s, rad
POSED = [0, 1, 2, 6, 7]  # the numbers of the state that a pose measures
WRONG_PX = 3.0  # a matched corner farther from its lamp has the wrong label


@dataclass(frozen=True, slots=True)
class PictureRun:
    """T pictures through the whole chain."""

    t_s: Array  # (T,)
    error: Array  # (T, 8) of the filter's states
    single: Array  # (T, 5) error of the pose of a single picture: x, y, z, m; yaw, pitch, rad; nan without one
    gust: Bools  # (T,)
    wrong: Bools  # (T,) a lamp has a wrong label


def run_pictures(seed: int, robust: bool, steps: int | None = None) -> PictureRun:
    """One recording of pictures; the same ones for both filters. steps: the first ones only."""
    recording = simulate(seed, 0, "none")
    rng, tracker = np.random.default_rng([seed, 71]), lamp_tracker()
    T = len(recording.t_s) if steps is None else steps
    x, P = X0, np.diag(START_SIGMA**2)
    error, single = np.full((T, 8), np.nan), np.full((T, 5), np.nan)
    wrong = np.zeros(T, dtype=bool)
    for k in range(T):
        state = recording.states[k]
        picture = render(state, GUST if recording.disturbed[k] else CLEAR, rng)
        if k:
            x, P = predict(x, P, process(DT_S), Q, SPREAD)
        frame = tracker.step(picture)
        if frame.status is PoseStatus.MEASURED:
            z, R = _measured(frame)
            rule = student_t if robust else full_weight
            step = update(x, P, z, lambda states: states[:, POSED], R, SPREAD, rule)
            x, P = step.x, step.P
            single[k] = z - state[POSED]
            wrong[k] = _is_wrong(frame, pose_of(state))
        error[k] = x - state
    return PictureRun(recording.t_s[:T], error, single, recording.disturbed[:T], wrong)


def _measured(frame: LampFrame) -> tuple[Array, Array]:
    """x, y, z, yaw, pitch (5,) of a measured pose, and their covariance."""
    pose, covariance = frame.tracked.pose, frame.tracked.covariance
    assert pose is not None
    assert covariance is not None
    T = np.zeros((5, 6))
    T[:3, :3] = np.eye(3)
    T[3:, 3:] = ypr_jacobian(pose.rotation)[:2]
    return np.concatenate([pose.translation, pose.ypr[:2]]), T @ covariance @ T.T


def _is_wrong(frame: LampFrame, truth: Pose) -> bool:
    apart = labelled_px(frame) - projected(MARKERS, truth)
    return bool(np.any(np.linalg.norm(apart, axis=1) > WRONG_PX))


def labelled_px(frame: LampFrame) -> Array:
    """Where each lamp (n, 2) is seen; nan where it is not."""
    out, index = np.full((len(MARKERS), 2), np.nan), frame.tracked.index[0]
    if frame.lights is not None:
        out[index >= 0] = frame.lights.uv_px[index[index >= 0]]
    return out


# Rows and figure of the part of the study of Fu (2016) that uses pictures.


_SETTLED_S = 1.0
_SHOWN_PX = (420, 180)  # size of the part of a picture that is shown


def picture_rows(runs: dict[str, PictureRun]) -> list[ComparisonRow]:
    """The rows; runs: one recording of pictures through the filters of these names."""
    quiet = {n: ~r.gust & (r.t_s > _SETTLED_S) for n, r in runs.items()}
    seen = {n: np.isfinite(r.single[:, 0]) for n, r in runs.items()}
    note = "four or five lamps agree with one pose, and no other labels do"
    clear = {n: 100 * float(seen[n][~r.gust].mean()) for n, r in runs.items()}
    out = [
        _row("pictures: clear ones with a pose", "%", None, clear, note),
        _row("pictures: wrong labels, all pictures", "", None, {n: float(r.wrong.sum()) for n, r in runs.items()}),
    ]
    if any(r.gust.any() for r in runs.values()):
        with_pose = {n: 100 * float(seen[n][r.gust].mean()) for n, r in runs.items()}
        out.append(
            _row("pictures: disturbed ones with a pose", "%", None, with_pose, "blur, 16 false lights, hidden lamps")
        )
    for quantity, of, unit, scale in (
        ("range x", [0], "m", 1.0),
        ("position y, z", [1, 2], "m", 1.0),
        ("yaw, pitch", [6, 7], "deg", float(np.rad2deg(1.0))),
    ):
        rms = {n: scale * float(np.sqrt(np.mean(r.error[quiet[n]][:, of] ** 2))) for n, r in runs.items()}
        out.append(
            _row(
                f"pictures: quiet RMS, {quantity}", unit, None, rms, "the pose observes all eight numbers of the state"
            )
        )
    if any(r.gust.any() for r in runs.values()):
        largest = {n: float(np.abs(r.error[r.gust][:, :3]).max()) for n, r in runs.items()}
        out.append(
            _row("pictures: largest position error, 6 to 8 s", "m", 0.1, largest, "x, y, z; the paper: within 10 cm")
        )
    return out


def picture_figure(seed: int, run: PictureRun) -> Section:
    """A clear and a disturbed picture with corners and lamps, and the errors over time."""
    panels = [_shown(seed, False), _shown(seed, True)]
    shade = (Shade(run.gust, "predicted", "disturbed"),)
    for column, single, title in ((0, 0, "x"), (1, 1, "y")):
        lines = (
            Line(run.single[:, single], ORANGE, "pose of one picture"),
            Line(run.error[:, column], VERMILLION, "filter"),
        )
        panels.append(
            time_panel(run.t_s, f"{title}: estimate − true", "m", lines=lines, shades=shade, y_range=(-0.1, 0.1))
        )
    return Section(
        "Pose from pictures: Harris corners and RANSAC (Figs. 2 and 3)",
        "Rendered pictures of a tanker with two lamps on the wing and three on the fuselage, 640 x 512 pixels, f = 500"
        " px. Circles: corners; squares: those that are lamps. Left: clear. Right: disturbed. Below:"
        " orange: pose of each picture; red: Student-t filter. Pictures without a safe pose have no orange value.",
        panels,
    )


def _shown(seed: int, disturbed: bool) -> str:
    """The part of a rendered picture around the tanker with its corners, as an img element."""
    recording = simulate(seed, 0, "none")
    state = recording.states[int(np.argmin(np.abs(recording.t_s - (FROM_S if disturbed else 1.0))))]
    rng = np.random.default_rng([seed, 73])
    grey = render(state, GUST if disturbed else CLEAR, rng)
    frame = lamp_tracker().step(grey)
    corners = harris_corners(grey).uv_px
    picture: Any = cv2.cvtColor(cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR)
    for u, v in (2 * corners + 0.5).round().astype(int).tolist():
        cv2.circle(picture, (u, v), 9, (80, 200, 255), 1, cv2.LINE_AA)
    seen = labelled_px(frame)
    for u, v in (2 * seen[np.isfinite(seen[:, 0])] + 0.5).round().astype(int).tolist():
        cv2.rectangle(picture, (u - 12, v - 12), (u + 12, v + 12), (80, 220, 80), 1, cv2.LINE_AA)
    middle = projected(MARKERS, pose_of(state)).mean(axis=0)
    left, top = (2 * middle - np.array(_SHOWN_PX)).round().astype(int).tolist()
    left, top = (int(np.clip(at, 0, n - 2 * size)) for at, n, size in zip(
        (left, top), (picture.shape[1], picture.shape[0]), _SHOWN_PX, strict=True))  # fmt: skip
    part = picture[top : top + 2 * _SHOWN_PX[1], left : left + 2 * _SHOWN_PX[0]]
    jpeg = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    word = "disturbed" if disturbed else "clear"
    return f'<img src="{picture_uri(jpeg, "jpeg")}" width="100%" alt="{word} picture with corners and lamps">'


RECORDINGS = 20
COLOURS = {"standard": BLUE, "as printed": ORANGE, "gate": GREEN, "Student-t": VERMILLION}
# Name: measurement function and the number of its components; R of a component is that of eq. (10).
OBSERVATIONS: dict[str, tuple[Function, int]] = {
    "eq. (4): y, z, yaw, pitch": (selection, 4),
    "eq. (5): y, z and two bearings": (bearings, 4),
    "both: y, z, yaw, pitch and two bearings": (lambda s: np.concatenate([selection(s), bearings(s)[:, 2:]], 1), 6),
}


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one filter over N recordings; columns position, m, velocity, m/s, angle, degrees."""

    quiet: Array  # (N, 4): RMS without disturbance; last column the range, m
    peaks: dict[str, Array]  # disturbance -> (N, 3)


def compare_fu2016(seed: int = 1, recordings: int = RECORDINGS, pictures: int | None = None) -> Comparison:
    """The table and the figures of section 4; the seed determines the result. pictures: the first ones; None: all."""
    errors = {name: _errors(seed, recordings, name) for name in FILTERS}
    first = simulate(seed, 0, "none")
    shown = {name: run_pictures(seed, name == "Student-t", pictures) for name in ("standard", "Student-t")}
    observed = {
        name: observability(first.states, process(DT_S), function, R[0, 0] * np.eye(m), P0)
        for name, (function, m) in OBSERVATIONS.items()
    }
    return Comparison(
        title="Fu, Kong, Dong, Zhi & Gao (2016), section 4",
        setting=f"{recordings} recordings · 20 s at {DT_S:g} s · disturbance from 6 to 8 s · seed {seed}",
        methods=FILTERS,
        rows=(*_quiet_rows(errors), *_peak_rows(errors), *_observability_rows(observed), *picture_rows(shown)),
        explanation="Standard: the unscented filter with the paper's numbers and the weights of eq. (9) as they are"
        " meant. As printed: with eqs. (11) to (13). Gate: measurements beyond a Mahalanobis distance (p = 0.001) are"
        " not used. Student-t: their noise is increased. All four have the same motion model, Q and R. Values are"
        " medians over the recordings; “worst” is the largest one. Position and velocity are those of y and z: eq. (4)"
        " does not observe the range x.",
        figures=(*_curves(seed), _observability_figure(observed), picture_figure(seed, shown["Student-t"])),
        source="Y. Fu, X. Kong, X. Dong, J. Zhi, Y. Gao, Journal of Applied Optics 37(6), 860 (2016),"
        " doi 10.5768/JAO201637.0602004.",
    )


def _errors(seed: int, recordings: int, name: str) -> Errors:
    quiet: list[tuple[float, ...]] = []
    largest: dict[str, list[tuple[float, ...]]] = {d: [] for d in DISTURBANCES[1:]}
    for number in range(recordings):
        still = simulate(seed, number, "none")
        quiet.append(quiet_rms(still, estimate(still, name)))
        for disturbance, of in largest.items():
            recording = simulate(seed, number, disturbance)
            of.append(peaks(recording, estimate(recording, name)))
    return Errors(np.array(quiet), {d: np.array(of) for d, of in largest.items()})


# The table --------------------------------------------------------------------------------------------------------


def _row(quantity: str, unit: str, paper: float | None, values: dict[str, float], note: str = "") -> ComparisonRow:
    """values: by filter; of observability, which depends on the measurement alone, those of the standard one."""
    return ComparisonRow(quantity, unit, paper, tuple(values.get(name) for name in FILTERS), note)


def _quiet_rows(errors: dict[str, Errors]) -> list[ComparisonRow]:
    out = []
    after = f"without disturbance, from {SETTLED_S:g} s on"
    for column, (quantity, unit) in enumerate((("position", "m"), ("velocity", "m/s"), ("angle", "deg"))):
        rms = {name: e.quiet[:, column] for name, e in errors.items()}
        out.append(_row(f"quiet RMS, {quantity}", unit, None, {n: float(np.median(v)) for n, v in rms.items()}, after))
        ratio = {n: float(np.max(v / rms["standard"])) for n, v in rms.items()}
        out.append(_row(f"quiet RMS, {quantity}, ratio to standard, worst", "", None, ratio))
    range_rms = {n: float(np.median(e.quiet[:, 3])) for n, e in errors.items()}
    note = "not observed by eq. (4): the error of the first state"
    return [*out, _row("quiet RMS, range x", "m", None, range_rms, note)]


def _peak_rows(errors: dict[str, Errors]) -> list[ComparisonRow]:
    out = []
    for disturbance in DISTURBANCES[1:]:
        for column, (quantity, unit, paper) in enumerate(
            (("position", "m", 0.1), ("velocity", "m/s", 0.1), ("angle", "deg", 1.0))
        ):
            largest = {name: e.peaks[disturbance][:, column] for name, e in errors.items()}
            note = "6 to 9 s; the published value is that of the modification, without its disturbance's size"
            middle = {n: float(np.median(v)) for n, v in largest.items()}
            out.append(_row(f"{disturbance}: peak error, {quantity}", unit, paper, middle, note))
            ratio = {n: float(np.max(v / largest["standard"])) for n, v in largest.items()}
            out.append(_row(f"{disturbance}: peak error, {quantity}, ratio to standard, worst", "", None, ratio))
    return out


def _observability_rows(observed: dict[str, Observability]) -> list[ComparisonRow]:
    out = []
    for name, o in observed.items():
        unobserved = [state for state, good in zip(STATES, o.observed(), strict=True) if not good]
        note = f"of {len(STATES)}; not observed: {', '.join(unobserved) or 'none'}"
        out.append(_row(f"observed directions, {name}", "", None, {"standard": float(o.rank)}, note))
        prior, sigma = f"prior {o.sigma_prior[0]:.1f} m", {"standard": float(o.sigma[0])}
        out.append(_row(f"sigma of range x, {name}", "m", None, sigma, prior))
    return out


# The figures ------------------------------------------------------------------------------------------------------


def _curves(seed: int) -> list[Section]:
    out = []
    for disturbance in DISTURBANCES[1:]:
        recording = simulate(seed, 0, disturbance)
        states = {name: estimate(recording, name) for name in FILTERS}
        shown = ((1, "y", "m"), (2, "z", "m"), (4, "velocity y", "m/s"), (6, "yaw", "deg"))
        panels = [_panel(recording, states, column, f"{name}: estimate − true", unit) for column, name, unit in shown]
        out.append(
            Section(
                f"Errors with a {disturbance} (Figs. 4 to 8)",
                "Blue: standard. Orange: as printed. Green: gate. Red: Student-t. The disturbance is shaded. The"
                " modification as printed keeps its previous value whenever a number changes by more than 0.5 %, so it"
                " does not follow the motion; the gate can stay closed after the disturbance.",
                panels,
            )
        )
    return out


def _panel(recording: Recording, states: dict[str, Array], column: int, title: str, unit: str) -> str:
    scale = np.rad2deg(1.0) if unit == "deg" else 1.0
    errors = {name: scale * (s - recording.states)[:, column] for name, s in states.items()}
    t = recording.t_s > 1.0  # before it the first state dominates
    lines = tuple(Line(e[t], COLOURS[name], name) for name, e in errors.items())
    y_range = robust_range(np.concatenate([e[t] for name, e in errors.items() if name != "as printed"]), 0.05)
    shade = (Shade(recording.disturbed[t], "predicted", "disturbance"),)
    return time_panel(recording.t_s[t], title, unit, lines=lines, shades=shade, y_range=y_range)


def _observability_figure(observed: dict[str, Observability]) -> Section:
    heads = ("state", "prior", *(n.partition(":")[0] for n in observed))
    units = ("m", "m", "m", "m/s", "m/s", "m/s", "rad", "rad")
    prior = next(iter(observed.values())).sigma_prior
    rows: list[list[object]] = [
        [f"{state} ({unit})", prior[i], *(o.sigma[i] for o in observed.values())]
        for i, (state, unit) in enumerate(zip(STATES, units, strict=True))
    ]
    rows.append(["directions observed", "", *(f"{o.rank} of {len(STATES)}" for o in observed.values())])
    return Section(
        "Which states are observable",
        "Sigma of each number of the first state, before and after 20 s of measurements, without process noise, from"
        " the observability Gramian along the true motion. Eq. (4) selects four numbers: range and range rate keep"
        " their prior sigma. Eq. (5) replaces the two attitude angles by the directions in which the tanker is seen:"
        " they observe the range weakly, through the parallax y / x, and the attitude not at all.",
        table=PageTable(heads, rows),
    )
