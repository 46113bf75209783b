"""Explanations of the verdict on a tracked drogue (BP-G)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

DROGUES: Explanations = {
    "BP-G01": Explanation(
        "No drogue was found",
        "No frame has a measured drogue: there is none in view, it is larger than the picture or smaller than 8 px, or"
        " several drogues are alike.",
        "Look at the pictures; set --min-diameter and --max-diameter; with several drogues, state --near.",
    ),
    "BP-G02": Explanation(
        "Few frames with a measured drogue",
        "A share of the frames has no measured drogue: FAIL below the gate, CHECK below 95 %. The text counts the"
        " causes. Frames that are measured are not affected.",
        "Treat the most frequent cause first; the overlay (--video) shows the frames.",
    ),
    "BP-G03": Explanation(
        "Frames without a picture",
        "Pictures are missing or damaged. The drogue is predicted there, with sigmas that say so.",
        "Check the camera, its disk and the file.",
    ),
    "BP-G04": Explanation(
        "Several drogues in view",
        "Before the first measurement, or after the drogue was lost, more than one object could be it. Such frames have"
        " the status `lost`, since a choice would be a guess.",
        "State the place of the drogue in the first picture (--near), or its range of diameters.",
    ),
    "BP-G05": Explanation(
        "The drogue was found again far from its last place",
        "The detector found a drogue elsewhere in the picture, more than a diameter away. Either the drogue moved while"
        " it was hidden, or one of the two is another object.",
        "Compare these frames in the overlay (--video); if it is another object, do not use the frames after it.",
    ),
    "BP-G06": Explanation(
        "Low confidence",
        "The confidence is the probability that the centre is right to a quarter of the diameter. Its mean is the share"
        " of frames that is expected to be right.",
        "Use frames with a high confidence only; improve light and contrast, or state a smaller --every.",
    ),
    "BP-G07": Explanation(
        "The detector does not confirm what is followed",
        "In most of its checks the detector finds no drogue where the light tracker is: the drogue may look unlike the"
        " rendered ones of the training, or another object is followed.",
        "Look at the overlay (--video); with a wrong object, state --near or the range of diameters.",
    ),
}
