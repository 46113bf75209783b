"""The experiment of Fu (2016): the table beside the published figures, and the curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.number_format import format_number
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, ORANGE, VERMILLION, robust_range
from studies.comparison import Comparison, ComparisonRow, Figure
from studies.fu2016_experiments import (
    DISTURBANCES,
    DT_S,
    FILTERS,
    SETTLED_S,
    Recording,
    estimate,
    peaks,
    picture_figure,
    picture_rows,
    quiet_rms,
    run_pictures,
    simulate,
)
from tracking.unscented.fu2016 import P0, STATES, Observability, R, bearings, observability, process, selection
from tracking.unscented.ukf import Function

RECORDINGS = 20
COLOURS = {"standard": BLUE, "as printed": ORANGE, "gate": GREEN, "Student-t": VERMILLION}
# Name: measurement function and the number of its components; R of a component is that of eq. (10).
OBSERVATIONS: dict[str, tuple[Function, int]] = {
    "eq. (4): y, z, yaw, pitch": (selection, 4),
    "eq. (5): y, z and two bearings": (bearings, 4),
    "both: y, z, yaw, pitch and two bearings": (lambda s: np.concatenate([selection(s), bearings(s)[:, 2:]], 1), 6),
}


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one filter over N recordings; columns position, m, velocity, m/s, angle, degrees."""

    quiet: Array  # (N, 4): RMS without disturbance; last column the range, m
    peaks: dict[str, Array]  # disturbance -> (N, 3)


def compare_fu2016(seed: int = 1, recordings: int = RECORDINGS, pictures: int | None = None) -> Comparison:
    """The table and the figures of section 4; the seed determines the result. pictures: the first ones; None: all."""
    errors = {name: _errors(seed, recordings, name) for name in FILTERS}
    first = simulate(seed, 0, "none")
    shown = {name: run_pictures(seed, name == "Student-t", pictures) for name in ("standard", "Student-t")}
    observed = {
        name: observability(first.states, process(DT_S), function, R[0, 0] * np.eye(m), P0)
        for name, (function, m) in OBSERVATIONS.items()
    }
    return Comparison(
        title="Fu, Kong, Dong, Zhi & Gao (2016), section 4",
        setting=f"{recordings} recordings · 20 s at {DT_S:g} s · disturbance from 6 to 8 s · seed {seed}",
        methods=FILTERS,
        rows=(*_quiet_rows(errors), *_peak_rows(errors), *_observability_rows(observed), *picture_rows(shown)),
        explanation="Standard: the unscented filter with the paper's numbers and the weights of eq. (9) as they are"
        " meant. As printed: with eqs. (11) to (13). Gate: measurements beyond a Mahalanobis distance (p = 0.001) are"
        " not used. Student-t: their noise is increased. All four have the same motion model, Q and R. Values are"
        " medians over the recordings; “worst” is the largest one. Position and velocity are those of y and z: eq. (4)"
        " does not observe the range x.",
        figures=(*_curves(seed), _observability_figure(observed), picture_figure(seed, shown["Student-t"])),
        source="Y. Fu, X. Kong, X. Dong, J. Zhi, Y. Gao, Journal of Applied Optics 37(6), 860 (2016),"
        " doi 10.5768/JAO201637.0602004.",
    )


def _errors(seed: int, recordings: int, name: str) -> Errors:
    quiet: list[tuple[float, ...]] = []
    largest: dict[str, list[tuple[float, ...]]] = {d: [] for d in DISTURBANCES[1:]}
    for number in range(recordings):
        still = simulate(seed, number, "none")
        quiet.append(quiet_rms(still, estimate(still, name)))
        for disturbance, of in largest.items():
            recording = simulate(seed, number, disturbance)
            of.append(peaks(recording, estimate(recording, name)))
    return Errors(np.array(quiet), {d: np.array(of) for d, of in largest.items()})


# The table --------------------------------------------------------------------------------------------------------


def _row(quantity: str, unit: str, paper: float | None, values: dict[str, float], note: str = "") -> ComparisonRow:
    return ComparisonRow(quantity, unit, paper, tuple(values[name] for name in FILTERS), note)


def _quiet_rows(errors: dict[str, Errors]) -> list[ComparisonRow]:
    out = []
    after = f"without disturbance, from {SETTLED_S:g} s on"
    for column, (quantity, unit) in enumerate((("position", "m"), ("velocity", "m/s"), ("angle", "deg"))):
        rms = {name: e.quiet[:, column] for name, e in errors.items()}
        out.append(_row(f"quiet RMS, {quantity}", unit, None, {n: float(np.median(v)) for n, v in rms.items()}, after))
        ratio = {n: float(np.max(v / rms["standard"])) for n, v in rms.items()}
        out.append(_row(f"quiet RMS, {quantity}, ratio to standard, worst", "", None, ratio))
    range_rms = {n: float(np.median(e.quiet[:, 3])) for n, e in errors.items()}
    out.append(
        _row("quiet RMS, range x", "m", None, range_rms, "not observed by eq. (4): the error of the first state")
    )
    return out


def _peak_rows(errors: dict[str, Errors]) -> list[ComparisonRow]:
    out = []
    for disturbance in DISTURBANCES[1:]:
        for column, (quantity, unit, paper) in enumerate(
            (("position", "m", 0.1), ("velocity", "m/s", 0.1), ("angle", "deg", 1.0))
        ):
            largest = {name: e.peaks[disturbance][:, column] for name, e in errors.items()}
            note = "6 to 9 s; the published value is that of the modification, without its disturbance's size"
            middle = {n: float(np.median(v)) for n, v in largest.items()}
            out.append(_row(f"{disturbance}: peak error, {quantity}", unit, paper, middle, note))
            ratio = {n: float(np.max(v / largest["standard"])) for n, v in largest.items()}
            out.append(_row(f"{disturbance}: peak error, {quantity}, ratio to standard, worst", "", None, ratio))
    return out


def _observability_rows(observed: dict[str, Observability]) -> list[ComparisonRow]:
    """The standard filter's column: observability depends on the measurement, not on the filter."""
    out = []
    for name, o in observed.items():
        note = f"of {len(STATES)}; not observed: {', '.join(_unobserved(o)) or 'none'}"
        out.append(_standard_only(f"observed directions, {name}", "", float(o.rank), note))
        out.append(
            _standard_only(f"sigma of range x, {name}", "m", float(o.sigma[0]), f"prior {o.sigma_prior[0]:.1f} m")
        )
    return out


def _standard_only(quantity: str, unit: str, value: float, note: str) -> ComparisonRow:
    return ComparisonRow(quantity, unit, None, (value, *[None] * (len(FILTERS) - 1)), note)


def _unobserved(o: Observability) -> list[str]:
    return [name for name, good in zip(STATES, o.observed(), strict=True) if not good]


# The figures ------------------------------------------------------------------------------------------------------


def _curves(seed: int) -> list[Figure]:
    out = []
    for disturbance in DISTURBANCES[1:]:
        recording = simulate(seed, 0, disturbance)
        states = {name: estimate(recording, name) for name in FILTERS}
        panels = [
            _panel(recording, states, 1, "y: estimate − true", "m"),
            _panel(recording, states, 2, "z: estimate − true", "m"),
            _panel(recording, states, 4, "velocity y: estimate − true", "m/s"),
            _panel(recording, states, 6, "yaw: estimate − true", "deg"),
        ]
        out.append(
            Figure(
                f"Errors with a {disturbance} (Figs. 4 to 8)",
                "Blue: standard. Orange: as printed. Green: gate. Red: Student-t. The disturbance is shaded. The"
                " modification as printed keeps its previous value whenever a number changes by more than 0.5 %, so it"
                " does not follow the motion; the gate can stay closed after the disturbance.",
                "".join(panels),
            )
        )
    return out


def _panel(recording: Recording, states: dict[str, Array], column: int, title: str, unit: str) -> str:
    scale = np.rad2deg(1.0) if unit == "deg" else 1.0
    errors = {name: scale * (s - recording.states)[:, column] for name, s in states.items()}
    t = recording.t_s > 1.0  # before it the first state dominates
    lines = tuple(Line(e[t], COLOURS[name], name) for name, e in errors.items())
    y_range = robust_range(np.concatenate([e[t] for name, e in errors.items() if name != "as printed"]), 0.05)
    shade = (Shade(recording.disturbed[t], "predicted", "disturbance"),)
    return time_panel(recording.t_s[t], title, unit, lines=lines, shades=shade, y_range=y_range)


def _observability_figure(observed: dict[str, Observability]) -> Figure:
    head = "".join(f"<th>{name}</th>" for name in ("state", "prior", *(n.partition(":")[0] for n in observed)))
    units = ("m", "m", "m", "m/s", "m/s", "m/s", "rad", "rad")
    rows = []
    for i, (state, unit) in enumerate(zip(STATES, units, strict=True)):
        sigmas = [next(iter(observed.values())).sigma_prior[i], *(o.sigma[i] for o in observed.values())]
        cells = "".join(f"<td>{format_number(float(s), 2)}</td>" for s in sigmas)
        rows.append(f"<tr><td>{state} ({unit})</td>{cells}</tr>")
    ranks = "".join(f"<td>{o.rank} of {len(STATES)}</td>" for o in observed.values())
    rows.append(f"<tr><td>directions observed</td><td></td>{ranks}</tr>")
    return Figure(
        "Which states are observable",
        "Sigma of each number of the first state, before and after 20 s of measurements, without process noise, from"
        " the observability Gramian along the true motion. Eq. (4) selects four numbers: range and range rate keep"
        " their prior sigma. Eq. (5) replaces the two attitude angles by the directions in which the tanker is seen:"
        " they observe the range weakly, through the parallax y / x, and the attitude not at all.",
        f'<table class="facts"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>',
    )
