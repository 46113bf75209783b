"""Detections drawn over real pictures: `python bench/real_pictures.py DATA_FOLDER OUT_FOLDER`.

DATA_FOLDER contains laser_beam_series_t, laser_beam_modes, laser_spot_room, laser_spot_saturated, star_fields and
particles_trackpy_reference; missing ones are skipped. Every spot is drawn as its 2-sigma ellipse with its rank.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tracking.detection.detect import find_spots
from tracking.detections import Detections

SETS = ("laser_beam_series_t", "laser_beam_modes", "laser_spot_room", "laser_spot_saturated", "star_fields")
SUFFIXES = {".pgm", ".jpg", ".png", ".tiff"}


def grey(path: Path) -> np.ndarray:
    """A picture for the detector; pictures with black particles are inverted."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise SystemExit(f"{path}: not a picture")
    return 255 - image if "particles" in str(path) else image


def overlay(image: np.ndarray, found: Detections, zoom: int) -> np.ndarray:
    """The picture, enlarged `zoom` times and stretched in contrast, with ellipses and ranks."""
    low, high = np.percentile(image, [1, 99.9])
    shown = np.clip((image - low) / max(high - low, 1) * 255, 0, 255).astype(np.uint8)
    canvas = cv2.cvtColor(
        cv2.resize(shown, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR
    )
    for rank, ((u, v), major, minor, angle) in enumerate(
        zip(found.uv_px, found.major_px, found.minor_px, found.angle_deg, strict=True)
    ):
        centre = (round(float(u + 0.5) * zoom), round(float(v + 0.5) * zoom))
        size = (max(int(2 * zoom * major), 3), max(int(2 * zoom * minor), 3))
        cv2.ellipse(canvas, centre, size, float(angle), 0, 360, (0, 255, 255), 1, cv2.LINE_AA)
        if rank < 40:
            cv2.putText(
                canvas, str(rank), (centre[0] + size[0] + 2, centre[1]), 0, 0.45, (80, 160, 255), 1, cv2.LINE_AA
            )
    return canvas


def main() -> None:
    """Draw and print the detections of all sets."""
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    data, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    for name in (*SETS, "particles_trackpy_reference"):
        for path in sorted((data / name).glob("*")):
            if path.suffix in SUFFIXES:
                image = grey(path)
                found = find_spots(image)
                print(f"{name}/{path.name}: {len(found)} spots")
                for i in range(min(len(found), 3)):
                    sigma = np.sqrt(np.diag(found.cov_px2[i]))
                    print(
                        f"   ({found.uv_px[i, 0]:.2f}, {found.uv_px[i, 1]:.2f}) +- ({sigma[0]:.3f}, {sigma[1]:.3f}) px,"
                        f" axes {found.major_px[i]:.2f} {found.minor_px[i]:.2f} px, peak {found.peak[i]:.0f} DN"
                    )
                zoom = 4 if max(image.shape) < 300 else 1
                cv2.imwrite(str(out / f"{name}-{path.stem.replace(' ', '_')}.png"), overlay(image, found, zoom))


if __name__ == "__main__":
    main()
