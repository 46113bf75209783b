"""From a grey picture to the points of light in it."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import SensorNoise
from tracking.candidates import find_candidates
from tracking.centroid import Fit, measure
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.parameters import DetectParameters


def find_spots(
    image: Picture,
    parameters: DetectParameters = DetectParameters(),  # noqa: B008  (frozen)
    noise: SensorNoise | NoiseModel | None = None,
) -> Detections:
    """The spots of a grey picture (h, w), 8 or 16 bit, brightest (by flux) first.

    Without a noise model the background's noise is taken from the picture itself (0.3 ms more); a run does better to
    estimate it once, from several pictures (tracking.noise.estimate_noise).

    Errors: ValueError if the picture is not of that form.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"picture: expected grey (h, w) of uint8 or uint16, got shape {image.shape} of {image.dtype}")
    if not image.size:
        return Detections.none()
    image = np.ascontiguousarray(image)
    if isinstance(noise, SensorNoise):
        noise = NoiseModel.of(noise)
    model = noise or guess_noise(image)
    saturation = parameters.saturation_dn
    if saturation is None:
        saturation = float(np.iinfo(image.dtype).max)
    uv, ground = find_candidates(image, model, parameters.threshold_sigma, 4 * parameters.max_detections)
    uv, ground = uv[: parameters.max_detections], ground[: parameters.max_detections]
    if not len(uv):
        return Detections.none()
    fit = measure(image, uv, ground, model, saturation)
    good = _is_spot(fit, image.shape, parameters)
    good[good] = _is_first(fit.uv_px[good], fit.shape_px2[good], fit.flux[good])
    rows = np.flatnonzero(good)
    return _detections(fit, rows[np.argsort(-fit.flux[rows], kind="stable")])


def _is_spot(fit: Fit, shape: tuple[int, ...], parameters: DetectParameters) -> Bools:
    major, minor, _ = axes(fit.shape_px2)
    sigma = np.sqrt(np.maximum(fit.cov_px2[:, [0, 1], [0, 1]], 0.0))
    size = np.array([shape[1], shape[0]])
    margin = 3 * sigma
    with np.errstate(invalid="ignore"):
        return (
            np.isfinite(fit.cov_px2).all(axis=(1, 2))
            & (fit.flux > parameters.threshold_sigma * fit.sigma_flux)
            & (fit.peak > 0)
            & (major <= parameters.max_sigma_px)
            & (minor >= parameters.min_sigma_px)
            & (fit.explained >= parameters.min_explained)
            & (sigma.max(axis=1) < 0.5 * np.maximum(major, 0.5))
            & (fit.uv_px > -0.5 - margin).all(axis=1)
            & (fit.uv_px < size - 0.5 + margin).all(axis=1)
        )


def _is_first(uv: Array, shape: Array, flux: Array) -> Bools:
    """False where a brighter spot's middle (1.5 sigma) holds the point: one light, found twice."""
    n = len(uv)
    first = np.ones(n, dtype=bool)
    if n < 2:
        return first
    order: Ints = np.argsort(-flux, kind="stable")
    d = uv[:, None, :] - uv[None, :, :]
    uu, uvs, vv = shape[:, 0] + 1 / 12, shape[:, 1], shape[:, 2] + 1 / 12
    inside = (vv * d[..., 0] ** 2 - 2 * uvs * d[..., 0] * d[..., 1] + uu * d[..., 1] ** 2) < 1.5**2 * (uu * vv - uvs**2)
    for place, i in enumerate(order):
        if first[i]:
            later = order[place + 1 :]
            first[later[inside[later, i]]] = False
    return first


def axes(shape_px2: Array) -> tuple[Array, Array, Array]:
    """1-sigma half axes major and minor (n,), px, and the major one's angle (n,), degrees in (-90, 90] from +u to +v.

    shape_px2 (n, 3): covariance as uu, uv, vv.
    """
    uu, uv, vv = shape_px2.T
    middle, gap = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    angle = np.degrees(0.5 * np.arctan2(2 * uv, uu - vv))
    angle = np.where(angle <= -90, angle + 180, angle)
    return np.sqrt(np.maximum(middle + gap, 0.0)), np.sqrt(np.maximum(middle - gap, 0.0)), angle


def _detections(fit: Fit, rows: Ints) -> Detections:
    major, minor, angle = axes(fit.shape_px2[rows])
    return Detections(fit.uv_px[rows], fit.cov_px2[rows], fit.flux[rows], fit.peak[rows], major, minor, angle)
