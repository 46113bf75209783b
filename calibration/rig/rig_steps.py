"""Calibration of a whole rig: the single steps in sequence, then the joint adjustment from their results."""

from __future__ import annotations

from dataclasses import dataclass

from calibration.beams.beams import BeamCalibration, StandModel, calibrate_beams
from calibration.beams.excitation import StandMotion, summary_of
from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.joint import Joint, Measured, calibrate_jointly
from calibration.screens.screens import ScreensResult
from calibration.terms.rig_blocks import BEAMS, POSES, STAND
from calibration.terms.spot_term import SpotPixels


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """Results of the steps."""

    screens: ScreensResult  # lenses, cameras, screens, control points and boards: all but the spots
    beams: BeamCalibration  # from the spots and the result of the first step
    measured: Measured
    joint: Joint  # the joint adjustment


def calibrate_in_steps(
    screens: ScreensResult, spots: SpotPixels, stand: StandModel, *, nominal: bool = True
) -> RigCalibration:
    """Calibrate screens, then beams, then all together.

    screens: of screens/screens.py, the first step; its network's rig holds nominal beams and the spots too. nominal:
    as in beams/beams.py.

    Raises:
        AdjustmentError: the spots are inconsistent, or a parameter is undetermined.
        ValueError: as raised by the steps.
    """
    try:
        beams = calibrate_beams(screens.fit.rig, spots, stand, screens.fit.covariance, nominal=nominal)
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
