"""The background of a picture: ambient light on a textured screen, details, defects, false spots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import erf

from bench.random_pictures.looks import Look
from bench.random_pictures.optics import Patch, screen_jacobian
from bench.random_pictures.sensors import Light
from bench.random_pictures.spots import periodic_field
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Screen

_NODE_PX = 16  # spacing of the pixels at which the position on the screen is computed; cubic interpolation between them
_PHOTOGRAPHS = ("laser_spot_room/*.jpg", "chessboard_webcam_c920/*.jpg", "circles_stills/*g")
_TILE = 1024  # samples of the periodic texture


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The constant background of one camera, electrons, and the factor on laser light."""

    ambient_e: Light  # (h, w), of light that flickers
    steady_e: Light  # (h, w), of constant lamps, and leakage current
    response: Light  # (h, w): surface and vignetting, of laser light; about 1
    blinking: tuple[tuple[int, int, float], ...]  # row, column, electrons: on in half of the pictures
    bright: Array  # (m, 3): u, v, radius (px) of details that resemble spots


def draw_surroundings(rng: np.random.Generator, look: Look, camera: Camera, screen: Screen) -> Surroundings:
    """The background of one camera."""
    width, height = camera.image_size_px
    full = look.sensor.full_well_e
    x, y = _screen_places(camera, screen)
    response = _vignetting(look, width, height)
    response *= _surface(rng, look, camera, screen, x, y)
    ambient = np.full((height, width), look.background * full, dtype=np.float32)
    ambient *= _gradient(rng, look, width, height)
    if look.photograph:
        albedo = draw_photograph(rng, camera.image_size_px)
        ambient *= albedo
        response *= 1 - np.float32(look.photograph) * (1 - np.clip(albedo / np.quantile(albedo, 0.99), 0, 1))
    if look.screen_edge:
        ambient *= _beyond_edge(rng, screen, x, y)
    for _ in range(look.reflections):
        ambient += _hump(rng, width, height) * np.float32(full * rng.uniform(0.01, 0.12))
    steady = np.zeros((height, width), dtype=np.float32)
    bright = [b for _ in range(look.details) if (b := _detail(rng, look, ambient, steady)) is not None]
    ambient *= response
    blinking = []
    for _ in range(look.hot_pixels):
        row, column, charge = int(rng.integers(height)), int(rng.integers(width)), full * rng.uniform(0.02, 0.9)
        if rng.random() < 0.15:
            blinking.append((row, column, charge))
        elif rng.random() < 0.1:
            ambient[row, column] = 0.0  # a dead pixel
            response[row, column] = 0.0
        else:
            steady[row, column] += charge
    return Surroundings(ambient, steady, response, tuple(blinking), np.array(bright).reshape(-1, 3))


def photographs() -> list[Path]:
    """Photographs of rooms, boards and tables beside the project; empty where they are not at hand."""
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    return sorted(f for pattern in _PHOTOGRAPHS for f in data.glob(pattern))


def draw_photograph(rng: np.random.Generator, size_px: tuple[int, int]) -> Light:
    """A random photograph, random part and side, scaled to a camera's size (width, height); mean 1."""
    files = photographs()
    if not files:
        raise SystemExit("photographs: expected photographs in ../shared/data beside the project, found none")
    grey = np.asarray(cv2.imread(str(files[int(rng.integers(len(files)))]), cv2.IMREAD_GRAYSCALE))
    width, height = size_px
    part = float(rng.uniform(0.5, 1.0)) * min(grey.shape[1] / width, grey.shape[0] / height)
    w, h = int(part * width), int(part * height)
    left, top = int(rng.integers(grey.shape[1] - w + 1)), int(rng.integers(grey.shape[0] - h + 1))
    cut = grey[top : top + h, left : left + w][:, :: int(rng.choice([-1, 1]))]
    way = cv2.INTER_AREA if part > 1 else cv2.INTER_CUBIC
    scaled = np.clip(cv2.resize(cut, size_px, interpolation=way).astype(np.float32), 2.0, 255.0)
    return np.asarray(scaled / scaled.mean(), np.float32)


def seen_turned(light: Light, camera: Camera, turn_rad: Array) -> Light:
    """Expected electrons (h, w) as the camera sees them after a small rotation (3,) about its own axes."""
    height, width = light.shape
    v, u = np.mgrid[0 : height + 32 : 32, 0 : width + 32 : 32].astype(float)
    R = camera.camera_from_world.rotation
    turned = Rotation.from_rotvec(turn_rad).as_matrix() @ R
    now = replace(camera, camera_from_world=Pose(turned, turned @ R.T @ camera.camera_from_world.translation))
    origin, rays = now.rays(np.stack([u, v], axis=-1))
    away = camera.project(origin + rays) - np.stack([u, v], axis=-1)
    to_v, to_u = np.mgrid[:height, :width]
    maps = np.asarray(to_u / 32, np.float32), np.asarray(to_v / 32, np.float32)
    gaps = [cv2.remap(np.asarray(away[..., i], np.float32), *maps, cv2.INTER_LINEAR) for i in (0, 1)]
    places = np.stack([to_v + gaps[1], to_u + gaps[0]])
    return np.maximum(ndimage.map_coordinates(light, places, order=3, mode="nearest"), np.float32(0.0))


def gaussian_patch(u: float, v: float, sigma: float, size_px: tuple[int, int]) -> Patch | None:
    """A round Gaussian of peak 1, integrated over the pixels in closed form."""
    reach = 5 * sigma + 2
    u0, v0 = max(int(u - reach), 0), max(int(v - reach), 0)
    u1, v1 = min(int(u + reach) + 2, size_px[0]), min(int(v + reach) + 2, size_px[1])
    if u0 >= u1 or v0 >= v1:
        return None
    scale = sigma * np.sqrt(2)

    def means(first: int, last: int, middle: float) -> Array:
        edges = erf((np.arange(first, last + 1) - 0.5 - middle) / scale)
        return np.asarray(np.diff(edges) * sigma * np.sqrt(np.pi / 2))

    return Patch(u0, v0, np.outer(means(v0, v1, v), means(u0, u1, u)).astype(np.float32))


def _screen_places(camera: Camera, screen: Screen) -> tuple[Light, Light]:
    """Screen x and y (m), each (h, w), seen by the pixels; nan where they see none. Undistorts by iteration."""
    width, height = camera.image_size_px
    u = np.arange(-2 * _NODE_PX, width + 2 * _NODE_PX + 1, _NODE_PX)
    v = np.arange(-2 * _NODE_PX, height + 2 * _NODE_PX + 1, _NODE_PX)
    uu, vv = np.meshgrid(u, v)
    xd = (uu - camera.matrix[0, 2]) / camera.matrix[0, 0]
    yd = (vv - camera.matrix[1, 2]) / camera.matrix[1, 1]
    k1, k2, p1, p2, k3 = np.pad(np.asarray(camera.distortion, dtype=float), (0, 5 - len(camera.distortion)))
    x, y = xd.copy(), yd.copy()
    for _ in range(60):
        r2 = x**2 + y**2
        radial = np.maximum(1 + k1 * r2 + k2 * r2**2 + k3 * r2**3, 0.2)
        nx = (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x**2)) / radial
        ny = (yd - p1 * (r2 + 2 * y**2) - 2 * p2 * x * y) / radial
        x, y = (x + nx) / 2, (y + ny) / 2
    R, t = camera.camera_from_world.rotation, camera.camera_from_world.translation
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ R
    centre = -R.T @ t
    S, origin = screen.world_from_screen.rotation, screen.world_from_screen.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        away = ((origin - centre) @ S[:, 2]) / (rays @ S[:, 2])
        hit = (centre + away[..., None] * rays - origin) @ S[:, :2]
    hit = np.where((away > 0)[..., None], hit, np.nan)
    to_u, to_v = np.meshgrid(np.arange(width) / _NODE_PX + 2, np.arange(height) / _NODE_PX + 2)
    maps = to_u.astype(np.float32), to_v.astype(np.float32)
    x, y = (cv2.remap(hit[..., i].astype(np.float32), *maps, cv2.INTER_CUBIC) for i in (0, 1))
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _surface(rng: np.random.Generator, look: Look, camera: Camera, screen: Screen, x: Light, y: Light) -> Light:
    """Albedo (h, w) about 1: fixed on the screen, or in one of five scenes in the picture (dust, uneven pixels)."""
    if not look.texture:
        return np.ones(x.shape, dtype=np.float32)
    field = periodic_field(np.random.default_rng(int(rng.integers(2**31))), _TILE, 2.0)
    if rng.random() < 0.2:
        width, height = camera.image_size_px
        to_x, to_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        scale = 2.0 / look.texture_grain_px
    else:
        middle = np.array([float(np.nanmedian(x)), float(np.nanmedian(y))])
        px_per_m = np.sqrt(abs(np.linalg.det(screen_jacobian(camera, screen, middle))))
        to_x, to_y = np.nan_to_num(x - middle[0]), np.nan_to_num(y - middle[1])
        scale = 2.0 * px_per_m / look.texture_grain_px
    sampled = cv2.remap(
        field, np.asarray(to_x * scale, np.float32), np.asarray(to_y * scale, np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )  # fmt: skip
    return np.asarray(1 + look.texture * np.clip(sampled, -3, 3), dtype=np.float32)


def _vignetting(look: Look, width: int, height: int) -> Light:
    u, v = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
    r2 = (u[None, :] ** 2 + v[:, None] ** 2) / 2
    return np.asarray(1 - look.vignetting * r2, dtype=np.float32)


def _gradient(rng: np.random.Generator, look: Look, width: int, height: int) -> Light:
    turn = rng.uniform(0, 2 * np.pi)
    u, v = np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height)
    return np.asarray(
        1 + look.gradient * (np.cos(turn) * u[None, :] + np.sin(turn) * v[:, None]) / np.sqrt(2), dtype=np.float32
    )


def _beyond_edge(rng: np.random.Generator, screen: Screen, x: Light, y: Light) -> Light:
    """1 on the screen, another level beyond its edge; of a screen without a stated size one straight edge is drawn."""
    level = float(rng.uniform(0.1, 1.8))
    if screen.size_m is not None:
        on = (np.abs(x) <= screen.size_m[0] / 2) & (np.abs(y) <= screen.size_m[1] / 2)
    else:
        turn, middle = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.5)
        height, width = x.shape
        u, v = np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height)
        on = np.cos(turn) * u[None, :] + np.sin(turn) * v[:, None] < middle
    return np.asarray(cv2.GaussianBlur(np.where(on, 1.0, level).astype(np.float32), (0, 0), 0.7))


def _hump(rng: np.random.Generator, width: int, height: int) -> Light:
    """A wide reflection of peak 1."""
    u0, v0, a, b = rng.uniform(0, width), rng.uniform(0, height), *rng.uniform(25, 150, 2)
    u, v = np.arange(width), np.arange(height)
    return np.asarray(
        np.exp(-(((v - v0) / b) ** 2) / 2)[:, None] * np.exp(-(((u - u0) / a) ** 2) / 2)[None, :], dtype=np.float32
    )


def _detail(rng: np.random.Generator, look: Look, ambient: Light, steady: Light) -> tuple[float, float, float] | None:
    """Add one detail; returns its position and radius if it resembles a spot."""
    height, width = ambient.shape
    u, v = float(rng.uniform(0, width - 1)), float(rng.uniform(0, height - 1))
    kind = str(rng.choice(["lamp", "screw", "mark", "line"]))
    if kind == "lamp":
        sigma = float(np.exp(rng.uniform(np.log(0.6), np.log(3.0))))
        patch = gaussian_patch(u, v, sigma, (width, height))
        if patch is None:
            return None
        steady[patch.where] += patch.light * np.float32(look.sensor.full_well_e * np.exp(rng.uniform(-3.5, 0.3)))
        return u, v, 4 * sigma
    reach = 8 if kind == "screw" else 60
    u0, v0 = max(int(u) - reach, 0), max(int(v) - reach, 0)
    part = ambient[v0 : int(v) + reach, u0 : int(u) + reach]
    drawn = np.zeros(part.shape, dtype=np.uint8)
    at = (round((u - u0) * 16), round((v - v0) * 16))  # in sixteenths of a pixel, as OpenCV draws
    turn, length = rng.uniform(0, 2 * np.pi), rng.uniform(10, 55) * 16
    end = (round(at[0] + length * np.cos(turn)), round(at[1] + length * np.sin(turn)))
    if kind == "screw":
        cv2.circle(drawn, at, round(rng.uniform(1.5, 5) * 16), 255, -1, cv2.LINE_AA, 4)
    else:
        cv2.line(drawn, at, end, 255, int(rng.integers(1, 4)), cv2.LINE_AA, 4)
    strength = {"screw": rng.uniform(0.3, 4.0), "mark": rng.uniform(0.3, 0.8), "line": rng.uniform(1.3, 4.0)}[kind]
    mask = cv2.GaussianBlur(drawn, (0, 0), 0.6).astype(np.float32) / np.float32(255)
    part *= 1 + np.float32(strength - 1) * mask
    return (u, v, 8.0) if kind == "screw" and strength > 1 else None
