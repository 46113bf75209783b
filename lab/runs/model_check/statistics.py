"""Means of residuals and of normalised innovations, per view, camera and beam, with what chance allows of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.uncertainty.chi_square import gamma_quantile
from lab.runs.model_check.linear import LinearisedFrames
from lab.runs.model_check.recording import ModelCheckRecording, finite, whitening

_FEWEST = 8  # frames below which a scatter or an autocorrelation says nothing


@dataclass(frozen=True, slots=True)
class NisMean:
    """The mean of normalised innovations squared over 2: 1 where the predictions claim what they do."""

    mean: float
    low: float  # where 95 of 100 right models lie, for so many frames that go together as these do
    high: float


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """Residuals of one view, or of all views of a camera or a beam, against the pose of all other views."""

    name: str  # "right/5", "right", "B"
    frames: int  # with such a residual: the other views give a pose
    mean_px: Array  # (2,) u, v, weighted by the claims; nan without frames
    sigma_of_mean_px: Array  # (2,) by the residuals' own scatter and how they go together in time
    mean_sigmas: Array  # (2,) the mean in claimed sigmas of one measurement: what it does to a frame
    calibration_px: Array  # (2,) 1 sigma of the mean that the calibration's claimed errors make; 0 where it claims none
    scatter: float  # mean of squared residuals about their mean / 2, in claimed variances: 1 if the sigmas are true
    nis: NisMean | None  # None without predictions and their covariances
    outliers: float  # share of the measurements that lie grossly elsewhere
    place_px: Array  # (2,) of one view: where its spot lies on average; nan for groups of views

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        nis = None if self.nis is None else {"mean": self.nis.mean, "low": self.nis.low, "high": self.nis.high}
        return {
            "name": self.name,
            "frames": self.frames,
            "mean_px": self.mean_px.tolist(),
            "sigma_of_mean_px": self.sigma_of_mean_px.tolist(),
            "mean_sigmas": self.mean_sigmas.tolist(),
            "calibration_px": self.calibration_px.tolist(),
            "scatter": self.scatter,
            "nis": nis,
            "outliers": self.outliers,
            "place_px": self.place_px.tolist(),
        }


@dataclass(frozen=True, slots=True)
class Statistics:
    """All groups."""

    views: tuple[GroupStatistics, ...]
    cameras: tuple[GroupStatistics, ...]
    beams: tuple[GroupStatistics, ...]

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        return {k: [g.as_mapping() for g in getattr(self, k)] for k in ("views", "cameras", "beams")}


def correlation_time(series: Array) -> float:
    """How many neighbours in time count as one: 1 + 2 sum of autocorrelations, at least 1. series (N, m), mean removed.

    Pooled over the m columns; nan is passed over. The sum ends where a pair of neighbouring autocorrelations is no
    longer positive (Geyer 1992, Practical Markov chain Monte Carlo, Stat. Sci. 7, sec. 3.3: initial positive sequence).
    """
    N = len(series)
    known = np.isfinite(series)
    x = np.where(known, series, 0.0)
    power = float(np.sum(x * x))
    if N < _FEWEST or power <= 0:
        return 1.0
    size = 2 ** int(np.ceil(np.log2(2 * N)))

    def lagged(values: Array) -> Array:
        return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(values, size, axis=0)) ** 2, size, axis=0)[:N].sum(axis=1))

    pairs = np.maximum(lagged(known.astype(float)), 1.0)
    rho = (lagged(x) / pairs) / (power / max(int(known.sum()), 1))
    rho[pairs < _FEWEST] = 0.0
    half = rho[: 2 * (N // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(half <= 0)
    return float(max(1.0, 2 * half[: ends[0] if ends.size else len(half)].sum() - 1))


def nis_band(frames: float) -> tuple[float, float]:
    """Where the mean of NIS / 2 over so many independent frames lies in 95 of 100: a gamma distribution of mean 1."""
    shape = max(frames, 1.0)
    return gamma_quantile(0.975, shape) / shape, gamma_quantile(0.025, shape) / shape


def statistics(
    model: SpotModel,
    beam_names: tuple[str, ...],
    recording: ModelCheckRecording,
    lin: LinearisedFrames,
    calibration_px: Mapping[str, Array],
) -> Statistics:
    """Of the linearised frames of a recording. calibration_px: by `group_key`; what is not there is 0."""
    nis = _nis(recording, lin)
    uv = np.where(lin.used[..., None], recording.uv_px[lin.frames], np.nan)
    arguments = (lin, uv, nis, calibration_px)

    def group(kind: str, name: str, views: Ints) -> GroupStatistics:
        return _group(group_key(kind, name), name, views, *arguments)

    return Statistics(
        views=tuple(group("view", f"{c}/{s}", np.array([i])) for i, (c, s) in enumerate(model.views)),
        cameras=tuple(
            group("camera", c, np.flatnonzero(model.camera_of == i)) for i, c in enumerate(model.camera_names)
        ),
        beams=tuple(group("beam", b, np.flatnonzero(model.beam_of == i)) for i, b in enumerate(beam_names)),
    )


def residual_weights(covariance: Array) -> Array:
    """Of the axes of residuals, (..., 2), from their covariances (..., 2, 2): 1 / variance, 0 where that is nan."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    good = finite(variance, -1)[..., None]
    return np.where(good, 1.0 / np.where(good, variance, 1.0), 0.0)


def group_key(kind: str, name: str) -> str:
    """`camera right`: a camera and a beam may have the same name."""
    return f"{kind} {name}"


def _nis(recording: ModelCheckRecording, lin: LinearisedFrames) -> Array | None:
    """(K, n) normalised innovations squared; nan where there is none."""
    if recording.predicted_px is None or recording.predicted_cov_px2 is None:
        return None
    innovation = recording.uv_px[lin.frames] - recording.predicted_px[lin.frames]
    covariance = recording.cov_px2[lin.frames] + recording.predicted_cov_px2[lin.frames]
    known = lin.used & finite(innovation, -1) & finite(covariance, (-1, -2))
    z = whitening(covariance, known) @ np.where(known[..., None], innovation, 0.0)[..., None]
    return np.where(known, np.sum(z[..., 0] ** 2, axis=-1), np.nan)


def _frame_means(values: Array) -> Array:
    """Means over views (K, v, ...) -> (K, ...); nan where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an empty mean is nan: just that is meant
        return np.asarray(np.nanmean(values, axis=1))


def _group(
    key: str,
    name: str,
    views: Ints,
    lin: LinearisedFrames,
    uv_px: Array,
    nis: Array | None,
    calibration_px: Mapping[str, Array],
) -> GroupStatistics:
    r, spread = lin.against_the_rest(views, lin.residual)
    known = finite(r, -1)
    frames = known.any(axis=1)
    count = int(frames.sum())
    none = np.full(2, np.nan)
    mean, sigma_of_mean, mean_sigmas, scatter = none, none, none, float("nan")
    if count:
        # By their claims: sigmas differ tenfold where spots smear, and a few blurred ones would drown the rest.
        weight = residual_weights(spread)
        mean = np.sum(np.where(known[..., None], weight * r, 0.0), axis=(0, 1)) / weight.sum(axis=(0, 1))
        gap = np.where(known[..., None], r - mean, 0.0)
        pull = np.sum(weight * gap, axis=1)  # (K, 2): what goes together within a frame is summed before it is squared
        squares = np.sum(pull**2, axis=0) if count >= _FEWEST else weight.sum(axis=(0, 1))
        together = [correlation_time(np.where(frames, pull[:, i], np.nan)[:, None]) for i in (0, 1)]
        sigma_of_mean = np.sqrt(squares * together) / weight.sum(axis=(0, 1))
        # In sigmas of one measurement as claimed, not of its residual, which also holds the others' noise.
        W = lin.W[:, views][known]
        information = np.diagonal(np.swapaxes(W, -1, -2) @ W, axis1=-2, axis2=-1)
        mean_sigmas = mean * np.sqrt(information.mean(axis=0))
        z = (whitening(spread, known) @ gap[..., None])[known]
        scatter = float(np.sum(z**2) / (2 * len(z)))
    told = None
    if nis is not None and np.isfinite(nis[:, views]).any():
        series = _frame_means(nis[:, views]) / 2
        values = nis[:, views][np.isfinite(nis[:, views])] / 2
        level = float(values.mean())
        told = NisMean(level, *nis_band(len(values) / correlation_time((series - np.nanmean(series))[:, None])))
    place = uv_px[:, views[0]][lin.used[:, views[0]]] if len(views) == 1 else np.empty((0, 2))
    seen = int((lin.used | lin.outlier)[:, views].sum())
    return GroupStatistics(
        name=name,
        frames=count,
        mean_px=mean,
        sigma_of_mean_px=sigma_of_mean,
        mean_sigmas=mean_sigmas,
        calibration_px=calibration_px.get(key, np.zeros(2)),
        scatter=scatter,
        nis=told,
        place_px=place.mean(axis=0) if len(place) else none,
        outliers=float(lin.outlier[:, views].sum() / seen) if seen else 0.0,
    )
