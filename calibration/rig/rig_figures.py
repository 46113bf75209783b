"""A rig calibrated in steps, then jointly; its expected pose uncertainty by source, and hold-out of positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from calibration.beams.beams import BeamCalibration, StandModel, calibrate_beams
from calibration.beams.excitation import StandMotion, summary_of
from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.joint import SPOTS, Joint, Measured, calibrate_jointly, jacobian, shares
from calibration.screens.screens import FittedScreens
from calibration.terms.rig_blocks import BEAMS, POSES, STAND, SpotPixels, SpotTerm, named_errors
from calibration.terms.surveyed import pose_of
from geometry.arrays import Array, Ints, symmetric
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rotations import nearest_rotation
from geometry.uncertainty.rig_uncertainty import Sensitivity

# Positions required for a trustworthy result. Without a fifth of eight, six remain, the number of parameters of a pose;
# with fewer, a single wrong record or label moves the beams without increasing the residuals.
FEWEST_POSITIONS = 8
FOLDS = 5  # groups of positions; each is predicted from the other four


def in_degrees(covariance: Array) -> float:
    """RMS over the three axes of the attitude sigmas of a pose covariance (6, 6), deg."""
    return float(np.rad2deg(np.sqrt(np.mean(np.maximum(np.diagonal(covariance)[3:], 0.0)))))


def in_mm(covariance: Array) -> float:
    """RMS over the three axes of the position sigmas of a pose covariance (6, 6), mm."""
    return float(1e3 * np.sqrt(np.mean(np.maximum(np.diagonal(covariance)[:3], 0.0))))


@dataclass(frozen=True, slots=True)
class ExpectedPose:
    """Uncertainty of a pose from one frame. Covariances are of [dt (m, world), dtheta (rad, body)]."""

    world_from_body: Pose
    views: int  # spots in the pictures at this pose
    total: Array  # (6, 6)
    noise: Array  # (6, 6): of the spots in that frame; reduced by averaging
    systematic: Array  # (6, 6): of the calibration; the same in every frame
    shares: Mapping[str, Array]  # (6, 6) of the systematic part, by kind of measurement


@dataclass(frozen=True, slots=True)
class HoldOut:
    """Positions predicted by a calibration without their spots."""

    positions: Ints  # (n,)
    errors: Array  # (n, 6): recorded pose minus the one measured with the spots, [dt (m, world), dtheta (rad, body)]
    sigmas: Array  # (n,): RMS of each position's normalised residuals; 1 is expected
    chi2: float  # of the held-out spots against their prediction, with all uncertainties
    dof: int
    p: float

    @property
    def attitude_rms(self) -> float:
        """RMS attitude error, rad, per axis."""
        return float(np.sqrt(np.mean(self.errors[:, 3:] ** 2)))

    @property
    def position_rms(self) -> float:
        """RMS position error, m, per axis."""
        return float(np.sqrt(np.mean(self.errors[:, :3] ** 2)))

    @property
    def ratio(self) -> float:
        """Ratio of actual to expected errors."""
        return float(np.sqrt(self.chi2 / self.dof))


def central_pose(joint: Joint) -> Pose:
    """world_from_body at the centre of the stand's positions."""
    poses = pose_of(joint.values, POSES)
    middle = Pose(nearest_rotation(poses.rotation.mean(axis=0)), poses.translation.mean(axis=0))
    return pose_of(joint.values, STAND)[0] @ middle


def expected_pose(joint: Joint, world_from_body: Pose, spot_sigma_px: float) -> ExpectedPose | None:
    """The covariance of a pose measured from one frame with the calibrated rig; None if too few spots are visible.

    Noise and calibration are weighted together as in geometry/pose_solver/gauss_newton.py.
    """
    model = SpotModel.of(joint.rig)
    d = model.derivatives(world_from_body)
    seen = model.in_picture(d.pixels)
    J = d.pose[seen].reshape(-1, 6)
    if len(J) < 6 or np.linalg.matrix_rank(J / np.linalg.norm(J, axis=0), tol=1e-7) < 6:
        return None
    names, T = named_errors(joint.rig, joint.values, joint.rig_at)
    S = Sensitivity(joint.rig, model, names).of(d)[seen].reshape(len(J), -1) @ T
    rows = joint.unknowns.of_several(joint.rig_at)
    spread = S @ joint.all_covariance[np.ix_(rows, rows)] @ S.T
    weighted = np.linalg.solve(spot_sigma_px**2 * np.eye(len(J)) + spread, J)
    total = symmetric(np.linalg.inv(J.T @ weighted))
    gain = total @ weighted.T
    effect = joint.effect(joint.rig_at, gain @ S)
    return ExpectedPose(
        world_from_body=world_from_body,
        views=int(seen.sum()),
        total=total,
        noise=spot_sigma_px**2 * symmetric(gain @ gain.T),
        systematic=symmetric(gain @ spread @ gain.T),
        shares=shares(joint.informations, joint.all_covariance, effect),
    )


def spot_sigma(joint: Joint) -> float:
    """The median sigma (px) of one coordinate of a spot, including its scale factor."""
    term = joint.terms[SPOTS][0]
    assert isinstance(term, SpotTerm)
    spots = term.spots
    return float(np.sqrt(np.median((spots.covariance[:, 0, 0] + spots.covariance[:, 1, 1]) / 2)))


def hold_out(measured: Measured, joint: Joint) -> HoldOut | None:
    """Five-fold cross-validation of the positions: calibrate without a fifth of their spots and predict them.

    None if there are too few positions. The held-out spots are compared with their prediction from rig, stand and
    record; the expected error includes the uncertainties of all three. Raises AdjustmentError: a fold is not determined
    by the others.
    """
    count = len(measured.stand.stand_from_body.translation)
    if count < FEWEST_POSITIONS:
        return None
    fold_of = np.random.default_rng(0).permutation(count) % FOLDS
    scale = joint.scales.get(SPOTS, 1.0)
    positions, errors, sigmas = [], [], []
    chi2, dof = 0.0, 0
    for fold in range(FOLDS):
        without = fold_of[measured.spots.position] == fold
        part = calibrate_jointly(measured, without=without, start=joint)
        held = measured.spots.pick(without & joint.kept[SPOTS])
        held = SpotPixels(held.position, held.view, held.pixels, held.covariance * scale**2)
        model = SpotModel.of(part.rig)
        bodies = pose_of(part.values, STAND)[0] @ pose_of(part.values, POSES)
        for k in np.unique(held.position):
            here = held.pick(held.position == k)
            fit = fit_pose(model, here.view, here.pixels, here.covariance, bodies[int(k)])
            if fit is None or not fit.observable:
                continue
            r, J = jacobian(SpotTerm(part.rig, here), part.values, part.unknowns)
            spread = np.eye(len(r)) + J @ part.all_covariance @ J.T
            of_position = float(r @ np.linalg.solve(spread, r))
            chi2, dof = chi2 + of_position, dof + len(r)
            positions.append(int(k))
            errors.append(bodies[int(k)].minus(fit.world_from_body))
            sigmas.append(np.sqrt(of_position / len(r)))
    if not positions:
        return None
    order = np.argsort(positions)
    return HoldOut(
        np.array(positions)[order],
        np.array(errors)[order],
        np.array(sigmas)[order],
        chi2,
        dof,
        float(chdtrc(dof, chi2)),
    )


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """Results of the steps."""

    screens: FittedScreens  # lenses, cameras, screens, control points and boards: all but the spots
    beams: BeamCalibration  # from the spots and the result of the first step
    measured: Measured
    joint: Joint  # the joint adjustment


def calibrate_in_steps(screens: FittedScreens, spots: SpotPixels, stand: StandModel) -> RigCalibration:
    """Calibrate screens, then beams, then all together.

    screens: of screens/screens.py, the first step; its network's rig holds nominal beams and the spots too. Raises
    AdjustmentError: the spots are inconsistent, or a parameter is undetermined; ValueError: as raised by the steps.
    """
    try:
        beams = calibrate_beams(screens.fit.rig, spots, stand, screens.fit.covariance)
    except AdjustmentError as error:
        # The iteration may diverge along an undetermined direction.
        motion = StandMotion.of(stand.stand_from_body)
        if not motion.flat:
            raise
        raise AdjustmentError(f"{error}; the stand's positions do not suffice ({motion}): {motion.remedy()}") from None
    if beams.undetermined:
        raise AdjustmentError(
            f"the stand's positions leave undetermined: {summary_of(beams.undetermined)}: {beams.motion.remedy()}"
        )
    found = beams.fit.adjusted.values
    starts = {n: found[n] for n in (BEAMS, STAND, POSES)}
    measured = Measured(screens.network, screens.fit, spots, stand, starts)
    return RigCalibration(screens, beams, measured, calibrate_jointly(measured))
