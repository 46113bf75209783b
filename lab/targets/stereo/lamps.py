"""`beampose track lamps`: the pose of a target with lamps, from the pictures of one calibrated camera (Fu 2016)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import evenly_spread
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.project.project import load_lens
from lab.files.rig.camera_file import CameraFile, require_valid_calibration
from lab.files.text import columns
from lab.files.text.error_text import require_one_of
from lab.findings.finding import Finding, Level, finding, level_above, passed
from lab.number_format import format_length, format_number
from lab.pictures.source import open_inputs
from lab.progress import Progress
from lab.report.page import Section
from lab.runs.frames.sensor_noise import noise_pictures
from lab.runs.processed import quantiles
from lab.runs.tables import pose_numbers
from lab.targets.page import TimeAxis
from lab.targets.recording import DEFAULT_RATE_HZ
from lab.targets.stereo.page import pose_section
from lab.targets.stereo.process import contradiction
from lab.targets.stereo.run import GOOD_NOISE_SCALE, LARGEST_NOISE_SCALE, load_lamps, noise_scale
from lab.targets.stereo.tables import attitude_row, covariance_rows
from lab.targets.target import Codes, Target, Track, TrackOptions, header_rate, track_pictures
from tracking.binocular.calibration_check import MOST_FRAMES, CalibrationCheck, LabelledFrame, check_calibration
from tracking.binocular.lamp_tracker import LampFrame, LampTracker, harris_corners
from tracking.binocular.marker_model import MarkerImages, MatchParameters
from tracking.detection.detect import find_spots
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.photon_transfer import estimate_noise
from tracking.statuses import PoseStatus

_MOST_LIGHTS = 60  # of a picture; the strongest


def spots(picture: Picture, noise: NoiseModel | None = None) -> MarkerImages:
    """The spots of light of a picture, those of the highest peak first.

    noise: that of the recording, with the texture of its background; None: that of this picture, without it.
    """
    found = find_spots(picture, noise=noise)
    rows = np.argsort(-found.peak, kind="stable")[:_MOST_LIGHTS]
    n = len(rows)
    return MarkerImages(found.uv_px[rows], found.cov_px2[rows], np.full(n, np.nan), np.zeros(n, dtype=np.int64))


# Name for --detector: what finds lights in a picture, given the noise of the recording.
DETECTORS: Mapping[str, Callable[[Picture, NoiseModel | None], MarkerImages]] = {
    "spots": spots,
    "harris": lambda picture, _: harris_corners(picture),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LampsOptions(TrackOptions):
    """Which lamps to track, seen by which camera, and how."""

    target: Path  # a file with `markers:`
    camera: Path  # a camera.yaml, or a file of another program
    camera_name: str | None = None  # where that file has several
    detector: str = "spots"

    def lens(self) -> CameraFile:
        """The camera.

        Raises InputError: the file cannot be used, or there is no such detector; CalibrationError: its calibration
        failed, or is out of date.
        """
        require_one_of("--detector", self.detector, DETECTORS)
        lens = load_lens(self.camera, self.camera_name)
        require_valid_calibration(lens.calibration, self.camera)
        return lens


class LampsTarget(Target[LampFrame]):
    """Lamps at known places of a body."""

    schema, table, columns = "beampose/lamps/1", "attitude.csv", columns.ATTITUDE
    subject, several = "target", "several poses that explain the lights"
    codes = Codes(none="BP-J01", few="BP-J02", missing="BP-J03", ambiguous="BP-J04", far="")
    options: LampsOptions

    def __init__(self, options: LampsOptions) -> None:
        self.options, self._lens, self._model = options, options.lens(), load_lamps(options.target)
        of_lens = self._lens.covariance
        self._covariance = (
            None
            if of_lens is None
            else RigCovariance(tuple(f"cameras.{self._lens.name}.{p}" for p in of_lens.names), of_lens.matrix)
        )

        self._check: CalibrationCheck | None = None  # of the lens, with the recording that was read

    def read(self, path: Path, progress: Progress | None) -> Track[LampFrame]:
        inputs = open_inputs([path])
        rate = self.options.rate_hz or header_rate(inputs) or DEFAULT_RATE_HZ
        seen = noise_pictures(inputs)
        # Without it the texture of ground counts as lights, and each costs a fit.
        noise = estimate_noise(seen).model if seen else None
        detector = DETECTORS[self.options.detector]
        tracker = LampTracker(
            self._lens.camera(), self._model, lambda picture: detector(picture, noise), 1 / rate, self._covariance
        )
        track = track_pictures(path, tracker.step, self.options, progress)
        measured = [f.tracked for f in track.frames if f.status is PoseStatus.MEASURED]
        some = [measured[k] for k in evenly_spread(np.arange(len(measured)), MOST_FRAMES).tolist()]
        labelled = [LabelledFrame(t.observed, t.pose) for t in some if t.observed is not None and t.pose is not None]
        self._check = check_calibration(tracker.pair, self._model, labelled)
        if track.recording.size_px != self._lens.image_size_px:
            expected, got = (
                "{} x {} px".format(*(size or ())) for size in (self._lens.image_size_px, track.recording.size_px)
            )
            raise InputError(f"{path}: expected pictures of {expected}, as of {self.options.camera.name}, got {got}")
        return track

    def row(self, track: Track[LampFrame], k: int) -> list[object]:
        number, rate_hz = int(track.recording.numbers[k]), track.recording.rate_hz
        assert rate_hz is not None  # assumed where it is not stated
        return attitude_row(number, number / rate_hz, track.frames[k].tracked)

    def more_tables(self, track: Track[LampFrame]) -> Mapping[str, tuple[Sequence[str], Iterable[list[object]]]]:
        numbered = zip(track.recording.numbers.tolist(), track.frames, strict=True)
        rows = covariance_rows((number, 0.0, frame.tracked) for number, frame in numbered)
        return {"covariance.csv": (columns.COVARIANCE, rows)}

    def findings(self, track: Track[LampFrame]) -> list[Finding]:
        """Residuals that contradict their sigmas or the lens, and a camera that states no covariance."""
        out, scale = [], _noise_scale(track)
        if np.isfinite(scale):
            what = f"residuals are {format_number(scale)} times as large as the stated sigmas of the lamps"
            out.append(finding("BP-J05", level_above(scale, GOOD_NOISE_SCALE, LARGEST_NOISE_SCALE), what))
        if (check := self._check) is not None and check.significant:
            of_lens = tuple(s for s in check.suspects if s.name.endswith(f"of {self._lens.name}"))
            level, what = contradiction(replace(check, suspects=of_lens), self.options.camera.name)
            out.append(finding("BP-J07", level, what))
        elif check is not None and not check.certain:
            words = f"an error of the focal length below {check.hidden_focal_percent:.2g} % would not show"
            out.append(passed(f"the lamps show no error of {self.options.camera.name}; {words}"))
        if self._covariance is None:
            what = f"{self.options.camera.name} states no covariance of the lens"
            out.append(finding("BP-J06", Level.WARN, what))
        return out

    def figures(self, track: Track[LampFrame]) -> dict[str, Any]:
        sigma = _sigmas(track)[track.measured]
        block = {
            "lamps": list(self._model.names),
            "sigma_position_m": quantiles(np.linalg.norm(sigma[:, :3], axis=1)),
            "sigma_rotation_deg": quantiles(np.linalg.norm(sigma[:, 3:], axis=1)),
            "noise_scale": _noise_scale(track),
        }
        return {"target": block}

    def parameters(self) -> dict[str, Any]:
        options = {name: str(v) if isinstance(v, Path) else v for name, v in asdict(self.options).items()}
        return {"options": options, "match": asdict(MatchParameters())}

    def method(self) -> str:
        return f"Fu et al. (2016): lights by {self.options.detector}, poses of three lamps tested against all lights"

    def key_figures(self, track: Track[LampFrame]) -> list[tuple[str, str, str]]:
        sigma = np.nanmedian(_sigmas(track)[track.measured], axis=0)
        turn = f"± {format_number(float(np.linalg.norm(sigma[3:])), 2)} deg"
        return [
            ("Position", f"± {format_length(float(np.linalg.norm(sigma[:3])))}", "median sigma, all axes together"),
            ("Attitude", turn, "median sigma, all angles together"),
        ]

    def sections(self, track: Track[LampFrame]) -> list[Section]:
        words = (
            "Pose of the target in the camera's frame: x to the right, y down, z ahead. Yaw, pitch and roll turn about"
            " z, y and x, in this order"
        )
        return [pose_section(TimeAxis.of(track), [f.tracked for f in track.frames], words)]


def _sigmas(track: Track[LampFrame]) -> np.ndarray:
    """(n, 6): sigmas of x, y, z (m), yaw, pitch, roll (deg); nan without a pose."""
    out = np.full((len(track.frames), 6), np.nan)
    for k, frame in enumerate(track.frames):
        if frame.tracked.pose is not None and frame.tracked.covariance is not None:
            out[k] = pose_numbers(frame.tracked.pose, frame.tracked.covariance)[10:]
    return out


def _noise_scale(track: Track[LampFrame]) -> float:
    measured = (f.tracked.fit for f in track.frames if f.status is PoseStatus.MEASURED)
    return noise_scale([fit for fit in measured if fit is not None])
