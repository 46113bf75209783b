"""Explanations of the verdict of `beampose stereo` (BP-W) and of `beampose calibrate pair` (BP-Q)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

STEREO: Explanations = {
    "BP-W01": Explanation(
        "The target was never found",
        "No frame has a measured pose: markers are missing in the pictures, or no pose explains those found.",
        "Look at the annotated pictures in the report. Adapt the colours in run.yaml; check the positions of the"
        " markers and which camera is which.",
    ),
    "BP-W02": Explanation(
        "Few frames with a measured pose",
        "A share of the frames has no measured pose: FAIL below 10 %, WARN below 95 %. The text counts the reasons.",
        "Treat the most frequent reason first.",
    ),
    "BP-W03": Explanation(
        "Missing pictures of a camera",
        "More than 5 % of the pictures of this camera are missing or damaged. Their poses rest on the other camera.",
        "Check the camera's disk, cable and trigger for dropped frames.",
    ),
    "BP-W04": Explanation(
        "A camera hardly sees the markers",
        "Fewer than three markers are found in most pictures of this camera.",
        "Look at its pictures: exposure, focus, colours in run.yaml, view not blocked.",
    ),
    "BP-W05": Explanation(
        "The cameras are not synchronised",
        "Residuals of the markers grow with their velocity in the picture, as they do if the two cameras expose at"
        " different times. Distances of a moving target are then wrong.",
        "Trigger both cameras with one signal; look for dropped frames in one of them.",
    ),
    "BP-W06": Explanation(
        "The pair has moved since its calibration",
        "All frames together show a rotation of the right camera against pair.yaml.",
        "Check the mounts, and calibrate the pair again with `beampose calibrate pair`.",
    ),
    "BP-W07": Explanation(
        "Residuals larger than the stated sigmas",
        "The images of the markers do not fit together as well as their sigmas state: FAIL above a factor of 5, WARN"
        " above 1.5.",
        "Check the marker positions in run.yaml and their `sigma_m`, then the calibration of the pair.",
    ),
    "BP-W08": Explanation(
        "Two attitudes explain the markers",
        "Seen from far away, a flat target looks the same with its normal reflected at the line of sight. Such frames"
        " are `predicted`, with a covariance that covers both attitudes.",
        "Mount some markers in front of the others, or measure from a shorter distance.",
    ),
    "BP-W09": Explanation(
        "The two cameras never agree",
        "Poses are measured with one camera alone, but hardly any where both see the markers, or no frame number has"
        " markers in both. Pictures of different times have the same number, or the pair is not the one that was"
        " calibrated.",
        "Give pictures of the same time the same number; check which camera is which, and the calibration.",
    ),
}
PAIR: Explanations = {
    "BP-Q01": Explanation(
        "Residuals of the pair's calibration",
        "Corners of the board do not fit one lens and one place per camera: exposures at different times while the"
        " board moved, a board that is not flat, or a camera that moved between photographs.",
        "Hold the board still for each pair of photographs, or trigger both cameras together.",
    ),
    "BP-Q02": Explanation(
        "Few pairs of photographs",
        "Few photographs show the board in both cameras. The relative pose has large sigmas.",
        "Take 15 pairs or more, the board tilted by 20 to 45 deg, near and far, in all parts of both pictures.",
    ),
    "BP-Q03": Explanation(
        "The distance is uncertain",
        "The sigma of the calibration alone exceeds 0.2 % of the distance at twenty baselines.",
        "Take more pairs of photographs; let the board fill the pictures; use a longer baseline.",
    ),
    "BP-Q04": Explanation(
        "A finding of one camera's lens",
        "The calibration of one camera of the pair has a warning or fails.",
        "See its code with `beampose explain`, or run `beampose calibrate camera` with its photographs.",
    ),
}
