"""From a grey picture to the points of light in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import SensorNoise
from tracking import ellipses
from tracking.candidates import find_candidates
from tracking.centroid import Measurement, measure
from tracking.compact import compact
from tracking.detections import Detections
from tracking.gaussian_fit import Spots
from tracking.moments import adaptive_moments
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.parameters import DetectParameters

NARROWER = 0.5  # a spot narrower than so much of another one is not that one found again


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
    if not image.flags.c_contiguous:
        image = image.copy()
    if isinstance(noise, SensorNoise):
        noise = NoiseModel.of(noise)
    model = noise or guess_noise(image)
    saturation = parameters.saturation_dn
    if saturation is None:
        saturation = float(np.iinfo(image.dtype).max)
    uv, ground = find_candidates(image, model, parameters.threshold_sigma, parameters.max_detections)
    if not len(uv):
        return Detections.none()
    uv, shape = adaptive_moments(image, uv, ground)
    fit = measure(image, uv, shape, ground, model, saturation, parameters.max_sigma_px)
    good = _is_spot(fit, image.shape, parameters)
    if not good.all():
        # What the fit found to be narrow stays out: a hot pixel is compact and bright, too.
        major, minor, _ = ellipses.axes(shape)
        fits = (minor >= parameters.min_sigma_px) & (major <= parameters.max_sigma_px)
        fits &= ellipses.axes(fit.spots.shape)[1] >= parameters.min_sigma_px
        poor = np.flatnonzero(~good & fits)
        bright, cov, height = compact(image, uv[poor], shape[poor], model, parameters.threshold_sigma)
        rows = poor[bright]
        fit = _with(fit, rows, uv[rows], shape[rows], cov[bright], height[bright])
        good[rows] = True
    good[good] = _is_first(fit.spots.uv[good], fit.spots.shape[good], fit.spots.flux[good])
    rows = np.flatnonzero(good)
    brightest = rows[np.argsort(-fit.spots.flux[rows], kind="stable")]
    return _detections(fit, brightest[: parameters.max_detections])


def _is_spot(fit: Measurement, shape: tuple[int, ...], parameters: DetectParameters) -> Bools:
    major, minor, _ = ellipses.axes(fit.spots.shape)
    sigma = np.sqrt(np.maximum(fit.cov_px2[:, [0, 1], [0, 1]], 0.0))
    size = np.array([shape[1], shape[0]])
    margin = 3 * sigma
    with np.errstate(invalid="ignore"):
        return (
            np.isfinite(fit.cov_px2).all(axis=(1, 2))
            & (fit.spots.flux > parameters.threshold_sigma * fit.sigma_flux)
            & (fit.peak > 0)
            & (major <= parameters.max_sigma_px)
            & (minor >= parameters.min_sigma_px)
            & (fit.explained >= parameters.min_explained)
            & (sigma.max(axis=1) < 0.5 * np.maximum(major, 0.5))
            & (fit.spots.uv > -0.5 - margin).all(axis=1)
            & (fit.spots.uv < size - 0.5 + margin).all(axis=1)
        )


def _with(fit: Measurement, rows: Ints, uv: Array, shape: Array, cov: Array, height: Array) -> Measurement:
    """The measurement with rows for which there are moments only."""

    def put(a: Array, b: Array) -> Array:
        a = a.copy()
        a[rows] = b
        return a

    flux = 2 * np.pi * np.sqrt(ellipses.determinant(shape)) * height
    spots = Spots(put(fit.spots.uv, uv), put(fit.spots.shape, shape), put(fit.spots.flux, flux), fit.spots.plane)
    return replace(fit, spots=spots, cov_px2=put(fit.cov_px2, cov), peak=put(fit.peak, height))


def _is_first(uv: Array, shape: Array, flux: Array) -> Bools:
    """False where the middle (1.5 sigma) of a brighter spot of about its width holds the point: one light, found twice.

    Width matters: a laser spot on a wide diffuse reflection has less flux than that, and is no part of it.
    """
    n = len(uv)
    first = np.ones(n, dtype=bool)
    if n < 2:
        return first
    order: Ints = np.argsort(-flux, kind="stable")
    d = uv[:, None, :] - uv[None, :, :]
    uu, uvs, vv = shape[:, 0] + 1 / 12, shape[:, 1], shape[:, 2] + 1 / 12
    inside = (vv * d[..., 0] ** 2 - 2 * uvs * d[..., 0] * d[..., 1] + uu * d[..., 1] ** 2) < 1.5**2 * (uu * vv - uvs**2)
    area = uu * vv - uvs**2  # sigma^4, px^4
    inside &= area[:, None] > NARROWER**4 * area[None, :]
    for place, i in enumerate(order):
        if first[i]:
            later = order[place + 1 :]
            first[later[inside[later, i]]] = False
    return first


def _detections(fit: Measurement, rows: Ints) -> Detections:
    major, minor, angle = ellipses.axes(fit.spots.shape[rows])
    return Detections(fit.spots.uv[rows], fit.cov_px2[rows], fit.spots.flux[rows], fit.peak[rows], major, minor, angle)
