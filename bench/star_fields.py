"""Accuracy of narrow spots, measured with stars: `python -m bench.star_fields DATA_FOLDER`.

DATA_FOLDER holds pictures of one camera and matches.csv (picture, ra_deg, dec_deg, tetra3_u_px, tetra3_v_px): the
catalogue's direction of each star and a place within 1.5 px. The pictures go through `beampose detect`, as a user's
would, and its centres and sigmas are compared with one lens (focal length, a radial and two tangential terms) for all
pictures, an attitude for each, and an affine map of three numbers for each (refraction). All that is fitted is judged
on stars that are not used in its fit: nine parts, each with the other eight.

Residuals are per axis, px: their 68 % quantile over that of a normal deviate. Error over sigma is that quantile of the
residual over the stated sigma. The amplitude is that of the first harmonic of the residual over the place of a star
within its pixel; noise alone gives about residual sqrt(pi / n). The last two columns are residuals of a fit to all
stars, which are too small by about as much as those of stars that are not used are too large.

Rows: single Gaussians; these with a curve over that place that makes the places even (no catalogue), or from the other
stars' directions; the same for what `beampose detect` writes.

Limits of the comparison, in the shared four pictures. Measured with Hipparcos (van Leeuwen 2007): proper motion from
the epoch of the directions to July 2019 moves a star by .003 px in the median and by .015 px or less in 90 %; a centre
is shifted along v by .025 px per magnitude of B-V, .015 px for the usual star (dispersion of the air, colour error of
the lens); with both known a residual of .043 px, fitted to all stars, was .040 px. The refraction is
computed from the altitude in the picture's name, the zenith upwards; what is not affine of it is .02 px at the upper
and lower border at an altitude of 40 degrees, .005 px at 60 degrees. The 29 fitted numbers change 270 residuals by 5 %.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from geometry.arrays import Array, Bools, Ints
from tracking.detection.detect import find_spots
from tracking.noise import NORMAL_68, SpotProfile
from tracking.noise_estimation.photon_transfer import estimate_noise

PARTS = 9
NEAR_PX = 1.5
REFRACTION_ARCSEC = 58.3  # at an altitude of 45 degrees
FOCAL_PX = 5000.0  # start of the fit: a field of about 11 degrees
CLEAR_PX = 0.1  # sigma of the spots whose places are made even
SMALLEST = 1e-3, 1e-2  # priors: sigmas of the affine map, and of the tangential terms
OUTLIER_PX = 0.1  # residuals beyond it weigh less in the fits: two stars in one spot


@dataclass(frozen=True)
class Stars:
    """n stars: picture, direction in the sky (n, 3), a place near their light (n, 2), px."""

    picture: Ints
    direction: Array
    near: Array
    altitude: Array  # (n,) deg, of the middle of the star's picture

    def of(self, rows: Bools | Ints) -> Stars:
        return Stars(self.picture[rows], self.direction[rows], self.near[rows], self.altitude[rows])


@dataclass(frozen=True)
class Spots:
    """m spots of all pictures."""

    picture: Ints
    uv: Array  # (m, 2) px
    sigma: Array  # (m, 2) px


def read_stars(folder: Path) -> tuple[list[Path], Stars]:
    """The pictures that matches.csv names, and its stars."""
    with (folder / "matches.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    names = sorted({row["picture"] for row in rows})
    ra, dec = (np.radians([float(row[key]) for row in rows]) for key in ("ra_deg", "dec_deg"))
    direction = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    near = np.array([[float(row["tetra3_u_px"]), float(row["tetra3_v_px"])] for row in rows])
    return [folder / name for name in names], Stars(
        np.array([names.index(row["picture"]) for row in rows]), direction, near,
        np.array([float(row["picture"].split("_Alt")[1].split("_")[0]) for row in rows]),
    )  # fmt: skip


def detected(files: list[Path]) -> Spots:
    """What `beampose detect` writes for these pictures, whose frames are numbered in alphabetical order."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "cli", "detect", *map(str, files), "--out", str(out)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=Path(__file__).resolve().parents[1])
        with (out / "detections.csv").open(encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
    columns = [[float(row[key]) for row in rows] for key in ("u_px", "v_px", "sigma_u_px", "sigma_v_px")]
    u, v, sigma_u, sigma_v = (np.array(column) for column in columns)
    frames = np.array([int(row["frame"]) for row in rows])
    return Spots(frames, np.column_stack([u, v]), np.column_stack([sigma_u, sigma_v]))


def gaussians(files: list[Path]) -> Spots:
    """The spots of these pictures as single Gaussians."""
    pictures = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) for file in files]
    estimate = estimate_noise(pictures)
    model = replace(estimate.model, profile=SpotProfile())
    found = [estimate.texture_shift.added_to(find_spots(p, noise=model), model) for p in pictures]
    sigma = np.concatenate([np.sqrt(d.cov_px2[:, [0, 1], [0, 1]]) for d in found])
    numbers = np.repeat(np.arange(len(found)), [len(d) for d in found])
    return Spots(numbers, np.concatenate([d.uv_px for d in found]), sigma)


def refracted(rays: Array, altitude_deg: Array) -> Array:
    """Unit rays (n, 3) in the camera, lifted by the air towards the zenith, which is upwards (-v) of the picture.

    Source: Smart (1977), Textbook on Spherical Astronomy, section 36: R = 58.3'' tan z, z the distance from the zenith.
    """
    away = np.radians(90.0 - altitude_deg)
    zenith = np.stack([np.zeros_like(away), -np.sin(away), np.cos(away)], axis=-1)
    cosine = np.sum(rays * zenith, axis=-1, keepdims=True)
    sine = np.sqrt(1.0 - cosine**2)
    lift = np.radians(REFRACTION_ARCSEC / 3600.0) * sine / cosine
    return np.asarray(rays * np.cos(lift) + (zenith - cosine * rays) / sine * np.sin(lift))


@dataclass(frozen=True)
class Lens:
    """The comparison: lens numbers and, of each picture, an attitude and an affine map. Source: ours."""

    centre: Array  # px
    attitudes: tuple[Array, ...]  # (3, 3), camera from sky, at the start
    x: Array  # focal length over FOCAL_PX, k1, p1, p2; of each picture a rotation vector and three of the map

    @staticmethod
    def start(stars: Stars, uv: Array, size: tuple[int, int]) -> Lens:
        centre = 0.5 * (np.array(size) - 1.0)
        attitudes = []
        for picture in range(int(stars.picture.max()) + 1):
            rows = stars.picture == picture
            rays = np.column_stack([(uv[rows] - centre) / FOCAL_PX, np.ones(rows.sum())])
            left, _, right = np.linalg.svd((rays / np.linalg.norm(rays, axis=1)[:, None]).T @ stars.direction[rows])
            attitudes.append(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right)
        x = np.zeros(4 + 6 * len(attitudes))
        x[0] = 1.0
        return Lens(centre, tuple(attitudes), x)

    def project(self, stars: Stars) -> Array:
        """(n, 2) px."""
        q = np.zeros((len(stars.picture), 2))
        for picture, attitude in enumerate(self.attitudes):
            rows, own = stars.picture == picture, self.x[4 + 6 * picture : 10 + 6 * picture]
            rays = refracted(stars.direction[rows] @ (cv2.Rodrigues(own[:3])[0] @ attitude).T, stars.altitude[rows])
            q[rows] = rays[:, :2] / rays[:, 2:] @ (np.eye(2) + np.array([[own[3], own[4]], [own[4], own[5]]]))
        scale, k1, p1, p2 = self.x[:4]
        x, y = q.T
        r2 = x * x + y * y
        bent = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
        return np.asarray(scale * FOCAL_PX * (q * (1 + k1 * r2)[:, None] + bent) + self.centre)

    def fitted(self, stars: Stars, uv: Array) -> Lens:
        """To these stars, with outliers weighted down."""
        sigma = np.full(len(self.x), np.inf)
        sigma[2:4] = SMALLEST[1]
        for picture in range(len(self.attitudes)):
            sigma[7 + 6 * picture : 10 + 6 * picture] = SMALLEST[0]
        lens = self
        for _ in range(12):
            residual = uv - lens.project(stars)
            weight = 1 / np.sqrt(1 + (np.linalg.norm(residual, axis=1, keepdims=True) / OUTLIER_PX) ** 2)
            columns = []
            for k in range(len(self.x)):
                step = np.zeros(len(self.x))
                step[k] = 1e-6
                columns.append(((replace(lens, x=lens.x + step).project(stars) - uv + residual) * weight * 1e6).ravel())
            A = np.concatenate([np.stack(columns, axis=-1), 0.05 * np.diag(1 / sigma)])
            b = np.concatenate([(residual * weight).ravel(), -0.05 * lens.x / sigma])
            scale = np.linalg.norm(A, axis=0)
            lens = replace(lens, x=lens.x + np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale)
        return lens


def harmonics(uv: Array, axis: int, count: int) -> Array:
    """(n, 2 count): sines and cosines of the place within a pixel."""
    turns = 2 * np.pi * uv[:, axis, None] * np.arange(1, count + 1)
    return np.concatenate([np.sin(turns), np.cos(turns)], axis=1)


def even_places(spots: Spots) -> Array:
    """(m, 2) px: the centres less a curve over the place within a pixel, so that the places are even.

    A centre c = x + h(x) of even places x has the density 1 - h'(c), so that the mean cosine of its n-th harmonic is
    -pi n times the sine part of h, and its mean sine pi n times the cosine part. Source: ours.
    """
    out, clear = spots.uv.copy(), spots.sigma.max(axis=1) < CLEAR_PX
    for axis in (0, 1):
        means = harmonics(spots.uv[clear], axis, 2).mean(axis=0) / (np.pi * np.tile([1.0, 2.0], 2))
        curve = np.concatenate([-means[2:], means[:2]])
        out[:, axis] -= harmonics(spots.uv, axis, 2) @ curve
    return out


def held_out(stars: Stars, uv: Array, size: tuple[int, int], curve: int) -> Array:
    """(n, 2) px: residuals of stars with what is fitted to the others; curve: harmonics fitted, too."""
    part = np.random.default_rng(0).permutation(len(uv)) % PARTS
    out = np.zeros_like(uv)
    for k in range(PARTS):
        others, corrected = part != k, uv.copy()
        lens = Lens.start(stars.of(others), uv[others], size)
        for _ in range(3 if curve else 1):
            lens = lens.fitted(stars.of(others), corrected[others])
            for axis in (0, 1) if curve else ():
                A = harmonics(uv, axis, curve)
                residual = (uv - lens.project(stars))[:, axis]
                weight = 1 / np.maximum(1, np.abs(residual) / OUTLIER_PX)[:, None]
                fit = np.linalg.lstsq((weight * A)[others], (weight[:, 0] * residual)[others], rcond=None)[0]
                corrected[:, axis] = uv[:, axis] - A @ fit
        out[~others] = (corrected - lens.project(stars))[~others]
    return out


def spread(values: Array) -> float:
    """Sigma of normal deviates from their 68 % quantile."""
    return float(np.quantile(np.abs(values), 0.68)) / NORMAL_68


def line(name: str, stars: Stars, spots: Spots, uv: Array, size: tuple[int, int], curve: int = 0) -> str:
    """One row of the table. uv: (m, 2) px, the centres that are judged."""
    nearest, there = np.zeros(len(stars.picture), int), np.zeros(len(stars.picture), bool)
    for picture in np.unique(stars.picture):
        rows, own = np.flatnonzero(stars.picture == picture), np.flatnonzero(spots.picture == picture)
        away = np.linalg.norm(stars.near[rows, None] - uv[own], axis=-1)
        nearest[rows], there[rows] = own[away.argmin(axis=1)], away.min(axis=1) < NEAR_PX
    stars, nearest = stars.of(there), nearest[there]
    own = uv[nearest]
    residual = held_out(stars, own, size, curve)
    fitted = own - Lens.start(stars, own, size).fitted(stars, own).project(stars)
    weight = 1 / np.maximum(1, np.abs(residual) / OUTLIER_PX)
    waves = []
    for axis in (0, 1):  # over the true place within the pixel: the one that the lens gives
        A = weight[:, axis, None] * harmonics(own - residual, axis, 1)
        waves.append(np.hypot(*np.linalg.lstsq(A, weight[:, axis] * residual[:, axis], rcond=None)[0]))
    each = f"{spread(residual[:, 0]):7.4f} {spread(residual[:, 1]):7.4f}"
    last = "" if curve else f"{spread(fitted):9.4f} {spread(fitted / spots.sigma[nearest]):10.2f}"
    of_sigma = spread(residual / spots.sigma[nearest])
    return (
        f"{name:42} {len(own):5} {spread(residual):8.4f} {each} {of_sigma:7.2f} {waves[0]:9.3f} {waves[1]:6.3f} {last}"
    )


def main() -> None:
    """Print the table."""
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    files, stars = read_stars(Path(sys.argv[1]))
    height, width = cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED).shape[:2]
    size = width, height
    before, after = gaussians(files), detected(files)
    print(f"{'':42} stars residual       u       v  /sigma amplitude   v    fitted res.   /sigma")
    for name, spots in (("single Gaussians", before), ("beampose detect", after)):
        print(line(name, stars, spots, spots.uv, size))
        print(line("  places made even, no catalogue", stars, spots, even_places(spots), size))
        print(line("  a curve from the other stars' directions", stars, spots, spots.uv, size, curve=2))


if __name__ == "__main__":
    main()
