"""A scenario as a run folder on disk: rig.yaml, run.yaml, pictures (or videos, or points) and truth.

For a rig of one's own: the scenario's motion where that rig sees the vehicle, or a recorded one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.visibility import middle_of_view
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import RigFile, load_rig_file, save_rig
from lab.files.run.run_file import save_run
from lab.files.run.truth import read_true_poses, write_true_poses
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.error_text import require_one_of
from lab.pictures.picture_file import GreyPicture
from lab.progress import Progress
from lab.simulate.picture import LaserPowers, Sensor, laser_powers, make_sensor, render
from lab.simulate.points import points_of
from lab.simulate.scenarios import LIGHTS, RIGS, Motion, PriorRegion, Scenario
from lab.simulate.scene import Scene, compose, has_motion, scenario_with, spots_in_view

_SMALLER = 0.8  # each further size of a motion, until it keeps the spots in view
_SIZES = 15  # the last one has a twentieth of the amplitude
_LEAST_SPOTS = 3  # that a pose needs
_NEAR_FIRST_M, _NEAR_FIRST_DEG = 0.3, 15.0  # the prior of a trajectory: what an engineer knows of the first pose
_DRAWS = 1000  # of a motion as it is; one in 75 suits the rig of "four-skew-beams", the least of all scenarios
_DRAWS_OF_A_SIZE = 40  # one in 40 is enough for the 3000 draws of any seed to find one


def placed(scenario: Scenario, rig: Rig, start: Pose | None = None) -> Scenario:
    """The scenario with its motion where a rig sees the vehicle, as large as keeps half of the spots in view.

    A rig whose spots allow the scenario as it is keeps it. start: the middle of the motion; default: that of the rig's
    view. Raises InputError: too few spots are in view there.
    """
    model = SpotModel.of(rig)
    if start is None and has_motion(scenario, model, _DRAWS):
        return scenario
    middle = middle_of_view(rig) if start is None else start
    seen = spots_in_view(model, middle)
    if len(seen) < _LEAST_SPOTS:
        raise InputError(
            f"{'rig' if start is None else 'start'}: expected {_LEAST_SPOTS} spots or more in view at"
            f" {_in_words(middle)}, got {', '.join(seen) if seen else 'none'}; `beampose check` says where each"
            " spot is in view"
        )
    prior = _about(middle, scenario.prior.within_m, scenario.prior.within_deg)
    base = scenario.motion
    if not isinstance(base, Motion):
        raise InputError("start: a recorded motion has its own; omit the start")
    out = replace(
        scenario,
        prior=prior,
        all_in_view_at_start=len(seen) == len(model.spot_names),
        always_in_view=(),
        leaves_and_returns=(),
        spots_in_view=max(_LEAST_SPOTS, (len(seen) + 1) // 2),
    )
    for size in _SMALLER ** np.arange(_SIZES):
        trial = replace(out, motion=base.about((*prior.position_m, *prior.yaw_pitch_roll_deg), float(size)))
        if has_motion(trial, model, _DRAWS_OF_A_SIZE):
            return trial
    raise InputError(
        f"scenario {scenario.name!r}: even with {100 * _SMALLER ** (_SIZES - 1):.0f} % of its motion about"
        f" {_in_words(middle)}, fewer than {out.spots_in_view} spots stay in view; use a wider lens, or state --start"
    )


@dataclass(frozen=True, slots=True)
class RecordedMotion:
    """The motion through stated poses: a cubic spline of the position, and one of the rotation."""

    duration_s: float
    position: CubicSpline
    rotation: RotationSpline

    def drawn(self, rng: np.random.Generator, frame_rate_hz: float) -> RecordedMotion:
        """This motion: nothing of it is random."""
        return self

    def pose(self, t_s: Array) -> Pose:
        """world_from_body, stacked (...), at times (...), s; beyond the ends the vehicle rests there."""
        t = np.clip(np.asarray(t_s, dtype=float), 0.0, self.duration_s)
        turned = self.rotation(t.ravel()).as_matrix().reshape(*t.shape, 3, 3)
        return Pose(turned, self.position(t))

    def bends_s(self, end_s: float) -> Array:
        """The times of corners: none."""
        return np.zeros(0)


def along(scenario: Scenario, path: Path, rig: Rig, frame_rate_hz: float | None = None) -> tuple[Scenario, list[str]]:
    """The scenario along the poses of a table with the columns of truth/pose.csv; and which spots leave the view when.

    The first pose is at the time 0 of the recording, which is as long as the table and has its rate, unless another one
    is stated. Raises InputError: the table is no trajectory, or no spot of the rig is ever in view.
    """
    table = read_true_poses(path)
    if len(table.frame) < 2:
        raise InputError(f"{path}: expected two poses or more, got {len(table.frame)}")
    steps = np.diff(table.t_s)
    if np.any(steps <= 0):
        line = int(np.argmax(steps <= 0)) + 3  # the table's first line is its header
        raise InputError(f"{path}: line {line}: t_s: expected rising times, got {table.t_s[line - 2]:g}")
    t = table.t_s - table.t_s[0]
    rate = 1 / float(np.median(steps)) if frame_rate_hz is None else frame_rate_hz
    turns = Rotation.from_quat(table.quaternion_wxyz[:, [1, 2, 3, 0]])
    motion = RecordedMotion(float(t[-1]), CubicSpline(t, table.position_m), RotationSpline(t, turns))
    out = replace(
        scenario,
        motion=motion,
        frames=int(np.floor(t[-1] * rate + 1e-6)) + 1,
        frame_rate_hz=rate,
        prior=_about(motion.pose(np.zeros(())), _NEAR_FIRST_M, _NEAR_FIRST_DEG),
        all_in_view_at_start=False,
        always_in_view=(),
        leaves_and_returns=(),
        spots_in_view=0,
    )
    return out, _leaving(SpotModel.of(rig), motion, out.frames, rate, path, rig)


def _leaving(model: SpotModel, motion: RecordedMotion, frames: int, rate: float, path: Path, rig: Rig) -> list[str]:
    """A line for each spot that is not in view throughout: when it leaves first, and its share of the frames."""
    t = np.arange(frames) / rate
    seen = model.in_picture(model.project(motion.pose(t))[0])
    if not seen.any():
        raise InputError(
            f"{path}: no spot is in any picture along this trajectory; the rig sees the vehicle best at"
            f" {_in_words(middle_of_view(rig))}"
        )
    out = []
    for i, name in enumerate(model.spot_names):
        views = seen[:, model.spot_of == i].any(axis=1)
        if not views.any():
            out.append(f"spot {name}: never in view")
        elif not views.all():
            k = int(np.argmin(views))
            out.append(f"spot {name}: out of view in frame {k} ({t[k]:.3g} s) and {100 * np.mean(~views):.0f} % of all")
    return out


def _about(pose: Pose, within_m: float, within_deg: float) -> PriorRegion:
    """The region of the first pose about a pose."""
    (x, y, z), (yaw, pitch, roll) = pose.translation.tolist(), np.rad2deg(pose.ypr).tolist()
    return PriorRegion((x, y, z), (yaw, pitch, roll), within_m, within_deg)


def _in_words(pose: Pose) -> str:
    p, ypr = pose.translation + 0.0, np.rad2deg(pose.ypr) + 0.0
    return (
        f"({p[0]:.3g}, {p[1]:.3g}, {p[2]:.3g}) m with yaw, pitch, roll ({ypr[0]:.3g}, {ypr[1]:.3g}, {ypr[2]:.3g}) deg"
    )


# PNG filters do not help with noisy or nearly constant pictures. A 1280x1024 picture with 1 DN of noise: 414 kB in
# 13 ms with these options, 385 kB in 19 ms with the default filters of OpenCV; one of light "quiet": 44 kB in 3 ms,
# against 60 kB in 180 ms with filters and zlib level 9.
_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE,
)  # fmt: skip
_VIDEO_CODEC = "FFV1"  # lossless
_BATCH = 8  # pictures rendered in parallel before they are written to a video


def simulate(
    scenario: str | Scenario,
    out: Path | str,
    *,
    seed: int = 0,
    frames: int | None = None,
    video: bool = False,
    points: bool = False,
    light: str | None = None,
    clutter: float | None = None,
    noise_px: float = 0.1,
    scale: float = 1.0,
    noisy: bool = True,
    threads: int | None = None,
    progress: Progress | None = None,
    rig: Path | str | None = None,
    known_rig: Path | str | None = None,
    start: Pose | None = None,
    trajectory: Path | str | None = None,
    rate_hz: float | None = None,
    exposure_s: float | None = None,
    note: Callable[[str], None] | None = None,
) -> Path:
    """Write one recording of a scenario into a new folder; returns the folder, complete. In Python: `lab.simulate_run`.

    >>> made = lab.simulate_run("sharp-turns", new_folder, frames=3, points=True)
    >>> sorted(path.name for path in made.iterdir())
    ['detections.csv', 'rig.yaml', 'run.yaml', 'truth']

    The same arguments give the same bytes (with the same versions of numpy and OpenCV), and the first frames do not
    depend on the number of frames.

    scenario: a name of SCENARIOS, or a value. frames: default: those of the scenario. video: one lossless video per
    camera instead of PNG files. points: no pictures, but a detections.csv with `noise_px` (1 sigma per axis). light: a
    name of LIGHTS instead of the light of the scenario. clutter: as in simulate_points. scale: 0.5 gives pictures of
    half the width and height. noisy: False: no shot and read noise, only rounding. threads: number of threads that
    render and write pictures. progress: called after each picture. rig: a rig.yaml instead of the rig of the scenario:
    the motion is moved to where that rig sees the vehicle, and as large as keeps half of its spots in view. known_rig:
    the rig.yaml written to the run folder, such as a calibration of that rig; default: the true one. start: the middle
    of the motion, instead of that of the rig's view. trajectory: a table of poses (columns of truth/pose.csv) instead
    of the scenario's motion, with its rate and length. rate_hz, exposure_s: instead of those of the scenario or the
    trajectory. note: called with a line for each spot that leaves the view of a trajectory. Raises InputError: an
    argument is not valid, or the folder exists.
    """
    if scale != 1.0 and (rig is not None or known_rig is not None):
        raise InputError("the pictures of a rig file keep its size: omit the scale or the rig")
    if not 0.05 <= scale <= 4.0:
        raise InputError(f"scale: expected 0.05 to 4, got {scale:g}")
    true_file = None if rig is None else load_rig_file(Path(rig))
    true_rig = None if true_file is None else true_file.rig
    known = None if known_rig is None else load_rig_file(Path(known_rig))
    if start is not None and trajectory is not None:
        raise InputError("a trajectory states where the vehicle is; omit the start or the trajectory")
    scenario = _with_light(scenario_with(scenario, clutter=clutter), light)
    seen_by = RIGS[scenario.rig]() if true_rig is None else true_rig
    if trajectory is not None:
        scenario, notes = along(scenario, Path(trajectory), seen_by, rate_hz)
        if note is not None:
            for line in notes:
                note(line)
    elif true_rig is not None or start is not None:
        scenario = placed(scenario, seen_by, start)
    scenario = scenario_with(scenario, frame_rate_hz=rate_hz, exposure_s=exposure_s)
    if video:
        _check_video(scenario, points)
    with atomic_folder(Path(out), lambda _: False) as folder:
        scene = compose(scenario, seed, frames, scale, true_rig)
        if known is not None and SpotModel.of(known.rig).views != scene.model.views:
            raise InputError(f"{known_rig}: expected the cameras and spots of the rig that is recorded, got others")
        forms = {} if true_file is None else true_file.measured_as
        save_rig(RigFile(scene.rig, measured_as=forms) if known is None else known, folder / "rig.yaml")
        write_truth(scene, folder / "truth")
        if points:
            _write_detections(scene, noise_px, folder / "detections.csv")
            sources = {name: {"detections": "detections.csv"} for name in scene.model.camera_names}
        else:
            write = _write_videos if video else _write_pictures
            sources = write(scene, folder, noisy, threads, progress)
        save_run(_run_mapping(scene, sources, known), folder)
    return Path(out)


simulate_run = simulate  # its name in `lab`


def _with_light(scenario: Scenario, light: str | None) -> Scenario:
    """The scenario with a light of LIGHTS; None: with its own."""
    if light is None:
        return scenario
    require_one_of("light", light, LIGHTS)
    return replace(scenario, light=LIGHTS[light])


def _check_video(scenario: Scenario, points: bool) -> None:
    if points:
        raise InputError("a recording is a video or points, not both; choose one")
    if scenario.faults:
        raise InputError(
            f"scenario {scenario.name!r} has missing or damaged pictures, which a video cannot contain; write PNG files"
        )
    if scenario.light.bits > 8:
        raise InputError("a video contains 8-bit pictures; write pictures with more bits as PNG files")


def _run_mapping(scene: Scene, sources: dict[str, dict[str, str]], known: RigFile | None) -> dict[str, object]:
    prior = scene.scenario.prior
    # The date of a simulated run is that of the calibration of its rig.
    state = None if known is None else known.calibration
    day = {} if state is None else {"recorded": state.date.isoformat()}
    return {
        **day,
        "name": f"{scene.scenario.name}-{scene.seed}",
        "rig": "rig.yaml",
        "frame_rate_hz": scene.scenario.frame_rate_hz,
        "exposure_s": scene.scenario.light.exposure_s,
        "cameras": {name: {**source, **_clock(scene.scenario, name)} for name, source in sources.items()},
        "prior": {
            "position_m": list(prior.position_m),
            "yaw_pitch_roll_deg": list(prior.yaw_pitch_roll_deg),
            "within_m": prior.within_m,
            "within_deg": prior.within_deg,
        },
        "notes": f"Simulated, seed {scene.seed}. {scene.scenario.summary}",
    }


def _clock(scenario: Scenario, camera: str) -> dict[str, float]:
    """The clock of a camera for run.yaml; empty where it is the run's."""
    for timing in scenario.clocks:
        if timing.camera == camera:
            stated = {
                "time_offset_s": timing.late_frames / scenario.frame_rate_hz,
                "row_time_s": timing.row_time_s,
            }
            return {key: value for key, value in stated.items() if value}
    return {}


def write_truth(scene: Scene, folder: Path) -> None:
    """Write truth/pose.csv and truth/spots.csv with every frame, also those without pictures."""
    folder.mkdir(parents=True)
    write_true_poses(folder / "pose.csv", scene.frame, scene.t_s, scene.poses)
    write_table(
        folder / "spots.csv",
        columns.TRUTH_SPOTS,
        (
            (k, camera, spot, *("" if np.isnan(x) else f"{x:.7f}" for x in scene.uv_px[k, i]), scene.in_view[k, i])
            for k in scene.frame
            for i, (camera, spot) in enumerate(scene.model.views)
        ),
    )


def _write_detections(scene: Scene, noise_px: float, path: Path) -> None:
    run = points_of(scene, noise_px)

    def rows() -> Iterator[tuple[object, ...]]:
        for k, pictures in enumerate(run.detections):
            for camera, found in zip(run.model.camera_names, pictures, strict=True):
                for uv, cov in zip(found.uv_px, found.cov_px2, strict=True):
                    sigmas = np.sqrt(np.diagonal(cov))
                    numbers = (f"{uv[0]:.5f}", f"{uv[1]:.5f}", f"{sigmas[0]:.5g}", f"{sigmas[1]:.5g}")
                    yield (k, camera, *numbers, "", "", "", "", "", f"{cov[0, 1]:.5g}")

    write_table(path, columns.DETECTIONS, rows())


def _workers(threads: int | None) -> int:
    return threads if threads is not None else min(4, os.cpu_count() or 1)


def _sensors(scene: Scene) -> tuple[list[Sensor], LaserPowers]:
    return [make_sensor(scene, c) for c in range(len(scene.model.camera_names))], laser_powers(scene)


def _write_pictures(
    scene: Scene, folder: Path, noisy: bool, threads: int | None, progress: Progress | None
) -> dict[str, dict[str, str]]:
    """Write frames/CAMERA/NNNNNN.png with the faults of the scenario."""
    sensors, powers = _sensors(scene)
    names = scene.model.camera_names
    for name in names:
        (folder / "frames" / name).mkdir(parents=True)
    faults = {(f.frame, f.camera or name): f.kind for f in scene.scenario.faults for name in names}

    def one(job: tuple[int, Sensor]) -> None:
        k, sensor = job
        name = names[sensor.camera]
        fault = faults.get((k, name))
        if fault == "dropped":
            return
        picture = render(scene, sensor, powers, k, noisy=noisy)
        if fault == "wrong size":
            picture = picture[: picture.shape[0] // 2, : picture.shape[1] // 2]
        data = cv2.imencode(".png", picture, _PNG)[1].tobytes()
        if fault == "truncated":
            data = data[: len(data) // 2]
        (folder / "frames" / name / f"{k:06d}.png").write_bytes(data)

    jobs = [(int(k), sensor) for k in scene.frame for sensor in sensors]
    with ThreadPoolExecutor(_workers(threads)) as pool:
        try:
            for done, _ in enumerate(pool.map(one, jobs), start=1):
                if progress is not None:
                    progress(done, len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {name: {"frames": f"frames/{name}"} for name in names}


def _write_videos(
    scene: Scene, folder: Path, noisy: bool, threads: int | None, progress: Progress | None
) -> dict[str, dict[str, str]]:
    """Write CAMERA.avi; its n-th picture is frame n."""
    sensors, powers = _sensors(scene)
    names = scene.model.camera_names
    done = 0
    with ThreadPoolExecutor(_workers(threads)) as pool:
        for sensor in sensors:
            path = folder / f"{names[sensor.camera]}.avi"
            writer = cv2.VideoWriter(
                str(path), cv2.VideoWriter.fourcc(*_VIDEO_CODEC), scene.scenario.frame_rate_hz, sensor.size_px, False
            )
            if not writer.isOpened():
                raise InputError(f"{path.name}: this OpenCV cannot write {_VIDEO_CODEC} video; write PNG files instead")

            def picture(k: int, sensor: Sensor = sensor) -> GreyPicture:
                return render(scene, sensor, powers, k, noisy=noisy)

            try:
                for first in range(0, len(scene.frame), _BATCH):
                    for image in pool.map(picture, range(first, min(first + _BATCH, len(scene.frame)))):
                        writer.write(image)
                        done += 1
                        if progress is not None:
                            progress(done, len(sensors) * len(scene.frame))
            finally:
                writer.release()
    return {name: {"frames": f"{name}.avi"} for name in names}
