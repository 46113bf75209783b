"""Mean residuals and normalised innovations per view, camera and beam, with their sampling uncertainty."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.model_check.linearised_frames import LinearisedFrames, ModelCheckRecording, finite, whitening
from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.uncertainty.chi_square import gamma_quantile

_FEWEST_FRAMES = 8  # with fewer, a scatter or an autocorrelation is meaningless


@dataclass(frozen=True, slots=True)
class NisMean:
    """Mean of the normalised innovations squared over 2: 1 if the covariances of the predictions are correct."""

    mean: float
    low: float  # bounds of the central 95 % for a correct model and this number of independent frames
    high: float


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """Residuals of one view, or of all views of a camera or a beam, against the pose of all other views."""

    name: str  # "right/5", "right", "B"
    frames: int  # with such a residual: the other views determine a pose
    mean_px: Array  # (2,) u, v, weighted by the stated variances; nan without frames
    sigma_of_mean_px: Array  # (2,) from the residuals' own scatter and their correlation in time
    mean_sigmas: Array  # (2,) the mean in stated sigmas of one measurement
    calibration_px: Array  # (2,) 1 sigma of the mean by the calibration's stated errors; 0 where it states none
    scatter: float  # mean squared residual about the mean / 2, in stated variances: 1 if the sigmas are correct
    nis: NisMean | None  # None without predictions and their covariances
    outliers: float  # share of the measurements that are gross outliers
    place_px: Array  # (2,) of one view: mean position of its spot; nan for groups of views


@dataclass(frozen=True, slots=True)
class Statistics:
    """The statistics of all groups."""

    views: tuple[GroupStatistics, ...]
    cameras: tuple[GroupStatistics, ...]
    beams: tuple[GroupStatistics, ...]


@dataclass(frozen=True, slots=True)
class _Groups:
    """What the statistics of every group are computed from: K frames of n views."""

    lin: LinearisedFrames
    uv_px: Array  # (K, n, 2) measured; nan for unused views
    nis: Array | None  # (K, n) normalised innovations squared
    calibration_px: Mapping[str, Array]  # (2,) by `group_key`


def correlation_time(series: Array) -> float:
    """Number of consecutive samples that count as one: 1 + 2 sum of autocorrelations, at least 1.

    series (N, m), mean removed, is pooled over its m columns; nan is ignored. The sum ends at the first pair of
    neighbouring autocorrelations that is not positive (Geyer 1992, Practical Markov chain Monte Carlo, Stat. Sci. 7,
    sec. 3.3: initial positive sequence).
    """
    N = len(series)
    known = np.isfinite(series)
    x = np.where(known, series, 0.0)
    power = float(np.sum(x * x))
    if N < _FEWEST_FRAMES or power <= 0:
        return 1.0
    size = 2 ** int(np.ceil(np.log2(2 * N)))

    def lagged(values: Array) -> Array:
        return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(values, size, axis=0)) ** 2, size, axis=0)[:N].sum(axis=1))

    pairs = np.maximum(lagged(known.astype(float)), 1.0)
    rho = (lagged(x) / pairs) / (power / max(int(known.sum()), 1))
    rho[pairs < _FEWEST_FRAMES] = 0.0
    half = rho[: 2 * (N // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(half <= 0)
    return float(max(1.0, 2 * half[: ends[0] if ends.size else len(half)].sum() - 1))


def nis_band(frames: float) -> tuple[float, float]:
    """Central 95 % interval of the mean of NIS / 2 over independent frames: a gamma distribution of mean 1."""
    shape = max(frames, 1.0)
    return gamma_quantile(0.975, shape) / shape, gamma_quantile(0.025, shape) / shape


def statistics(
    model: SpotModel,
    beam_names: tuple[str, ...],
    recording: ModelCheckRecording,
    lin: LinearisedFrames,
    calibration_px: Mapping[str, Array],
) -> Statistics:
    """Statistics of the linearised frames of a recording. calibration_px: by `group_key`; 0 for missing groups."""
    uv = np.where(lin.used[..., None], recording.uv_px[lin.frames], np.nan)
    groups = _Groups(lin, uv, _nis(recording, lin), calibration_px)

    def group(kind: str, name: str, views: Ints) -> GroupStatistics:
        return _group(group_key(kind, name), name, views, groups)

    return Statistics(
        views=tuple(group("view", f"{c}/{s}", np.array([i])) for i, (c, s) in enumerate(model.views)),
        cameras=tuple(
            group("camera", c, np.flatnonzero(model.camera_of == i)) for i, c in enumerate(model.camera_names)
        ),
        beams=tuple(group("beam", b, np.flatnonzero(model.beam_of == i)) for i, b in enumerate(beam_names)),
    )


def calibration_sigmas_px(
    lin: LinearisedFrames, jacobian: Array, covariance: Array, model: SpotModel, beam_names: tuple[str, ...]
) -> Mapping[str, Array]:
    """By `group_key`, 1 sigma (2,), px, of the group's mean residual that the calibration's stated errors cause.

    jacobian (K, n, 2, p), whitened; covariance (p, p), as the calibration states it.
    """
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if not known.size:
        return {}
    C = covariance[np.ix_(known, known)]

    def sigma(views: Ints) -> Array:
        off, spread = lin.leave_group_out(views, jacobian[..., known])
        weight = _weights(spread)  # the same as in the mean residuals
        total = weight.sum(axis=(0, 1))
        if not (total > 0).all():
            return np.full(2, np.nan)
        mean = np.sum(weight[..., None] * np.where(weight[..., None] > 0, off, 0.0), axis=(0, 1)) / total[:, None]
        return np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", mean, C, mean), 0.0))

    out = {group_key("view", f"{c}/{s}"): sigma(np.array([i])) for i, (c, s) in enumerate(model.views)}
    for i, c in enumerate(model.camera_names):
        out[group_key("camera", c)] = sigma(np.flatnonzero(model.camera_of == i))
    for i, b in enumerate(beam_names):
        out[group_key("beam", b)] = sigma(np.flatnonzero(model.beam_of == i))
    return out


def group_key(kind: str, name: str) -> str:
    """`camera right`: a camera and a beam may have the same name."""
    return f"{kind} {name}"


def _weights(covariance: Array) -> Array:
    """Weights (..., 2) of the u and v residuals from their covariances (..., 2, 2): 1 / variance, 0 for nan."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    good = finite(variance, -1)[..., None]
    return np.where(good, 1.0 / np.where(good, variance, 1.0), 0.0)


def _nis(recording: ModelCheckRecording, lin: LinearisedFrames) -> Array | None:
    """(K, n) normalised innovations squared; nan where there is none."""
    if recording.predicted_px is None or recording.predicted_cov_px2 is None:
        return None
    innovation = recording.uv_px[lin.frames] - recording.predicted_px[lin.frames]
    covariance = recording.cov_px2[lin.frames] + recording.predicted_cov_px2[lin.frames]
    known = lin.used & finite(innovation, -1) & finite(covariance, (-1, -2))
    z = whitening(covariance, known) @ np.where(known[..., None], innovation, 0.0)[..., None]
    return np.where(known, np.sum(z[..., 0] ** 2, axis=-1), np.nan)


def _nis_mean(nis: Array) -> NisMean | None:
    """The mean over K frames and v views, nis (K, v); None if all values are nan."""
    values = nis[np.isfinite(nis)] / 2
    if not values.size:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the mean of a frame without values is nan, as intended
        series = np.asarray(np.nanmean(nis, axis=1)) / 2
    level = float(values.mean())
    return NisMean(level, *nis_band(len(values) / correlation_time((series - np.nanmean(series))[:, None])))


def _group(key: str, name: str, views: Ints, groups: _Groups) -> GroupStatistics:
    lin = groups.lin
    r, spread = lin.leave_group_out(views, lin.residual)
    known = finite(r, -1)
    frames = known.any(axis=1)
    count = int(frames.sum())
    none = np.full(2, np.nan)
    mean, sigma_of_mean, mean_sigmas, scatter = none, none, none, float("nan")
    if count:
        # Weighted: sigmas differ tenfold where spots are smeared, and a few of those would dominate a plain mean.
        weight = _weights(spread)
        mean = np.sum(np.where(known[..., None], weight * r, 0.0), axis=(0, 1)) / weight.sum(axis=(0, 1))
        gap = np.where(known[..., None], r - mean, 0.0)
        # (K, 2): residuals of one frame are correlated, so they are summed before they are squared.
        pull = np.sum(weight * gap, axis=1)
        squares = np.sum(pull**2, axis=0) if count >= _FEWEST_FRAMES else weight.sum(axis=(0, 1))
        correlated = [correlation_time(np.where(frames, pull[:, i], np.nan)[:, None]) for i in (0, 1)]
        sigma_of_mean = np.sqrt(squares * correlated) / weight.sum(axis=(0, 1))
        # In stated sigmas of one measurement, not of its residual, which also contains the noise of the others.
        W = lin.W[:, views][known]
        information = np.diagonal(np.swapaxes(W, -1, -2) @ W, axis1=-2, axis2=-1)
        mean_sigmas = mean * np.sqrt(information.mean(axis=0))
        z = (whitening(spread, known) @ gap[..., None])[known]
        scatter = float(np.sum(z**2) / (2 * len(z)))
    place = groups.uv_px[:, views[0]][lin.used[:, views[0]]] if len(views) == 1 else np.empty((0, 2))
    seen = int((lin.used | lin.outlier)[:, views].sum())
    return GroupStatistics(
        name=name,
        frames=count,
        mean_px=mean,
        sigma_of_mean_px=sigma_of_mean,
        mean_sigmas=mean_sigmas,
        calibration_px=groups.calibration_px.get(key, np.zeros(2)),
        scatter=scatter,
        nis=None if groups.nis is None else _nis_mean(groups.nis[:, views]),
        place_px=place.mean(axis=0) if len(place) else none,
        outliers=float(lin.outlier[:, views].sum() / seen) if seen else 0.0,
    )
