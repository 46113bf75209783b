"""Explanations of the verdict on a tracked circle (BP-T)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

CIRCLES: Explanations = {
    "BP-T01": Explanation(
        "No circle was found",
        "No frame has a measured circle: there is no target in view, its rim is not a circle of the searched radii, it"
        " is larger than the picture, or several circles are alike.",
        "Look at the pictures; set --min-radius and --max-radius; with several circles, state --near.",
    ),
    "BP-T02": Explanation(
        "Few frames with a measured circle",
        "A share of the frames has no measured circle: FAIL below the gate, CHECK below 95 %. The text counts the"
        " causes. Circles of frames that are measured are not affected.",
        "Treat the most frequent cause first; the overlay (--video) shows the frames.",
    ),
    "BP-T03": Explanation(
        "Frames without a picture",
        "Pictures are missing or damaged. The circle is predicted there, with sigmas that say so.",
        "Check the camera, its disk and the file.",
    ),
    "BP-T04": Explanation(
        "Several circles fit equally well",
        "Before the first measurement, or after the circle was lost, more than one circle could be the target. Such"
        " frames have the status `lost`, since a choice would be a guess.",
        "State the place of the circle in the first picture (--near), or its range of radii.",
    ),
    "BP-T05": Explanation(
        "The circle was found again far from its last place",
        "After a gap the search of the whole picture found a circle of the same radius and polarity elsewhere.",
        "Compare these frames in the overlay (--video); if it is another circle, do not use the frames after it.",
    ),
}
