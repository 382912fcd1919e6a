"""Compiled loops of the fit over the pixels of whole objects; each call is single-threaded and releases the interpreter.

Pixels are sorted by (object, cluster) and worked through in pieces of `PIECE`, column by column, so that sums over pixels become
vector instructions. One thread makes the sums of an object in one order, so the bytes do not depend on the number of threads.
Model of a pixel: Eq. M.1 and M.2; residuals, loss and derivatives: Eq. M.6 to M.10; interpolation in r: Eq. M.4, M.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.compiled import njit

PIECE = 64
"""Pixels whose Jacobian columns are held together (`_Piece`)."""
# Reassociation lets the compiler turn a sum over pixels into vector sums. Without `nnan` and `ninf`, a sum that is not finite
# stays so, and the comparisons that accept a step refuse it.
_MATHS = {"reassoc", "contract", "nsz", "arcp"}
_compiled = njit(fastmath=_MATHS)
# Functions that other loops call are inlined: docs/method/numerics.md#sums-that-depend-on-the-compiler.
_inlined = njit(fastmath=_MATHS, forceinline=True)


class PixelArrays(NamedTuple):
    """Pixels of a fit, sorted by (object, cluster): n pixels, O objects, C clusters, J levels, h = 1 or 2 halves."""

    obj: NDArray
    """(n,) int64 object."""
    base: NDArray
    """(n, 5) base material."""
    diffuse: NDArray
    """(n, h, 3) cached diffuse light D."""
    lobes: NDArray
    """(n, J, 2, 6 h) values (0) and slopes in r (1) of S0 and S1 at the levels; per half: S0 in R G B, then S1."""
    levels: NDArray
    """(J,) roughness of the levels."""
    target: NDArray
    """(n, 3) what the prediction is compared with, in units of the curve."""
    exposure: NDArray
    """(n,) e."""
    saturated: NDArray
    """(n, 3) bool: `target` bounds the prediction from below."""
    trust: NDArray
    """(n, 3) weight tau of the loss (Eq. M.7)."""
    starts: NDArray
    """(C + 1,) first pixel of each cluster."""
    first: NDArray
    """(O + 1,) first cluster of each object."""


class ResponseTables(NamedTuple):
    """Curve f of the residuals; N nodes, P parameters, q of them for each channel (`tone.Tone.tables`)."""

    knee: float
    """Above 0: f(x) = gain log(1 + x / knee) (Eq. M.3), without parameters."""
    gain: float
    curve: NDArray
    """(3, N + 1, 2) f and df/du at the nodes of u = x^(1/4)."""
    ends: NDArray
    """(3, 1 + q) df/dx at 1, and its derivatives by the parameters."""
    by_params: NDArray
    """(3, N + 1, q) derivatives of f by the parameters."""
    per_channel: bool
    """Each channel has its own parameters."""


class Penalties(NamedTuple):
    """Loss and limits of the objective."""

    robust_width: float
    """c of Eq. M.7."""
    brightest: float
    """Largest albedo."""
    box: float
    """Weight of the squared distance to the allowed range (Eq. M.11)."""
    roughness_weight: float
    metallic_weight: float
    """Weights of 1 - r and of m in the mean squared error (Eq. M.45)."""


class Sums(NamedTuple):
    """What `sums` writes; arrays that are not wanted may be empty. P parameters of the response."""

    cost: NDArray
    """(O,) objective."""
    data: NDArray
    """(O,) data term alone."""
    size: NDArray
    """(O,) sum of the moduli of the data terms."""
    h: NDArray
    """(O, 16 + P, 16 + P) Gauss-Newton matrix."""
    g: NDArray
    """(O, 16 + P) gradient."""
    scores: NDArray
    """(C, 16 + P) gradient of each cluster."""
    errors: NDArray
    """(n, h, 3) residuals."""


class _Columns(NamedTuple):
    """Which numbers move a channel: column i < used[c] of channel c is kind[c, i] (0 to 3 albedo, 4 and 5 roughness, 6 and 7
    metallic, then the response) and belongs to row place[c, i] of the system."""

    kind: NDArray
    place: NDArray
    used: NDArray


class _Piece(NamedTuple):
    """Up to `PIECE` pixels: Jacobian columns (2, 3, columns, PIECE), weight (3, PIECE) and error (2, 3, PIECE) of the halves,
    room for products (2, PIECE)."""

    columns: NDArray
    weight: NDArray
    error: NDArray
    weighted: NDArray


@_inlined
def _inner(left, right, h_left, h_right):
    # Slope at an inner level (Eq. M.5): weighted harmonic mean of both chords. It is 0 at an extremum, where the cubic would
    # overshoot otherwise.
    if left * right <= 0.0:
        return 0.0
    w_left = 2.0 * h_right + h_left
    w_right = h_right + 2.0 * h_left
    return (w_left + w_right) * left * right / (w_left * right + w_right * left)


@_inlined
def _end(mean, beyond, h, h_beyond):
    # Slope at an outermost level: derivative of the parabola through three levels. `mean` is the chord of the outermost interval,
    # `beyond` the chord of the next one.
    slope = ((2.0 * h + h_beyond) * mean - h * beyond) / (h + h_beyond)
    # A slope against the chord, or steeper than three chords, could take the cubic out of the range of its two values.
    if slope * mean <= 0.0:
        return 0.0
    if abs(slope) > 3.0 * abs(mean):
        return 3.0 * mean
    return slope


@_compiled
def slopes(shading, levels, out):
    """Write the slopes of the monotone cubic at the levels (Eq. M.5): shading (n, J, 3) -> out (n, J, 3)."""
    last = len(levels) - 1
    for p in range(len(shading)):
        for c in range(3):
            for j in range(last + 1):
                # Chords in float64: neighbouring levels differ by little, and the cache may be float32.
                y = float(shading[p, j, c])
                left = 0.0
                right = 0.0
                h_left = 0.0
                h_right = 0.0
                if j > 0:
                    h_left = levels[j] - levels[j - 1]
                    left = (y - shading[p, j - 1, c]) / h_left
                if j < last:
                    h_right = levels[j + 1] - levels[j]
                    right = (shading[p, j + 1, c] - y) / h_right
                if j > 0 and j < last:
                    out[p, j, c] = _inner(left, right, h_left, h_right)
                # Two levels: the missing chord is 0, so this is the slope of a straight line.
                elif last == 1:
                    out[p, j, c] = left + right
                elif j == 0:
                    beyond = levels[2] - levels[1]
                    out[p, j, c] = _end(right, (shading[p, 2, c] - shading[p, 1, c]) / beyond, h_right, beyond)
                else:
                    beyond = levels[j - 1] - levels[j - 2]
                    out[p, j, c] = _end(left, (shading[p, j - 1, c] - shading[p, j - 2, c]) / beyond, h_left, beyond)


@_inlined
def _interpolation_weights(levels, r):
    """Return the level below r, and the weights of y0, y1, y0', y1' in value and slope there (Eq. M.4)."""
    # Index and t are held inside the levels, so a roughness that rounding moved outside reads the nearest level
    # (docs/method/numerics.md#roughness-outside-the-cached-levels).
    last = len(levels) - 2
    j = 0
    while j < last and r >= levels[j + 1]:
        j += 1
    span = levels[j + 1] - levels[j]
    t = min(max((r - levels[j]) / span, 0.0), 1.0)
    left = 1.0 - t
    steep = 6.0 * t * left / span
    # Hermite's form of Eq. M.4. At t = 0 and t = 1 one weight is exactly 1 and the others are 0, so the levels come back
    # unchanged.
    value = (left * left * (1.0 + 2.0 * t), t * t * (3.0 - 2.0 * t), span * t * left * left, -span * t * t * left)
    return j, value, (-steep, steep, (1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0))


@_inlined
def _interpolate_lobes(nodes, j, w, out):
    """Interpolate both lobes in all channels and halves of a pixel with the weights w: nodes (J, 2, 6 h) hold y and y'."""
    w0, w1, v0, v1 = w
    y0, y1 = nodes[j, 0], nodes[j + 1, 0]
    d0, d1 = nodes[j, 1], nodes[j + 1, 1]
    # One set of weights serves all 6 h columns, which lie next to each other: a vector loop.
    for k in range(len(out)):
        out[k] = w0 * y0[k] + w1 * y1[k] + v0 * d0[k] + v1 * d1[k]


@_inlined
def _apply_curve(x, knee, gain, curve, end):
    """Return f, df/dx, and node and share of the table at x."""
    if knee > 0.0:
        # Linear photographs: Eq. M.3 in closed form. The curve has no parameters, so node and share do not matter.
        x = max(x, 0.0)
        return gain * np.log1p(x / knee), gain / (knee + x), 0, 0.0
    last = len(curve) - 1
    if x >= 1.0:
        # Above white, the straight line of Eq. C.16 keeps a gradient where the prediction is too bright. The share is x - 1.
        return curve[last, 0] + end * (x - 1.0), end, last, x - 1.0
    # The nodes are evenly spaced in u = x^(1/4). Response curves behave like powers near 0: steep in x, smooth in u.
    root = np.sqrt(max(x, 0.0))
    u = np.sqrt(root)
    at = u * last
    i = min(int(at), last - 1)
    t = at - i
    h = 1.0 / last
    # Cubic of Eq. M.4 between two nodes, in u. `bend0` and `bend1` are df/du at the nodes minus the chord.
    mean = (curve[i + 1, 0] - curve[i, 0]) * last
    bend0 = curve[i, 1] - mean
    bend1 = curve[i + 1, 1] - mean
    f = curve[i, 0] + h * t * (mean + (1.0 - t) * ((1.0 - t) * bend0 - t * bend1))
    du = mean + (1.0 - t) * (1.0 - 3.0 * t) * bend0 + t * (3.0 * t - 2.0) * bend1
    # df/dx = df/du / (4 u^3); the floor keeps it finite at x = 0 (docs/method/numerics.md#pow-at-zero).
    return f, du / max(4.0 * root * u, 1e-12), i, t


@_compiled
def sums(
    pixels: PixelArrays,
    tone: ResponseTables,
    penalties: Penalties,
    affine: NDArray,
    free: NDArray,
    objects: NDArray,
    want: int,
    out: Sums,
) -> None:
    """Sum objective, Gauss-Newton system (Eq. M.8) and residuals of some objects.

    Args:
        pixels, tone, penalties: the problem.
        affine: (O, 16) float64 numbers of the objects.
        free: (O, 16) bool, the numbers that the system is wanted for.
        objects: indices of the objects to sum.
        want: 0: objective; 1: and its system; 2: and the gradients of the clusters; 3: objective and residuals.
        out: arrays that receive the sums of these objects.
    """
    h = out.h
    per = tone.by_params.shape[2]
    # A channel depends on eight numbers of its object (its row of [A | b], gain and bias of roughness and of metallic) and on
    # `per` parameters of the response. The columns have the type of the cache, float32 or float64.
    width, kind = 8 + per, pixels.lobes.dtype
    layout = _Columns(np.zeros((3, width), np.int64), np.zeros((3, width), np.int64), np.zeros(3, np.int64))
    columns, error = np.zeros((2, 3, width, PIECE), kind), np.zeros((2, 3, PIECE), kind)
    piece = _Piece(columns, np.zeros((3, PIECE), kind), error, np.zeros((2, PIECE), kind))
    system = want == 1 or want == 2
    for x in range(len(objects)):
        o = objects[x]
        if system:
            h[o] = 0.0
            out.g[o] = 0.0
            _choose_columns(free[o], per, tone.per_channel, layout)
        cost, data, size = _sum_object(pixels, tone, penalties, affine[o], o, want, layout, piece, out)
        out.cost[o] = cost + data
        out.data[o] = data
        out.size[o] = size
        if system:
            # `_add_piece` and `_add_range_curvature` fill the upper triangle alone.
            for i in range(h.shape[1]):
                for j in range(i):
                    h[o, i, j] = h[o, j, i]


@_inlined
def _choose_columns(free, per, per_channel, layout):
    """Lay out the free numbers of an object and the parameters of the response."""
    for c in range(3):
        layout.used[c] = 0
        for i in range(8 + per):
            # Row of the system: the channel's row of [A | b] is 4 c to 4 c + 3, roughness and metallic are 12 to 15. The response
            # follows, in one block for all channels or one block each. `at` increases with i, so columns i <= j belong to the
            # upper triangle.
            at = 4 * c + i if i < 4 else (8 + i if i < 8 else 8 + i + (c * per if per_channel else 0))
            if i >= 8 or free[at]:
                layout.kind[c, layout.used[c]] = i
                layout.place[c, layout.used[c]] = at
                layout.used[c] += 1


@_inlined
def _sum_object(pixels, tone, penalties, t, o, want, layout, piece, out):
    """Sum over the pixels of object o with the map t; returns the terms of the objective that depend on the material alone, the
    data term, and the sum of its moduli."""
    base, diffuse, lobes, levels, target = pixels.base, pixels.diffuse, pixels.lobes, pixels.levels, pixels.target
    exposure, saturated, trust, starts = pixels.exposure, pixels.saturated, pixels.trust, pixels.starts
    # Where no system is wanted, h and g are views into empty arrays and stay untouched.
    curve, ends, h, g = tone.curve, tone.ends, out.h[o], out.g[o]
    columns, weight, error, kind, used = piece.columns, piece.weight, piece.error, layout.kind, layout.used
    c2 = penalties.robust_width * penalties.robust_width
    halves, per = diffuse.shape[1], tone.by_params.shape[2]
    # With a single half both residuals are the same one, and their product is its square.
    last_half = halves - 1
    # Of one pixel: the clamped material, its distance beyond the allowed range, and 1.0 where it lies within. Next: the
    # derivatives of one residual by eight numbers, and the lobes with their slopes in r, ordered as in `lobes`.
    value, beyond, is_free = np.zeros(5), np.zeros(5), np.zeros(5)
    slope_at, lobe, lobe_slope = np.zeros(8), np.zeros(lobes.shape[3]), np.zeros(lobes.shape[3])
    system = want == 1 or want == 2
    cost = data = size = 0.0
    k = pixels.first[o]  # cluster of the current pixel
    end = starts[pixels.first[o + 1]]
    begin = starts[k]
    while begin < end:
        stop = min(begin + PIECE, end)
        m_pixels = stop - begin

        # -------- material, range term and lobes of each pixel of the piece --------
        k_begin = k
        for q in range(m_pixels):
            p = begin + q
            # Clusters may be empty (`Pixels.take` keeps all of them), so several may end here.
            while p >= starts[k + 1]:
                k += 1
            b = base[p]
            cost = _clamp(b, t, penalties, value, beyond, is_free, cost)
            if system:
                _add_material_slopes(g, b, penalties, beyond, is_free)
                _add_range_curvature(h, b, penalties.box, beyond)
                if want == 2:
                    _add_material_slopes(out.scores[k], b, penalties, beyond, is_free)
            # All channels and halves share the roughness, so one search for the level serves the whole pixel.
            j, of_value, of_slope = _interpolation_weights(levels, value[3])
            _interpolate_lobes(lobes[p], j, of_value, lobe)
            if system:
                _interpolate_lobes(lobes[p], j, of_slope, lobe_slope)
            e = exposure[p]
            m = value[4]

            # -------- prediction, residual and slopes of one channel in each half --------
            for c in range(3):
                a = value[c]
                ks = 0.04 * (1.0 - m) + m * a
                for half in range(halves):
                    d = float(diffuse[p, half, c])
                    s0 = lobe[6 * half + c]
                    s1 = lobe[6 * half + 3 + c]
                    # e L (Eq. M.1), exposed radiance: an 8-bit photograph is white from 1 on.
                    x_shown = e * ((1.0 - m) * a * d + ks * s0 + s1)
                    f, df, node, part = _apply_curve(x_shown, tone.knee, tone.gain, curve[c], ends[c, 0])
                    left = f - target[p, c]
                    # A saturated value bounds the prediction from below: above the bound, residual and slope are 0 (Eq. M.6,
                    # M.9). Where the value is not saturated, a prediction that is too bright keeps its slope.
                    idle = saturated[p, c] and left > 0.0
                    if idle:
                        left = 0.0
                    error[half, c, q] = left
                    if want == 3:
                        out.errors[p, half, c] = left
                    if system:
                        # zeta of Eq. M.10. The derivatives by the material are 0 where a value is clamped.
                        slope = 0.0 if idle else df * e
                        da = slope * ((1.0 - m) * d + m * s0) * is_free[c]
                        dr = slope * (ks * lobe_slope[6 * half + c] + lobe_slope[6 * half + 3 + c]) * is_free[3]
                        dm = slope * (-a * d + (a - 0.04) * s0) * is_free[4]
                        _write_slopes(slope_at, b, da, dr, dm)
                        # The free numbers of the object have the first columns, the response the last `per`.
                        own = used[c] - per
                        for i in range(own):
                            columns[half, c, i, q] = slope_at[kind[c, i]]
                        for i in range(per):
                            columns[half, c, own + i, q] = 0.0 if idle else _by_param(tone, c, node, part, i)

                # -------- loss and weight of the pair of halves (Eq. M.7, M.8) --------
                # The loss is odd in the product. If only positive products were damped, large noise of opposite signs would pay,
                # and the response would be bent until it amplifies the noise.
                product = float(error[0, c, q]) * float(error[last_half, c, q])
                modulus = abs(product)
                rho = 0.5 * trust[p, c] * c2 * np.log1p(modulus / c2)
                # Moduli: `data` may be near 0 or negative with two halves, and would be no scale for a tolerance.
                size += rho
                data += rho if product >= 0.0 else -rho
                weight[c, q] = trust[p, c] / (1.0 + modulus / c2)

        # -------- sums over the piece --------
        if system:
            _add_piece(piece, last_half, m_pixels, layout, h, g)
        if want == 2:
            # Pixels low_q to high_q - 1 of the piece belong to cluster y, which may begin before the piece or end behind it.
            low_q = 0
            for y in range(k_begin, k + 1):
                high_q = min(starts[y + 1] - begin, m_pixels)
                _add_scores(piece, last_half, low_q, high_q, layout, out.scores[y])
                low_q = high_q
        begin = stop
    return cost, data, size


@_inlined
def _clamp(b, t, penalties, value, beyond, is_free, cost):
    """Write the clamped material of base value b under map t, its distance beyond the allowed range, and 1.0 where it lies
    within. Returns `cost` plus the terms of the objective that depend on the material alone (Eq. M.11, M.45)."""
    for i in range(5):
        if i < 3:
            # Row i of [A | b] applied to the base albedo (Eq. R.14).
            raw = t[4 * i] * b[0] + t[4 * i + 1] * b[1] + t[4 * i + 2] * b[2] + t[4 * i + 3]
        else:
            raw = t[6 + 2 * i] * b[i] + t[7 + 2 * i]
        # The albedo may exceed 1 during the fit, because the level of the light is not known that well (`FitOptions.brightest`).
        value[i] = min(max(raw, 0.02 if i == 3 else 0.0), penalties.brightest if i < 3 else 1.0)
        beyond[i] = raw - value[i]
        is_free[i] = 1.0 if beyond[i] == 0.0 else 0.0
        if beyond[i] != 0.0:
            cost += 0.5 * penalties.box * beyond[i] * beyond[i]
    # The objective sums half the squares of three channels: 3 / 2 times their mean, to which the weights of Eq. M.45 refer.
    return cost + 1.5 * (penalties.roughness_weight * (1.0 - value[3]) + penalties.metallic_weight * value[4])


@_inlined
def _add_material_slopes(g, b, penalties, beyond, is_free):
    """Add the gradient of the terms that depend on the material alone."""
    # Where a value is clamped, the range term alone has a slope; it leads the value back.
    for i in range(5):
        if beyond[i] != 0.0:
            _add_slope(g, i, b, penalties.box * beyond[i])
    if is_free[3] > 0.0:
        _add_slope(g, 3, b, -1.5 * penalties.roughness_weight)
    if is_free[4] > 0.0:
        _add_slope(g, 4, b, 1.5 * penalties.metallic_weight)


@_inlined
def _add_slope(g, i, b, slope):
    """Add the gradient of a term whose derivative by channel i (0 to 4) of a pixel's material is `slope`."""
    if i < 3:
        for x in range(3):
            g[4 * i + x] += slope * b[x]
        g[4 * i + 3] += slope
    else:
        g[6 + 2 * i] += slope * b[i]
        g[7 + 2 * i] += slope


@_inlined
def _add_range_curvature(h, b, box, beyond):
    """Add the curvature of the squared distance to the allowed range (Eq. M.11; docs/method/numerics.md#gradients-at-clamps)."""
    for i in range(5):
        if beyond[i] == 0.0:
            continue
        # Curvature of 0.5 box beyond^2: box times the outer product of (b, 1), upper triangle alone.
        if i < 3:
            for x in range(4):
                bx = b[x] if x < 3 else 1.0
                for y in range(x, 4):
                    by = b[y] if y < 3 else 1.0
                    h[4 * i + x, 4 * i + y] += box * bx * by
        else:
            at = 6 + 2 * i
            h[at, at] += box * b[i] * b[i]
            h[at, at + 1] += box * b[i]
            h[at + 1, at + 1] += box


@_inlined
def _write_slopes(slope_at, b, da, dr, dm):
    """Write the derivatives by the eight numbers that a channel depends on."""
    slope_at[0] = da * b[0]
    slope_at[1] = da * b[1]
    slope_at[2] = da * b[2]
    slope_at[3] = da
    slope_at[4] = dr * b[3]
    slope_at[5] = dr
    slope_at[6] = dm * b[4]
    slope_at[7] = dm


@_inlined
def _by_param(tone, c, node, part, i):
    """Derivative of f by parameter i of channel c, at share `part` behind a node of the table."""
    if node == tone.curve.shape[1] - 1:
        # Above white the parameters also turn the straight line of Eq. C.16; `part` is x - 1.
        return tone.by_params[c, node, i] + part * tone.ends[c, 1 + i]
    return (1.0 - part) * tone.by_params[c, node, i] + part * tone.by_params[c, node + 1, i]


@_inlined
def _add_scores(piece, last_half, low, high, layout, g):
    """Add (J1' W e2 + J2' W e1) / 2 over the pixels low to high - 1 of a piece to g (Eq. M.8)."""
    columns, weight, error, used, place = piece.columns, piece.weight, piece.error, layout.used, layout.place
    for c in range(3):
        one = columns[0, c]
        two = columns[last_half, c]
        w = weight[c]
        e1 = error[0, c]
        e2 = error[last_half, c]
        for i in range(used[c]):
            total = 0.0
            for q in range(low, high):
                total += w[q] * (one[i, q] * e2[q] + two[i, q] * e1[q])
            g[place[c, i]] += 0.5 * total


@_inlined
def _add_piece(piece, last_half, m, layout, h, g):
    """Add (J1' W J2 + J2' W J1) / 2 over a piece to the upper triangle of h, and the gradient to g (Eq. M.8)."""
    columns, weight, error, weighted = piece.columns, piece.weight, piece.error, piece.weighted
    used, place = layout.used, layout.place
    none = columns[0, 0, 0, 0] * 0
    for c in range(3):
        one = columns[0, c]
        two = columns[last_half, c]
        w = weight[c]
        e1 = error[0, c]
        e2 = error[last_half, c]
        for i in range(used[c]):
            # W J1 and W J2 of column i serve all columns j >= i.
            for q in range(m):
                weighted[0, q] = w[q] * one[i, q]
                weighted[1, q] = w[q] * two[i, q]
            total = none
            for q in range(m):
                total += weighted[0, q] * e2[q] + weighted[1, q] * e1[q]
            g[place[c, i]] += 0.5 * total
            for j in range(i, used[c]):
                total = none
                # With one half both products of Eq. M.8 are the same, so one of them replaces their mean.
                if last_half == 0:
                    for q in range(m):
                        total += weighted[0, q] * one[j, q]
                    h[place[c, i], place[c, j]] += total
                else:
                    for q in range(m):
                        total += weighted[0, q] * two[j, q] + weighted[1, q] * one[j, q]
                    h[place[c, i], place[c, j]] += 0.5 * total
