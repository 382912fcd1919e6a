"""Compiled loops of the fit over the pixels of whole objects; each call is single-threaded and releases the interpreter.

Pixels are sorted by (object, cluster). An object is worked through in pieces of `PIECE` pixels: what the Gauss-Newton system
needs of a pixel is laid out column by column, so that the sums over pixels become vector instructions. `reassoc` lets the
compiler add a piece in lanes; the order is fixed when the code is compiled. An object's sums are made by one thread in one
order: the bytes do not depend on the number of threads.

Source of the formulae: METHOD 2.7, 7b; the cubic in r: `levels`; the tables of the response: `tone`.
"""

from __future__ import annotations

import numba
import numpy as np

PIECE = 64
_MATHS = {"reassoc", "contract", "nsz", "arcp"}
_compiled = numba.njit(nogil=True, cache=True, fastmath=_MATHS)
# What other loops call is inlined: see iif_core.base.kernels.
_inlined = numba.njit(nogil=True, cache=True, fastmath=_MATHS, forceinline=True)


@_inlined
def _inner(left, right, h_left, h_right):
    if left * right <= 0.0:
        return 0.0
    w_left = 2.0 * h_right + h_left
    w_right = h_right + 2.0 * h_left
    return (w_left + w_right) * left * right / (w_left * right + w_right * left)


@_inlined
def _end(mean, beyond, h, h_beyond):
    slope = ((2.0 * h + h_beyond) * mean - h * beyond) / (h + h_beyond)
    if slope * mean <= 0.0:
        return 0.0
    if abs(slope) > 3.0 * abs(mean):
        return 3.0 * mean
    return slope


@_inlined
def _cubic(y_before, y0, y1, y_after, h_before, h, h_after, t):
    """Value and slope; an absent neighbour has distance 0."""
    mean = (y1 - y0) / h
    d0 = mean
    d1 = mean
    if h_before > 0.0:
        before = (y0 - y_before) / h_before
        d0 = _inner(before, mean, h_before, h)
        if h_after <= 0.0:
            d1 = _end(mean, before, h, h_before)
    if h_after > 0.0:
        after = (y_after - y1) / h_after
        d1 = _inner(mean, after, h, h_after)
        if h_before <= 0.0:
            d0 = _end(mean, after, h, h_after)
    bend0 = d0 - mean
    bend1 = d1 - mean
    value = y0 + h * t * (mean + (1.0 - t) * ((1.0 - t) * bend0 - t * bend1))
    slope = mean + (1.0 - t) * (1.0 - 3.0 * t) * bend0 + t * (3.0 * t - 2.0) * bend1
    return value, slope


@_inlined
def _lobe(s, x, c, j, before, after, span_before, span, span_after, share):
    """One channel of the lobe whose levels begin at row x of a pixel's shading s."""
    y_before, y0, y1, y_after = float(s[x + before, c]), float(s[x + j, c]), float(s[x + j + 1, c]), float(s[x + after, c])
    return _cubic(y_before, y0, y1, y_after, span_before, span, span_after, share)


@_inlined
def _bracket(levels, r):
    """Where r lies among the levels: node below, its neighbours, the three spans and the share of its own."""
    last = len(levels) - 2
    j = 0
    while j < last and r >= levels[j + 1]:
        j += 1
    before = max(j - 1, 0)
    after = min(j + 2, last + 1)
    span = levels[j + 1] - levels[j]
    share = min(max((r - levels[j]) / span, 0.0), 1.0)
    return j, before, after, levels[j] - levels[before], span, levels[after] - levels[j + 1], share


@_inlined
def _tone(x, knee, gain, curve, end):
    """f, df/dx, node and share of the table."""
    if knee > 0.0:
        x = max(x, 0.0)
        return gain * np.log1p(x / knee), gain / (knee + x), 0, 0.0
    last = len(curve) - 1
    if x >= 1.0:
        return curve[last, 0] + end * (x - 1.0), end, last, x - 1.0
    root = np.sqrt(max(x, 0.0))
    u = np.sqrt(root)
    at = u * last
    i = min(int(at), last - 1)
    t = at - i
    h = 1.0 / last
    mean = (curve[i + 1, 0] - curve[i, 0]) * last
    bend0 = curve[i, 1] - mean
    bend1 = curve[i + 1, 1] - mean
    f = curve[i, 0] + h * t * (mean + (1.0 - t) * ((1.0 - t) * bend0 - t * bend1))
    du = mean + (1.0 - t) * (1.0 - 3.0 * t) * bend0 + t * (3.0 * t - 2.0) * bend1
    return f, du / max(4.0 * root * u, 1e-12), i, t


@_compiled
def sums(
    base,
    shading,  # (n, halves, 1 + 2 J, 3): diffuse, s0 levels, s1 levels
    levels,
    target,
    exposure,
    saturated,
    trust,
    starts,  # (clusters + 1,) first pixel of each cluster
    first,  # (O + 1,) first cluster of each object
    affine,
    knee,
    gain,
    curve,
    ends,
    by_params,
    per_channel,
    robust_width,
    roughness_weight,
    metallic_weight,
    brightest,
    box,
    low,
    high,
    want,  # 0: objective; 1: and its Gauss-Newton system; 2: and the residuals
    cost,  # (O,)
    data,  # (O,)
    size,  # (O,) sum of the moduli of the data terms
    h,  # (O, 16 + P, 16 + P)
    g,  # (clusters, 16 + P)
    errors,  # (n, halves, 3)
    shown,  # (n, halves, 3) e L, with the system
):
    """Objective, system and residuals of the objects low ... high - 1, written into the last seven arrays."""
    halves = shading.shape[1]
    n_levels = len(levels)
    per = by_params.shape[2]
    cols = 8 + per
    c2 = robust_width * robust_width
    last_half = halves - 1
    columns = np.zeros((2, 3, cols, PIECE))
    weight = np.zeros((3, PIECE))
    error = np.zeros((2, 3, PIECE))
    weighted = np.zeros(PIECE)
    place = np.zeros((3, cols), np.int64)
    for c in range(3):
        for i in range(4):
            place[c, i] = 4 * c + i
        for i in range(4):
            place[c, 4 + i] = 12 + i
        for i in range(per):
            place[c, 8 + i] = 16 + i + (c * per if per_channel else 0)
    raw = np.zeros(5)
    value = np.zeros(5)
    is_free = np.zeros(5)
    jacobian = want == 1
    for o in range(low, high):
        t = affine[o]
        cost_o = 0.0
        data_o = 0.0
        size_o = 0.0
        k = first[o]
        end = starts[first[o + 1]]
        begin = starts[k]
        while begin < end:
            stop = min(begin + PIECE, end)
            m_pixels = stop - begin
            k_begin = k
            for q in range(m_pixels):
                p = begin + q
                while p >= starts[k + 1]:
                    k += 1
                b = base[p]
                for c in range(3):
                    raw[c] = t[4 * c] * b[0] + t[4 * c + 1] * b[1] + t[4 * c + 2] * b[2] + t[4 * c + 3]
                raw[3] = t[12] * b[3] + t[13]
                raw[4] = t[14] * b[4] + t[15]
                for i in range(5):
                    floor = 0.02 if i == 3 else 0.0
                    value[i] = min(max(raw[i], floor), brightest if i < 3 else 1.0)
                    beyond = raw[i] - value[i]
                    is_free[i] = 1.0 if beyond == 0.0 else 0.0
                    if beyond != 0.0:
                        cost_o += 0.5 * box * beyond * beyond
                        if jacobian:
                            _add_beyond(h[o], g[k], i, b, box, beyond)
                r = value[3]
                m = value[4]
                cost_o += 1.5 * (roughness_weight * (1.0 - r) + metallic_weight * m)
                if jacobian:
                    if is_free[3] > 0.0:
                        g[k, 12] -= 1.5 * roughness_weight * b[3]
                        g[k, 13] -= 1.5 * roughness_weight
                    if is_free[4] > 0.0:
                        g[k, 14] += 1.5 * metallic_weight * b[4]
                        g[k, 15] += 1.5 * metallic_weight
                j, before, after, span_before, span, span_after, share = _bracket(levels, r)
                e = exposure[p]
                for c in range(3):
                    a = value[c]
                    ks = 0.04 * (1.0 - m) + m * a
                    for half in range(halves):
                        s = shading[p, half]
                        d = float(s[0, c])
                        s0, ds0 = _lobe(s, 1, c, j, before, after, span_before, span, span_after, share)
                        s1, ds1 = _lobe(s, 1 + n_levels, c, j, before, after, span_before, span, span_after, share)
                        x = e * ((1.0 - m) * a * d + ks * s0 + s1)
                        f, df, node, part = _tone(x, knee, gain, curve[c], ends[c, 0])
                        left = f - target[p, c]
                        idle = saturated[p, c] and left > 0.0
                        if idle:
                            left = 0.0
                        error[half, c, q] = left
                        if want == 2:
                            errors[p, half, c] = left
                        if jacobian:
                            shown[p, half, c] = x
                            slope = 0.0 if idle else df * e
                            da = slope * ((1.0 - m) * d + m * s0) * is_free[c]
                            dr = slope * (ks * ds0 + ds1) * is_free[3]
                            dm = slope * (-a * d + (a - 0.04) * s0) * is_free[4]
                            columns[half, c, 0, q] = da * b[0]
                            columns[half, c, 1, q] = da * b[1]
                            columns[half, c, 2, q] = da * b[2]
                            columns[half, c, 3, q] = da
                            columns[half, c, 4, q] = dr * b[3]
                            columns[half, c, 5, q] = dr
                            columns[half, c, 6, q] = dm * b[4]
                            columns[half, c, 7, q] = dm
                            for i in range(per):
                                if idle:
                                    columns[half, c, 8 + i, q] = 0.0
                                elif node == curve.shape[1] - 1:
                                    columns[half, c, 8 + i, q] = by_params[c, node, i] + part * ends[c, 1 + i]
                                else:
                                    columns[half, c, 8 + i, q] = (1.0 - part) * by_params[c, node, i] + part * by_params[
                                        c, node + 1, i
                                    ]
                    # Odd in the product: were only positive ones damped, loud noise of opposite signs would pay, and the
                    # response would be bent until it amplifies the noise.
                    product = error[0, c, q] * error[last_half, c, q]
                    modulus = abs(product)
                    rho = 0.5 * trust[p, c] * c2 * np.log1p(modulus / c2)
                    size_o += rho
                    data_o += rho if product >= 0.0 else -rho
                    weight[c, q] = trust[p, c] / (1.0 + modulus / c2)
            if jacobian:
                _add_piece(columns, weight, error, last_half, m_pixels, place, weighted, h[o])
                low_q = 0
                for x in range(k_begin, k + 1):
                    high_q = min(starts[x + 1] - begin, m_pixels)
                    _add_scores(columns, weight, error, last_half, low_q, high_q, place, g[x])
                    low_q = high_q
            begin = stop
        cost[o] = cost_o + data_o
        data[o] = data_o
        size[o] = size_o
        if jacobian:
            for i in range(h.shape[1]):
                for j in range(i):
                    h[o, i, j] = h[o, j, i]


@_compiled
def toned(target, saturated, trust, shown, offsets, knee, gain, curve, ends, robust_width, low, high, data):
    """The data terms of the objects low ... high - 1 where e L is `shown` (n, halves, 3), written into `data` (O,)."""
    c2 = robust_width * robust_width
    last_half = shown.shape[1] - 1
    for o in range(low, high):
        data_o = 0.0
        for p in range(offsets[o], offsets[o + 1]):
            for c in range(3):
                one = _tone(shown[p, 0, c], knee, gain, curve[c], ends[c, 0])[0] - target[p, c]
                two = _tone(shown[p, last_half, c], knee, gain, curve[c], ends[c, 0])[0] - target[p, c]
                if saturated[p, c]:
                    one, two = min(one, 0.0), min(two, 0.0)
                rho = 0.5 * trust[p, c] * c2 * np.log1p(abs(one * two) / c2)
                data_o += rho if one * two >= 0.0 else -rho
        data[o] = data_o


@_inlined
def _add_beyond(h, g, i, b, box, beyond):
    """Squared distance to the allowed range: gives clamped values a way back (METHOD H13)."""
    if i < 3:
        for x in range(4):
            bx = b[x] if x < 3 else 1.0
            g[4 * i + x] += box * beyond * bx
            for y in range(x, 4):
                by = b[y] if y < 3 else 1.0
                h[4 * i + x, 4 * i + y] += box * bx * by
        return
    at = 12 + 2 * (i - 3)
    g[at] += box * beyond * b[i]
    g[at + 1] += box * beyond
    h[at, at] += box * b[i] * b[i]
    h[at, at + 1] += box * b[i]
    h[at + 1, at + 1] += box


@_inlined
def _add_scores(columns, weight, error, last_half, low, high, place, g):
    """g += (J1' W e2 + J2' W e1) / 2 of the pixels low ... high - 1 of a piece."""
    for c in range(3):
        one = columns[0, c]
        two = columns[last_half, c]
        w = weight[c]
        e1 = error[0, c]
        e2 = error[last_half, c]
        for i in range(columns.shape[2]):
            total = 0.0
            for q in range(low, high):
                total += w[q] * (one[i, q] * e2[q] + two[i, q] * e1[q])
            g[place[c, i]] += 0.5 * total


@_inlined
def _add_piece(columns, weight, error, last_half, m, place, weighted, h):
    """Upper triangle of H += (J1' W J2 + J2' W J1) / 2."""
    cols = columns.shape[2]
    for c in range(3):
        one = columns[0, c]
        two = columns[last_half, c]
        w = weight[c]
        for i in range(cols):
            for q in range(m):
                weighted[q] = w[q] * one[i, q]
            if last_half == 0:
                for j in range(i, cols):
                    total = 0.0
                    for q in range(m):
                        total += weighted[q] * one[j, q]
                    h[place[c, i], place[c, j]] += total
                continue
            for j in range(i, cols):
                total = 0.0
                for q in range(m):
                    total += weighted[q] * two[j, q] + w[q] * two[i, q] * one[j, q]
                h[place[c, i], place[c, j]] += 0.5 * total


@_compiled
def gradient(
    obj,
    base,
    shading,  # (n, 1, 1 + 2 J, 3)
    levels,
    target,
    exposure,
    saturated,
    rows,
    affine,
    knee,
    gain,
    curve,
    ends,
    by_params,
    per_channel,
    roughness_weight,
    metallic_weight,
    g,  # (O, 16 + P)
):
    """Sum over the pixels `rows` of the gradient of (sum over channels of e^2) / 3 + w_r (1 - r) + w_m m, added to g."""
    n_levels = len(levels)
    per = by_params.shape[2]
    last = curve.shape[1] - 1
    value = np.zeros(5)
    is_free = np.zeros(5)
    for row in range(len(rows)):
        p = rows[row]
        o = obj[p]
        t = affine[o]
        b = base[p]
        for i in range(5):
            if i < 3:
                raw = t[4 * i] * b[0] + t[4 * i + 1] * b[1] + t[4 * i + 2] * b[2] + t[4 * i + 3]
            else:
                raw = t[6 + 2 * i] * b[i] + t[7 + 2 * i]
            value[i] = min(max(raw, 0.02 if i == 3 else 0.0), 1.0)
            is_free[i] = 1.0 if raw == value[i] else 0.0
        r = value[3]
        m = value[4]
        j, before, after, span_before, span, span_after, share = _bracket(levels, r)
        e = exposure[p]
        s = shading[p, 0]
        slope_r = -roughness_weight
        slope_m = metallic_weight
        for c in range(3):
            a = value[c]
            ks = 0.04 * (1.0 - m) + m * a
            d = float(s[0, c])
            s0, ds0 = _lobe(s, 1, c, j, before, after, span_before, span, span_after, share)
            s1, ds1 = _lobe(s, 1 + n_levels, c, j, before, after, span_before, span, span_after, share)
            f, df, node, part = _tone(e * ((1.0 - m) * a * d + ks * s0 + s1), knee, gain, curve[c], ends[c, 0])
            error = f - target[p, c]
            if saturated[p, c] and error > 0.0:
                continue
            pull = 2.0 / 3.0 * error
            slope = pull * df * e
            da = slope * ((1.0 - m) * d + m * s0) * is_free[c]
            g[o, 4 * c] += da * b[0]
            g[o, 4 * c + 1] += da * b[1]
            g[o, 4 * c + 2] += da * b[2]
            g[o, 4 * c + 3] += da
            slope_r += slope * (ks * ds0 + ds1)
            slope_m += slope * (-a * d + (a - 0.04) * s0)
            at = 16 + (c * per if per_channel else 0)
            for i in range(per):
                if node == last:
                    g[o, at + i] += pull * (by_params[c, node, i] + part * ends[c, 1 + i])
                else:
                    g[o, at + i] += pull * ((1.0 - part) * by_params[c, node, i] + part * by_params[c, node + 1, i])
        g[o, 12] += slope_r * b[3] * is_free[3]
        g[o, 13] += slope_r * is_free[3]
        g[o, 14] += slope_m * b[4] * is_free[4]
        g[o, 15] += slope_m * is_free[4]
