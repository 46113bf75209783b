"""A light that moves little, and the background behind it, fitted together to some pictures.

Where a light moves by less than its size it is in all pictures, and no picture shows the background behind it. But the
background is the same in all of them: of the pictures k at a pixel x,

    g_k(x) = B(x) + (p + q B(x)) s_k G(x - c_k),

with a Gaussian G of peak 1 and one size for all pictures, and strengths s_k of the light that are known to about a
percent, since lasers flicker (1, unless the pictures were scaled to equal light of the room). The light falls on the
surface whose own brightness is B, so the surface modulates it: q > 0. B is linear in this equation and is eliminated at
each pixel; p, q, the size, the strengths and the places c_k are found by Gauss-Newton steps. A bright light is so
determined to a few hundredths of a pixel by a motion of half its width, on any background. What the motion leaves open
is decided by the ground beside the light: B lies as near to its plane as that does, except beyond edges, of which the
plane says nothing. Source: ours; the elimination is the variable projection of Golub & Pereyra (1973), SIAM J. Numer.
Anal. 10, 413, in the approximation of Kaufman (1975), BIT 15, 49.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geometry.arrays import MEDIAN_TO_SIGMA, Array, weighted_median

_STEPS, _TRIES = 30, 8  # limits: steps of the fit, and shorter trials of each
_CONVERGED = 1e-5  # relative decrease of the cost
_DAMPING, _LESS, _MORE = 1e-2, 1 / 6, 6.0  # of the steps: at the start, after a good and after a bad trial
_NO_GAUSSIAN = 0.02  # error of the model, as a share of the peak: no light is quite a Gaussian
# Sigma of the strengths, as a share: half of what laser diodes show. The pictures measure it to a tenth of that, and
# lights that do not flicker stay as well known.
_FLICKER = 0.005
MODULATED = 0.5, 0.4  # usual share of the light that the brightness of the surface modulates, and its sigma
UNLIKE = 0.1  # usual sigma of the modulated share of different places
_DARKEST = 0.1  # of the usual light: what is left of it on black ground, at least
_ROUNDS = 2  # of the texture's size and the fit
_LEAST_TEXTURE, _FIRST_TEXTURE = 2.0, 20.0  # sigmas of the noise
_EDGE = 3.0  # sigmas of the ground around a light: what differs from its plane by more is another surface
_BESIDE = 0.1  # of the light: pixels with less of it show the ground around it
_UNKNOWN = 10.0  # sigma of another surface, in differences from the plane: that says nothing of it
_PLANES = 10  # fits of the plane, from which pixels on edges count less and less
_ALIKE = 2.0  # root of the number of pixels, at least, over which texture is alike
_LARGEST_CHI2 = 2.0  # per degree of freedom
_LARGEST_SIGMA = 0.1  # of the mean place, in widths of the light
_LEAST_SHOWN = 1e-3  # share of the information on the modulation
# Widths: error of the places that the model leaves. With it the products of the errors in successive pictures agree
# with the stated shared variance (63 lights in front of photographs).
_LEAST_SIGMA = 0.002
_LARGEST_CHANGE = 3.0  # of the width, as a factor, from the start


def share_at(share: Array, ratio: Array) -> tuple[Array, Array]:
    """Of a modulated share on usual ground: that on ground of another brightness, over the usual; its derivative."""
    more = share * ratio
    return more / (1 - share + more), ratio / (1 - share + more) ** 2


@dataclass(frozen=True, slots=True)
class Modulation:
    """How the light of a surface modulates lights: to 1 - share + share B / B0 where it is B instead of B0."""

    share: float
    level_dn: float  # B0, above black
    unlike: float = UNLIKE  # sigma of the share, by which places differ
    black_dn: float = 0.0  # grey value without light

    def at(self, level_dn: float) -> tuple[float, float]:
        """The share where the surface has this light, DN above black, and the sigma by which places differ."""
        share, slope = share_at(np.array(self.share), np.array(level_dn / self.level_dn))
        return float(share), float(slope) * self.unlike

    def response(self, surface: Array | NDArray[np.float32]) -> Array:
        """The light where the surface has these grey values, DN, over that where it is B0."""
        lit = (surface - self.black_dn) / self.level_dn
        return np.asarray(np.maximum(1 - self.share + self.share * lit, _DARKEST), float)

    def sensitivity(
        self, surface: NDArray[np.float32], variance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """A surface (h, w) whose logarithm is the change of a light's logarithm by the share, and its variance.

        surface, variance (h, w): grey value, DN, and its variance, DN^2.
        """
        response = self.response(surface)
        change = np.exp(((surface - self.black_dn) / self.level_dn - 1) / response)
        own = variance * (change / (self.level_dn * response**2)) ** 2
        return np.asarray(change, np.float32), np.asarray(own, np.float32)


@dataclass(frozen=True, slots=True)
class JointLight:
    """A light in n pictures."""

    places: Array  # (n, 2) px
    shape: Array  # (3,): l11, l21, l22 of the Cholesky factor of the inverse covariance, 1/px
    plain: float  # p, DN
    modulated: float  # q, no unit
    plane: Array  # (3,): the background's, DN and DN per px, about `origin`
    origin: Array  # (2,) px
    texture_dn: Array  # (m,): sigma of the background about the plane, in the pixels that were fitted
    strength: Array  # (n, 1)

    @property
    def widths_px(self) -> Array:
        """(2,): half axes, the larger first."""
        factor = np.array([[self.shape[0], 0.0], [self.shape[1], self.shape[2]]])
        return np.asarray(1 / np.sqrt(np.linalg.eigvalsh(factor @ factor.T)))

    def _moved(self, step: Array) -> JointLight:
        n = len(self.places)
        places, plane, strength = np.split(step[5:], [2 * n, 2 * n + 3])
        return replace(
            self, plain=self.plain + step[0], modulated=self.modulated + step[1], shape=self.shape + step[2:5],
            places=self.places + places.reshape(n, 2), plane=self.plane + plane,
            strength=self.strength + strength[:, None],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Pixels:
    """What n pictures show at m pixels."""

    uv: Array  # (m, 2)
    values: Array  # (n, m), DN above black
    variance: Array  # (n, m), DN^2, of the noise
    usual: float  # DN above black, of the background
    height: float  # DN, of the light
    modulated: tuple[float, float]  # expected share of the light, and its sigma
    empty: Array  # (m,) DN, of pictures without the light: their mean, and the information of that, 1/DN^2
    empty_information: Array  # (m,)
    strength: Array  # (n, 1): expected

    def seen(self, light: JointLight) -> _Seen:
        """A light in these pixels."""
        l11, l21, l22 = light.shape
        du, dv = (self.uv[:, i] - light.places[:, i : i + 1] for i in (0, 1))
        along, across = l11 * du + l21 * dv, l22 * dv
        form = np.exp(-0.5 * (along**2 + across**2))
        light_of = light.strength * form
        weight = 1 / (self.variance + (_NO_GAUSSIAN * self.height * light_of) ** 2)
        slope = 1 + light.modulated * light_of
        about = self.uv - light.origin
        plane = light.plane[0] + about @ light.plane[1:]
        information = (slope**2 * weight).sum(axis=0) + light.texture_dn**-2 + self.empty_information
        behind = (slope * weight * (self.values - light.plain * light_of)).sum(axis=0) + plane * light.texture_dn**-2
        behind += self.empty_information * self.empty
        behind /= information
        root = np.sqrt(weight)
        residual = np.concatenate([
            (self.values - slope * behind - light.plain * light_of) * root,
            ((plane - behind) / light.texture_dn)[None],
            ((self.empty - behind) * np.sqrt(self.empty_information))[None],
        ])  # fmt: skip
        # What is known of p and q, so that they stay where the light lies on even ground.
        modulated = light.modulated * self.usual
        height = light.plain + modulated
        share, sigma = self.modulated
        usual = np.array([(modulated - share * height) / sigma, 0.5 * (height - self.height)]) / self.height
        flicker = ((light.strength - self.strength) / (_FLICKER * self.strength)).ravel()
        usual = np.concatenate([usual, flicker])
        return _Seen(du, dv, along, across, form, light_of, root, slope, behind, information, residual, usual)

    def normal(self, light: JointLight, seen: _Seen) -> tuple[Array, Array]:
        """Normal matrix and right side of the step, with the background eliminated."""
        n, m = self.values.shape
        size = 5 + 2 * n + 3 + n
        height = (light.plain + light.modulated * seen.behind) * seen.root
        weighted = height * seen.light_of
        # Of each picture (n, 8, m): by p and q, shape, its place and its strength; where these parameters are (n, 8).
        slopes = np.stack([
            seen.light_of * seen.root, seen.light_of * seen.behind * seen.root, -weighted * seen.along * seen.du,
            -weighted * seen.along * seen.dv, -weighted * seen.across * seen.dv, *seen.place_slopes(light),
            height * seen.form,
        ], axis=1)  # fmt: skip
        each, plane = np.arange(n), slice(5 + 2 * n, size - n)
        own = np.column_stack([np.tile(np.arange(5), (n, 1)), 5 + 2 * each, 6 + 2 * each, size - n + each])
        by_plane = -np.stack([np.ones(m), *(self.uv - light.origin).T]) / light.texture_dn
        # The residuals have no part along the background's slopes: it is the best one for this light.
        by_background = np.concatenate([seen.slope * seen.root, 1 / light.texture_dn[None]])
        by_background /= np.sqrt(seen.information)
        along = slopes * by_background[:n, None]
        eliminated = np.zeros((size, m))
        eliminated[:5], eliminated[own[:, 5:]] = along[:, :5].sum(axis=0), along[:, 5:]
        eliminated[plane] = by_plane * by_background[n]
        usual = np.zeros((2 + n, size))
        share, sigma = self.modulated
        usual[0, :2] = np.array([-share, (1 - share) * self.usual]) / (sigma * self.height)
        usual[1, :2] = np.array([1, self.usual]) / (2 * self.height)
        usual[2 + each, size - n + each] = 1 / (_FLICKER * self.strength.ravel())
        normal, right = usual.T @ usual - eliminated @ eliminated.T, -usual.T @ seen.usual
        np.add.at(normal, (own[:, :, None], own[:, None]), slopes @ slopes.transpose(0, 2, 1))
        np.add.at(right, own, (slopes @ seen.residual[:n, :, None])[..., 0])
        normal[plane, plane] += by_plane @ by_plane.T
        right[plane] += by_plane @ seen.residual[n]
        return normal, right


@dataclass(frozen=True, slots=True)
class _Seen:
    du: Array  # (n, m) px
    dv: Array
    along: Array  # (n, m), widths
    across: Array
    form: Array  # (n, m): of a peak of 1
    light_of: Array  # (n, m): of a peak of `strength`
    root: Array  # (n, m): of the weights, 1/DN
    slope: Array  # (n, m): by the background
    behind: Array  # (m,) DN: the background
    information: Array  # (m,) 1/DN^2
    residual: Array  # (n + 2, m), sigmas
    usual: Array  # (2 + n,), sigmas

    @property
    def cost(self) -> float:
        return float(np.sum(self.residual**2) + np.sum(self.usual**2))

    def place_slopes(self, light: JointLight) -> Array:
        """(2, n, m): derivatives of the values, in sigmas, by the light's place, px, with the background as it is."""
        l11, l21, l22 = light.shape
        weighted = (light.plain + light.modulated * self.behind) * self.light_of * self.root
        return np.stack([weighted * self.along * l11, weighted * (self.along * l21 + self.across * l22)])


@dataclass(frozen=True, slots=True)
class JointFit:
    """A light of which the fit explains the pictures."""

    light: JointLight
    uv: Array  # (m, 2) px: the pixels of the fit
    share: float  # variance of the errors that its places share, over that of one of them by the noise of its picture
    strength_cov: Array  # (2, 2): of p and q
    level_dn: float  # DN above black, of the ground
    expected: tuple[float, float]  # share of the light that this modulates, before the fit, and its sigma
    noise_share: float  # of the information on the modulation: by errors of the ground, which modulate nothing

    @property
    def shown(self) -> tuple[float, float]:
        """The share of the light that the ground modulates, and its variance, by the pictures alone."""
        (share, variance), (before, sigma) = self.modulated_share(self.level_dn), self.expected
        left = max(1 - variance / sigma**2, _LEAST_SHOWN)  # of the information
        shown = max(left - self.noise_share, _LEAST_SHOWN)  # by structure
        return before + (share - before) / left, variance / shown + (MODULATED[0] * self.noise_share / shown) ** 2

    def modulated_share(self, level_dn: float) -> tuple[float, float]:
        """The share of the light that the surface's brightness modulates, where that is `level_dn`; its variance."""
        p, more = self.light.plain, self.light.modulated * level_dn
        slope = np.array([-more, p * level_dn]) / (p + more) ** 2
        return more / (p + more), float(slope @ self.strength_cov @ slope)

    def behind(
        self, uv: Array, values: Array, variance: Array, empty: tuple[Array, Array]
    ) -> tuple[Array, Array, Array]:
        """The background (m,), DN, its information in pictures (m,), and the light, (m,), highest of all pictures.

        uv (m, 2): pixels; values, variance (n, m): of the pictures there, as in `fitted`; empty: as `mean_of` returns
        them.
        """
        pixels = _Pixels(uv, values, variance, 1.0, self.light.plain, MODULATED, *empty, self.light.strength)
        texture_dn = self.light.texture_dn[cKDTree(self.uv).query(uv)[1]]
        seen = pixels.seen(replace(self.light, texture_dn=texture_dn))
        return seen.behind, seen.information * variance.mean(axis=0), seen.light_of.max(axis=0)


def mean_of(empty: Array, variance: Array) -> tuple[Array, Array]:
    """The mean (m,) of pictures (k, m) without the light, and its information, given variances (n, m) of others."""
    if not len(empty):
        return np.zeros(variance.shape[1]), np.zeros(variance.shape[1])
    return empty.mean(axis=0), len(empty) / variance.min(axis=0)


def fitted(
    uv: Array, values: Array, variance: Array, places: Array, width_px: float, height_dn: float,
    empty: tuple[Array, Array], modulation: Modulation | None = None, strength: Array | float = 1.0,
) -> JointFit | None:  # fmt: skip
    """A light in n pictures that starts from these places (n, 2), width and height; None: it does not explain them.

    uv (m, 2): pixels around it; values, variance (n, m): of the pictures there, DN above black, since light modulates
    light, and DN^2; empty: what pictures without the light show (`mean_of`). modulation: as other lights show it.
    strength (n, 1): of the light in each one.
    """
    low = np.sort(values, axis=0)[: max(len(values) // 2, 1)].mean(axis=0)
    usual = float(np.median(low))
    expected = MODULATED if modulation is None else modulation.at(max(usual, 1.0))
    strength = np.broadcast_to(strength, (len(values), 1)).astype(float)
    pixels = _Pixels(uv, values, variance, max(usual, 1.0), height_dn, expected, *empty, strength)
    origin, inverse, noise_dn = uv.mean(axis=0), 1 / width_px, float(np.sqrt(np.median(variance)))
    light = JointLight(
        places, np.array([inverse, 0.0, inverse]), (1 - expected[0]) * height_dn,
        expected[0] * height_dn / pixels.usual, np.array([usual, 0.0, 0.0]), origin,
        np.full(len(uv), _ALIKE * _FIRST_TEXTURE * noise_dn), strength,
    )  # fmt: skip
    for _ in range(_ROUNDS):
        light = _descended(pixels, light)
        light = _before_ground(light, uv, pixels.seen(light), noise_dn)
    light = _descended(pixels, light)
    return _checked(pixels, light, width_px)


def _before_ground(light: JointLight, uv: Array, seen: _Seen, noise_dn: float) -> JointLight:
    """The light before the plane of the ground beside it, with what that says of each pixel (m, 2) behind the light."""
    lit = seen.light_of.max(axis=0)
    beside = np.where(lit < _BESIDE, np.sqrt(lit), 0.0)  # most of what is nearest
    if not beside.any():
        return light  # it has left the pixels
    about = np.column_stack([np.ones(len(uv)), uv - light.origin])
    plane = np.array([weighted_median(seen.behind, beside), 0.0, 0.0])
    for _ in range(_PLANES):
        left = seen.behind - about @ plane
        usual = max(MEDIAN_TO_SIGMA * weighted_median(np.abs(left), beside), _LEAST_TEXTURE * noise_dn)
        weighted = about * (beside / (1 + (left / usual) ** 2))[:, None]
        plane = np.asarray(np.linalg.lstsq(weighted.T @ about, weighted.T @ seen.behind, rcond=None)[0], float)
    left = seen.behind - about @ plane
    other = np.abs(left) > _EDGE * usual
    alike = max(_alike_px(uv, np.where((beside > 0) & ~other, left, np.nan)), _ALIKE)
    return replace(light, plane=plane, texture_dn=alike * np.where(other, _UNKNOWN * np.abs(left), usual))


def _alike_px(uv: Array, structure: Array) -> float:
    """Root of the number of pixels over which a structure (m,), NaN elsewhere, is alike, by the correlation of
    neighbours."""
    columns, rows = (np.unique(x, return_inverse=True)[1] for x in uv.T)
    grid = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    grid[rows, columns] = structure - np.nanmean(structure)
    known = np.isfinite(grid)
    grid[~known] = 0.0
    area, total = 1.0, max(float(np.mean(grid[known] ** 2)), 1e-12)  # 0: one pixel, or all alike
    for one, other in (np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]):
        pairs = max(int(np.count_nonzero(known[one] & known[other])), 1)
        r = min(max(float(np.sum(grid[one] * grid[other])) / (pairs * total), 0.0), 0.95)
        area *= (1 + r) / (1 - r)
    return float(np.sqrt(min(area, np.count_nonzero(known) / 4)))


def _descended(pixels: _Pixels, light: JointLight) -> JointLight:
    """Levenberg-Marquardt steps from a light."""
    damping, seen = _DAMPING, pixels.seen(light)
    for _ in range(_STEPS):
        normal, right = pixels.normal(light, seen)
        for _ in range(_TRIES):
            damped = normal + damping * np.diag(normal.diagonal())
            tried = light._moved(np.asarray(np.linalg.lstsq(damped, right, rcond=None)[0], dtype=float))
            after = pixels.seen(tried)
            if np.isfinite(after.cost) and after.cost < seen.cost:
                break
            damping *= _MORE
        else:
            return light
        gained = seen.cost - after.cost
        light, seen, damping = tried, after, damping * _LESS
        if gained < _CONVERGED * seen.cost:
            break
    return light


def _checked(pixels: _Pixels, light: JointLight, width_px: float) -> JointFit | None:
    """The fit, if it explains the pictures and the mean place is known."""
    n, m = pixels.values.shape
    seen = pixels.seen(light)
    known = pixels.empty_information > 0  # there other pictures show the background, too
    squares = np.sum(seen.residual[:n] ** 2) + np.sum(seen.residual[n + 1] ** 2)
    chi2 = float(squares) / max(n * m + np.count_nonzero(known) - m - 3 * n, 1)
    widths = light.widths_px
    normal, _ = pixels.normal(light, seen)
    covariance = np.linalg.pinv(normal, hermitian=True)
    places = covariance[5 : 5 + 2 * n, 5 : 5 + 2 * n].reshape(n, 2, n, 2)
    slopes = seen.place_slopes(light)
    of_places = np.einsum("ikm,jkm->kij", slopes, slopes)
    with np.errstate(over="ignore", invalid="ignore"):  # a light that has left the pixels
        alone = np.linalg.pinv(of_places, hermitian=True)  # if the background were known
    every, own = (float(np.trace(P, axis1=1, axis2=2).mean()) / 2 for P in (np.einsum("kikj->kij", places), alone))
    mean = float(np.trace(places.mean(axis=(0, 2)))) / 2 * max(chi2, 1.0)
    height = (light.plain + light.modulated * seen.behind)[seen.light_of.max(axis=0) > 0.1]
    bad = chi2 > _LARGEST_CHI2 or not np.isfinite(own) or not height.size or float(np.median(height)) <= 0
    modulated = light.modulated * pixels.usual
    # Its share of the light must lie within 1 of the usual one.
    bad |= abs(modulated - MODULATED[0] * (light.plain + modulated)) > light.plain + modulated
    bad |= bool((widths > _LARGEST_CHANGE * width_px).any() or (widths < width_px / _LARGEST_CHANGE).any())
    bad |= np.sqrt(mean) > _LARGEST_SIGMA * float(widths.max())
    if bad:
        return None
    # The noise of the background, 1 / n, is in its information as well.
    shared = max(every - (1 + 1 / n) * own, 0.0) * max(chi2, 1.0) + (_LEAST_SIGMA * float(widths.max())) ** 2
    strength_cov = covariance[:2, :2] * max(chi2, 1.0)
    # The errors of the background look like structure that modulates: so much of the information on q is theirs.
    weighted = seen.light_of * seen.root
    noise = np.sum(weighted**2, axis=0) - np.sum(seen.slope * seen.root * weighted, axis=0) ** 2 / seen.information
    noise_share = min(float(np.sum(noise / seen.information)) * float(covariance[1, 1]), 1.0)
    share = float(shared / max(own, 1e-9))
    return JointFit(light, pixels.uv, share, strength_cov, pixels.usual, pixels.modulated, noise_share)
