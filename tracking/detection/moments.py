"""What the light around a peak is like before any fit: whether it stands out, is sharp, or round; its moments.

The moments are a first centre and size of each candidate, and the result for bright compact spots that are not
Gaussian: saturated cores with rings, spots at an edge of the screen. `compact_height` recognises these.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.ellipse import gaussian_window
from tracking.detection.pixels import (
    OUTSIDE,
    Noise,
    Pixels,
    Window,
    insertion_sort,
    maximum_of,
    mean3,
    nth_smallest,
    pixel,
    read_window,
    texture_variance,
    total_of_products,
    variance,
    window_around,
    with_texture,
)  # fmt: skip
from tracking.detection.table import ROW, SCRATCH, STATE, VALUES, Candidate, Candidates, Peak

# Growing windows: half the number of cells, cell size, iterations, and the largest 1-sigma half axis (px) for each.
_WINDOWS = ((9, 1, 3, 3.5), (18, 2, 5, 9.0), (18, 4, 5, np.inf))
_START, _START_WIDE = 2.0, 16.0  # px^2: least variance of the first window; that of wide faint peaks
_START_SHARE = 0.7  # variance of the first window over the square of the light's half side: half the light's variance
_RADII = (0.4, 0.8, 2.4, 2.8, 3.2)  # sigmas of the moments' ellipse: two in the core, three in the ring
# Error of the centre relative to the ellipse's sigma. On the three saturated laser spots of the real pictures the
# moments and the middle of the core differ by 0.05 to 0.15.
CENTRE_SHARE = 0.15
_OF_HALF = 2.885  # variance of a Gaussian over that of its pixels above half of its height: 2 / ln 2
_FEWEST = 5  # such pixels, that a start is taken from
_THRESHOLD_FACTOR = 1.5  # factor on the noise in the detection threshold, because no fit confirms the spot

_STEPS, _SIGMAS = (1, 2, 4, 8), (0.6, 1.0, 1.6, 2.5)  # px; of these steps


def _round_shapes(half: int) -> tuple[Array, Array]:
    """(3, n): a plane on a square of (2 half + 1)^2 cells, orthonormal; (4, n): Gaussians without it, of length 1."""
    along = np.arange(-half, half + 1.0)
    v, u = (x.ravel() for x in np.meshgrid(along, along, indexing="ij"))
    plane = np.array([np.ones_like(u), u, v])
    plane /= np.linalg.norm(plane, axis=1)[:, None]
    shapes = np.array([np.exp(-0.5 * (u * u + v * v) / (s * s + 1 / 12)) for s in _SIGMAS])
    shapes -= shapes @ plane.T @ plane
    return plane, shapes / np.linalg.norm(shapes, axis=1)[:, None]


_HALF, _CLOSE = 7, 4  # px to each side of the windows of the test
_PLANE, _ROUND = _round_shapes(_HALF)
_CLOSE_PLANE, _CLOSE_ROUND = _round_shapes(_CLOSE)  # for spots with others around them

_BY_NOISE = 3.0  # sigmas of the sum of squared noise on the squares of `is_round`
# Share of the texture's sigma in it: the light falls off in all directions, which most grains of texture do not.
_OF_TEXTURE = 0.7

PEAK_SHARE = 0.75  # share of the threshold above which a peak is measured
# Radii, px, of the circles on which the light of a line continues, and the numbers of points on them. The last one is
# for a narrow spot in a small even place, where only the first one shows nothing else.
_CIRCLES, _RING = (4.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 6.0), (12, 20, 28, 36, 52, 72, 108, 16)
_IN_SMALL_PLACE = len(_CIRCLES) - 1
_TURNS = [np.exp(2j * np.pi * np.arange(n) / n) for n in _RING]
_ON_CIRCLES = np.concatenate([r * turn for r, turn in zip(_CIRCLES, _TURNS, strict=True)])
_POINTS = np.rint(np.column_stack([_ON_CIRCLES.real, _ON_CIRCLES.imag])).astype(np.int64)  # (sum of _RING, 2), px
_HIGHEST = (1.6, 1.9, 2.0, 2.1, 2.2, 2.4, 2.5, 1.8)  # expected highest of as many normal deviates, in sigmas
# The first circle outside a spot that is wide enough to raise the background from the search, and by this ratio.
_OUTSIDE_WIDE, _RAISED = 5, 0.8
# Of the texture around: an even place among objects has less than this on a circle, homogeneous texture never.
_EVEN = 1 / 3
_SHARP_CIRCLES = 4  # of them, for what is about two pixels wide
_CLEARLY_HIGH = 2.0  # times the threshold by the texture: for such a peak it does not matter how even its place is
_LEAST_ON_RING = 3
_ON_RING = 1.0  # sigmas of a pixel: three of the means
MOST_ON_RING = max(_RING)


@compiled
def stands_out(image: Pixels, peak: Peak, noise: Noise, threshold_sigma: float, ring: Array) -> bool:
    """Whether a peak is far higher than the light on a circle around it; lowers its contrast in an even place.

    On each circle around a part of an edge, a cable or another long line some light continues; fits of candidates on
    lines would grow over large windows and take most of the time. A spot, also a streak, is brighter than all light on
    a circle that is large enough. The structure of the background at a place is that on the second most even of such
    circles: what stands farther away does not matter. ring (MOST_ON_RING,) is workspace. Source: ours.
    """
    here, column, row = peak["height"] + peak["level"], int(peak["u"]), int(peak["v"])
    sigma, alone, lowest, second = sqrt(variance(noise, peak["level"])), False, np.inf, np.inf
    level = peak["level"]  # without the light of a wide spot, which is in the background from the search
    structure = sqrt(texture_variance(with_texture(noise, peak["contrast"]), peak["level"]))
    high = peak["height"] >= _CLEARLY_HIGH * threshold_sigma * structure
    first = 0
    for k in range(len(_CIRCLES)):
        if k == _IN_SMALL_PLACE and (not alone or second < np.inf):
            break
        n = 0  # points inside the picture
        for i in range(first, first + _RING[k]):
            u, v = column + _POINTS[i, 0], row + _POINTS[i, 1]
            if 0 < u < image.width - 1 and 0 < v < image.height - 1:
                ring[n] = mean3(image, u, v)
                n += 1
        first += _RING[k]
        if n < _LEAST_ON_RING:
            alone = True
            break
        around, highest = nth_smallest(ring, n, n // 2), maximum_of(ring[:n])
        if highest - around < 0.5 * (here - around) + _ON_RING * sigma:
            if high:
                return True
            alone, scatter = True, (highest - around) / _HIGHEST[k]
            if _OUTSIDE_WIDE <= k < _IN_SMALL_PLACE and around < _RAISED * level:
                level = min(level, around)
            lowest, second = min(lowest, scatter), min(second, max(lowest, scatter))
    if second < _EVEN * peak["contrast"] * peak["level"]:
        peak["contrast"] = second / max(peak["level"], 1.0)
    structure = sqrt(texture_variance(with_texture(noise, peak["contrast"]), level))
    return alone and here - level >= PEAK_SHARE * threshold_sigma * structure


@compiled
def is_sharp(image: Pixels, peak: Peak, noise: Noise, threshold_sigma: float) -> bool:
    """Whether a peak is far sharper than the structure around it; if so, its contrast is that of sharp structure.

    Edges and objects have a high contrast in means of 3x3 pixels, of which a narrow spot fills only a part, but little
    light that exceeds all neighbours. The second lowest of the maxima on circles counts, as in `stands_out`.
    """
    column, row, best = int(peak["u"]), int(peak["v"]), 0.0
    for i in range(row - 1, row + 1):
        for j in range(column - 1, column + 1):
            best = max(best, _sharpness(image, j, i))
    # Speckle is on the light of a wider spot.
    if best < max(threshold_sigma * sqrt(variance(noise, peak["level"]) / 3.0), peak["height"]):
        return False
    lowest, second = np.inf, np.inf
    first = 0
    for k in range(_SHARP_CIRCLES):
        highest = 0.0
        for i in range(first, first + _RING[k]):
            highest = max(highest, _sharpness(image, column + _POINTS[i, 0], row + _POINTS[i, 1]))
        first += _RING[k]
        scatter = highest / _HIGHEST[k]
        lowest, second = min(lowest, scatter), min(second, max(lowest, scatter))
    contrast = second / max(peak["level"], 1.0)
    if contrast > _EVEN * max(peak["contrast"], noise.texture):  # the texture is as fine as the peak
        return False
    if best < threshold_sigma * sqrt(texture_variance(with_texture(noise, contrast), peak["level"])):
        return False
    peak["contrast"] = contrast
    return True


@compiled
def _sharpness(image: Pixels, u: int, v: int) -> float:
    """The mean of the 2x2 pixels from (u, v) on less that of the twelve around them, DN; 0 at the picture's border."""
    if not (1 <= u < image.width - 2 and 1 <= v < image.height - 2):
        return 0.0
    inner, whole = 0.0, 0.0
    for i in range(-1, 3):
        for j in range(-1, 3):
            x = pixel(image, u + j, v + i)
            whole += x
            inner += x if 0 <= i <= 1 and 0 <= j <= 1 else 0.0
    return inner / 4.0 - (whole - inner) / 12.0


@compiled
def is_round(image: Pixels, u: int, v: int, variance_dn2: float, least: float) -> bool:
    """Whether a round Gaussian of some width explains at least this share of the light on a square around a peak.

    The light above a plane, without the noise of the pixels. Of spots it explains 0.6 and more, also of streaks and of
    two beside each other; of edges, lines and corners 0.1 to 0.4 in most cases. True at the picture's border. Source:
    ours.
    """
    found = _explains(image, u, v, _CLOSE, 1, _CLOSE_PLANE, _CLOSE_ROUND, variance_dn2, least)
    for step in _STEPS:
        found = found or _explains(image, u, v, _HALF, step, _PLANE, _ROUND, variance_dn2, least)
    return found


@compiled
def _explains(
    image: Pixels, u: int, v: int, half: int, step: int, plane: Array, shapes: Array, variance_dn2: float, least: float
) -> bool:
    """`is_round` on a square of (2 half + 1)^2 pixels with this distance."""
    reach, n, k = half * step, shapes.shape[1], 0
    if u < reach or v < reach or u + reach >= image.width or v + reach >= image.height:
        return True
    light = np.empty(n)
    for i in range(v - reach, v + reach + 1, step):
        for j in range(u - reach, u + reach + 1, step):
            light[k] = pixel(image, j, i)
            k += 1
    # Less what the noise may add: of a faint spot it is most of the sum.
    total = total_of_products(light, light) - (n + _BY_NOISE * sqrt(2.0 * n)) * variance_dn2
    for p in range(plane.shape[0]):
        total -= total_of_products(light, plane[p]) ** 2
    for p in range(shapes.shape[0]):
        along = total_of_products(light, shapes[p])
        if along > 0.0 and along * along >= least * total:
            return True
    return False


@compiled
def start_variance(half_side: float) -> float:
    """Variance, px^2, of the first window for light that fills a square of this half side, px."""
    return _START_SHARE * half_side * half_side


@compiled
def find_moments(image: Pixels, table: Candidates, cells: Array) -> None:
    """Moments and flux of candidates (n,), starting from their moments' centre and `start`, above the background.

    Accurate to about a tenth of a pixel, which is enough to start a fit.
    Source: Bernstein & Jarvis (2002), "Shapes and shears, stars and smears", Astron. J. 123, section 3.
    """
    for i in range(table.shape[0]):
        start = _START_WIDE if table[i]["wide"] else max(table[i]["start"], _START)
        table[i]["moment_uu"], table[i]["moment_uv"], table[i]["moment_vv"] = start, 0.0, start
    largest = 0.0
    for step in range(3):
        half, cell, rounds, limit = _WINDOWS[step]
        for i in range(table.shape[0]):
            spot = table[i]
            # Only candidates that have outgrown the previous window are measured in the next one.
            high = ellipse.eigenvalues(spot["moment_uu"], spot["moment_uv"], spot["moment_vv"])[1]
            if (step > 0 and high <= largest) or (step == 0 and (spot["wide"] or high > limit**2)):
                continue
            spot["cell_size"] = cell
            window = window_around(spot["moment_u"], spot["moment_v"], half, half, cell)
            # Clipped pixels are used: for a first width and centre a clipped top is better than missing pixels.
            read_window(image, window, np.inf, cells[VALUES], cells[STATE])
            background = spot["background"]
            if cell > 1:  # the given background, a median over 40 px, is biased by a wide spot
                background = _median_of_border(window, cells[VALUES], cells[STATE], cells[SCRATCH], background)
            _subtract_background(window, table, i, background, cells[VALUES], cells[STATE])
            for _ in range(rounds):
                spot["flux"] = cell * cell * _adapt_window(window, cells[VALUES], spot, cells[ROW:])
        largest = limit**2


@compiled
def _median_of_border(window: Window, values: Array, state: Array, scratch: Array, background: float) -> float:
    """The median of the window's border cells inside the picture; `background` if there are none."""
    n, last = 0, window.rows - 1
    for i in range(window.rows):
        for j in range(window.columns):
            k = i * window.columns + j
            if (i == 0 or j == 0 or i == last or j == window.columns - 1) and state[k] != OUTSIDE:
                scratch[n] = values[k]
                n += 1
    if n == 0:
        return background
    return 0.5 * (nth_smallest(scratch, n, (n - 1) // 2) + nth_smallest(scratch, n, n // 2))


@compiled
def _subtract_background(
    window: Window, table: Candidates, i: int, background: float, values: Array, state: Array
) -> None:
    """Subtract the background; cells outside and cells nearer to another candidate become 0."""
    cells = window.rows * window.columns
    for k in range(cells):
        values[k] = values[k] - background if state[k] != OUTSIDE else 0.0
    reach = 1.0 * window.cell * window.columns
    middle = 0.5 * (window.cell - 1)
    for j in range(table.shape[0]):
        du, dv = table[j]["moment_u"] - table[i]["moment_u"], table[j]["moment_v"] - table[i]["moment_v"]
        if j == i or max(abs(du), abs(dv)) >= reach:
            continue
        half = 0.5 * (du * du + dv * dv)
        for row in range(window.rows):
            y = window.top + middle + row * window.cell - table[i]["moment_v"]
            for column in range(window.columns):
                x = window.left + middle + column * window.cell - table[i]["moment_u"]
                if x * du + y * dv > half:
                    values[row * window.columns + column] = 0.0


@compiled
def _adapt_window(window: Window, light: Array, spot: Candidate, lines: Array) -> float:
    """One iteration of the adaptive window; returns the flux, DN cells. lines (4, cells) is workspace.

    Under a window W a Gaussian S has the covariance (1/S + 1/W)^-1. If both are equal, the measured offset and flux are
    half the true ones, so they are doubled.
    """
    pixel = window.cell**2 / 12.0
    W = (spot["moment_uu"] + pixel, spot["moment_uv"], spot["moment_vv"] + pixel)
    narrow = ellipse.inverse(*W)
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - spot["moment_u"], window.top + middle - spot["moment_v"]
    n = window.columns
    # Sums of the columns times y^0, y^1, y^2.
    weights, sum0, sum1, sum2 = lines[0, : n * window.rows], lines[1, :n], lines[2, :n], lines[3, :n]
    gaussian_window(narrow, u0, v0, float(window.cell), n, weights)
    for j in range(n):
        sum0[j] = sum1[j] = sum2[j] = 0.0
    for r in range(window.rows):
        y = v0 + r * window.cell
        row, line = weights[r * n : (r + 1) * n], light[r * n : (r + 1) * n]
        for j in range(line.shape[0]):
            a = row[j] * line[j]
            sum0[j] += a
            sum1[j] += a * y
            sum2[j] += a * y * y
    s0 = su = sv = suu = suv = svv = 0.0
    for j in range(n):
        x = u0 + j * window.cell
        s0, su, sv = s0 + sum0[j], su + x * sum0[j], sv + sum1[j]
        suu, suv, svv = suu + x * x * sum0[j], suv + x * sum1[j], svv + sum2[j]
    s0 = max(s0, 1e-9)
    mu, mv = su / s0, sv / s0
    seen = ellipse.clip_in_metric((suu / s0 - mu * mu, suv / s0 - mu * mv, svv / s0 - mv * mv), W, 0.15, 0.75)
    a, b, c = ellipse.inverse(*seen)
    a, b, c = ellipse.inverse(a - narrow[0], b - narrow[1], c - narrow[2])
    short = 2.0 / max(2.0 * ellipse.mahalanobis(mu, mv, *W), 1.0)
    spot["moment_u"] += short * mu
    spot["moment_v"] += short * mv
    a, b, c = ellipse.clip_eigenvalues(a - pixel, b, c - pixel, 0.1, np.inf)
    spot["moment_uu"], spot["moment_uv"], spot["moment_vv"] = a, b, c
    return 2.0 * s0


@compiled
def at_half_height(image: Pixels, peak: Peak, half: int, spot: Candidate) -> None:
    """Set the moments of a spot to those of the connected pixels above half of a peak, and its flux accordingly.

    As they are where these pixels are few, or reach a side of the square of so many px to each side. Source: ours.
    """
    side = 2 * half + 1
    left, top = int(peak["u"]) - half, int(peak["v"]) - half
    least = peak["level"] + 0.5 * peak["height"]
    seen, waiting = np.zeros(side * side, np.uint8), np.zeros(side * side, np.int64)
    waiting[0] = half * side + half
    seen[waiting[0]] = 1
    done, count = 0, 1
    n, u, v, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    while done < count:
        k = waiting[done]
        done += 1
        i, j = k // side, k % side
        if i == 0 or j == 0 or i == side - 1 or j == side - 1:
            return
        n, x, y = n + 1.0, float(j - half), float(i - half)
        u, v, uu, uv, vv = u + x, v + y, uu + x * x, uv + x * y, vv + y * y
        for step in (-side, -1, 1, side):
            other = k + step
            column, row = left + other % side, top + other // side
            inside = 0 <= column < image.width and 0 <= row < image.height
            if inside and not seen[other] and pixel(image, column, row) > least:
                seen[other], waiting[count] = 1, other
                count += 1
    if n < _FEWEST:
        return
    u, v = u / n, v / n
    uu, uv, vv = _OF_HALF * (uu / n - u * u), _OF_HALF * (uv / n - u * v), _OF_HALF * (vv / n - v * v)
    spot["moment_u"], spot["moment_v"] = peak["u"] + u, peak["v"] + v
    spot["moment_uu"], spot["moment_uv"], spot["moment_vv"] = ellipse.clip_eigenvalues(uu, uv, vv, 0.5, np.inf)
    det = spot["moment_uu"] * spot["moment_vv"] - spot["moment_uv"] ** 2
    spot["flux"] = 2 * pi * sqrt(det) * peak["height"]


@compiled
def light_ends(image: Pixels, spot: Candidate, most_dn: float, scratch: Array) -> bool:
    """Whether the light falls by at most so many DN from three to six widths of a spot, in the median of directions.

    The top of a wide light looks compact, but falls on. scratch (8,) is workspace.
    """
    step, n = sqrt(0.5 * (spot["uu"] + spot["vv"])), 0
    for octant in range(8):
        p, q = step * cos(octant * pi / 4), step * sin(octant * pi / 4)
        u, v = int(np.rint(spot["u"] + 6.0 * p)), int(np.rint(spot["v"] + 6.0 * q))
        if 0 < u < image.width - 1 and 0 < v < image.height - 1:
            near = mean3(image, int(np.rint(spot["u"] + 3.0 * p)), int(np.rint(spot["v"] + 3.0 * q)))
            scratch[n] = near - mean3(image, u, v)
            n += 1
    return n == 0 or nth_smallest(scratch, n, n // 2) <= most_dn


@compiled
def compact_height(
    image: Pixels, u: float, v: float, shape: tuple[float, float, float], noise: Noise, threshold_sigma: float,
    most: float, scratch: Array,
) -> float:  # fmt: skip
    """Height, DN, of a compact core above the ring around it; 0 if the light does not fall off in all directions.

    shape: the ellipse, px^2. In each of eight directions the ring around the core must have at most the share `most` of
    the median excess, which excludes edges, corners and ridges. scratch (32,) is workspace. Source: ours.
    """
    uu, uv, vv = ellipse.clip_eigenvalues(shape[0], shape[1], shape[2], 0.1, np.inf)
    l11 = sqrt(uu)
    l21 = uv / l11
    l22 = sqrt(vv - l21 * l21)
    highest = -np.inf
    for octant in range(8):
        p, q = cos(octant * pi / 4), sin(octant * pi / 4)
        ring = scratch[21:24]
        for k in range(5):
            column = int(np.rint(u + _RADII[k] * l11 * p))
            row = int(np.rint(v + _RADII[k] * (l21 * p + l22 * q)))
            if column < 0 or row < 0 or column >= image.width or row >= image.height:
                return 0.0
            if k < 2:
                scratch[2 * octant + k] = pixel(image, column, row)
            else:
                ring[k - 2] = pixel(image, column, row)
        insertion_sort(ring, 3)
        scratch[24 + octant] = ring[1]
        highest = max(highest, ring[1])
    insertion_sort(scratch[:16], 16)
    insertion_sort(scratch[24:32], 8)
    core, background = 0.5 * (scratch[7] + scratch[8]), 0.5 * (scratch[27] + scratch[28])
    above = core - background
    sigma2 = _THRESHOLD_FACTOR**2 * variance(noise, background) + _OF_TEXTURE**2 * texture_variance(noise, background)
    if highest - background > most * above or above <= threshold_sigma * sqrt(sigma2):
        return 0.0
    return above
