"""Explanations of the verdict of `beampose track point` (BP-N)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

POINT: Explanations = {
    "BP-N01": Explanation(
        "The target was never found",
        "No detection agrees with a steady motion over enough consecutive pictures. There is no position.",
        "Look at the pictures. `--detector spots` is for points of light, `darker` and `brighter` for larger targets."
        " Lower the detector's threshold with `--set`.",
    ),
    "BP-N02": Explanation(
        "Few frames with a measured position",
        "In the other frames the position is predicted by the motion, with sigmas that grow, or the target is lost."
        " FAIL below the gate `--min-measured`, CHECK below 95 %.",
        "Improve light and contrast, or use the predicted positions with their sigmas.",
    ),
    "BP-N03": Explanation(
        "The target was lost",
        "There was no detection in the gate for so long that the prediction is useless. The target is then searched"
        " again within the distance that it can have moved, by its brightness.",
        "Check the frames after it: another target with a similar brightness can be taken for it.",
    ),
    "BP-N04": Explanation(
        "Innovations larger than their sigmas",
        "The target moves less steadily, or its detections scatter more, than the filter assumes. Positions are still"
        " near the detections; their sigmas are too small.",
        "Set `track.sigma_model_px` or `track.sigma_a_px` to a larger value.",
    ),
    "BP-N05": Explanation(
        "Several similar targets",
        "Another detection has at least half the brightness of the tracked one. The track starts with the brightest.",
        "Choose the target with `--start U,V`, in pixels of the first picture.",
    ),
    "BP-N06": Explanation(
        "Missing pictures",
        "More than 5 % of the pictures are missing or damaged. Their positions are predicted.",
        "Check the camera, its disk, cable and trigger for dropped frames.",
    ),
}
