"""The patch of light that a moving beam leaves in one exposure of one camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bench.random_pictures.optics import (
    HALO_WIDTH,
    REACH,
    BeamShape,
    Patch,
    blurred,
    fine_pixels,
    pixel_means,
    samples_per_pixel,
    screen_jacobian,
    screen_points,
)
from bench.random_pictures.sensors import Light
from bench.random_scenes.projection import camera_pixels
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Beam, Screen, Spot

AIRY_SIGMA = 0.42  # sigma of the Gaussian most like the spot of an aperture, in wavelengths times the aperture number


@dataclass(frozen=True, slots=True)
class BeamEnd:
    """One end of a beam that emits light, with its camera and screen."""

    camera: Camera
    screen: Screen
    beam: Beam
    spot: Spot
    shape: BeamShape
    blur_px: float
    speckle: Light | None  # `SPECKLE_PARTS` times as fine as the pixels, periodic, mean 1; None: none
    speckle_parts: int = 2

    def rays(self, world_from_body: Pose) -> tuple[Array, Array, Array]:
        """Of a stack of poses (S,): start (S, 3) m, unit axis (S, 3), two unit vectors across it (S, 2, 3), world."""
        along = self.spot.sign * self.beam.direction / np.linalg.norm(self.beam.direction)
        aside = np.eye(3)[int(np.argmin(np.abs(along)))]
        first = np.cross(along, aside)
        first /= np.linalg.norm(first)
        across = np.stack([first, np.cross(along, first)])
        R = world_from_body.rotation
        return R @ self.beam.point + world_from_body.translation, R @ along, np.einsum("sij,kj->ski", R, across)

    def hits(self, world_from_body: Pose) -> tuple[Array, Array]:
        """The intersection of the axis with the screen: (S, 2) m on the screen, and its distance from the start (S,),
        m.
        """
        start, along, _ = self.rays(world_from_body)
        R, origin = self.screen.world_from_screen.rotation, self.screen.world_from_screen.translation
        reach = ((origin - start) @ R[:, 2]) / (along @ R[:, 2])
        return (start + reach[:, None] * along - origin) @ R[:, :2], reach

    def covariance_px2(self, world_from_body: Pose) -> Array:
        """(2, 2), px^2: of the light in the picture without motion, to first order, for one pose as a stack (1,)."""
        hit, reach = self.hits(world_from_body)
        _, _, across = self.rays(world_from_body)
        J = screen_jacobian(self.camera, self.screen, hit[0])
        R = self.screen.world_from_screen.rotation
        # Screen vectors onto the plane across the beam; its inverse spreads the cross-section over the screen.
        onto = across[0] @ R[:, :2]
        c, s = np.cos(self.shape.turn_rad), np.sin(self.shape.turn_rad)
        turn = np.array([[c, -s], [s, c]])
        sigma = float(self.shape.sigma_at(reach)[0])
        section = turn @ np.diag([sigma**2, (sigma * self.shape.ratio) ** 2]) @ turn.T
        spread = J @ np.linalg.inv(onto)
        return np.asarray(spread @ section @ spread.T + (self.blur_px**2 + 1 / 12) * np.eye(2))

    def patch(self, world_from_body: Pose, parts: int | None = None) -> Patch | None:
        """The light of sub-exposures (S,), their mean; on the axis at the waist a beam has 1. None outside the picture.

        parts: samples per pixel and axis; by default by the spot's width.
        """
        hits, _ = self.hits(world_from_body)
        middle = len(hits) // 2
        covariance = self.covariance_px2(world_from_body[middle : middle + 1])
        if not np.isfinite(covariance).all() or not np.isfinite(hits).all():
            return None
        R, origin = self.screen.world_from_screen.rotation, self.screen.world_from_screen.translation
        uv, good = camera_pixels(self.camera, hits @ R[:, :2].T + origin)
        if not good.all():
            return None
        reach = REACH * (HALO_WIDTH * 0.7 if self.shape.halo else 1.0)
        margin = reach * np.sqrt(np.diag(covariance)) + 2
        size = np.array(self.camera.image_size_px)
        beyond = int(np.ceil(REACH * self.blur_px))  # the lens brings light from beside the picture into it
        low = np.maximum(np.floor(uv.min(axis=0) - margin), -beyond).astype(int)
        high = np.minimum(np.ceil(uv.max(axis=0) + margin) + 1, size + beyond).astype(int)
        first, last = np.maximum(low, 0), np.minimum(high, size)
        if (first >= last).any():
            return None
        narrow = float(np.linalg.eigvalsh(covariance)[0]) - 1 / 12
        own = np.sqrt(max(narrow - self.blur_px**2, 0.0))
        parts = parts or max(
            samples_per_pixel(np.sqrt(narrow), own), self.speckle_parts if self.speckle is not None else 1
        )
        u, v = (fine_pixels(low[i], high[i] - low[i], parts) for i in (0, 1))
        seen = screen_points(self.camera, self.screen, hits[middle], u, v)
        if seen is None:
            return None
        fine = blurred(self._irradiance(world_from_body, *seen), self.blur_px, parts)
        if self.speckle is not None:
            n = len(self.speckle)
            rows, columns = (np.floor(self.speckle_parts * (x + 0.5)).astype(int) % n for x in (v, u))
            fine = fine * self.speckle[np.ix_(rows, columns)]
        (left, top), (right, bottom) = first - low, last - low
        return Patch(int(first[0]), int(first[1]), pixel_means(fine, parts)[top:bottom, left:right])

    def _irradiance(self, world_from_body: Pose, x_m: Array, y_m: Array) -> Light:
        """Mean irradiance of the sub-exposures at points of the screen (h, w), relative to the axis at the waist."""
        R, origin = self.screen.world_from_screen.rotation, self.screen.world_from_screen.translation
        normal = R[:, 2]
        total = np.zeros(x_m.shape)
        starts, axes, across = self.rays(world_from_body)
        for start, axis, (first, second) in zip(starts, axes, across, strict=True):
            from_start = origin - start

            def component(along: Array, shift: Array = from_start) -> Array:
                return np.asarray(x_m * (R[:, 0] @ along) + y_m * (R[:, 1] @ along) + shift @ along)

            a, b, z = component(first), component(second), component(axis)
            # Divergence: beside the axis the direction is axis + across / R(z) with the radius R of the wavefront.
            bend = self.shape.divergence**2 * z / self.shape.sigma_at(z) ** 2
            incidence = np.abs(normal @ axis + bend * (a * (normal @ first) + b * (normal @ second)))
            total += self.shape.irradiance(a, b, z) * incidence
        return np.asarray(total / len(starts), dtype=np.float32)


def draw_speckle(rng: np.random.Generator, contrast: float, grain_px: float) -> Light | None:
    """A periodic field of mean 1 that multiplies laser light, lognormal, twice as fine as the pixels; 512 px wide."""
    if not contrast:
        return None
    field = periodic_field(rng, 1024, 2 * grain_px)
    width = np.sqrt(np.log1p(contrast**2))
    return np.asarray(np.exp(width * field - width**2 / 2), dtype=np.float32)


def draw_developed_speckle(rng: np.random.Generator, patterns: int, grain_px: float, parts: int) -> Light:
    """A periodic field of mean 1: fully developed speckle, `parts` times as fine as the pixels, 1536 samples wide.

    patterns: independent ones of the same mean. Each is the square of a complex field of random phases, of which a
    round aperture lets the low frequencies pass. grain_px: sigma of a Gaussian as wide as the aperture's own spot.
    """
    size, total = 1536, 0.0
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    passed = frequency < AIRY_SIGMA / (2 * grain_px * parts)
    for _ in range(patterns):
        field = np.fft.ifft2(np.fft.fft2(np.exp(2j * np.pi * rng.random((size, size)))) * passed)
        total = total + np.abs(field) ** 2
    return np.asarray(total / np.mean(total), dtype=np.float32)


def periodic_field(rng: np.random.Generator, size: int, sigma: float) -> Light:
    """(size, size): a normal random field of mean 0 and variance 1, smoothed by a Gaussian of sigma samples."""
    margin = int(np.ceil(5 * sigma))
    white = np.pad(rng.standard_normal((size, size), dtype=np.float32), margin, mode="wrap")
    field = cv2.GaussianBlur(white, (2 * margin + 1, 2 * margin + 1), sigma)[margin:-margin, margin:-margin]
    return np.asarray((field - field.mean()) / field.std(), dtype=np.float32)
