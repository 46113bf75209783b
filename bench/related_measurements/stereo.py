"""Binocular measurement: distances from 5 to 30 m, seven markers at 10 m, and distances after a calibration.

    python -m bench.related_measurements.stereo --trials 400 --seed 1 --campaigns 4

Distances: bias and RMS of the distance of one marker, over the bound of the information used. Poses: RMS over the
bound, NEES/6. Campaigns: the pair is calibrated from simulated photographs of a board first; the errors over the sigmas
that the joint covariance of the calibration states.
"""

from __future__ import annotations

import argparse

import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from calibration.pair import CalibratedPair, calibrate_pair
from geometry import rotations
from geometry.arrays import Array, Ints
from geometry.camera import in_picture
from geometry.pose import Pose
from lab.targets.stereo.simulated_recording import drogue_markers, simulated_pair
from studies.zhou2020 import BASELINE_M, FOCAL_PX, METHODS, SIZE_PX, distance_errors, pose_errors
from tracking.binocular.joint_fit import MarkerObservations, fit_pose
from tracking.binocular.marker_model import StereoPair, project, project_markers

DISTANCES_M = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise-px", type=float, default=0.1)
    parser.add_argument("--campaigns", type=int, default=0, help="simulated calibrations of the pair")
    given = parser.parse_args()
    rng = np.random.default_rng([given.seed, 2020])
    print(f"distance of a marker, noise {given.noise_px:g} px, {given.trials} trials")
    for distance in DISTANCES_M:
        e = distance_errors(distance, given.trials, given.noise_px, rng)
        parts = [
            f"{m}: bias {100 * b / distance:+.4f} %, RMS {1000 * r:.1f} mm = {r / s:.3f} x bound"
            for m, b, r, s in zip(METHODS, e.bias, e.rms, e.bound, strict=True)
        ]
        print(f"  {distance:4.0f} m  " + "; ".join(parts))
    p = pose_errors(given.trials, given.noise_px, rng)
    horn, joint = (np.sqrt((d**2).mean(axis=0)) for d in (p.horn, p.joint))
    for name, rms in (("Horn", horn), ("joint", joint)):
        turn = np.rad2deg(np.linalg.norm(rms[3:]))
        print(f"seven markers, 10 m, {name}: {1000 * np.linalg.norm(rms[:3]):.2f} mm, {turn:.3f} deg")
    position, rotation = p.ratios()
    print(f"  joint over bound: position {position:.3f}, rotation {rotation:.3f}; NEES/6 {p.nees.mean() / 6:.3f}")
    if given.campaigns:
        _campaigns(given.campaigns, given.seed)


def simulated_calibration(rng: np.random.Generator, pairs: int = 20, noise_px: float = 0.1) -> CalibratedPair:
    """The pair of `distance_errors`, calibrated from corners of a board of 9 x 6 squares of 80 mm at 1.2 to 3.5 m."""
    true = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M)
    grid = np.array([[x, y, 0.0] for y in range(6) for x in range(9)]) * 0.08
    middle = grid.mean(axis=0)
    found: list[list[tuple[Ints, Array]]] = [[], []]
    numbers: tuple[list[int], list[int]] = ([], [])
    number = 0
    while min(map(len, numbers)) < pairs:
        number += 1
        depth = rng.uniform(1.2, 3.5)
        at = np.array([0.25 + rng.uniform(-0.7, 0.7) * depth, rng.uniform(-0.4, 0.4) * depth, depth])
        turn = rotations.exp(rng.uniform(-0.6, 0.6, 3))
        board = Pose(turn, at - turn @ middle)
        pixels = project(true, board.apply(grid))[0]
        for c, camera in enumerate(true.cameras):
            inside: Ints = np.flatnonzero(in_picture(pixels[c], np.array(camera.image_size_px), -10.0)).astype(np.int64)
            if len(inside) >= 20:
                found[c].append((inside, pixels[c, inside] + rng.normal(0, noise_px, (len(inside), 2))))
                numbers[c].append(number)
    options = IntrinsicsOptions(lens=LensModel(5), warp=False, stretch=False)
    single = [calibrate_intrinsics(CornerTable.of(views, grid, middle, SIZE_PX), options) for views in found]
    return calibrate_pair(("left", "right"), (single[0], single[1]), numbers)


def _campaigns(count: int, seed: int) -> None:
    """Errors after a simulated calibration: bias by distance, and NEES with the calibration's covariance."""
    bias, nees = [], []
    for i in range(count):
        rng = np.random.default_rng([seed, 7, i])
        known = simulated_calibration(rng)
        pair = StereoPair(known.cameras, known.covariance)
        bias.append([distance_errors(d, 40, 0.1, rng, pair).bias[2] / d for d in DISTANCES_M])
        nees.append(_calibrated_nees(pair, rng))
        print(f"campaign {i}: bias of the joint fit " + ", ".join(f"{100 * b:+.3f} %" for b in bias[-1])
              + f"; NEES/6 {nees[-1] / 6:.2f}")  # fmt: skip
    rms = np.sqrt((np.array(bias) ** 2).mean(axis=0))
    shares = [f"{d:g} m {100 * b:.3f} %" for d, b in zip(DISTANCES_M, rms, strict=True)]
    print("all campaigns: RMS bias " + ", ".join(shares)
          + f"; NEES/6 {np.mean(nees) / 6:.2f}")  # fmt: skip


def _calibrated_nees(pair: StereoPair, rng: np.random.Generator) -> float:
    """NEES of one pose with noise and the errors of this calibration: one draw per campaign is independent."""
    from lab.targets.stereo.simulated_recording import simulated_pair
    from studies.zhou2020 import BASELINE_M, FOCAL_PX, SIZE_PX, random_pose

    true, model = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M), drogue_markers()
    pose = random_pose(10.0, rng)
    cov = np.broadcast_to(0.01 * np.eye(2), (2, len(model), 2, 2))
    uv = project_markers(true, model, pose)[0] + rng.normal(0, 0.1, (2, len(model), 2))
    fit = fit_pose(pair, model, MarkerObservations(uv, cov), pose)
    assert fit is not None
    delta = pose.minus(fit.world_from_body)
    return float(delta @ np.linalg.solve(fit.covariance, delta))


if __name__ == "__main__":
    main()
