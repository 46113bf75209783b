"""Detection and tracking of arrays, without files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import RigFile, joint_covariance, load_rig_file
from lab.files.run.run_file import prior_from
from lab.files.text import columns
from lab.files.text.csv_text import is_whole
from lab.files.text.dataclass_fields import with_overrides
from lab.files.text.error_text import suggest_name
from lab.runs.tables import pose_numbers
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detection.detect import find_spots as find_in_picture
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import TrackedFrame

Prior: TypeAlias = PosePrior | Mapping[str, Any] | None
Points: TypeAlias = pd.DataFrame | ArrayLike | None
_SHAPE = columns.DETECTIONS[6:11]  # flux to angle_deg
_TRACKED = ("frame", "t_s", *columns.POSE, "spots_used", "rms_px", "status")


def find_spots(
    picture: Picture, *, noise: NoiseModel | None = None, regions: ArrayLike | None = None, **settings: Any
) -> pd.DataFrame:
    """The spots of a grey picture (h, w), uint8 or uint16, brightest first, with the columns of detections.csv.

    noise: of the camera; None: estimated from this picture. regions (n, 3), px: boxes u, v, half size to search.
    settings: of `detect`, such as threshold_sigma=5. Places are centroids of light in distorted pixels; a run moves
    them to the beams' axes with the rig's model (a few hundredths of a pixel).

    >>> import numpy as np
    >>> v, u = np.mgrid[:40, :60]
    >>> picture = (10 + 150 * np.exp(-((u - 22.3) ** 2 + (v - 17.6) ** 2) / 4)).astype(np.uint8)
    >>> lab.find_spots(picture)[["u_px", "v_px"]].round(1).values.tolist()
    [[22.3, 17.6]]

    Raises:
        InputError: the picture or the regions have another shape or type, or a setting is wrong.
    """
    parameters = _parameters({f"detect.{name}": value for name, value in settings.items()})
    try:
        found = find_in_picture(picture, parameters.detect, noise, regions)
    except ValueError as error:  # the message names the argument, what it expects and what it got
        raise InputError(str(error)) from None
    sigma = np.sqrt(np.diagonal(found.cov_px2, axis1=-2, axis2=-1))
    numbers = (found.uv_px, sigma, *(getattr(found, name) for name in _SHAPE), found.cov_px2[:, 0, 1])
    return pd.DataFrame(np.column_stack(numbers), columns=list(columns.DETECTIONS[2:]))


class Tracker:
    """Labels the spots and estimates the pose, frame by frame, from the points of all cameras.

    >>> import pandas as pd
    >>> prior = {"position_m": [0, 0, 0], "yaw_pitch_roll_deg": [0, 0, 0], "within_m": 0.5, "within_deg": 30}
    >>> tracker = lab.Tracker(run_folder / "rig.yaml", prior=prior)
    >>> first = pd.read_csv(run_folder / "detections.csv").query("frame == 0")
    >>> frame = tracker.step(0.0, {camera: rows for camera, rows in first.groupby("camera")})
    >>> str(frame.pose_status), frame.spots_used
    ('measured', 6)
    """

    def __init__(self, rig: Rig | Path | str, *, prior: Prior = None, covariance: bool = True, **settings: Any) -> None:
        """rig: a rig.yaml, or a rig. prior: where the vehicle is at first, as the `prior` block of a run.yaml; None:
        anywhere, which takes more frames, and more spots than a symmetric rig has.

        covariance: use the calibration's covariance of the rig.yaml, if it has one. settings: tracker parameters, such
        as method="spots".

        Raises:
            InputError: the rig or a setting is wrong.
        """
        file = RigFile(rig) if isinstance(rig, Rig) else load_rig_file(Path(rig))
        self.rig = file.rig
        self.parameters = _parameters(settings)
        known = None
        if covariance and file.covariances:
            known = joint_covariance(self.rig, file.covariances, str(rig))
        start = PosePrior.everywhere(self.rig) if prior is None else prior
        if not isinstance(start, PosePrior):
            start = prior_from(start)
        kind = SpotTracker if self.parameters.method == "spots" else RigidTracker
        self._tracker = kind(self.rig, self.parameters, start, known)

    @property
    def views(self) -> tuple[tuple[str, str], ...]:
        """Camera and spot of each row of a frame's arrays."""
        return SpotModel.of(self.rig).views

    def step(self, dt_s: float, points: Mapping[str, Points], *, sigma_px: float = 0.1) -> TrackedFrame:
        """Process the next frame.

        dt_s: time since the previous one, s; 0 for the first. points: by camera: a frame of `find_spots` or of
        detections.csv, or places (n, 2), px, each with an error of `sigma_px`; None, or a camera left out: it has no
        picture. Returns pose, covariance, and for each of `views` its place and status.

        Raises:
            InputError: the rig has no such camera, or the points have another shape.
        """
        for name in points:
            if name not in self.rig.cameras:
                known = ", ".join(self.rig.cameras)
                raise InputError(
                    f"points: expected cameras of the rig ({known}), got {name!r}{suggest_name(name, self.rig.cameras)}"
                )
        if not (np.isfinite(dt_s) and dt_s >= 0):
            raise InputError(f"dt_s: expected a time of 0 s or more, got {dt_s}")
        found = [_detections(points.get(name), name, sigma_px) for name in self.rig.cameras]
        return self._tracker.step(float(dt_s), found)


def track(
    detections: pd.DataFrame,
    rig: Rig | Path | str,
    *,
    frame_rate_hz: float | None = None,
    prior: Prior = None,
    sigma_px: float = 0.1,
    **settings: Any,
) -> pd.DataFrame:
    """The poses of a table of detections, each from the frames up to it (no smoothing).

    detections: columns frame, camera, u_px, v_px, and t_s unless a frame rate is given; those of detections.csv are
    used where they are there, otherwise every point has an error of `sigma_px`. A camera without rows in a frame, and
    every camera in a frame number without rows, has a picture without points. Returns columns of attitude.csv: a row
    for every frame number with a known time.

    >>> import pandas as pd
    >>> points = pd.read_csv(run_folder / "detections.csv")
    >>> poses = lab.track(points, run_folder / "rig.yaml", frame_rate_hz=100, prior=lab.load(results).prior)
    >>> poses["status"].value_counts().to_dict()
    {'measured': 40}

    Raises:
        InputError: a column is missing, or the rig or a setting is wrong.
    """
    missing = [name for name in ("frame", "camera", "u_px", "v_px") if name not in detections]
    if missing or (frame_rate_hz is None and "t_s" not in detections):
        raise InputError(
            f"detections: expected the columns frame, camera, u_px, v_px, and t_s or a frame rate; got"
            f" {', '.join(map(str, detections.columns))}"
        )
    if frame_rate_hz is not None and not (np.isfinite(frame_rate_hz) and frame_rate_hz > 0):
        raise InputError(f"frame_rate_hz: expected a rate above 0 Hz, got {frame_rate_hz}")
    tracker = Tracker(rig, prior=prior, **settings)
    numbers = detections["frame"].to_numpy(dtype=float)
    if not is_whole(numbers).all():
        raise InputError("detections: frame: expected whole numbers")
    order = np.argsort(numbers, kind="stable")
    numbers, detections = numbers[order], detections.iloc[order]
    rows: list[list[object]] = []
    previous = None
    for frame in range(int(numbers.min()), int(numbers.max()) + 1) if len(numbers) else ():
        here = detections.iloc[slice(*np.searchsorted(numbers, [frame, frame + 1]))]
        if frame_rate_hz is None and not len(here):
            continue  # no time is known
        t_s = frame / frame_rate_hz if frame_rate_hz is not None else float(here["t_s"].iloc[0])
        points = {name: here[here["camera"] == name] for name in tracker.rig.cameras}
        done = tracker.step(0.0 if previous is None else t_s - previous, points, sigma_px=sigma_px)
        previous = t_s
        rows.append([frame, t_s, *_pose_row(done), done.spots_used, done.rms_px, done.pose_status.value])
    return pd.DataFrame(rows, columns=list(_TRACKED))


def _pose_row(done: TrackedFrame) -> list[float]:
    """The columns of the pose of one frame."""
    if done.pose is None or done.pose_covariance is None:
        return [np.nan] * len(columns.POSE)
    one = Pose(done.pose.rotation[None], done.pose.translation[None])
    out: list[float] = pose_numbers(one, done.pose_covariance[None])[0].tolist()
    return out


def _parameters(settings: Mapping[str, Any]) -> TrackerParameters:
    return with_overrides(TrackerParameters(), settings, "settings")


def _detections(points: Points, camera: str, sigma_px: float) -> Detections | None:
    """Points of one camera as the trackers want them. Raises InputError."""
    if points is None:
        return None
    if not (np.isfinite(sigma_px) and sigma_px > 0):
        raise InputError(f"sigma_px: expected an error above 0 px, got {sigma_px}")
    if not isinstance(points, pd.DataFrame):
        uv = _own(points)
        if uv.ndim != 2 or uv.shape[1] != 2 or not np.isfinite(uv).all():
            raise InputError(f"points of {camera}: expected finite places (n, 2), px, got an array of shape {uv.shape}")
        return Detections.at(uv, np.tile(np.eye(2) * sigma_px**2, (len(uv), 1, 1)))
    uv = _own(points[["u_px", "v_px"]])
    if not np.isfinite(uv).all():
        raise InputError(f"points of {camera}: u_px, v_px: expected finite numbers; leave rows without a place out")
    sigma = np.stack([_column(points, name, sigma_px) for name in ("sigma_u_px", "sigma_v_px")], axis=-1)
    cov = sigma[:, :, None] * np.eye(2) * sigma[:, None, :]
    cov[:, 0, 1] = cov[:, 1, 0] = _column(points, "cov_uv_px2", 0.0)
    shape = (_column(points, name, np.nan) for name in _SHAPE)
    found = Detections(uv, cov, *shape)
    return found[np.argsort(-np.nan_to_num(found.flux, nan=np.inf), kind="stable")]


def _own(values: ArrayLike) -> Array:
    """A copy row by row: compiled functions are compiled again for arrays in another order, or that are read-only."""
    return np.array(values, dtype=float, order="C")


def _column(points: pd.DataFrame, name: str, default: float) -> Array:
    """A column (n,), with a default where it or a value of it is missing."""
    if name not in points:
        return np.full(len(points), default)
    values = points[name].to_numpy(dtype=float)
    return np.where(np.isfinite(values), values, default)
