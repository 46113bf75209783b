"""Renders a drogue in front of a background, with what stands in front of it."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from studies.drogue.scene import (
    CLOUDS,
    DISC,
    GROUND,
    PICTURE,
    DrogueBackground,
    DroguePicture,
    DrogueScene,
    Floats32,
    Occluder,
    ellipse_through,
    rim_points_px,
    shade_rays,
)

# Backgrounds: a gradient of the sky, clouds and ground as fractal noise, or a given picture, with distractors.
#
# A background is drawn once, larger than the picture, and shifted by the offset of the frame; mirrored at its edges.

_MARGIN = 0.25  # of the picture's size, on each side, that moves into view
_CLOUD_SHIFT = 4  # bits of sub-pixel positions in OpenCV's drawing functions
_BLUE_SKY, _CLOUD, _EARTH, _GRASS = (1.25, 1.02, 0.78), (1.03, 1.0, 0.98), (0.72, 0.95, 1.1), (0.75, 1.08, 0.88)


def background_picture(background: DrogueBackground, size_px: tuple[int, int]) -> Floats32:
    """Colours (h, w, 3) in DN of the background; size_px: width, height. The caller owns the array."""
    picture = background.picture
    content = None if picture is None else (picture.tobytes(), picture.shape)
    texture = _texture(
        background.kind,
        background.seed,
        background.brightness_dn,
        background.contrast_dn,
        background.clutter,
        size_px,
        content,
    )
    (width, height), (du, dv) = size_px, background.offset_px
    left = (texture.shape[1] - width) / 2 - du
    top = (texture.shape[0] - height) / 2 - dv
    whole = float(left).is_integer() and float(top).is_integer() and left >= 0 and top >= 0
    if whole and left + width <= texture.shape[1] and top + height <= texture.shape[0]:
        return texture[int(top) : int(top) + height, int(left) : int(left) + width].copy()
    shift = np.array([[1.0, 0.0, left], [0.0, 1.0, top]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(texture, shift, size_px, flags=flags, borderMode=cv2.BORDER_REFLECT_101))


def fractal_noise(rng: np.random.Generator, size_px: tuple[int, int], coarsest: int, slope: float) -> Floats32:
    """Noise (h, w) of mean 0 and sigma 1: octaves of smooth random fields whose amplitude falls as 2^-slope per octave.

    coarsest: cells of the first octave along the longer side. Source: standard (Perlin 1985; value noise).
    """
    width, height = size_px
    out = np.zeros((height, width), np.float32)
    cells, amplitude = coarsest, 1.0
    while cells <= max(width, height) // 2:
        share = cells / max(width, height)
        grid = rng.standard_normal((max(int(height * share), 2), max(int(width * share), 2)), dtype=np.float32)
        out += np.float32(amplitude) * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, amplitude = 2 * cells, amplitude * 2.0**-slope
    out -= out.mean()
    return out / max(float(out.std()), 1e-9)


@lru_cache(maxsize=4)
def _texture(
    kind: str,
    seed: int,
    brightness_dn: float,
    contrast_dn: float,
    clutter: int,
    size_px: tuple[int, int],
    content: tuple[bytes, tuple[int, ...]] | None,
) -> Floats32:
    """The whole background (H, W, 3). Cached, since the frames of a sequence share it."""
    rng = np.random.default_rng([seed, 733])
    size = (int(size_px[0] * (1 + 2 * _MARGIN)), int(size_px[1] * (1 + 2 * _MARGIN)))
    if kind == PICTURE and content is not None:
        out = _from_picture(np.frombuffer(content[0], np.uint8).reshape(content[1]), size)
    elif kind == GROUND:
        out = _ground(rng, size, brightness_dn, contrast_dn)
    else:
        out = _sky(rng, size, brightness_dn, contrast_dn if kind == CLOUDS else 0.0)
    for _ in range(clutter):
        _draw_distractor(out, rng)
    return out


def _from_picture(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> Floats32:
    """A given picture, scaled to cover the background and cut at its middle."""
    colour = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    scale = max(size_px[0] / colour.shape[1], size_px[1] / colour.shape[0])
    wide, high = (max(int(np.ceil(n * scale)), m) for n, m in zip(colour.shape[1::-1], size_px, strict=True))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(colour, (wide, high), interpolation=way)
    top, left = (high - size_px[1]) // 2, (wide - size_px[0]) // 2
    return resized[top : top + size_px[1], left : left + size_px[0]].astype(np.float32)


def _sky(rng: np.random.Generator, size_px: tuple[int, int], brightness_dn: float, contrast_dn: float) -> Floats32:
    """A vertical gradient from blue to haze, with clouds where the noise is high."""
    width, height = size_px
    v = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    blue, haze = np.asarray(_BLUE_SKY, np.float32), np.asarray(_CLOUD, np.float32)
    slope = np.float32(rng.uniform(0.1, 0.35))
    level = np.float32(brightness_dn) * (1 - slope / 2 + slope * v)
    out = np.repeat(level * ((1 - v) * blue + v * haze), width, axis=1)
    if contrast_dn > 0:
        field = fractal_noise(rng, size_px, int(rng.integers(2, 7)), float(rng.uniform(0.7, 1.1)))
        cover = np.clip((field - np.float32(rng.uniform(-0.8, 0.8))) * np.float32(0.9), 0, 1)[..., None]
        shade = fractal_noise(rng, size_px, 8, 1.0)[..., None]
        cloud = (np.float32(brightness_dn + contrast_dn) + np.float32(0.35 * contrast_dn) * shade) * haze
        out = out * (1 - cover) + cloud * cover
    return np.asarray(out, np.float32)


def _ground(rng: np.random.Generator, size_px: tuple[int, int], brightness_dn: float, contrast_dn: float) -> Floats32:
    """Fields of different colours with fine texture."""
    kinds = fractal_noise(rng, size_px, int(rng.integers(4, 12)), 0.8)[..., None]
    fine = fractal_noise(rng, size_px, 16, float(rng.uniform(0.25, 0.7)))[..., None]
    mix = np.clip(kinds + np.float32(0.5), 0, 1)
    colour = mix * np.asarray(_EARTH, np.float32) + (1 - mix) * np.asarray(_GRASS, np.float32)
    level = np.float32(0.8 * brightness_dn) + np.float32(contrast_dn / 2) * (np.float32(0.5) * kinds + fine)
    return np.asarray(np.maximum(level, 4) * colour, np.float32)


def _draw_distractor(picture: Floats32, rng: np.random.Generator) -> None:
    """One disc, thin ring, line or polygon at a random place; anti-aliased, with the colour of something distant."""
    height, width = picture.shape[:2]
    at = rng.uniform([0, 0], [width, height])
    size = float(np.exp(rng.uniform(np.log(4), np.log(0.2 * height))))
    level = float(rng.uniform(15, 245))
    colour = tuple(float(c) for c in np.clip(level * rng.uniform(0.9, 1.1, 3), 0, 255))
    layer = picture.astype(np.uint8)
    kind = rng.integers(4)
    if kind == 0:
        cv2.circle(layer, _fixed(at), int(size / 2 * 2**_CLOUD_SHIFT), colour, -1, cv2.LINE_AA, _CLOUD_SHIFT)
    elif kind == 1:
        radius = int(max(size, 12) / 2 * 2**_CLOUD_SHIFT)
        cv2.circle(layer, _fixed(at), radius, colour, int(rng.integers(1, 3)), cv2.LINE_AA, _CLOUD_SHIFT)
    elif kind == 2:
        end = at + rng.normal(0, 3 * size, 2)
        cv2.line(layer, _fixed(at), _fixed(end), colour, int(rng.integers(1, 6)), cv2.LINE_AA, _CLOUD_SHIFT)
    else:
        turn = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
        reach = size * rng.uniform(0.3, 1.2, len(turn))
        corners = at + reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        points = np.round(corners * 2**_CLOUD_SHIFT).astype(np.int32)
        cv2.fillPoly(layer, [points], colour, cv2.LINE_AA, _CLOUD_SHIFT)
    changed = np.any(layer != picture.astype(np.uint8), axis=2)
    picture[changed] = layer[changed]


def _fixed(point_px: NDArray[np.float64]) -> tuple[int, int]:
    """A point in OpenCV's fixed-point numbers."""
    u, v = np.round(np.asarray(point_px) * 2**_CLOUD_SHIFT).astype(int)
    return int(u), int(v)


# `render_drogue`: the picture of a scene, with its truth.
#
# Rays through a grid of points per pixel are shaded (surfaces.py) and averaged; a larger drogue needs fewer per pixel,
# since more pixels share its edge. Then follow motion blur of the drogue, occluders, defocus of everything, noise and
# rounding to 8 bits.


_SAMPLES = ((48.0, 5), (100.0, 4), (200.0, 3), (np.inf, 2))  # side of the drawn region, px: points per pixel and axis
_GRID_PX = 8  # step of the grid on which a distorted lens is inverted
_SHIFT = 6  # bits of sub-pixel positions in OpenCV's drawing functions


def render_drogue(scene: DrogueScene, rng: np.random.Generator, grey: bool = False) -> DroguePicture:
    """The picture of a scene; `rng` draws the noise only. grey: of a grey camera, at a third of the time."""
    width, height = scene.camera.image_size_px
    picture = background_picture(scene.background, (width, height))
    _draw_hose(picture, scene)
    mean_bgr = picture.reshape(-1, 3)[::97].mean(axis=0)
    rim = rim_points_px(scene)
    _draw_basket(picture, scene, rim, mean_bgr)
    for occluder in scene.occluders:
        _draw_occluder(picture, occluder)
    if grey:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.float32)
    if scene.blur_px > 0:
        cv2.GaussianBlur(picture, (0, 0), scene.blur_px, dst=picture, borderType=cv2.BORDER_REPLICATE)
    if scene.noise_dn > 0:
        # In place: fresh arrays of this size cost as much time as what is computed in them.
        sigma = np.maximum(picture, 0)
        sigma *= 0.75 / 128
        sigma += 0.25
        np.sqrt(sigma, out=sigma)
        sigma *= np.float32(scene.noise_dn)
        sigma *= rng.standard_normal(picture.shape, dtype=np.float32)
        picture += sigma
    np.clip(np.rint(picture, out=picture), 0, 255, out=picture)
    return _with_truth(scene, picture.astype(np.uint8), rim)


def _with_truth(scene: DrogueScene, image: np.ndarray, rim: Array) -> DroguePicture:
    camera = scene.camera
    ellipse = ellipse_through(rim)
    markers = camera.project(scene.world_from_drogue.apply(scene.markers))
    hidden = ~camera.sees(rim) | _behind(scene.occluders, rim)
    return DroguePicture(
        image=image,
        centre_px=camera.project(scene.world_from_drogue.translation),
        ellipse=ellipse,
        radius_px=ellipse.major_px,
        hidden=float(hidden.mean()),
        markers_px=markers,
        markers_visible=camera.sees(markers) & ~_behind(scene.occluders, markers),
    )


def _behind(occluders: tuple[Occluder, ...], points_px: Array) -> Bools:
    """Whether points (n, 2) lie behind an occluder."""
    out = np.zeros(len(points_px), bool)
    for occluder in occluders:
        end = np.asarray(occluder.end_px)
        along = np.zeros(2) if occluder.kind == DISC else np.asarray(occluder.start_px) - end
        share = (points_px - end) @ along / max(float(along @ along), 1e-12)
        nearest = end + np.clip(share, 0, 1)[:, None] * along
        out |= np.linalg.norm(points_px - nearest, axis=1) <= occluder.width_px / 2
    return out


def _draw_occluder(picture: Floats32, occluder: Occluder) -> None:
    """Blend an occluder into the picture; its edge is anti-aliased by the distance from it."""
    height, width = picture.shape[:2]
    end = np.asarray(occluder.end_px)
    start = end if occluder.kind == DISC else np.asarray(occluder.start_px)
    reach = occluder.width_px / 2 + 1
    low = np.floor(np.minimum(start, end) - reach).astype(int).clip(0)
    high = np.minimum(np.ceil(np.maximum(start, end) + reach).astype(int) + 1, [width, height])
    if np.any(high <= low):
        return
    u, v = np.meshgrid(np.arange(low[0], high[0]) - end[0], np.arange(low[1], high[1]) - end[1])
    along = start - end
    share = np.clip((u * along[0] + v * along[1]) / max(float(along @ along), 1e-12), 0, 1)
    distance = np.hypot(u - share * along[0], v - share * along[1])
    cover = np.clip(occluder.width_px / 2 - distance + 0.5, 0, 1)[..., None].astype(np.float32)
    # A round bar: brighter along its middle.
    level = (1.15 - 0.5 * (distance / max(occluder.width_px / 2, 1e-9)) ** 2)[..., None].clip(0.5)
    piece = picture[low[1] : high[1], low[0] : high[0]]
    piece *= 1 - cover
    piece += cover * (level * np.asarray(occluder.bgr)).astype(np.float32)


def _draw_hose(picture: Floats32, scene: DrogueScene) -> None:
    """The hose from the end of the basket to the tanker: a line behind the drogue, as wide as its near end."""
    look, R = scene.look, scene.radius_m
    if look.hose_length <= 0:
        return
    ends = np.array([[0, 0, 0.9 * look.depth * R], [0, 0, (look.depth + look.hose_length) * R]])
    near, far = scene.camera.project(scene.world_from_drogue.apply(ends))
    if not np.all(np.isfinite([near, far])):
        return
    distance = float(np.linalg.norm(scene.camera_from_drogue.translation))
    width = max(round(2 * look.hose_radius * R * scene.camera.matrix[0, 0] / distance), 1)
    points = [tuple(int(x) for x in np.round(p * 2**_SHIFT)) for p in (near, far)]
    mask = np.zeros(picture.shape[:2], np.uint8)
    cv2.line(mask, points[0], points[1], 255, width, cv2.LINE_AA, _SHIFT)
    u, v, w, h = cv2.boundingRect(mask)
    share = (mask[v : v + h, u : u + w, None] / np.float32(255)).astype(np.float32)
    level = np.float32(scene.light.ambient + 0.3 * scene.light.diffuse)
    piece = picture[v : v + h, u : u + w]
    piece += share * (level * np.asarray(look.lining_bgr, np.float32) - piece)


def _draw_basket(picture: Floats32, scene: DrogueScene, rim: Array, haze_bgr: Floats32) -> None:
    """Draw canopy, markers and basket over the background."""
    height, width = picture.shape[:2]
    end = scene.radius_m * scene.look.depth
    back = rim_of(scene, scene.radius_m * scene.look.canopy_inner, end)
    outline = np.concatenate([rim, back])
    outline = outline[np.isfinite(outline).all(axis=1)]
    pad = int(np.ceil(np.max(np.abs(scene.motion_px)) / 2)) + 2
    low = (np.floor(outline.min(axis=0)).astype(int) - pad).clip(0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + pad + 1, [width, height])
    if np.any(high <= low):
        return
    n = next(points for side, points in _SAMPLES if max(high - low) <= side)
    colour, alpha = _layer(scene, low, high, n)
    if np.hypot(*scene.motion_px) > 0.05:
        kernel = _motion_kernel(scene.motion_px)
        colour = np.asarray(cv2.filter2D(colour, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
        alpha = np.asarray(cv2.filter2D(alpha, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
    piece = picture[low[1] : high[1], low[0] : high[0]]
    piece *= 1 - alpha[..., None]
    if scene.haze > 0:
        colour = (1 - np.float32(scene.haze)) * colour + np.float32(scene.haze) * alpha[..., None] * haze_bgr
    piece += colour


def rim_of(scene: DrogueScene, radius_m: float, z_m: float) -> Array:
    """Images (36, 2), px, of a circle of the basket at a depth behind the rim."""
    angle = np.arange(36) * (np.pi / 18)
    circle = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(36, z_m)], axis=1)
    return scene.camera.project(scene.world_from_drogue.apply(circle))


def _layer(scene: DrogueScene, low: np.ndarray, high: np.ndarray, n: int) -> tuple[Floats32, Floats32]:
    """Colours (h, w, 3), multiplied by the opacity, and opacities (h, w) of the region; n points per pixel and axis."""
    wide, tall = high - low
    shift = (np.arange(n) + 0.5) / n - 0.5
    u = (np.arange(low[0], high[0])[:, None] + shift).ravel()
    v = (np.arange(low[1], high[1])[:, None] + shift).ravel()
    mx, my, x0, y0 = _rays(scene, u, v)
    colour, alpha = shade_rays(scene, mx, my, x0, y0)
    # Means over the points of a pixel, by OpenCV: five times as fast as numpy's sum over two axes.
    size = (int(wide), int(tall))
    colour = np.asarray(cv2.resize(colour.reshape(len(v), len(u), 3), size, interpolation=cv2.INTER_AREA), np.float32)
    mean = cv2.resize(alpha.reshape(len(v), len(u)), size, interpolation=cv2.INTER_AREA)
    return colour, np.asarray(mean, np.float32)


def _rays(scene: DrogueScene, u: Array, v: Array) -> tuple[Floats32, Floats32, Floats32, Floats32]:
    """Slopes and points in the plane of the rim (surfaces.py) of rays through the grid u x v, each (len(v) len(u),)."""
    inverse = scene.camera_from_drogue.inverse()
    origin = inverse.translation / scene.radius_m
    x, y = _normalised(scene, u, v)
    R = inverse.rotation
    dx, dy, dz = (R[i, 0] * x + R[i, 1] * y + R[i, 2] for i in range(3))
    mx, my = dx / dz, dy / dz
    x0, y0 = origin[0] - origin[2] * mx, origin[1] - origin[2] * my
    return tuple(np.asarray(a, np.float32).ravel() for a in (mx, my, x0, y0))  # type: ignore[return-value]


def _normalised(scene: DrogueScene, u: Array, v: Array) -> tuple[Array, Array]:
    """Undistorted image coordinates of the grid: x, y (len(v), len(u)), or broadcastable to it.

    A distorted lens is inverted on a coarse grid and interpolated: the error of the latter is 1e-3 px for k1 = -0.1.
    """
    camera = scene.camera
    if not any(camera.distortion) and camera.lens == "perspective":
        fx, fy, cx, cy = camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]
        return ((u - cx) / fx)[None, :], ((v - cy) / fy)[:, None]
    nodes_u, weights_u = _linear(u)
    nodes_v, weights_v = _linear(v)
    pixels = np.stack(np.meshgrid(nodes_u, nodes_v), axis=-1)
    rays = camera.rays(pixels)[1] @ camera.camera_from_world.rotation.T
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return weights_v @ x @ weights_u.T, weights_v @ y @ weights_u.T


def _linear(values: Array) -> tuple[Array, Array]:
    """Nodes (m,) of a coarse grid and the weights (n, m) of linear interpolation at values (n,)."""
    count = max(int(np.ceil((values[-1] - values[0]) / _GRID_PX)), 1) + 1
    nodes = np.linspace(values[0], values[-1], count)
    place = np.clip((values - nodes[0]) / (nodes[1] - nodes[0]), 0, count - 1)
    left = np.minimum(place.astype(int), count - 2)
    weights = np.zeros((len(values), count))
    rows = np.arange(len(values))
    weights[rows, left], weights[rows, left + 1] = 1 - (place - left), place - left
    return nodes, weights


def _motion_kernel(motion_px: tuple[float, float]) -> Floats32:
    """The kernel of a uniform straight motion of this path, centred: its mean position does not move."""
    half = int(np.ceil(np.max(np.abs(motion_px)) / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    steps = max(int(8 * np.hypot(*motion_px)), 2)
    share = (np.arange(steps) + 0.5) / steps - 0.5
    u, v = half + share * motion_px[0], half + share * motion_px[1]
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    a, b = (v - i).astype(np.float32), (u - j).astype(np.float32)
    for di, wi in ((0, 1 - a), (1, a)):
        for dj, wj in ((0, 1 - b), (1, b)):
            np.add.at(kernel, (i + di, j + dj), wi * wj)
    return kernel / kernel.sum()
