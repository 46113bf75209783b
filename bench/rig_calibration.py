"""Accuracy of calibrated rigs and of their stated uncertainty, from simulated campaigns.

    python -m bench.rig_calibration [campaigns] [first seed]
    python -m bench.rig_calibration [campaigns] [first seed] --recordings [px of noise]

Each campaign is drawn (mounting, lens calibrations, survey, stand, spots) and calibrated by the joint adjustment. A new
recording of the true rig is processed with the result: one frame at each of some poses. Printed: errors of attitude and
position, their NEES (normalised estimation error squared, 1 per component if the covariance is correct), and the share
of parameters within one sigma.

With --recordings a slow recording of the true rig is processed twice: with the calibrated rig, and with the true one.
Both see the same points, so that the noise part of their sigmas should be the same. Printed: the ratio, the share of
errors of places, NEES/6 with the errors of the calibration, which the frames of a recording share, and chi-square per
degree of freedom as `beampose compare` computes it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.beams.beams import StandModel
from calibration.rig.joint import Joint
from calibration.rig.rig_figures import RigCalibration, calibrate_in_steps
from calibration.screens.network import ControlPoints, Network, PointObservations
from calibration.screens.screens import ScreenSetup, calibrate
from calibration.terms.rig_blocks import prior_of, stacks_of
from geometry.arrays import Array, normalised
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty, independent
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.run.results import ResultFolder, read_summary
from lab.results.compare import compare
from lab.runs.process import process_run
from lab.simulate.campaign import Campaign, CampaignQuality, draw_campaign, spots_at
from lab.simulate.write import simulate

POSES_PER_CAMPAIGN = 5  # of the new recording; they share the errors of the calibration
FRAMES = 120  # of a recording


@dataclass(frozen=True, slots=True)
class Trial:
    """One campaign and the errors of its calibration."""

    seed: int
    errors: Array  # (k, 6): [dt (m, world), dtheta (rad, body)] of the poses measured with the calibrated rig
    nees: Array  # (k,): e^T C^-1 e / 6
    noise_nees: Array  # (k,): the same with the covariance of the noise only, as if the calibration were exact
    normalised: dict[str, float]  # error of each rig parameter that is not a convention, in sigmas
    joint_nees: float  # of all independent errors of the rig, per component
    scales: dict[str, float]
    seconds: float


def as_measured(c: Campaign) -> tuple[Network, list[ScreenSetup], StandModel]:
    """The input of a calibration from a campaign as arrays, without files."""
    rig = replace(
        c.nominal,
        cameras={
            n: d.camera(c.nominal.cameras[n].screen, c.nominal.cameras[n].camera_from_world)
            for n, d in c.lenses.items()
        },
    )
    known = [(f"cameras.{n}.", d.covariance) for n, d in c.lenses.items() if d.covariance is not None]
    lenses = (RigCovariance(tuple(at + p for p in own.names), own.matrix) for at, own in known)
    prior, free = prior_of(rig, independent(lenses))
    survey = np.broadcast_to(np.eye(3) * c.quality.survey_m**2, (len(c.dot_names), 3, 3))
    network = Network(
        rig,
        ControlPoints(c.dot_names, c.dots_surveyed, survey, c.dot_screen),
        PointObservations(c.seen_camera, c.seen_dot, c.seen_pixels, np.full(len(c.seen_dot), c.quality.dot_px)),
        lens_priors=() if prior is None else (prior,),
        lens_free=free["intrinsics"],
    )
    q = c.quality
    record_sigmas = np.repeat([q.stand_m, np.deg2rad(q.stand_deg)], 3)
    place_covariance = np.diag(np.repeat([q.place_m, np.deg2rad(q.place_deg)], 3) ** 2)
    stand = StandModel(
        c.stand_recorded,
        record_sigmas,
        c.stand_surveyed if q.place_known else None,
        place_covariance if q.place_known else None,
    )
    return network, [ScreenSetup() for _ in rig.screens], stand


def calibrated(c: Campaign) -> RigCalibration:
    """The rig of the campaign by the joint adjustment."""
    network, setups, stand = as_measured(c)
    return calibrate_in_steps(calibrate(network, setups), c.spots, stand)


def trial(seed: int, rig: str = "fan", quality: CampaignQuality | None = None) -> Trial:
    """Draw a campaign, calibrate its rig, and measure with it."""
    c = draw_campaign(seed, rig, quality)
    start = time.perf_counter()
    joint = calibrated(c).joint
    seconds = time.perf_counter() - start
    rng = np.random.default_rng([seed, 99])
    turns = np.deg2rad(rng.uniform(-15, 15, (POSES_PER_CAMPAIGN, 3)))
    poses = Pose.from_ypr(turns, rng.uniform(-0.15, 0.15, (POSES_PER_CAMPAIGN, 3)))
    errors, nees, alone = measured_with(joint.rig, joint.covariance, c.truth, poses, c.quality.spot_px, rng)
    normalised, joint_nees = parameter_errors(joint, c.truth)
    return Trial(seed, errors, nees, alone, normalised, joint_nees, dict(joint.scales), seconds)


def measured_with(
    rig: Rig, covariance: RigCovariance, truth: Rig, poses: Pose, spot_px: float, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Errors (k, 6) of poses measured with a calibrated rig, NEES/6 (k,), and NEES/6 of the noise alone (k,)."""
    model = SpotModel.of(rig)
    spread = RigUncertainty(rig, model, covariance)
    spots = spots_at(truth, poses, spot_px, rng)
    errors, nees, alone = [], [], []
    for k in range(len(poses.translation)):
        here = spots.pick(spots.position == k)
        fit = fit_pose(model, here.view, here.pixels, here.covariance, poses[k], calibration=spread)
        if fit is None or not fit.observable:
            continue
        e = poses[k].minus(fit.world_from_body)
        errors.append(e)
        nees.append(e @ np.linalg.solve(fit.covariance, e) / 6)
        alone.append(e @ np.linalg.solve(fit.noise, e) / 6)
    return np.array(errors), np.array(nees), np.array(alone)


def parameter_errors(joint: Joint, truth: Rig) -> tuple[dict[str, float], float]:
    """Errors of the rig parameters in sigmas, by name; and NEES of all independent ones, per component.

    The axes of a screen within its plane and the point of a beam along it are conventions: the truth is expressed in
    the same convention before the comparison.
    """
    same = _described_alike(truth, joint.rig)
    true, found = stacks_of(same), joint.values
    at = joint.rig_at
    error = np.concatenate([true[s].minus(found[s])[i] for s, i in at])
    rows = joint.unknowns.of_several(at)
    C = joint.all_covariance[np.ix_(rows, rows)]
    names = [f"{s}.{i}.{k}" for s, i in at for k in range(found[s].dof)]
    sigma = np.sqrt(np.diagonal(C))
    gauge = np.array([n.split(".")[0] == "screens" and s < 3e-6 for n, s in zip(names, sigma, strict=True)])
    real = (sigma > 0) & ~gauge
    normalised = {n: float(e / s) for n, e, s, r in zip(names, error, sigma, real, strict=True) if r}
    free = sigma > 0
    scaled = C[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    e = error[free] / sigma[free]
    return normalised, float(e @ np.linalg.solve(scaled, e) / np.sum(real))


def _described_alike(truth: Rig, found: Rig) -> Rig:
    """The true rig with the axes of its screens moved to the estimated ones.

    A bent surface keeps its curvature; its frame is tangent to it below the estimated origin.
    """
    screens = {}
    for name, s in truth.screens.items():
        now = found.screens[name].world_from_screen
        a, b, c = s.bow
        x0, y0, _ = s.world_from_screen.inverse().apply(now.translation)
        on_surface = np.array([x0, y0, a * x0 * x0 + b * x0 * y0 + c * y0 * y0])
        slope = np.array([-(2 * a * x0 + b * y0), -(b * x0 + 2 * c * y0), 1.0])
        z = normalised(s.world_from_screen.turn(slope))
        z = z if z @ now.rotation[:, 2] > 0 else -z
        x = normalised(now.rotation[:, 0] - (now.rotation[:, 0] @ z) * z)
        R = np.stack([x, np.cross(z, x), z], axis=1)
        # The same curvature along the new axes, with the opposite sign where z is reversed.
        turn = (s.world_from_screen.rotation.T @ R)[:2, :2]
        side = np.sign(z @ s.world_from_screen.rotation[:, 2])
        M = side * turn.T @ np.array([[a, b / 2], [b / 2, c]]) @ turn
        bow = (float(M[0, 0]), float(2 * M[0, 1]), float(M[1, 1]))
        screens[name] = replace(s, world_from_screen=Pose(R, s.world_from_screen.apply(on_surface)), bow=bow)
    return replace(truth, screens=screens)


def bench_figures(seeds: Iterable[int], rig: str = "fan", quality: CampaignQuality | None = None) -> dict[str, float]:
    """The figures over some campaigns."""
    return figures([trial(s, rig, quality) for s in seeds])


def figures(trials: Sequence[Trial]) -> dict[str, float]:
    """The figures of several trials."""
    errors = np.concatenate([t.errors for t in trials])
    inside = np.array([abs(v) <= 1 for t in trials for v in t.normalised.values()])
    shared = set.intersection(*(set(t.normalised) for t in trials))
    each = np.array([np.mean([abs(t.normalised[n]) <= 1 for t in trials]) for n in sorted(shared)])
    numbers = sum(len(t.normalised) for t in trials)
    per_axis = np.sqrt(np.mean(errors**2, axis=0))
    return {
        "campaigns": float(len(trials)),
        "attitude_rms_deg": float(np.rad2deg(np.sqrt(np.mean(errors[:, 3:] ** 2)))),
        "attitude_worst_axis_rms_deg": float(np.rad2deg(per_axis[3:].max())),
        "position_rms_mm": float(1e3 * np.sqrt(np.mean(errors[:, :3] ** 2))),
        "position_worst_axis_rms_mm": float(1e3 * per_axis[:3].max()),
        "nees_per_number": float(np.mean([t.nees.mean() for t in trials])),
        "nees_noise_alone": float(np.mean([t.noise_nees.mean() for t in trials])),
        "joint_nees_per_number": float(np.mean([t.joint_nees for t in trials])),
        # Half width of the 95 % interval of this mean about 1 if the covariances are correct.
        "joint_nees_95_percent_band": float(1.96 * np.sqrt(2 / numbers)),
        "coverage_percent": float(100 * inside.mean()),
        "coverage_of_single_parameters_least": float(100 * each.min()),
        "coverage_of_single_parameters_most": float(100 * each.max()),
        "parameters_within_62_to_75_percent": float(100 * np.mean((each >= 0.62) & (each <= 0.75))),
        "parameters": float(len(each)),
        "rescaled_campaigns": float(sum(bool(t.scales) for t in trials)),
        "seconds_per_calibration": float(np.mean([t.seconds for t in trials])),
    }


def written(rig: Rig, covariance: RigCovariance | None, path: Path) -> Path:
    """A rig.yaml."""
    save_rig(RigFile(rig, {} if covariance is None else covariance_blocks(covariance)), path)
    return path


def noise_part(results: Path) -> Array:
    """Covariances (T, 6, 6) of the poses without the errors of the calibration."""
    poses = ResultFolder.of_run(results).poses
    return np.asarray(poses.covariance - np.nan_to_num(poses.systematic))


def recorded(seed: int, noise_px: float, work: Path) -> str:
    """The figures of one campaign and its recording, as a line."""
    c = draw_campaign(seed, "fan")
    joint = calibrated(c).joint
    true, known = written(c.truth, None, work / "true.yaml"), written(joint.rig, joint.covariance, work / "known.yaml")
    folders = [
        simulate(
            "small-motion", work / name, seed=seed, frames=FRAMES, points=True, noise_px=noise_px, rig=true,
            known_rig=given,
        )
        for name, given in (("exact", true), ("calibrated", known))
    ]  # fmt: skip
    exact, found = (work / f"{f.name}-results" for f in folders)
    for run, results in zip(folders, (exact, found), strict=True):
        process_run(run, results)
    ratio = np.trace(np.linalg.solve(noise_part(exact), noise_part(found)), axis1=1, axis2=2) / 6
    summary = read_summary(found)
    nees = summary["errors"]["pose"]["measured"]["nees_mean"] / 6
    chi2 = compare(found, reference=folders[1] / "truth" / "pose.csv").noise
    return (
        f"seed {seed}: sigma over that with the exact rig {np.sqrt(np.median(ratio)):.2f}, places"
        f" {summary['smoother']['place_share']:.3f}, NEES/6 {nees:.2f},"
        f" chi-square {chi2.factor:.2f} +- {chi2.sigma:.2f}, {summary['verdict']['status']}"
    )


def main(arguments: Sequence[str]) -> None:
    """Print the figures."""
    recordings = "--recordings" in arguments
    at = arguments.index("--recordings") if recordings else len(arguments)
    arguments, noise = arguments[:at], arguments[at + 1 :]
    count = int(arguments[0]) if arguments else 10
    first = int(arguments[1]) if len(arguments) > 1 else 0
    if recordings:
        for seed in range(first, first + count):
            with tempfile.TemporaryDirectory() as work:
                print(recorded(seed, float(noise[0]) if noise else 0.01, Path(work)), flush=True)
        return
    trials = []
    for seed in range(first, first + count):
        trials.append(trial(seed))
        t = trials[-1]
        deg, mm = np.rad2deg(np.sqrt(np.mean(t.errors[:, 3:] ** 2))), 1e3 * np.sqrt(np.mean(t.errors[:, :3] ** 2))
        print(
            f"seed {seed:4d}: {deg:.4f} deg, {mm:.3f} mm, NEES/6 {t.nees.mean():.2f}"
            f" ({t.noise_nees.mean():.2f} by noise alone),"
            f" joint {t.joint_nees:.2f}, {t.seconds:.1f} s {t.scales or ''}",
            flush=True,
        )
    for name, value in figures(trials).items():
        print(f"{name:32s} {value:.4g}")


if __name__ == "__main__":
    main(sys.argv[1:])
