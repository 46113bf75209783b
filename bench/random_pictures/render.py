"""The pictures of a recording, one after the other, and the signal-to-noise ratio of each spot."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bench.random_pictures.optics import Patch
from bench.random_pictures.scene import PictureScene
from bench.random_pictures.sensors import Light, Picture, compressed, expose
from bench.random_pictures.surroundings import Surroundings, draw_surroundings, gaussian_patch, seen_turned
from bench.random_scenes.scene import SHINING
from geometry.arrays import Array

LEAST_SNR = 11.0  # smallest SNR of the median spot at rest in a matched filter; peaks are raised to it
SURROUNDINGS, AMPLITUDE, CLUTTER, NOISE, FLICKER, SHAKE, BANDS = range(21, 28)  # streams of random numbers


@dataclass(slots=True)
class Renderer:
    """Renders `picture(frame, camera)`; `snr` and `width_px` are filled with each picture."""

    ps: PictureScene
    still: list[Surroundings] = field(init=False)
    peak_e: Array = field(init=False)  # (c,) electrons of a patch of 1 with a power of 1
    clutter_uv: Array = field(init=False)  # (c, m, T, 2) px
    clutter_light: Array = field(init=False)  # (c, m, 2) sigma (px) and electrons at the peak
    ambient: Array = field(init=False)  # (T, c) relative
    laser: Array = field(init=False)  # (T, n) relative
    compression_e2: Array = field(init=False)  # (c,) mean square that a lossy file adds to a pixel
    snr: Array = field(init=False)  # (T, n) in a matched filter; 0 where there is no light, nan where not rendered yet
    width_px: Array = field(init=False)  # (n,) sigma of a spot at rest, mean of both axes

    def __post_init__(self) -> None:
        ps, look = self.ps, self.ps.look
        frames, views = ps.scene.in_view.shape
        cameras = list(ps.scene.rig.cameras.values())
        self.still = [
            draw_surroundings(self._rng(SURROUNDINGS, c), look, camera, ps.scene.rig.screens[camera.screen])
            for c, camera in enumerate(cameras)
        ]
        self.snr = np.full((frames, views), np.nan)
        self.width_px = np.full(views, look.sigma_px)
        self.compression_e2 = np.zeros(len(cameras))
        self._draw_light(frames, views)
        self._draw_amplitudes()
        self._draw_clutter()
        if look.sensor.lossy:
            for c in range(len(cameras)):
                raw = expose(look.sensor, self.still[c].ambient_e + self.still[c].steady_e, self._rng(NOISE, 0, c))
                off = compressed(look.sensor, raw).astype(np.float32) - raw
                self.compression_e2[c] = float(np.mean(off**2)) * look.sensor.gain_e_per_dn**2

    def _rng(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([*self.ps.key, *purpose])

    def _draw_light(self, frames: int, views: int) -> None:
        """Flicker: mains light aliased with the frame rate, and a random part; linear drift. Lasers: 1 %."""
        look, rng = self.ps.look, self._rng(FLICKER)
        t = np.arange(frames)
        cameras = len(self.still)
        beat, phase = rng.uniform(0.01, 0.5), rng.uniform(0, 2 * np.pi)
        wave = np.sin(2 * np.pi * beat * t + phase)[:, None] + 0.3 * rng.normal(size=(frames, cameras))
        self.ambient = 1 + look.flicker * wave + look.drift * (t / max(frames - 1, 1))[:, None]
        self.laser = 1 + 0.01 * rng.normal(size=(frames, views))

    def noise_e(self, camera: int, patch: Patch | None = None) -> Array:
        """Sigma of the pixels of the background with texture, electrons: of a patch, or one value for the picture."""
        look, still = self.ps.look, self.still[camera]
        if patch is None:
            light: Array = np.array(float(np.median(still.ambient_e[::8, ::8])))
        else:
            light = np.asarray(still.ambient_e[patch.where] + still.steady_e[patch.where], dtype=float)
        texture = (look.texture * light) ** 2
        return np.asarray(np.sqrt(look.sensor.variance_e2(light) + texture + self.compression_e2[camera]))

    def _draw_amplitudes(self) -> None:
        """The light for which the median spot of each camera at rest has the given peak."""
        ps, look, scene = self.ps, self.ps.look, self.ps.scene
        self.peak_e = np.zeros(len(self.still))
        for c in range(len(self.still)):
            peaks, norms = [], []
            for i in np.flatnonzero(scene.camera_of == c):
                shown = np.flatnonzero(scene.in_view[:, i])
                if not shown.size:
                    continue
                pose = scene.poses[shown[:1]]
                self.width_px[i] = float(np.sqrt(np.trace(ps.ends[i].covariance_px2(pose)) / 2))
                patch = ps.ends[i].patch(pose)
                if patch is not None and patch.light.max() > 0:
                    peaks.append(float(patch.light.max()) * ps.powers[i])
                    norms.append(float(np.linalg.norm(patch.light)) * ps.powers[i])
            if not peaks:
                continue
            noise = float(self.noise_e(c))
            wanted = look.peak_snr * noise / float(np.median(peaks))
            wanted = min(wanted, look.most_peak * look.sensor.full_well_e / max(peaks))
            self.peak_e[c] = max(wanted, LEAST_SNR * noise / float(np.median(norms)))

    def _draw_clutter(self) -> None:
        """Moving false spots: half of them beside a spot with its motion, half on a straight path."""
        ps, look, rng = self.ps, self.ps.look, self._rng(CLUTTER)
        frames, cameras = len(ps), len(self.still)
        self.clutter_uv = np.zeros((cameras, look.clutter, frames, 2))
        self.clutter_light = np.zeros((cameras, look.clutter, 2))
        for c, camera in enumerate(ps.scene.rig.cameras.values()):
            size = np.array(camera.image_size_px)
            for m in range(look.clutter):
                path = rng.uniform(0, size) + np.linspace(-0.5, 0.5, frames)[:, None] * rng.normal(0, 0.3, 2) * size
                views = np.flatnonzero(ps.scene.camera_of == c)
                followed = ps.scene.uv_px[:, rng.choice(views)] if views.size else np.full((frames, 2), np.nan)
                if rng.random() < 0.5 and np.isfinite(followed).all():
                    turn, away = rng.uniform(0, 2 * np.pi), rng.uniform(15, 80)
                    moved = followed[0] + rng.uniform(0.5, 1.2) * (followed - followed[0])
                    path = moved + away * np.array([np.cos(turn), np.sin(turn)])
                self.clutter_uv[c, m] = path
                peak = min(self.peak_e[c] * 0.8, look.sensor.full_well_e) * np.exp(rng.uniform(-1.5, 0.2))
                self.clutter_light[c, m] = look.sigma_px * np.exp(rng.uniform(-0.3, 0.5)), peak

    def patch(self, k: int, view: int) -> Patch | None:
        """The light of a view in frame k, electrons on the sensor; None where there is none."""
        ps, scene = self.ps, self.ps.scene
        c = int(scene.camera_of[view])
        if ps.hidden[k, view] or np.isnan(scene.uv_px[k, view]).any():
            return None
        during = ps.during(k)
        ends, _ = ps.ends[view].hits(during[np.array([0, -1])])
        if np.linalg.norm(ends[1] - ends[0]) < 1e-6:  # m: at rest
            during = during[ps.parts // 2 : ps.parts // 2 + 1]
        patch = ps.ends[view].patch(during)
        if patch is None:
            return None
        strength = self.peak_e[c] * ps.powers[view] * self.laser[k, view]
        return Patch(patch.u0, patch.v0, patch.light * np.float32(strength) * self.still[c].response[patch.where])

    def expected(self, k: int, camera: int) -> Light:
        """The expected electrons of the pixels, (h, w); fills `snr` of the views of this frame."""
        still, scene = self.still[camera], self.ps.scene
        light = still.ambient_e * self._ambient(k, camera)
        light += still.steady_e
        for view in np.flatnonzero(scene.camera_of == camera):
            patch = self.patch(k, int(view))
            self.snr[k, view] = 0.0
            if patch is not None:
                light[patch.where] += patch.light
                if scene.in_view[k, view] == SHINING:
                    self.snr[k, view] = self._snr(camera, patch)
        for path, (sigma, peak) in zip(self.clutter_uv[camera], self.clutter_light[camera], strict=True):
            u, v = path[k]
            patch = gaussian_patch(u, v, sigma, (light.shape[1], light.shape[0]))
            if patch is not None:
                light[patch.where] += patch.light * np.float32(peak)
        return light

    def _ambient(self, k: int, camera: int) -> Light:
        """The ambient light of the rows (h, 1), relative to the usual one."""
        height = len(self.still[camera].ambient_e)
        periods, of_frame, phase = self._rng(BANDS, camera).uniform([0.0, 0.0, 0.0], [4.0, 1.0, 1.0])
        waves = periods * np.arange(height)[:, None] / height + of_frame * k + phase
        return np.asarray(self.ambient[k, camera] + self.ps.look.bands * np.sin(2 * np.pi * waves), np.float32)

    def _snr(self, camera: int, patch: Patch) -> float:
        """SNR of a matched filter over noise and texture of the background; light above full scale does not count."""
        still, look = self.still[camera], self.ps.look
        background = still.ambient_e[patch.where] + still.steady_e[patch.where]
        signal = np.minimum(patch.light, np.maximum(look.sensor.full_well_e - background, 0.0))
        return float(np.sqrt(np.sum((signal / self.noise_e(camera, patch)) ** 2)))

    def raw(self, k: int, camera: int) -> Picture:
        """Frame k as read from the sensor, before lossy compression."""
        light, rng = self.expected(k, camera), self._rng(NOISE, 1 + k, camera)
        if self.ps.look.shake_px:
            seen_by = list(self.ps.scene.rig.cameras.values())[camera]
            turn = self._rng(SHAKE, k, camera).normal(0.0, self.ps.look.shake_px / seen_by.matrix[0, 0], 3)
            light = seen_turned(light, seen_by, turn)
        for row, column, charge in self.still[camera].blinking:
            if rng.random() < 0.5:
                light[row, column] += charge
        return expose(self.ps.look.sensor, light, rng)

    def picture(self, k: int, camera: int) -> Picture:
        """Frame k as read by the program."""
        return compressed(self.ps.look.sensor, self.raw(k, camera))
