"""Triangulation of the known dots of a real four-camera set-up, against their published positions.

    python -m bench.related_measurements.stereo_real ../shared/data/ptv_four_cameras

The dots of the calibration target are the published positions. Light passes glass and water, so that a pinhole camera
is an approximation: each camera is fitted to one half of the dots (it absorbs the refraction in focal length and k1),
and the other half is triangulated by pairs of cameras. First positions come from the published orientations by Snell's
law at a flat wall.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.pose import Pose
from tracking.binocular.joint_fit import triangulate
from tracking.binocular.marker_model import StereoPair

SIZE_PX, PITCH_MM = (1280, 1024), 0.012
INDEX_GLASS, INDEX_WATER, GLASS_MM = 1.46, 1.33, 6.0  # parameters/ptv.par
LEAST_PIXELS = 8  # of a dot's image; smaller ones are noise
SHIFTS_PX = np.arange(-80, 81, 4)  # searched: the orientations belong to another reference of the wall
GATES_PX = (6.0, 6.0, 4.0, 3.0, 3.0, 3.0)
PAIRS = ((1, 2), (3, 4), (1, 3), (2, 4))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    if not (folder / "cal").is_dir():
        parser.error(f"{folder}: expected the folder ptv_four_cameras with cal/, found nothing")
    dots = np.loadtxt(folder / "cal" / "target_on_a_side.txt")[:, 1:]
    labelled = {c: label(folder, c, dots) for c in (1, 2, 3, 4)}
    print("dots not used for the calibration: triangulated minus published, mm")
    for pair in PAIRS:
        errors = np.concatenate([held_out(pair, labelled, dots, half) for half in (0, 1)])
        rms = np.sqrt((errors**2).mean(axis=0))
        print(
            f"  cameras {pair[0]} and {pair[1]}: {len(errors)} dots, RMS x {rms[0]:.3f}, y {rms[1]:.3f}, z {rms[2]:.3f}"
        )


def label(folder: Path, camera: int, dots: Array) -> Array:
    """Pixels (n, 2) of the dots (n, 3), mm, in one camera; nan where none is found or it is not unique."""
    lines = (folder / "cal" / f"cam{camera}.tif_targets").read_text().splitlines()[1:]
    found = np.array([[float(v) for v in line.split()[1:4]] for line in lines if len(line.split()) > 3])
    seen = found[found[:, 2] > LEAST_PIXELS, :2]
    tree = cKDTree(seen)
    first = refracted(folder / "cal" / f"cam{camera}.tif.ori", dots)
    shifts = np.stack(np.meshgrid(SHIFTS_PX, SHIFTS_PX), axis=-1).reshape(-1, 2)
    hits = [int((tree.query(first + s, distance_upper_bound=4.0)[0] < 4).sum()) for s in shifts]
    expected = first + shifts[int(np.argmax(hits))]
    pixels = np.full((len(dots), 2), np.nan)
    for gate in GATES_PX:
        distance, index = tree.query(expected)
        near: Bools = np.asarray(distance < gate)
        names, counts = np.unique(index[near], return_counts=True)
        near &= ~np.isin(index, names[counts > 1])
        pixels = np.where(near[:, None], seen[index], np.nan)
        expected = fitted(pixels, dots, np.arange(len(dots))).project(dots / 1000)
    return pixels


def refracted(path: Path, dots: Array) -> Array:
    """Pixels (n, 2) of points in water, mm, by an OpenPTV orientation and Snell's law at a flat wall."""
    v = [float(word) for word in path.read_text().split()]
    centre, R, focal, wall = np.array(v[:3]), np.array(v[6:15]).reshape(3, 3), v[17], np.array(v[18:21])
    normal, away = wall / np.linalg.norm(wall), float(np.linalg.norm(wall))
    out = []
    for x in dots:
        in_air, in_water = float(centre @ normal) - away - GLASS_MM, away - float(x @ normal)
        sideways = (centre - (centre @ normal) * normal) - (x - (x @ normal) * normal)
        length = float(np.linalg.norm(sideways))

        def miss(s: float, a: float = in_air, w: float = in_water, total: float = length) -> float:
            sines = (s, s * INDEX_WATER / INDEX_GLASS, s * INDEX_WATER)
            tangents = [q / np.sqrt(1 - q * q) for q in sines]
            return float(w * tangents[0] + GLASS_MM * tangents[1] + a * tangents[2] - total)

        sine = float(brentq(miss, 0.0, 0.74)) * INDEX_WATER
        ray = R.T @ (-np.sqrt(1 - sine * sine) * normal - sine * sideways / length)
        image = -focal * ray[:2] / ray[2] / PITCH_MM
        out.append([SIZE_PX[0] / 2 + image[0], SIZE_PX[1] / 2 - image[1]])
    return np.array(out)


def fitted(pixels: Array, dots: Array, use: Ints) -> Camera:
    """A pinhole camera with k1 from dots (n, 3), mm, of the rows `use`."""
    rows = use[np.isfinite(pixels[use, 0])]
    points, uv = dots[rows].astype(np.float32)[None], pixels[rows].astype(np.float32)[None]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    K = np.array([[8000.0, 0, 639.5], [0, 8000.0, 511.5], [0, 0, 1]])
    _, K, distortion, turn, shift = cv2.calibrateCamera(points, uv, SIZE_PX, K, np.zeros(5), flags=flags)
    pose = Pose(cv2.Rodrigues(turn[0])[0], np.ravel(shift[0]) / 1000)
    return Camera("camera", "", SIZE_PX, K, tuple(float(d) for d in np.ravel(distortion)[:5]), pose)


def held_out(pair: tuple[int, int], labelled: dict[int, Array], dots: Array, half: int) -> Array:
    """Errors (n, 3), mm, of the dots of one half, with cameras fitted to the other."""
    other = np.arange(1 - half, len(dots), 2)
    cameras = [fitted(labelled[c], dots, other) for c in pair]
    both = np.isfinite(labelled[pair[0]][:, 0]) & np.isfinite(labelled[pair[1]][:, 0])
    test = np.flatnonzero(both & (np.arange(len(dots)) % 2 == half))
    uv = np.stack([labelled[c][test] for c in pair])
    cov = np.broadcast_to(0.3**2 * np.eye(2), (2, len(test), 2, 2))
    found = triangulate(StereoPair((cameras[0], cameras[1])), uv, cov)
    return np.asarray(1000 * found.points - dots[test])


if __name__ == "__main__":
    main()
