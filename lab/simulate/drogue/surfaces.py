"""Colours of the drogue along rays: canopy ring, markers, basket of struts with gaps, lining and coupling.

A ray is given by its slopes (mx, my) = d(x, y)/dz in the drogue frame and the point (x0, y0) where it meets the plane
of the rim, so that the equations of the surfaces are well conditioned at any distance. Source: ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.simulate.drogue.scene import DrogueLook, DrogueScene, Floats32

_INSIDE_SHADE = 0.75  # loss of light at the end of the basket
_RING_AT, _RING_WIDTH = 0.26, 0.05  # spreader ring between the struts, in depths of the basket
_LIP = (0.6, 0.8)  # components of the canopy's normal outwards and towards the camera


def shade_rays(scene: DrogueScene, mx: Floats32, my: Floats32, x0: Floats32, y0: Floats32) -> tuple[Floats32, Floats32]:
    """Colours (n, 3) in DN and opacities (n,), 0 or 1, of rays (n,); lengths in radii of the rim."""
    look = scene.look
    towards = scene.camera_from_drogue.rotation.T @ np.asarray(scene.light.towards)
    towards /= np.linalg.norm(towards)
    colour = np.zeros((len(mx), 3), np.float32)
    alpha = np.zeros(len(mx), np.float32)
    rho2 = x0 * x0 + y0 * y0
    inner2 = np.float32(look.canopy_inner**2)

    ring = np.flatnonzero((rho2 <= 1) & (rho2 >= inner2))
    colour[ring], alpha[ring] = _canopy(scene, x0[ring], y0[ring], towards), 1
    rest = np.flatnonzero((rho2 < inner2) | (rho2 > 1))
    found, basket, solid = _basket(scene, mx[rest], my[rest], x0[rest], y0[rest], rho2[rest] < inner2, towards)
    rest = rest[found]
    colour[rest], alpha[rest] = basket, solid
    _paint_markers(scene, colour, alpha, (mx, my, x0, y0), towards)
    return colour, alpha


def _lit(scene: DrogueScene, cosine: Floats32, translucency: float = 0.0) -> Floats32:
    light = scene.light
    through = np.maximum(cosine, 0) + np.float32(translucency) * np.maximum(-cosine, 0)
    return np.float32(light.ambient) + np.float32(light.diffuse) * through


def _canopy(scene: DrogueScene, x: Floats32, y: Floats32, towards: Array) -> Floats32:
    look = scene.look
    rho = np.sqrt(x * x + y * y)
    out, front = _LIP
    cosine = (out * (x * towards[0] + y * towards[1]) / rho - front * towards[2]).astype(np.float32)
    gore = np.floor(np.arctan2(y, x) * np.float32(look.gores / (2 * np.pi))) % 2
    light = _lit(scene, cosine, scene.light.translucency) * (1 - np.float32(look.gore_contrast) * gore)
    return np.asarray(light[:, None] * np.asarray(look.canopy_bgr, np.float32), np.float32)


def _basket(
    scene: DrogueScene,
    mx: Floats32,
    my: Floats32,
    x0: Floats32,
    y0: Floats32,
    enters: NDArray[np.bool_],
    towards: Array,
) -> tuple[NDArray[np.intp], Floats32, Floats32]:
    """Which rays (k,) meet the basket, their colours (k, 3) and opacities (k,).

    The basket is the cone of radius inner - k z, 0 < z < depth. A ray meets it where A z^2 + 2 B z + C = 0; the first
    of the two places at which it is not a gap counts. A ray through the mouth that meets no wall ends at the coupling.
    """
    look = scene.look
    k = np.float32((look.canopy_inner - look.rear) / look.depth)
    inner = np.float32(look.canopy_inner)
    A = mx * mx + my * my - k * k
    B = x0 * mx + y0 * my + k * inner
    C = x0 * x0 + y0 * y0 - inner * inner
    root = np.sqrt(np.maximum(B * B - A * C, 0))
    q = -(B + np.where(B >= 0, root, -root))
    q = np.where(np.abs(q) > 1e-12, q, np.float32(1e-12))
    A = np.where(np.abs(A) > 1e-9, A, np.float32(1e-9))
    one, two = q / A, C / q
    meets = B * B - A * C > 0
    colour = np.zeros((len(mx), 3), np.float32)
    done = np.zeros(len(mx), bool)
    for z in (np.minimum(one, two), np.maximum(one, two)):
        here = np.flatnonzero(meets & ~done & (z > 0) & (z < look.depth))
        zh = z[here]
        x, y = x0[here] + mx[here] * zh, y0[here] + my[here] * zh
        paint, solid = _wall(look, x, y, zh)
        radial = (x * towards[0] + y * towards[1]) / np.sqrt(x * x + y * y)
        # The inner wall is seen if the ray leaves the cone there: its outward slope exceeds the wall's.
        inside = (x * mx[here] + y * my[here]) / np.sqrt(x * x + y * y) > -k
        cosine = np.where(inside, -radial, radial).astype(np.float32)
        dim = np.where(inside, 1 - np.float32(_INSIDE_SHADE) * zh / np.float32(look.depth), np.float32(0.8))
        shade = (_lit(scene, cosine) * dim)[:, None] * paint
        colour[here[solid]], done[here[solid]] = shade[solid], True
    depth = np.float32(look.depth)
    end2 = (x0 + mx * depth) ** 2 + (y0 + my * depth) ** 2
    end = enters & ~done & (end2 < look.rear**2)
    coupling = (end2 > (0.35 * look.rear) ** 2) & (end2 < (0.7 * look.rear) ** 2)
    level = np.float32((1 - _INSIDE_SHADE) * (scene.light.ambient + 0.5 * scene.light.diffuse))
    colour[end & coupling] = level * np.asarray(look.coupling_bgr, np.float32) * np.float32(2)
    colour[end & ~coupling] = level * np.asarray(look.lining_bgr, np.float32)
    found = np.flatnonzero(done | end)
    return found, colour[found], np.ones(len(found), np.float32)


def _wall(look: DrogueLook, x: Floats32, y: Floats32, z: Floats32) -> tuple[Floats32, NDArray[np.bool_]]:
    """Colours (n, 3) of the wall of the basket at points of it, and where it is solid."""
    turn = np.arctan2(y, x) * np.float32(look.ribs / (2 * np.pi)) % 1
    rib = np.abs(turn - np.float32(0.5)) < 0.5 * look.rib_share
    share = z / np.float32(look.depth)
    rib |= np.abs(share - np.float32(_RING_AT)) < 0.5 * _RING_WIDTH
    paint = np.where(rib[:, None], np.asarray(look.rib_bgr, np.float32), np.asarray(look.lining_bgr, np.float32))
    return paint, rib | (share > look.lining_from)


def _paint_markers(
    scene: DrogueScene,
    colour: Floats32,
    alpha: Floats32,
    rays: tuple[Floats32, Floats32, Floats32, Floats32],
    towards: Array,
) -> None:
    """Discs parallel to the rim, in front of everything else of the drogue."""
    mx, my, x0, y0 = rays
    look = scene.look
    markers = scene.markers / scene.radius_m
    near = np.arange(len(mx))
    flat = bool(np.all(markers[:, 2] == 0))
    if flat:
        reach = np.hypot(markers[:, 0], markers[:, 1])
        rho2 = x0 * x0 + y0 * y0
        low, high = max(reach.min() - look.marker_radius, 0), reach.max() + look.marker_radius
        near = np.flatnonzero((rho2 >= low * low) & (rho2 <= high * high))
    level = _lit(scene, np.float32(-towards[2]) * np.ones(1, np.float32), 0.0)
    for (x, y, z), bgr in zip(markers.astype(np.float32), look.marker_bgr, strict=True):
        dx, dy = x0[near] + mx[near] * z - x, y0[near] + my[near] * z - y
        hit = near[dx * dx + dy * dy <= look.marker_radius**2]
        colour[hit], alpha[hit] = level * np.asarray(bgr, np.float32), 1
