"""Explanations of a camera's calibration (BP-L): its board, photographs and lens model."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

LENSES: Explanations = {
    "BP-L01": Explanation(
        "Uncertain lens model",
        "The photographs do not distinguish lens models, or no available model describes the lens. All sigmas are"
        " multiplied by the factor found.",
        "Add photographs with the board near the border of the picture; name the lens model if you know it (--lens).",
    ),
    "BP-L02": Explanation(
        "Board or pixels out of scale",
        "The photographs cannot distinguish a board that is out of scale from pixels that are not square.",
        "Photograph the board turned by 90 deg as well; measure it along both directions.",
    ),
    "BP-L03": Explanation(
        "The board is out of scale",
        "Rows and columns differ from the stated sizes. The lens is corrected for it; absolute distances may be"
        " wrong by the same share.",
        "Measure the board over its whole length in both directions, or print it again at 100 %.",
    ),
    "BP-L04": Explanation(
        "Displaced points of the board",
        "The board is printed unevenly, joined, wavy or damaged. Its points were solved for.",
        "Print it on one stiff sheet, or use a machined board.",
    ),
    "BP-L05": Explanation(
        "Diameter of the circles",
        "The circles differ from the stated diameter; the measured one was used.",
        "Measure diameter and spacing of the circles, and state both.",
    ),
    "BP-L10": Explanation(
        "The lens model folds",
        "Two directions map to the same pixel inside the picture: the model is wrong there.",
        "Take more photographs with the board in all parts of the picture.",
    ),
    "BP-L11": Explanation(
        "Large residuals of the corners",
        "Blur, a board that is not flat or not as stated, or a lens that no model describes.",
        "Fix the board to glass or a thick plate, hold it still, light it well, check its measures.",
    ),
    "BP-L12": Explanation(
        "Many corners excluded",
        "Corners far from the model count as outliers; with many of them the others are doubtful too.",
        "Photograph the marked views again, sharp and without glare.",
    ),
    "BP-L13": Explanation(
        "Few photographs",
        "Neither the lens model nor its errors can be checked.",
        "Take 15 to 30 photographs.",
    ),
    "BP-L14": Explanation(
        "The board was hardly tilted",
        "Without tilted boards the focal length can hardly be separated from the distance.",
        "Tilt the board by 20 to 45 deg in several directions.",
    ),
    "BP-L15": Explanation(
        "Parts of the picture are not covered",
        "The lens model is extrapolated there.",
        "Add photographs with the board in these areas, cut off by the border if the board allows it.",
    ),
    "BP-L16": Explanation(
        "Uncertain focal length",
        "A pose's distance is uncertain by the same share.",
        "Take more photographs, with the board tilted and at several distances.",
    ),
    "BP-L17": Explanation(
        "fx and fy differ",
        "Pixels are square on nearly every sensor: a wrong spacing of the board, stretched pictures, or views"
        " that do not determine both.",
        "Measure the board along both directions; photograph it turned by 90 deg; check the scaling of the pictures.",
    ),
    "BP-L18": Explanation(
        "Principal point off the centre",
        "A large offset indicates a cropped or shifted picture.",
        "Check that the pictures are not cropped; photograph the board turned by 90 deg as well.",
    ),
    "BP-L19": Explanation(
        "The lens is fitted to noise",
        "Photographs that were not used fit worse than those that were.",
        "Take more photographs.",
    ),
    "BP-L20": Explanation(
        "Halves cannot be compared",
        "Half of the photographs do not determine the lens, so that errors of the model remain undetected.",
        "Take more photographs.",
    ),
    "BP-L21": Explanation(
        "Halves of the photographs disagree",
        "Lens model, board or corners have errors that noise does not explain.",
        "Use a stiffer board, check its measures, take more and more varied photographs; calibrate sets of"
        " different focus separately.",
    ),
    "BP-L22": Explanation(
        "Two sets of photographs disagree",
        "The photographs seem to be from two cameras, or focus or zoom was changed in between.",
        "Calibrate each set separately; fix focus and zoom before the first photograph.",
    ),
    "BP-L23": Explanation(
        "Errors within a photograph are correlated",
        "The parameters scatter from photograph to photograph more than noise explains; all sigmas are multiplied"
        " by the factor.",
        "Use a stiffer board, hold it still, and take more photographs.",
    ),
    "BP-L24": Explanation(
        "Directions of pixels are uncertain",
        "Every spot at such a place has this error in all frames: averaging does not reduce it.",
        "Add photographs with the board where the uncertainty map is worst.",
    ),
    "BP-L25": Explanation(
        "A bent board",
        "The bend was corrected, but it may differ each time the board is held.",
        "Glue the board to glass or a thick plate.",
    ),
}
