"""Explanations of inputs (BP-K), screens (BP-S), beams (BP-B), the joint rig (BP-R) and drift checks (BP-C)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

INPUTS: Explanations = {
    "BP-K01": Explanation(
        "Verdict of the cameras and screens",
        "The rig.yaml or screens.yaml that the beams are calibrated with has a WARN or FAIL. Its errors carry"
        " over to the beams.",
        "Read the report beside that file.",
    ),
    "BP-K02": Explanation(
        "No covariance of cameras and screens",
        "Cameras and screens are taken as exact, so that the sigmas of the beams are too small.",
        "Calibrate cameras and screens with beampose, which writes their covariance.",
    ),
    "BP-K03": Explanation(
        "The stand's pose has no sigma",
        "world_from_stand is taken as exact. Its error enters the directions of all beams.",
        "Give stand.sigma_m and stand.sigma_deg, or omit world_from_stand.",
    ),
    "BP-K04": Explanation(
        "A lens calibration failed",
        "The camera.yaml has the verdict FAIL. An error of the lens distorts every measurement of this camera.",
        "Calibrate the lens again (`beampose calibrate camera`).",
    ),
    "BP-K05": Explanation(
        "A lens calibration has expired",
        "Lenses change with time and temperature.",
        "Calibrate the lens again (`beampose calibrate camera`).",
    ),
    "BP-K06": Explanation(
        "A lens without covariance",
        "The lens is taken as exact, so that all sigmas are too small.",
        "Calibrate the lens with beampose, which writes the covariance.",
    ),
    "BP-K07": Explanation(
        "The result has expired already",
        "The measurements are older than the stated validity: runs recorded today refuse this calibration.",
        "Measure again, or correct date and valid_days.",
    ),
    "BP-K08": Explanation(
        "An assumption about the inputs",
        "The files leave something open, such as the sigma of a survey, and a usual value was assumed.",
        "State the value in the file that the finding names.",
    ),
}

SCREENS: Explanations = {
    "BP-S01": Explanation(
        "No redundancy",
        "There are only as many measurements as unknowns. A wrong dot cannot be detected.",
        "Survey eight dots or more per screen, all seen by its camera.",
    ),
    "BP-S02": Explanation(
        "Residuals larger than their sigmas",
        "Survey and pixels fit worse than stated. All sigmas of the result are multiplied by the factor; the"
        " cause may also bias it.",
        "Check the sigmas of survey and pixels, the names of the dots, and that each lens belongs to its camera.",
    ),
    "BP-S03": Explanation(
        "A dot does not fit",
        "The pixel or the coordinates of this dot are wrong, or its name is exchanged. It was excluded.",
        "Correct the name, or survey the dot again, as the finding says.",
    ),
    "BP-S04": Explanation(
        "Many dots of a camera do not fit",
        "With so many outliers the others may fit by chance.",
        "Check names and coordinates, and that the lens belongs to this camera at this focus.",
    ),
    "BP-S05": Explanation(
        "A dot is off its screen",
        "The dot is far from the surface of its screen, and was excluded from it.",
        "Survey it again, or correct the column `screen`.",
    ),
    "BP-S06": Explanation(
        "Few dots on a screen",
        "Too few dots to distinguish a bent screen from a wrong dot.",
        "Survey eight or more, spread to the screen's edges.",
    ),
    "BP-S07": Explanation(
        "A bent screen",
        "The screen is not a plane. Spots are computed on the bent surface, which is extrapolated beyond the dots.",
        "Flatten the screen, or survey dots to its edges.",
    ),
    "BP-S08": Explanation(
        "A rough screen",
        "The surface scatters about its shape. Spots at oblique incidence are displaced by about as much.",
        "Flatten the screen, or survey more dots.",
    ),
    "BP-S09": Explanation(
        "A screen or camera is not known well enough",
        "Every pose measured with it has this error.",
        "Survey more dots, farther apart, with smaller sigmas; let the camera see all of them.",
    ),
    "BP-S10": Explanation(
        "Two poses of a camera are possible",
        "Coplanar dots that appear small in the picture allow two poses; the better one was used.",
        "Add near_m to this camera, or dots off the screen's plane.",
    ),
    "BP-S11": Explanation(
        "A camera is far from its stated position",
        "The pose of the camera contradicts near_m: exchanged axes, another unit, mirrored pixels or exchanged"
        " cameras.",
        "Check near_m, the columns of the survey, u and v of the pixels, and the cameras' names.",
    ),
    "BP-S12": Explanation(
        "Two cameras share a lens calibration",
        "Two lenses of one type differ by much more than the errors of a calibration.",
        "Give each camera its own lens calibration.",
    ),
    "BP-S13": Explanation(
        "A dot outside of the screen",
        "A dot is outside of size_m; spots there count as off the screen.",
        "Correct size_m, or define the screen's frame by three named points (`frame`).",
    ),
    "BP-S14": Explanation(
        "Dots cover part of a screen",
        "Outside of the dots the shape of the screen is extrapolated.",
        "Survey points near its corners.",
    ),
}

BEAMS: Explanations = {
    "BP-B01": Explanation(
        "Positions excluded",
        "At some positions too few spots were detected to determine the vehicle's pose.",
        "Keep spots of both screens in view.",
    ),
    "BP-B02": Explanation(
        "Few positions",
        "With so few positions a wrong record or label cannot be detected.",
        "Record 20 positions or more, turned about all axes.",
    ),
    "BP-B03": Explanation(
        "Positions do not determine the beams",
        "Along some motions no spot moves, so that some directions or offsets keep their start values.",
        "Add the motions that the finding names.",
    ),
    "BP-B04": Explanation(
        "No position of the stand is known",
        "Angles between beams are measured, but the body frame is chosen by the drawing, not by the vehicle's own"
        " axes.",
        "Record some positions at known attitudes.",
    ),
    "BP-B05": Explanation(
        "Many spots excluded",
        "Reflections, wrong labels or saturated spots. They do not affect the result, but many of them make the"
        " others doubtful.",
        "Inspect these pictures; correct the labels or the light.",
    ),
    "BP-B06": Explanation(
        "Exchanged spots",
        "At one position two names are exchanged; both spots were excluded.",
        "Exchange the two names in the table of spots.",
    ),
    "BP-B07": Explanation(
        "A position does not fit",
        "Most spots of a position have large residuals: its recorded pose or its labels are wrong.",
        "Check the stand's record there.",
    ),
    "BP-B08": Explanation(
        "Spots scatter more than stated",
        "The model lacks an error: screens that are not flat, cameras that moved, an inaccurate stand, or beams"
        " that drift. All sigmas are multiplied by the factor.",
        "See the residuals by screen and position; calibrate cameras and screens again, warm up the lasers.",
    ),
    "BP-B09": Explanation(
        "Directions are not known well enough",
        "The sigmas of the beams exceed the goal.",
        "Shift the vehicle farther along its beams, or record more positions, as the finding says.",
    ),
    "BP-B10": Explanation(
        "A beam looks like another one",
        "Its direction is nearer to the drawing of another beam: the labels may be exchanged in all pictures.",
        "Check which laser is which: cover one.",
    ),
    "BP-B11": Explanation(
        "A beam is far from its drawing",
        "A wrong label, or a body frame other than the drawing's.",
        "Check labels and axes; if both are right, update the drawing.",
    ),
    "BP-B12": Explanation(
        "Two ends are not one line",
        "Both ends are described as one beam, so that each is wrong by half of their angle.",
        "Describe them in target.beams as two beams with one spot each, and calibrate again.",
    ),
}

RIG: Explanations = {
    "BP-R01": Explanation(
        "No hold-out test",
        "Without any position the others do not determine the calibration, so that it is not tested with"
        " independent spots.",
        "Record 20 positions or more, turned about all axes.",
    ),
    "BP-R02": Explanation(
        "A kind of measurement misfits",
        "Dots, survey, records, lenses or spots contradict the others by more than their sigmas.",
        "Follow the remedy of the finding; it depends on the kind.",
    ),
    "BP-R03": Explanation(
        "Survey and stand contradict each other",
        "Each is consistent by itself, but not together.",
        "Check that dots and spots were recorded with the same settings and nothing moved in between.",
    ),
    "BP-R04": Explanation(
        "Records of the stand do not fit",
        "Some recorded poses do not fit the spots; they were excluded.",
        "Check the stand's record there: a missed step, or shifted frame numbers.",
    ),
    "BP-R05": Explanation(
        "Many outliers",
        "With many outliers the other measurements may agree by chance.",
        "Inspect these pictures and labels; correct them or the light.",
    ),
    "BP-R06": Explanation(
        "A position does not fit",
        "Most spots of a position were excluded: its record or its labels are wrong.",
        "Check the stand's record there.",
    ),
    "BP-R07": Explanation(
        "Hold-out errors are too large",
        "Positions that were not used are predicted worse than the covariance says. Errors of new recordings will"
        " exceed it too.",
        "See which positions have large errors and what changed between them: a camera, the stand's zero, the lasers.",
    ),
    "BP-R08": Explanation(
        "No pose can be measured",
        "At the centre of the stand's positions too few spots are in the pictures.",
        "Aim the cameras at the spots.",
    ),
    "BP-R09": Explanation(
        "The goal is not reached",
        "The pose of one frame is less accurate than the goal.",
        "Improve the part that the finding names; more positions or dots help if noise is the cause.",
    ),
}

DRIFT: Explanations = {
    "BP-C01": Explanation(
        "No date of calibration",
        "rig.yaml has no block `calibration`; it may be out of date.",
        "Calibrate with beampose, or add the block.",
    ),
    "BP-C02": Explanation(
        "The calibration failed",
        "Its verdict is FAIL: it must not be used, even without drift.",
        "Correct the cause and calibrate again.",
    ),
    "BP-C03": Explanation(
        "The calibration is dated in the future",
        "Its age is unknown.",
        "Check the clock of this computer and the date in rig.yaml.",
    ),
    "BP-C04": Explanation(
        "The calibration has expired",
        "Mounts and lenses creep; runs are refused.",
        "Calibrate again, or, if the drift is within the limits, set a new valid_until.",
    ),
    "BP-C05": Explanation(
        "The calibration expires soon",
        "Later runs will be refused.",
        "Plan a new calibration.",
    ),
    "BP-C06": Explanation(
        "A camera has changed",
        "The camera has turned or moved, or its focus has changed, by a significant amount.",
        "Check mount, focus and zoom rings; then calibrate its pose or lens again.",
    ),
    "BP-C07": Explanation(
        "Unexplained pixels of a camera",
        "Points, screen or lens differ from the calibration in a way that no single change explains.",
        "Check names and coordinates of the points; if correct, calibrate again.",
    ),
    "BP-C08": Explanation(
        "A weak check",
        "The check shows no change, but could miss one that matters.",
        "Measure more points, distributed over the picture, or give the pose of the vehicle.",
    ),
    "BP-C09": Explanation(
        "A wrong point or a moved laser",
        "One point or laser deviates, the others do not.",
        "Measure the point again, or fix the laser's mount and calibrate the beams.",
    ),
    "BP-C10": Explanation(
        "A camera was not checked",
        "Nothing was measured in it: a drift would not be noticed.",
        "Measure known points in every camera.",
    ),
    "BP-C11": Explanation(
        "No covariance",
        "The calibration's own errors count as drift; false alarms are more frequent.",
        "Calibrate with beampose, which writes the covariance.",
    ),
}
