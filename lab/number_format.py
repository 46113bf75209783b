"""Numbers in reports and messages: significant digits, units, and values with their sigma."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np


def format_number(value: float | None, digits: int = 3, signed: bool = False) -> str:
    """A number with `digits` significant digits, without exponent from 1e-4 to 1e6; a dash for None, nan and inf.

    signed: with a plus in front of a positive one.
    """
    if signed and value is not None and np.isfinite(value) and value > 0:
        return f"+{format_number(value, digits)}"
    if value is None or not np.isfinite(value):
        return "\u2013"
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} × 10^{int(exponent)}".replace("-", "\u2212")
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{decimals}f}".replace("-", "\u2212")


def format_with_sigma(value: float, sigma: float, signed: bool = False) -> str:
    """`0.350 ± 0.012`: the sigma to one digit (two digits where the first is 1), the value to as many decimals."""
    if not np.isfinite(value):
        return "\u2013"
    if not (np.isfinite(sigma) and sigma > 0):
        return format_number(value, 2, signed)
    if sigma < 1e-9:  # rounding errors: nothing is measured so well
        return f"{format_number(value, 2, signed)} ± {format_number(sigma, 1)}"
    power = int(np.floor(np.log10(sigma)))
    decimals = max(0, -power + (1 if sigma / 10.0**power < 2 else 0))
    text = f"{value:{'+' if signed else ''}.{decimals}f} ± {sigma:.{decimals}f}"
    return text.replace("-", "\u2212")


def decimals_of(sigma: float) -> int:
    """Decimals that show two digits of a sigma, at most six."""
    return int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))


def median(values: np.ndarray) -> float | None:
    """The median of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def format_cell(value: float) -> str:
    """Six digits, for a table whose figures are less precise; empty if not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""


def format_some(things: Sequence[object], most: int = 5, separator: str = ", ") -> str:
    """The first ones of some numbers or names."""
    return separator.join(map(str, things[:most])) + (f"{separator}..." if len(things) > most else "")


def format_vector(vector: Iterable[float], decimals: int) -> str:
    """`1.00, \u22122.00, 0.00`."""
    return ", ".join(f"{round(float(v), decimals) + 0.0:.{decimals}f}" for v in vector).replace("-", "\u2212")


def format_p(p_value: float) -> str:
    """`= 0.2`, `= 3e-09`, `below 1e-12`."""
    return "below 1e-12" if p_value < 1e-12 else f"= {p_value:.1g}"


def format_count(count: int, thing: str) -> str:
    """`1 frame`, `2 frames`."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def format_percent(share: float | None) -> str:
    """A share as a percentage. 0 % and 100 % mean exactly none and all: other shares get enough decimals."""
    if share is None or not np.isfinite(share):
        return "\u2013"
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    decimals = 1
    while decimals < 4 and f"{100 * share:.{decimals}f}" in ("100." + "0" * decimals, "0." + "0" * decimals):
        decimals += 1
    return f"{100 * share:.{decimals}f} %"


def format_length(metres: float | None) -> str:
    """A length in mm, or in m from one metre on."""
    if metres is None or not np.isfinite(metres):
        return "\u2013"
    return f"{format_number(metres)} m" if abs(metres) >= 1 else f"{format_number(1000 * metres)} mm"


def format_angle(degrees: float | None) -> str:
    """An angle in degrees, or in thousandths of a degree below a tenth."""
    if degrees is None or not np.isfinite(degrees):
        return "\u2013"
    return f"{format_number(degrees)}\u00b0" if abs(degrees) >= 0.1 else f"{format_number(1000 * degrees)} mdeg"
