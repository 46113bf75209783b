"""Parameters of the circle tracker. Lengths are pixels, times are frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Edge(StrEnum):
    """Which edge of a target with several ones about the same centre is tracked."""

    SUPPORTED = "supported"  # the outermost of those that are supported about equally well
    OUTER = "outer"  # of the rim
    INNER = "inner"  # of a thin rim: the other side of its line
    OPENING = "opening"  # of the basket: clearly inside the rim


@dataclass(frozen=True, slots=True)
class CircleParameters:
    """Each field with its unit and, where it is from Zhou (2014), the symbol there."""

    min_radius_px: float = 7.0  # of circles searched in the whole picture (the paper: 10)
    max_radius_px: float | None = None  # None: half of the picture's smaller side (the paper: 30)
    edge: Edge = Edge.SUPPORTED
    blur_px: float = 1.0  # 1 sigma of the Gaussian filter before gradients
    window_radii: float = 4.0  # side of the search window in radii (section 2.3)
    gate_px: float = 8.0  # sigma: largest distance of a centre from the prediction, at least 3 standard deviations
    radius_gate: float = 0.25  # largest relative difference of a radius from the prediction
    candidates: int = 3  # coarse circles of a window that are fitted to the rim
    min_coverage: float = 0.4  # share of the rim with edge points for a measurement
    acquire_coverage: float = 0.6  # the same for a circle without a prediction
    ambiguous_share: float = 0.8  # a second circle with this share of the best one's score makes the choice ambiguous
    occluded: float = 0.5  # beta: with an occlusion coefficient from here on the state is only predicted
    accelerations_px: tuple[float, ...] = (0.02, 0.08, 0.3, 1.2)  # px/frame^2, 1 sigma, of the filters of the bank
    jerks_px: tuple[float, ...] = (0.003, 0.012, 0.05)  # px/frame^3, of the filters with a steady acceleration
    radius_share: float = 0.15  # acceleration of the radius as a share of that of the centre
    forgetting: float = 0.95  # of the likelihoods of the bank, per frame
    gate_chi2: float = 21.1  # innovation gate, 3 degrees of freedom, p = 1e-4
    search_after: int = 3  # frames without a measurement after which the whole picture is searched, too
    most_predicted: int = 50  # frames without a measurement after which the circle is lost
    lost_sigma_radii: float = 1.0  # standard deviation of the centre, in radii, above which the circle is lost

    def __post_init__(self) -> None:
        if not self.min_radius_px >= 4:
            raise ValueError(f"min_radius_px: expected 4 px or more, got {self.min_radius_px:g}")
        if self.max_radius_px is not None and not self.max_radius_px > self.min_radius_px:
            raise ValueError(
                f"max_radius_px: expected more than min_radius_px ({self.min_radius_px:g}), got {self.max_radius_px:g}"
            )
        if not self.accelerations_px or min(self.accelerations_px) <= 0:
            raise ValueError(f"accelerations_px: expected positive numbers, got {self.accelerations_px}")
