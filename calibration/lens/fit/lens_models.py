"""The candidate lens models: which distortion coefficients each has, and whether a lens maps the whole picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from calibration.terms.corners import INTRINSICS_COUNT
from geometry import lens
from geometry.arrays import Array, Bools
from geometry.camera import FISHEYE, PERSPECTIVE
from geometry.uncertainty.rig_uncertainty import DISTORTION, FISHEYE_DISTORTION, PINHOLE

_BORDER = 25  # sampled pixels along each side of the picture; distortion varies little between them


@dataclass(frozen=True, slots=True)
class LensModel:
    """Kind of lens, and number of free distortion coefficients."""

    coefficients: int  # 0, 4, 5, 8 or 12; of a fisheye 4
    lens: str = PERSPECTIVE

    def __post_init__(self) -> None:
        allowed = (4,) if self.lens == FISHEYE else (0, 4, 5, 8, 12)
        if self.lens not in (PERSPECTIVE, FISHEYE) or self.coefficients not in allowed:
            raise ValueError(f"expected one of the models {', '.join(m.title for m in LENS_MODELS)}")

    @property
    def fisheye(self) -> bool:
        """Whether the coefficients are those of OpenCV's fisheye model."""
        return self.lens == FISHEYE

    @property
    def title(self) -> str:
        """`5` or `fisheye`: the name in reports and options."""
        return FISHEYE if self.fisheye else str(self.coefficients)

    @property
    def words(self) -> str:
        """The name in a sentence."""
        return "fisheye lens, 4 coefficients" if self.fisheye else f"perspective lens, {self.coefficients} coefficients"

    @property
    def free(self) -> Bools:
        """(18,): which of fx, fy, cx, cy and the fourteen distortion coefficients are free in a fit."""
        return np.arange(INTRINSICS_COUNT) < 4 + self.coefficients

    def cut(self, numbers: Array) -> Array:
        """The lens (18,) with the coefficients that this model does not have set to 0."""
        return np.where(self.free, numbers, 0.0)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        names = FISHEYE_DISTORTION if self.fisheye else DISTORTION
        return (*PINHOLE, *names[: self.coefficients])


# In ascending order of flexibility. Fisheye stands before the rational model: it has as many coefficients as the
# second model, but distorts even with all of them 0.
LENS_MODELS = (
    LensModel(0),
    LensModel(4),
    LensModel(5),
    LensModel(4, FISHEYE),
    LensModel(8),
    LensModel(12),
)


def named(title: str) -> LensModel:
    """The model with this title. Raises ValueError: no model has it; the message lists the titles."""
    for model in LENS_MODELS:
        if model.title == title:
            return model
    raise ValueError(f"expected a lens model out of {', '.join(m.title for m in LENS_MODELS)}, got {title!r}")


def rational_of_fisheye(numbers: Array, widest_rad: float) -> Array:
    """The perspective lens (18,) with k1 ... k6 closest to a fisheye lens (18,) up to an angle off the optical axis.

    Linear least squares over the radius: of d = r N / D, the equation N - (d / r) D = 0. k4, k5, k6 of D are not
    negative: otherwise N and D may share a root inside the picture, from which a fit finds no way to a lens without.
    """
    angle = np.linspace(0, min(widest_rad, np.deg2rad(80)), 200)[1:]
    r2 = np.tan(angle) ** 2
    points = np.stack([np.tan(angle), 0 * angle], axis=1)
    scale = lens.distort(points, np.broadcast_to(numbers[4:], (len(angle), 14)), True)[0][:, 0] / points[:, 0]
    powers = np.stack([r2, r2**2, r2**3], axis=1)
    weight = (1 / (1 + r2**3))[:, None]
    A = np.concatenate([powers, -scale[:, None] * powers], axis=1) * weight
    norm = np.linalg.norm(A, axis=0)
    lowest = np.array([-np.inf, -np.inf, -np.inf, 0, 0, 0])
    k = lsq_linear(A / norm, (scale - 1) * weight[:, 0], (lowest, np.inf), method="bvls").x / norm
    out = np.zeros(INTRINSICS_COUNT)
    out[:4] = numbers[:4]
    out[[4, 5, 8]], out[9:12] = k[:3], k[3:]
    return out


def fold_r2(numbers: Array, fisheye: bool) -> float:
    """The squared normalised radius up to which the mapping of a lens (18,) is one to one along every ray."""
    coefficients = tuple(float(v) for v in numbers[4:])
    return lens.fisheye_fold_limit(coefficients[:4]) if fisheye else lens.fold_limit(coefficients)


def folds_in_picture(numbers: Array, fisheye: bool, image_size_px: tuple[int, int]) -> bool:
    """Whether a pixel on the border of the picture has no ray, or two rays, through the lens (18,).

    If no border pixel does, no pixel inside does: the radial mapping increases monotonically up to the corners. A
    fisheye lens that increases up to 90 deg off its axis does not fold; pixels farther out have no ray to the front.
    """
    if fisheye and np.isinf(fold_r2(numbers, fisheye)):
        return False
    u, v = np.meshgrid(*(np.linspace(-0.5, n - 0.5, _BORDER) for n in image_size_px))
    inside = np.zeros(u.shape, dtype=bool)
    inside[1:-1, 1:-1] = True
    border = np.stack([u[~inside], v[~inside]], axis=1)
    return bool(np.isnan(undistorted(border, numbers, fisheye)).any())


def undistorted(pixels: Array, numbers: Array, fisheye: bool) -> Array:
    """Normalised image points X/Z, Y/Z (n, 2) of pixels (n, 2) through a lens (18,); nan where there is none."""
    distorted = (pixels - numbers[2:4]) / numbers[:2]
    return lens.undistort(distorted, numbers[4:], fold_r2(numbers, fisheye), fisheye)
