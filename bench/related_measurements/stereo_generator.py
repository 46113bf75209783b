"""Stereo recordings for measurements of the binocular method, by a generator that shares no code with it.

Two parallel cameras of 1280 x 960 px and 1000 px focal length, 1 m apart, see seven red discs of 5 cm on a drogue.
Pictures are ray-traced: each pixel is the mean of 6 x 6 rays that meet the planes of the discs, blurred by the lens,
with noise. World is the frame of the left camera; x to the right, y down, z ahead. Written from the description of the
measurement, with its own projection, rotation and noise; only the formats of the files are the project's.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M, DISC_M = 1280, 960, 1000.0, 1.0, 0.05
RAYS, BLUR_PX, NOISE_DN = 6, 0.7, 2.0
RED, CLOTH, SKY = (np.array(c, dtype=float) for c in ((38, 30, 170), (62, 60, 58), (165, 140, 120)))
_TURNS = np.deg2rad([4.0, 58.0, 99.0, 161.0, 214.0, 259.0, 322.0])
DISCS = np.column_stack([0.34 * np.cos(_TURNS), 0.34 * np.sin(_TURNS), [0.0, 0.1, 0.03, 0.09, 0.0, 0.07, 0.12]])
_RIM = (0.27, 0.43, 0.14)  # inner and outer radius of the cloth, and its plane, m


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula: a turn by a vector (3,), rad."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / max(angle, 1e-15)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass(frozen=True)
class Eye:
    """A pinhole camera: pixel = f (x, y) / z + c of R (X - centre)."""

    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    R: np.ndarray = field(default_factory=lambda: np.eye(3))
    f: float = FOCAL_PX
    c: tuple[float, float] = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)

    def pixels(self, X: np.ndarray) -> np.ndarray:
        """(n, 2) of points (n, 3)."""
        x, y, z = ((X - self.centre) @ self.R.T).T
        return np.column_stack([self.f * x / z + self.c[0], self.f * y / z + self.c[1]])

    def rays(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Directions (n, 3) in world."""
        return np.column_stack([(u - self.c[0]) / self.f, (v - self.c[1]) / self.f, np.ones_like(u)]) @ self.R


def true_eyes() -> tuple[Eye, Eye]:
    """The cameras that take the pictures."""
    return Eye(), Eye(np.array([BASELINE_M, 0.0, 0.0]), rotation(np.deg2rad([0.2, -0.4, 0.3])))


@dataclass(frozen=True)
class Place:
    """A pose of the drogue: X_world = R X_body + t."""

    R: np.ndarray
    t: np.ndarray


def random_place(z: float, rng: np.random.Generator, tilt_deg: float = 12.0) -> Place:
    """Near the middle of both pictures at a distance z, m, turned by about tilt_deg per axis."""
    t = np.array([0.5 + rng.uniform(-0.08, 0.08) * z, rng.uniform(-0.08, 0.08) * z, z])
    return Place(rotation(np.deg2rad(tilt_deg) * rng.normal(size=3)), t)


def approach(frames: int, far: float, near: float, rng: np.random.Generator) -> list[Place]:
    """A drogue that comes nearer and sways, 25 pictures per second."""
    s = np.arange(frames) / 25.0
    phase, rate = rng.uniform(0, 6.28, 5), rng.uniform(1.0, 2.2, 5)
    waves = np.sin(rate * s[:, None] + phase)
    z = far + (near - far) * np.linspace(0, 1, frames) ** 0.8
    out = []
    for k in range(frames):
        t = np.array([0.5 + 0.04 * z[k] * waves[k, 0], 0.04 * z[k] * waves[k, 1], z[k]])
        out.append(Place(rotation(np.array([0.3, 0.3, 0.2]) * waves[k, 2:]), t))
    return out


def picture(eye: Eye, place: Place, shown: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The picture (h, w, 3), BGR, of the discs in `shown` (7,), bool."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    clouds = 6 * np.sin(u / 140 + rng.uniform(0, 6)) * np.sin(v / 90 + rng.uniform(0, 6)) + 10 * v / HEIGHT
    image = SKY.astype(np.float32) + clouds[..., None]
    _cover(image, eye, place, np.array([0.0, 0.0, _RIM[2]]), _RIM[1], _RIM[0], CLOTH)
    for disc in DISCS[shown]:
        _cover(image, eye, place, disc, DISC_M / 2, 0.0, RED)
    image += rng.normal(0, NOISE_DN, image.shape).astype(np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _cover(
    image: np.ndarray, eye: Eye, place: Place, centre: np.ndarray, outer: float, inner: float, colour: np.ndarray
) -> None:
    """Paint a flat ring or disc: each pixel by the share of its rays that meet it, after the blur of the lens."""
    turn = np.linspace(0, 2 * np.pi, 60)
    edge = centre + outer * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    at = eye.pixels(edge @ place.R.T + place.t)
    (u0, v0), (u1, v1) = np.floor(at.min(axis=0)).astype(int) - 5, np.ceil(at.max(axis=0)).astype(int) + 6
    u0, v0, u1, v1 = max(u0, 0), max(v0, 0), min(u1, WIDTH), min(v1, HEIGHT)
    if u0 >= u1 or v0 >= v1:
        return
    fine = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    us = (np.arange(u0, u1)[:, None] + fine).ravel()
    vs = (np.arange(v0, v1)[:, None] + fine).ravel()
    U, V = np.meshgrid(us, vs)
    rays = eye.rays(U.ravel(), V.ravel()) @ place.R  # in body
    start = (eye.centre - place.t) @ place.R
    far = (centre[2] - start[2]) / rays[:, 2]
    meet = start[:2] + far[:, None] * rays[:, :2] - centre[:2]
    r2 = (meet**2).sum(axis=1)
    hit = ((r2 <= outer**2) & (r2 >= inner**2)).reshape(U.shape).astype(np.float32)
    blurred = cv2.GaussianBlur(hit, (0, 0), BLUR_PX * RAYS)
    share = blurred.reshape(v1 - v0, RAYS, u1 - u0, RAYS).mean(axis=(1, 3))[..., None]
    image[v0:v1, u0:u1] = share * colour + (1 - share) * image[v0:v1, u0:u1]


def quaternion(R: np.ndarray) -> list[float]:
    """w, x, y, z of a turn by less than 180 degrees."""
    w = np.sqrt(max(1 + np.trace(R), 1e-12)) / 2
    return [float(w), *((np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)).tolist())]


def _yaml_camera(eye: Eye) -> dict[str, object]:
    return {
        "image_size_px": [WIDTH, HEIGHT],
        "camera_matrix": {"fx": eye.f, "fy": eye.f, "cx": eye.c[0], "cy": eye.c[1]},
        "distortion": [],
        "camera_from_world": {"quaternion_wxyz": quaternion(eye.R), "translation_m": (-eye.R @ eye.centre).tolist()},
    }


def write_recording(
    folder: Path,
    places: list[Place],
    stated: tuple[Eye, Eye],
    rng: np.random.Generator,
    *,
    shown: np.ndarray | None = None,
    pictures: bool = True,
    noise_px: float = 0.04,
    sigmas: dict[str, float] | None = None,
    black_right: int = 0,
) -> None:
    """Write a run folder with truth.

    stated: the cameras of pair.yaml; the pictures are always those of `true_eyes`. shown (n, 7): discs that are there.
    pictures: False: a table of centroids with noise_px. sigmas: standard deviations of parameters of the cameras, for
    the covariance of pair.yaml. black_right: number of first pictures of the right camera that are black.
    """
    folder.mkdir(parents=True)
    eyes = true_eyes()
    shown = np.ones((len(places), 7), bool) if shown is None else shown
    pair: dict[str, object] = {
        "schema": "beampose/pair/1",
        "cameras": {name: _yaml_camera(eye) for name, eye in zip(("left", "right"), stated, strict=True)},
    }
    if sigmas:
        pair["covariance"] = {"parameters": list(sigmas), "matrix": np.diag(np.square(list(sigmas.values()))).tolist()}
    run: dict[str, object] = {
        "schema": "beampose/stereo/1",
        "name": folder.name,
        "pair": "pair.yaml",
        "frame_rate_hz": 25.0,
        "cameras": {
            n: {"frames": f"frames/{n}"} if pictures else {"detections": "points.csv"} for n in ("left", "right")
        },
        "target": {
            "colours": {"red": {"hue_deg": [340.0, 20.0], "saturation": [0.35, 1.0], "value": [0.2, 1.0]}},
            "markers": {
                str(k + 1): {"position_m": x.tolist(), "colour": "red", "radius_m": DISC_M / 2}
                for k, x in enumerate(DISCS)
            },
        },
    }
    (folder / "pair.yaml").write_text(json.dumps(pair))
    (folder / "run.yaml").write_text(json.dumps(run))
    rows = ["frame,camera,u_px,v_px,sigma_u_px,sigma_v_px"]
    for name, eye in zip(("left", "right"), eyes, strict=True):
        if pictures:
            (folder / "frames" / name).mkdir(parents=True)
        for k, place in enumerate(places):
            if pictures:
                image = picture(eye, place, shown[k], rng)
                if name == "right" and k < black_right:
                    image[:] = 0
                path = folder / "frames" / name / f"{k:06d}.png"
                cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            else:
                at = eye.pixels(DISCS[shown[k]] @ place.R.T + place.t)
                at = rng.permutation(at + rng.normal(0, noise_px, at.shape))
                rows += [f"{k},{name},{u:.5f},{v:.5f},{noise_px},{noise_px}" for u, v in at]
    if not pictures:
        (folder / "points.csv").write_text("\n".join(rows) + "\n")
    (folder / "truth").mkdir()
    lines = ["frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz"]
    for k, p in enumerate(places):
        lines.append(f"{k},{k / 25:.6f}," + ",".join(f"{v:.12g}" for v in (*p.t, *quaternion(p.R))))
    (folder / "truth" / "pose.csv").write_text("\n".join(lines) + "\n")
