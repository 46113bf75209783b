"""The page that sets the figures of the paper beside ours, from the table that `python -m website.figures` keeps."""

from __future__ import annotations

import csv
from pathlib import Path

from website.text import cell, table

_FIGURES = Path(__file__).resolve().parents[1] / "docs" / "images" / "huo2015" / "figures.csv"
_HEAD = """# The paper's figures beside ours

Huo, Yang & Yang, *Optics and Precision Engineering* 23(8), 2015, section 5.1: three beams 20° apart, two cameras of 1280x1024
pixels, 10 ms per frame, a false point near each spot with a probability of 20 %. beampose repeats this experiment:

```console
$ beampose study huo2015 --out results/study
```

The paper does not print its trajectory, noise or filter settings, so the repetition agrees in what the paper states: the geometry,
the rate, the clutter, the bends and the spots that leave the picture.
"""
_TAIL = """An empty cell means that there is no such figure: the paper does not print it, or the method does not compute it.

Three remarks on the comparison:

- **Recognition rate, eq. (15).** The paper prints 65.97 %, which is nearly 4/6. Four of the six spots are always in view: it seems that
  every estimate out of view counts as wrong. The rows below it say what that rate does not show: whether the spots in view have the right label, and
  how far the estimates out of view are off.
- **Out of view.** With exact input, eqs. (10) to (14) and the rigid body are exact to rounding. The paper's 0.05 px in simulation thus reflects
  its noise; 0.1 px of noise gives the values above.
- **Curve switching** helps a stiff filter and hardly changes a loose one, because a loose filter follows a bend by itself.

## Prediction (Figs. 5 and 6)

<div class="grid-2" markdown>

![Prediction error of spot 1, conventional Kalman filter](images/huo2015/prediction-conventional.svg)

![Prediction error of spot 1, curve-switching Kalman filter](images/huo2015/prediction-switching.svg)

</div>

Left: the conventional filter overshoots after each bend of the trajectory. Right: with the restart of eq. (6) only the frame of the bend itself
is off.

## Spots out of view (Figs. 7 and 12)

<div class="grid-2" markdown>

![Distance of spot 3 from the truth while it is out of view](images/huo2015/out-of-view-3.svg)

![Distance of spot 6 from the truth while it is out of view](images/huo2015/out-of-view-6.svg)

</div>

## Trajectories (Fig. 8)

<div class="grid-2" markdown>

![Tracks of the spots in the left camera](images/huo2015/tracks-left.svg)

![Tracks of the spots in the right camera](images/huo2015/tracks-right.svg)

</div>

## Tracking error (Figs. 9 and 13)

![Tracking error of spot 3, in view and out of view](images/huo2015/tracking-error-3.svg)

The report of the study has all spots. Formulas: [Trackers of single spots](theory/spot-tracker.md). `python -m website.figures` makes the
pictures and the table of this page.
"""


def page() -> str:
    """The page as Markdown."""
    with _FIGURES.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [_HEAD]
    head = ("quantity", "unit", "paper", "conventional filter", "curve switching", "beampose", "note")
    columns = ("paper", "conventional", "curve_switching", "beampose")
    lines += table(
        head,
        ((cell(r["quantity"]), r["unit"], *(_number(r[c]) for c in columns), cell(r["note"])) for r in rows),
    )
    return "\n".join([*lines, _TAIL])


def _number(text: str) -> str:
    if not text:
        return ""
    value = float(text)
    return "below 1e-9" if 0 <= value < 1e-9 else f"{value:.4g}"
