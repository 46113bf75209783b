"""The appearance of a recording: light, surface, defects, sensor and motion, random or of one of FAMILIES."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bench.random_pictures.sensors import Sensor, draw_sensor


@dataclass(frozen=True, slots=True)
class Look:
    """The appearance of the pictures of a scene. Light is a share of the sensor range from black to full scale."""

    sensor: Sensor
    sigma_px: float  # of the spots, with lens, beam and pixel
    blur_px: float  # of the lens
    ratio: float  # of the beams' axes
    flat: int  # 1: Gaussian, otherwise a flat top
    halo: float  # share of the peak
    divergence: float  # share of the width of the beam on the screen due to divergence
    peak_snr: float  # of the median spot at rest, over the noise of the background with its texture
    most_peak: float  # upper limit of the light of a peak
    power_spread: float  # largest relative difference of the beams
    background: float  # at the middle of the picture
    gradient: float  # share, from edge to edge
    vignetting: float  # share lost in the corners
    texture: float  # contrast of the surface
    texture_grain_px: float
    speckle: float  # contrast, for laser light only
    speckle_grain_px: float  # 1 sigma
    flicker: float  # of the ambient light, share
    drift: float  # of the ambient light over the recording, share
    reflections: int  # wide humps per picture
    details: int  # small bright or black details per picture
    screen_edge: bool
    hot_pixels: int  # per picture
    clutter: int  # moving false spots per picture
    exposure_share: float  # of the frame interval
    fastest_px: float  # per frame
    least_streak_px: float = 0.0  # of the longest streak
    motion: str = ""  # of bench.random_scenes.draw.motions; empty: any
    hidden: bool = True  # with occlusions and missing pictures
    plain_rig: bool = False  # the rig of the paper at 1280 x 1024
    shake_px: float = 0.0  # rotation of each camera in each picture, about each axis, times its focal length; rms
    bands: float = 0.0  # of the ambient light, share: lamps that flicker while the sensor reads its rows; amplitude
    patterns: int = 0  # independent ones in fully developed speckle, of contrast 1 / sqrt(patterns); 0: none
    photograph: float = 0.0  # share of the laser light that the darkest place of a photograph takes; 0: no photograph

    @property
    def text(self) -> str:
        """A short description."""
        parts = [
            f"sigma {self.sigma_px:.2g} px (lens {self.blur_px:.2g})",
            f"peak {self.peak_snr:.3g} x noise, <= {self.most_peak:.2g} of scale",
            f"background {self.background:.2g} gradient {self.gradient:.2g} vignetting {self.vignetting:.2g}",
        ]
        shape = ("flat top" if self.flat > 1 else "") + (f" ratio {self.ratio:.2g}" if self.ratio < 1 else "")
        parts += [shape.strip()] if shape.strip() else []
        parts += [f"halo {self.halo:.2g}"] if self.halo else []
        parts += [f"texture {self.texture:.1%} grain {self.texture_grain_px:.1f} px"] if self.texture else []
        contrast = self.patterns**-0.5 if self.patterns else self.speckle
        parts += [f"speckle {contrast:.2g} grain {self.speckle_grain_px:.1f} px"] if contrast else []
        parts += [f"flicker {self.flicker:.1%}"] if self.flicker else []
        parts += [f"drift {self.drift:.1%}"] if self.drift else []
        for count, what in ((self.reflections, "reflections"), (self.details, "details"), (self.hot_pixels, "hot px")):
            parts += [f"{count} {what}"] if count else []
        parts += ["screen edge"] if self.screen_edge else []
        parts += ["in front of a photograph"] if self.photograph else []
        parts += [f"bands of {self.bands:.1%}"] if self.bands else []
        parts += [f"shakes by {self.shake_px:.2g} px"] if self.shake_px else []
        parts += [f"{self.clutter} moving clutter"] if self.clutter else []
        parts += [f"exposure {self.exposure_share:.2g} of a frame"]
        return f"{self.sensor.text}; {', '.join(parts)}"


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sometimes(rng: np.random.Generator, chance: float, low: float, high: float) -> float:
    """Zero, or with this probability a value between the limits."""
    value = float(rng.uniform(low, high))
    return value if rng.random() < chance else 0.0


def mixed_look(rng: np.random.Generator) -> Look:
    """All properties random and independent."""
    sigma = _log(rng, 0.5, 20.0) if rng.random() < 0.6 else _log(rng, 0.8, 3.0)
    full = rng.random() < 0.15
    return Look(
        sensor=draw_sensor(rng),
        sigma_px=sigma,
        blur_px=min(float(rng.uniform(0.3, 0.9)), 0.8 * sigma),
        ratio=1.0 if rng.random() < 0.7 else float(rng.uniform(0.5, 1.0)),
        flat=1 if rng.random() < 0.85 else int(rng.integers(2, 4)),
        halo=_sometimes(rng, 0.2, 0.003, 0.02) if sigma < 4 else 0.0,
        divergence=float(rng.uniform(0, 1)),
        peak_snr=_log(rng, 4, 400),
        most_peak=float(rng.uniform(1.2, 4.0)) if full else 0.9,
        power_spread=float(rng.uniform(0, 0.4)),
        background=float(rng.uniform(0, 0.05)) if rng.random() < 0.4 else float(rng.uniform(0, 0.31)),
        gradient=_sometimes(rng, 0.7, 0, 0.8),
        vignetting=_sometimes(rng, 0.7, 0, 0.5),
        texture=_sometimes(rng, 0.7, 0, 0.06),
        texture_grain_px=_log(rng, 0.5, 6),
        speckle=_sometimes(rng, 0.5, 0.02, 0.3),
        speckle_grain_px=_log(rng, 0.4, 2),
        flicker=_sometimes(rng, 0.6, 0, 0.03),
        drift=_sometimes(rng, 0.4, -0.2, 0.2),
        reflections=int(rng.integers(0, 4)) if rng.random() < 0.5 else 0,
        details=int(rng.integers(1, 12)) if rng.random() < 0.5 else 0,
        screen_edge=bool(rng.random() < 0.3),
        hot_pixels=int(rng.integers(0, 30)) if rng.random() < 0.6 else 0,
        clutter=int(rng.integers(1, 3)) if rng.random() < 0.25 else 0,
        exposure_share=_log(rng, 0.01, 0.9),
        fastest_px=30.0 if rng.random() < 0.85 else 60.0,
    )


def plain_look(rng: np.random.Generator) -> Look:
    """The base of the families: 8 bits, clear spots of 1 to 3 px, few disturbances; a family adds its difficulty."""
    return replace(
        mixed_look(rng),
        sensor=replace(draw_sensor(rng, "8"), row_e=0.0),
        sigma_px=_log(rng, 0.9, 3.0), blur_px=float(rng.uniform(0.3, 0.7)), ratio=1.0, flat=1, halo=0.0,
        peak_snr=_log(rng, 30, 200), most_peak=0.8, background=float(rng.uniform(0.03, 0.12)), gradient=0.2,
        vignetting=0.2, texture=_sometimes(rng, 0.5, 0, 0.02), speckle=0.0, flicker=_sometimes(rng, 0.5, 0, 0.01),
        drift=0.0, reflections=0, details=0, screen_edge=False, hot_pixels=int(rng.integers(0, 6)), clutter=0,
        exposure_share=0.05, fastest_px=20.0, hidden=False,
    )  # fmt: skip


def _issue(rng: np.random.Generator, look: Look) -> Look:
    """1280 x 1024, peaks of 150 DN on 18 DN, noise 1 DN: the first noise estimate failed on such pictures."""
    full_well = float(rng.uniform(6_000, 12_000))  # with 2 to 4 electrons of read noise: about 1 DN at the background
    sensor = Sensor(8, full_well, 0.7 * full_well / 255, 8 / 255)
    return replace(
        look, sensor=sensor, sigma_px=float(rng.uniform(0.9, 1.1)), blur_px=0.5, peak_snr=150, most_peak=0.61,
        power_spread=0.1, background=10 / 247, gradient=0.1, texture=0.04, texture_grain_px=_log(rng, 0.5, 3),
        hot_pixels=12, flicker=0.02, exposure_share=0.05, plain_rig=True, hidden=bool(rng.random() < 0.5),
    )  # fmt: skip


def _clutter(rng: np.random.Generator, look: Look) -> Look:
    return replace(look, details=int(rng.integers(6, 20)), reflections=3, clutter=int(rng.integers(1, 4)),
                   screen_edge=True, hot_pixels=20)  # fmt: skip


def _photographs(rng: np.random.Generator, look: Look) -> Look:
    return replace(
        look, photograph=0.6, background=40 / 255, gradient=0.0, vignetting=0.0, texture=0.0, flicker=0.0,
        sensor=replace(look.sensor, full_well_e=float(rng.uniform(8e3, 15e3)), read_e=4.0),
        peak_snr=_log(rng, 40, 150), hot_pixels=0,
    )  # fmt: skip


FAMILIES: dict[str, Callable[[np.random.Generator, Look], Look]] = {
    "issue": _issue,
    "faint": lambda r, k: replace(k, peak_snr=_log(r, 4, 9), sigma_px=_log(r, 1.0, 3.0)),
    "faint-on-texture": lambda r, k: replace(
        k, peak_snr=_log(r, 2.5, 5), sigma_px=_log(r, 1.2, 2.5), texture=float(r.uniform(0.03, 0.06)),
        texture_grain_px=_log(r, 0.5, 1.5), background=float(r.uniform(0.06, 0.15)), motion="sines",
    ),
    "saturated": lambda r, k: replace(k, peak_snr=1e4, most_peak=float(r.uniform(1.2, 4.0)), sigma_px=_log(r, 0.9, 6)),
    "still": lambda r, k: replace(k, motion="rest", texture=0.04, texture_grain_px=_log(r, 0.7, 4)),
    "slow": lambda r, k: replace(
        k, motion="sines", fastest_px=_log(r, 0.1, 7), texture=0.04, texture_grain_px=_log(r, 0.7, 4)
    ),
    "streaks": lambda r, k: replace(
        k, exposure_share=float(r.uniform(0.4, 0.9)), fastest_px=float(r.uniform(12, 30)), least_streak_px=5.0,
        motion="sines",
    ),
    "wide": lambda r, k: replace(k, sigma_px=_log(r, 5, 20), divergence=float(r.uniform(0.5, 1))),
    "small": lambda r, k: replace(k, sigma_px=_log(r, 0.5, 0.8), blur_px=0.35),
    "textured": lambda r, k: replace(k, texture=float(r.uniform(0.03, 0.06)), texture_grain_px=_log(r, 0.5, 6)),
    "speckled": lambda r, k: replace(k, speckle=float(r.uniform(0.1, 0.3)), speckle_grain_px=_log(r, 0.4, 2)),
    "jpeg": lambda r, k: replace(k, sensor=draw_sensor(r, "jpg")),
    "mjpg": lambda r, k: replace(k, sensor=draw_sensor(r, "mjpg")),
    "12-bit-in-16": lambda r, k: replace(k, sensor=draw_sensor(r, "12in16"), texture=0.04 * r.random()),
    "16-bit": lambda r, k: replace(k, sensor=draw_sensor(r, "16"), texture=0.04 * r.random()),
    "black-clipped": lambda r, k: replace(k, sensor=draw_sensor(r, "clipped"), background=float(r.uniform(0, 0.004))),
    "bright-background": lambda r, k: replace(
        k, background=float(r.uniform(0.2, 0.31)), gradient=0.6, texture=float(r.uniform(0, 0.04)), most_peak=0.6
    ),
    "changing-light": lambda r, k: replace(
        k, flicker=0.03, drift=float(r.choice([-0.2, 0.2])), background=float(r.uniform(0.06, 0.2)), texture=0.02
    ),
    "clutter": _clutter,
    "flat-top": lambda r, k: replace(
        k, flat=int(r.integers(2, 4)), ratio=float(r.uniform(0.5, 1)), sigma_px=_log(r, 1, 8)
    ),
    "quiet-sensor": lambda r, k: replace(
        k, sensor=replace(draw_sensor(r, "8"), full_well_e=float(r.uniform(3e4, 6e4)), read_e=1.0, row_e=0.0),
        background=float(r.uniform(0, 0.03)), texture=0.0, flicker=0.0,
    ),
    "photographs": _photographs,
    "bands": lambda r, k: replace(_photographs(r, k), bands=_log(r, 0.02, 0.3)),
    "shaking": lambda r, k: replace(_photographs(r, k), shake_px=_log(r, 0.03, 1.0)),
    "row-noise": lambda r, k: replace(k, sensor=replace(k.sensor, row_e=float(r.uniform(0.5, 1.0) * k.sensor.read_e))),
    # Physical: intensities of fields of random phases, seen through a round aperture; two patterns: both polarisations.
    "laser": lambda r, k: replace(
        k, patterns=int(r.integers(1, 3)), speckle_grain_px=_log(r, 0.15, 0.6), sigma_px=_log(r, 0.9, 5)
    ),
}  # fmt: skip


def draw_look(rng: np.random.Generator, family: str | None) -> Look:
    """The appearance of a family, or a random one without a family."""
    if family is None:
        return mixed_look(rng)
    return FAMILIES[family](rng, plain_look(rng))
