"""Quantiles of gamma and chi-square distributions, and the tail probability of the latter.

In plain Python, because importing scipy.special takes 0.13 s of a run that must start within half a second; the tests
compare with it.
"""

from __future__ import annotations

import math
from functools import cache

_TINY = 1e-300
_MAX_STEPS = 200  # bisections and Newton steps; about ten are usual


@cache
def chi2_limit(p_above: float, dof: int) -> float:
    """The value that a chi-square variable with dof degrees of freedom exceeds with probability p_above (0 to 1)."""
    return 2 * gamma_quantile(p_above, dof / 2)


def chi2_tail(value: float, dof: int) -> float:
    """The probability that a chi-square variable with dof degrees of freedom exceeds a value; nan for nan."""
    if not 0 < value < math.inf:
        return value if math.isnan(value) else float(value <= 0)
    return math.exp(_log_tails(value / 2, dof / 2)[2])


def gamma_quantile(p_above: float, shape: float) -> float:
    """The value that a gamma variable of this shape and of scale 1 exceeds with probability p_above (0 to 1).

    Newton's method on the logarithm of the tail, within a bracket; relative accuracy about 1e-12 for shapes below 1e4,
    1e-9 below 1e7. Start: Wilson and Hilferty (1931). Raises ValueError: the shape is not positive, or p_above is no
    probability.
    """
    if not shape > 0 or not 0 <= p_above <= 1:
        raise ValueError(f"expected a shape above 0 and a probability, got {shape} and {p_above}")
    if p_above in (0.0, 1.0):
        return math.inf if p_above == 0 else 0.0
    below, above = 0.0, math.inf
    x = max(shape * (1 - 1 / (9 * shape) + _normal(p_above) / (3 * math.sqrt(shape))) ** 3, 1e-3 * shape)
    upper = p_above < 0.5  # the smaller tail, whose logarithm loses no digits
    wanted = math.log(p_above if upper else 1 - p_above)
    for _ in range(_MAX_STEPS):
        log_density, log_lower, log_upper = _log_tails(x, shape)
        gap = (log_upper if upper else log_lower) - wanted
        if (gap > 0) == upper:
            below = max(below, x)
        else:
            above = min(above, x)
        step = gap * math.exp((log_upper if upper else log_lower) - log_density) * (1 if upper else -1)
        following = x + step
        if not below < following < above:
            following = 0.5 * (below + above) if math.isfinite(above) else 2 * x
        if abs(following - x) <= 4e-16 * x:
            return following
        x = following
    return x


def _log_tails(x: float, shape: float) -> tuple[float, float, float]:
    """Logarithms of a gamma variable's density at x, of the probability below x, and of the probability above x.

    Series below the mean, continued fraction above it. Source: DLMF 8.11.4 and 8.9.2; Lentz's method.
    """
    log_density = -x + (shape - 1) * math.log(x) - math.lgamma(shape)
    if x < shape + 1:
        term = total = 1 / shape
        n = shape
        while term > 1e-17 * total:
            n += 1
            term *= x / n
            total += term
        log_lower = log_density + math.log(x) + math.log(total)
        return log_density, log_lower, _log_complement(log_lower)
    b = x + 1 - shape
    c, d = 1 / _TINY, 1 / b
    h, i = d, 0
    while True:
        i += 1
        a = -i * (i - shape)
        b += 2
        d = a * d + b
        d = 1 / (d if abs(d) > _TINY else _TINY)
        c = b + a / c
        c = c if abs(c) > _TINY else _TINY
        h *= c * d
        if abs(c * d - 1) < 1e-16 or i > 100_000:
            break
    log_upper = log_density + math.log(x) + math.log(h)
    return log_density, _log_complement(log_upper), log_upper


def _log_complement(log_p: float) -> float:
    """ln(1 - exp(log_p))."""
    return math.log(max(-math.expm1(log_p), _TINY))


def _normal(p_above: float) -> float:
    """Quantile of a normal variable, to 0.003. Source: Abramowitz and Stegun, 26.2.22."""

    p = min(p_above, 1 - p_above)
    t = math.sqrt(-2 * math.log(p))
    z = t - (2.30753 + 0.27061 * t) / (1 + 0.99229 * t + 0.04481 * t * t)
    return z if p_above < 0.5 else -z
