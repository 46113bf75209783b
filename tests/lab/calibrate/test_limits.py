"""Each limit of the findings on screens, beams and a rig decides by itself."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from lab.calibrate.beams.beams_page import BeamGoals, beam_findings
from lab.calibrate.rig import rig_page
from lab.calibrate.rig.rig import calibrate_rig
from lab.calibrate.rig.rig_page import RigLimits, joint_findings
from lab.calibrate.screens.screen_page import ScreenLimits, network_findings
from lab.simulate.campaign import CampaignQuality, simulate_calibration

LIMITS = [(kind, f.name) for kind in (ScreenLimits, BeamGoals, RigLimits) for f in fields(kind)]
POSITIONS = 12


@pytest.fixture(scope="module")
def findings_with(tmp_path_factory):
    """The findings on one calibration with outliers and too small sigmas, with other limits of one kind."""
    folder, quality = tmp_path_factory.mktemp("limits") / "lab", CampaignQuality(dots=(5, 4))
    project = simulate_calibration(folder, seed=4, positions=POSITIONS, wrong=0.05, quality=quality)
    made = calibrate_rig(project, project.parent / "out").result
    steps, names = made.steps, [str(k) for k in range(POSITIONS)]
    surfaces = [
        replace(s, flatness=replace(s.flatness, chosen=replace(s.flatness.chosen, scatter_m=1e-4)))
        for s in steps.screens.screens
    ]
    fit = replace(steps.screens.fit, variance_factor=1.5)
    screens = replace(steps.screens, fit=fit, screens=tuple(surfaces))
    first, second = list(steps.beams.rig.beams)[:2]
    beams = steps.beams.rig.beams
    drawing = replace(steps.beams.rig, beams={**beams, first: replace(beams[first], direction=beams[second].direction)})
    joint = replace(steps.joint, scales=dict.fromkeys(steps.joint.groups, 1.5))

    def of(limits):
        with pytest.MonkeyPatch.context() as patch:
            if isinstance(limits, ScreenLimits):
                return network_findings(screens, limits)
            if isinstance(limits, BeamGoals):
                return beam_findings(steps.beams, drawing, names, limits)
            patch.setattr(rig_page, "LIMITS", limits)
            held_out = replace(made.held_out, p=0.0)
            return joint_findings(replace(steps, joint=joint), names, made.expected, held_out)

    return of


@pytest.mark.parametrize(("kind", "name"), LIMITS)
def test_a_limit_that_nothing_exceeds_makes_findings_milder_and_one_that_all_exceed_makes_them_worse(
    findings_with, kind, name
):
    """Whether the other limits are exceeded, or none, or those of a warning alone."""
    names, unusable = [f.name for f in fields(kind)], ("fail", "unusable")
    always, never = 1e-12, np.inf
    others = (
        dict.fromkeys(names, always),
        dict.fromkeys(names, never),
        {n: never if any(word in n for word in unusable) else always for n in names},
    )
    worse = []
    for given in others:
        severity = [sum(f.level for f in findings_with(kind(**{**given, name: limit}))) for limit in (always, never)]
        worse.append(severity[0] - severity[1])
    assert min(worse) >= 0
    assert max(worse) > 0
