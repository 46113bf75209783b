"""Binocular measurement: distances from 5 to 30 m, seven markers at 10 m, and distances after a calibration.

    python -m bench.related_measurements.stereo --trials 400 --seed 1 --campaigns 4

Distances: bias and RMS of the distance of one marker, over the bound of the information used. Poses: RMS over the
bound, NEES/6. Campaigns: the pair is calibrated from simulated photographs of a board first; the errors over the sigmas
that the joint covariance of the calibration states.
"""

from __future__ import annotations

import argparse

import numpy as np

from lab.targets.stereo.simulated_recording import drogue_markers
from studies.zhou2020 import (
    DISTANCES_M,
    METHODS,
    distance_errors,
    pose_errors,
    simulated_calibration,
)
from tracking.binocular.joint_fit import MarkerObservations, fit_pose
from tracking.binocular.marker_model import StereoPair, project_markers


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
    delta = pose.minus(fit.pose)
    return float(delta @ np.linalg.solve(fit.covariance, delta))


if __name__ == "__main__":
    main()
