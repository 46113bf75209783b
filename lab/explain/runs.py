"""Explanations of a run's verdict (BP-V) and of its model check (BP-M)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

VERDICT: Explanations = {
    "BP-V01": Explanation(
        "No frames",
        "The run has no frame, so there is nothing to measure.",
        "Check the folders of pictures, the videos or the tables of detections that run.yaml names: `beampose"
        " check` lists what it finds there.",
    ),
    "BP-V02": Explanation(
        "The vehicle was never found",
        "No frame has a measured pose. The reasons listed below it say whether pictures, points of light or an"
        " explaining pose are missing.",
        "Act on the other reasons, the first one first.",
    ),
    "BP-V03": Explanation(
        "Few frames with a measured pose",
        "A share of the frames has no measured pose: FAIL below the gate, CHECK below 95 %. The text counts the"
        " causes: hidden spots, spots out of view, too few points of light, uncertain labels and others. Poses of"
        " frames that are measured are not affected.",
        "Treat the most frequent cause first. If the spots leave the pictures, `beampose plan` shows where.",
    ),
    "BP-V04": Explanation(
        "A camera without pictures",
        "No usable picture of this camera was found. The pose rests on the other cameras alone.",
        "Check the camera, its cable and the path in run.yaml; or take the camera out of run.yaml.",
    ),
    "BP-V05": Explanation(
        "A camera starts late",
        "This camera has no picture of the first frames. Poses before its first picture have wider sigmas.",
        "Start all cameras before the motion.",
    ),
    "BP-V06": Explanation(
        "A camera stopped early",
        "This camera has no picture from some frame on. Later poses have wider sigmas.",
        "Check the camera's disk, cable and trigger.",
    ),
    "BP-V07": Explanation(
        "Missing pictures",
        "More than 5 % of the pictures of this camera are missing or damaged, scattered over the run.",
        "Check the camera's disk, cable and trigger for dropped frames.",
    ),
    "BP-V08": Explanation(
        "Nothing detected",
        "Pictures of this camera show no point of light where the pose puts spots.",
        "Look at the pictures: laser on, lens uncovered, spots bright enough? If spots are visible, lower"
        " detect.threshold_sigma or state the camera's noise in rig.yaml.",
    ),
    "BP-V09": Explanation(
        "Too few points of light",
        "Too few points are visible at once to determine a first pose.",
        "Improve light and exposure, or keep the vehicle where the cameras see its spots.",
    ),
    "BP-V10": Explanation(
        "No pose explains the points",
        "Enough points of light are visible, but no pose within the prior explains them.",
        "Check the prior in run.yaml, that each camera's pictures are in its own folder, and that rig.yaml is the"
        " rig of this recording (`beampose calibrate check`).",
    ),
    "BP-V11": Explanation(
        "Causal poses not confirmed",
        "The causal pass measures poses that the smoothing pass does not confirm.",
        "Use attitude_causal.csv with care, and report this run as an error of the program.",
    ),
    "BP-V12": Explanation(
        "More than one pose is possible",
        "Different labels of the spots fit equally well, so that the pose is ambiguous.",
        "Make the prior narrower, start where another spot is visible, or use a fan with unequal angles.",
    ),
    "BP-V13": Explanation(
        "The vehicle was lost",
        "For a time nothing explained the points of light. Frames of that time have no pose or a predicted one.",
        "Check the first of these frames: occlude fewer spots, or for a shorter time.",
    ),
    "BP-V14": Explanation(
        "Contradictory poses",
        "Some poses contradict their own spots or the causal pass. They are reported as predicted, with sigmas"
        " that cover the difference.",
        "Check these frames for reflections near the spots and for a rig that has moved.",
    ),
    "BP-V15": Explanation(
        "Invalid covariance",
        "A covariance is not positive definite. This is an error of the program; the values are omitted.",
        "Report this run as an error of the program.",
    ),
    "BP-V16": Explanation(
        "Spots far from the fitted pose",
        "The spots lie farther from the fitted pose than their sigmas allow. Above the gate, rig.yaml does not"
        " describe this set-up.",
        "Check the calibration (`beampose calibrate check`) and the light (speckle).",
    ),
    "BP-V17": Explanation(
        "A finding of the model check",
        "The spots of the whole run show a systematic deviation from rig.yaml. Its own code, BP-M01 to BP-M08,"
        " says which kind.",
        "Act on the finding: the report names the component.",
    ),
    "BP-V18": Explanation(
        "Raw pictures of a colour camera",
        "Neighbouring pixels of the pictures lie behind different colour filters. A laser spot lights one or two of"
        " four pixels, and its centroid follows the mosaic by up to some tenths of a pixel. The residuals hardly show"
        " it, and the sigmas do not include it.",
        "Convert the pictures to colour or grey before the run (demosaicing), or let the camera do so; a camera"
        " without colour filters is more accurate.",
    ),
    "BP-V19": Explanation(
        "A camera has moved during the recording",
        "From some frame on, all spots of one camera are displaced by the same shift from where the pose of the other"
        " cameras puts them. They keep their labels, but the poses of these frames are computed without them.",
        "Check the mounts of this camera and its screen, and calibrate again.",
    ),
    "BP-V20": Explanation(
        "The poses contradict the truth",
        "The run folder has a truth (truth/pose.csv), and measured poses are farther from it than 10 of their sigmas,"
        " to which 0.01 mm and 0.01 mrad are added. FAIL for more than 0.5 % of the poses. A rig that fits every"
        " recording may still be wrong: two cameras of a symmetric rig that are exchanged, for example.",
        "Check that the truth belongs to this recording and is in the world of rig.yaml; then check the rig and the"
        " names of the cameras.",
    ),
}

MODEL_CHECK: Explanations = {
    "BP-M01": Explanation(
        "A component of the rig has changed",
        "A camera, screen, beam, spot or clock deviates from rig.yaml by a significant amount. The finding states"
        " the amount and the effect on the pose. Averaging over frames does not reduce this effect.",
        "Check the mount of that component, then calibrate it again. `beampose calibrate check` with known points"
        " distinguishes several candidates.",
    ),
    "BP-M02": Explanation(
        "The residuals do not fit the rig",
        "The residuals are larger than the sigmas allow, and no single component explains them. The sigmas of the"
        " poses do not include this.",
        "Calibrate the rig again; if that does not help, check lens models and flatness of the screens.",
    ),
    "BP-M03": Explanation(
        "Correlated residuals",
        "The errors of the spots are similar in neighbouring frames. They do not average out, so that the stated"
        " sigmas of the poses are too small.",
        "Check lens models, flatness of the screens and the light (reflections, clipped spots); then calibrate"
        " the rig again.",
    ),
    "BP-M04": Explanation(
        "Sigmas of the spots are too small",
        "The residuals are random, but larger than stated. The covariances of the poses are widened by the factor"
        " found.",
        "Improve the light (larger or brighter spots, shorter exposure, matt screen), or state larger sigmas with"
        " the detections.",
    ),
    "BP-M05": Explanation(
        "A spot is hardly ever measured",
        "The pose puts this spot well inside the picture, but it is not found there. The pose is computed without it.",
        "Check whether its laser is on and unobstructed; then its mount; or calibrate the beams again.",
    ),
    "BP-M06": Explanation(
        "A mistake of the set-up",
        "Sampled frames of the recording were labelled with the files as given and, where these do not explain them,"
        " without each of the usual mistakes: exchanged, mirrored, turned, transposed, smaller or cropped pictures,"
        " numbers that are off by one, inverted transforms, quaternions in the order x, y, z, w, exchanged beams or"
        " lenses, other units, a wrong prior. The mistake that is named explains the frames to their sigmas. Numbers"
        " that no lab has are named without a recording.",
        "Correct what is named, run `beampose check` again, then process the recording again.",
    ),
    "BP-M07": Explanation(
        "A camera whose points are never labelled",
        "A camera sees points of light, and none of them is ever the spot of a pose: the poses do not use the camera.",
        "Check that the pictures, the lens and camera_from_world of that camera belong together; or leave it out.",
    ),
    "BP-M08": Explanation(
        "Numbers that contradict each other",
        "The frame rate of run.yaml is not that of the video's header, or the recording does not fit, and"
        " two cameras have the same lens to the last digit or all points of a camera lie in a part of its picture."
        " Poses do not depend on the frame rate; velocities do.",
        "Correct the number that is wrong; times in a `timestamps` table are used instead of both frame rates.",
    ),
}
