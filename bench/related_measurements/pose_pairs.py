"""Poses of a camera from a target, against those of the robot arm that carries it: `compare` on a real pair of motions.

python -m bench.related_measurements.pose_pairs FOLDER

FOLDER has two CSV tables without a header, t_s, x, y, z (m), qx, qy, qz, qw: `*_hinge.csv` (the arm, the reference) and
`*_target_ir.csv` (the camera). The place of the camera on the arm, that of the target, and the offset of the clocks are
unknown; they are estimated, as `beampose compare` does, from every second block of ten seconds; the figures are those
of the other blocks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.arrays import Array
from tracking.comparison.estimation import estimate_alignment
from tracking.comparison.frame_alignment import PoseSeries, residuals

BLOCK_S = 10.0
SIGMA_M, SIGMA_DEG = 0.002, 0.2  # of the camera's poses, for the weights of positions and attitudes


def read(folder: Path, ending: str) -> PoseSeries:
    """The motion in the table with this ending."""
    path = next(folder.glob(f"*{ending}"))
    table = np.loadtxt(path, delimiter=",")
    table = table[np.concatenate([[True], np.diff(table[:, 0]) > 0])]
    sigmas = np.array([SIGMA_M] * 3 + [np.radians(SIGMA_DEG)] * 3)
    covariance = np.broadcast_to(np.diag(sigmas**2), (len(table), 6, 6))
    return PoseSeries(table[:, 0], Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4], covariance)


def sizes(values: Array, digits: int) -> str:
    """Median, 95 % and largest of sizes, as text."""
    figures = np.median(values), np.quantile(values, 0.95), values.max()
    return ", ".join(f"{x:.{digits}f}" for x in figures)


def main() -> None:
    """Print the figures."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    folder = Path(sys.argv[1])
    arm, camera = read(folder, "_hinge.csv"), read(folder, "_target_ir.csv")
    even = (camera.t_s - camera.t_s[0]) // BLOCK_S % 2 == 0
    found = estimate_alignment(camera.select(even), arm)
    length = camera.t_s[-1] - camera.t_s[0]
    print(f"{len(camera)} poses of the camera, {len(arm)} of the arm, {length:.0f} s")
    offset, sigma = 1e3 * found.alignment.offset_s, 1e3 * found.sigmas[0]
    print(f"clock of the arm minus that of the camera: {offset:.1f} ms, sigma {sigma:.1f} ms")
    for name, rows in (("used", even), ("not used", ~even)):
        r = residuals(camera.select(rows), arm, found.alignment)
        away = 1e3 * np.linalg.norm(r.values[r.known, :3], axis=1)
        turn = np.degrees(np.linalg.norm(r.values[r.known, 3:], axis=1))
        print(f"{name}: {r.known.sum()} poses; median, 95 %, largest:")
        print(f"  position {sizes(away, 1)} mm; attitude {sizes(turn, 2)} deg")


if __name__ == "__main__":
    main()
