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
# What other loops call is inlined: see iif_core.fusion.kernels.
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


@_compiled
def slopes(shading, levels, out):
    """Slopes at the levels of the monotone cubic through them: shading (n, J, 3) -> out (n, J, 3)."""
    last = len(levels) - 1
    for p in range(len(shading)):
        for c in range(3):
            for j in range(last + 1):
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
                elif last == 1:
                    out[p, j, c] = left + right
                elif j == 0:
                    beyond = levels[2] - levels[1]
                    out[p, j, c] = _end(right, (shading[p, 2, c] - shading[p, 1, c]) / beyond, h_right, beyond)
                else:
                    beyond = levels[j - 1] - levels[j - 2]
                    out[p, j, c] = _end(left, (shading[p, j - 1, c] - shading[p, j - 2, c]) / beyond, h_left, beyond)


@_inlined
def _bracket(levels, r):
    """Where r lies among the levels: node below, and what y0, y1, y0', y1' weigh there in the value and in the slope."""
    last = len(levels) - 2
    j = 0
    while j < last and r >= levels[j + 1]:
        j += 1
    span = levels[j + 1] - levels[j]
    t = min(max((r - levels[j]) / span, 0.0), 1.0)
    one = t * t * (3.0 - 2.0 * t)
    steep = 6.0 * t * (1.0 - t) / span
    value = (1.0 - one, one, span * t * (1.0 - t) * (1.0 - t), -span * t * t * (1.0 - t))
    return j, value, (-steep, steep, (1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0))


@_inlined
def _shine(nodes, j, w, out):
    """Both lobes in all channels of all halves at weights w: nodes (J, 2, halves x 2 x 3) of a pixel, y and y'."""
    w0, w1, v0, v1 = w
    y0, y1 = nodes[j, 0], nodes[j + 1, 0]
    d0, d1 = nodes[j, 1], nodes[j + 1, 1]
    for k in range(len(out)):
        out[k] = w0 * y0[k] + w1 * y1[k] + v0 * d0[k] + v1 * d1[k]


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
    diffuse,  # (n, halves, 3)
    lobes,  # (n, J, 2, halves x 2 x 3): value and slope of s0 and s1
    levels,
    target,
    exposure,
    saturated,
    trust,
    starts,  # (clusters + 1,) first pixel of each cluster
    first,  # (O + 1,) first cluster of each object
    affine,
    free,  # (O, 16) numbers that the system is wanted for
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
    objects,
    want,  # 0: objective; 1: and its Gauss-Newton system; 2: and the clusters' gradients; 3: objective and residuals
    cost,  # (O,)
    data,  # (O,)
    size,  # (O,) sum of the moduli of the data terms
    h,  # (O, 16 + P, 16 + P)
    g,  # (O, 16 + P)
    scores,  # (clusters, 16 + P)
    errors,  # (n, halves, 3)
):
    """Objective, system and residuals of some objects, written into the last seven arrays."""
    halves = diffuse.shape[1]
    per = by_params.shape[2]
    cols = 8 + per
    c2 = robust_width * robust_width
    last_half = halves - 1
    columns = np.zeros((2, 3, cols, PIECE), lobes.dtype)
    weight = np.zeros((3, PIECE), lobes.dtype)
    error = np.zeros((2, 3, PIECE), lobes.dtype)
    weighted = np.zeros((2, PIECE), lobes.dtype)
    kind = np.zeros((3, cols), np.int64)  # column -> 0 ... 3 albedo, 4, 5 roughness, 6, 7 metallic, then the response
    place = np.zeros((3, cols), np.int64)
    used = np.zeros(3, np.int64)
    raw = np.zeros(5)
    value = np.zeros(5)
    is_free = np.zeros(5)
    slope_at = np.zeros(8)
    shine = np.zeros(lobes.shape[3])
    shine_slope = np.zeros(lobes.shape[3])
    jacobian = want == 1 or want == 2
    for x in range(len(objects)):
        o = objects[x]
        t = affine[o]
        cost_o = 0.0
        data_o = 0.0
        size_o = 0.0
        if jacobian:
            h[o] = 0.0
            g[o] = 0.0
            for c in range(3):
                used[c] = 0
                for i in range(cols):
                    at = 4 * c + i if i < 4 else (8 + i if i < 8 else 8 + i + (c * per if per_channel else 0))
                    if i >= 8 or free[o, at]:
                        kind[c, used[c]] = i
                        place[c, used[c]] = at
                        used[c] += 1
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
                            _add_beyond(h[o], g[o], i, b, box, beyond)
                            if want == 2:
                                _add_pull(scores[k], i, b, box * beyond)
                r = value[3]
                m = value[4]
                cost_o += 1.5 * (roughness_weight * (1.0 - r) + metallic_weight * m)
                if jacobian:
                    if is_free[3] > 0.0:
                        _add_pull(g[o], 3, b, -1.5 * roughness_weight)
                        if want == 2:
                            _add_pull(scores[k], 3, b, -1.5 * roughness_weight)
                    if is_free[4] > 0.0:
                        _add_pull(g[o], 4, b, 1.5 * metallic_weight)
                        if want == 2:
                            _add_pull(scores[k], 4, b, 1.5 * metallic_weight)
                j, of_value, of_slope = _bracket(levels, r)
                _shine(lobes[p], j, of_value, shine)
                if jacobian:
                    _shine(lobes[p], j, of_slope, shine_slope)
                e = exposure[p]
                for c in range(3):
                    a = value[c]
                    ks = 0.04 * (1.0 - m) + m * a
                    for half in range(halves):
                        d = float(diffuse[p, half, c])
                        s0 = shine[6 * half + c]
                        s1 = shine[6 * half + 3 + c]
                        x_shown = e * ((1.0 - m) * a * d + ks * s0 + s1)
                        f, df, node, part = _tone(x_shown, knee, gain, curve[c], ends[c, 0])
                        left = f - target[p, c]
                        idle = saturated[p, c] and left > 0.0
                        if idle:
                            left = 0.0
                        error[half, c, q] = left
                        if want == 3:
                            errors[p, half, c] = left
                        if jacobian:
                            slope = 0.0 if idle else df * e
                            da = slope * ((1.0 - m) * d + m * s0) * is_free[c]
                            dr = slope * (ks * shine_slope[6 * half + c] + shine_slope[6 * half + 3 + c]) * is_free[3]
                            dm = slope * (-a * d + (a - 0.04) * s0) * is_free[4]
                            slope_at[0] = da * b[0]
                            slope_at[1] = da * b[1]
                            slope_at[2] = da * b[2]
                            slope_at[3] = da
                            slope_at[4] = dr * b[3]
                            slope_at[5] = dr
                            slope_at[6] = dm * b[4]
                            slope_at[7] = dm
                            own = used[c] - per
                            for i in range(own):
                                columns[half, c, i, q] = slope_at[kind[c, i]]
                            for i in range(per):
                                if idle:
                                    columns[half, c, own + i, q] = 0.0
                                elif node == curve.shape[1] - 1:
                                    columns[half, c, own + i, q] = by_params[c, node, i] + part * ends[c, 1 + i]
                                else:
                                    columns[half, c, own + i, q] = (1.0 - part) * by_params[c, node, i] + part * by_params[
                                        c, node + 1, i
                                    ]
                    # Odd in the product: were only positive ones damped, loud noise of opposite signs would pay, and the
                    # response would be bent until it amplifies the noise.
                    product = float(error[0, c, q]) * float(error[last_half, c, q])
                    modulus = abs(product)
                    rho = 0.5 * trust[p, c] * c2 * np.log1p(modulus / c2)
                    size_o += rho
                    data_o += rho if product >= 0.0 else -rho
                    weight[c, q] = trust[p, c] / (1.0 + modulus / c2)
            if jacobian:
                _add_piece(columns, weight, error, last_half, m_pixels, used, place, weighted, h[o], g[o])
            if want == 2:
                low_q = 0
                for y in range(k_begin, k + 1):
                    high_q = min(starts[y + 1] - begin, m_pixels)
                    _add_scores(columns, weight, error, last_half, low_q, high_q, used, place, scores[y])
                    low_q = high_q
            begin = stop
        cost[o] = cost_o + data_o
        data[o] = data_o
        size[o] = size_o
        if jacobian:
            for i in range(h.shape[1]):
                for j in range(i):
                    h[o, i, j] = h[o, j, i]


@_inlined
def _add_pull(g, i, b, pull):
    """Gradient of a term whose derivative with respect to material number i (0 ... 4) of a pixel is `pull`."""
    if i < 3:
        for x in range(3):
            g[4 * i + x] += pull * b[x]
        g[4 * i + 3] += pull
    else:
        g[6 + 2 * i] += pull * b[i]
        g[7 + 2 * i] += pull


@_inlined
def _add_beyond(h, g, i, b, box, beyond):
    """Squared distance to the allowed range: gives clamped values a way back (METHOD H13)."""
    _add_pull(g, i, b, box * beyond)
    if i < 3:
        for x in range(4):
            bx = b[x] if x < 3 else 1.0
            for y in range(x, 4):
                by = b[y] if y < 3 else 1.0
                h[4 * i + x, 4 * i + y] += box * bx * by
        return
    at = 6 + 2 * i
    h[at, at] += box * b[i] * b[i]
    h[at, at + 1] += box * b[i]
    h[at + 1, at + 1] += box


@_inlined
def _add_scores(columns, weight, error, last_half, low, high, used, place, g):
    """g += (J1' W e2 + J2' W e1) / 2 of the pixels low ... high - 1 of a piece."""
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
def _add_piece(columns, weight, error, last_half, m, used, place, weighted, h, g):
    """Upper triangle of H += (J1' W J2 + J2' W J1) / 2, and g."""
    none = columns[0, 0, 0, 0] * 0
    for c in range(3):
        one = columns[0, c]
        two = columns[last_half, c]
        w = weight[c]
        e1 = error[0, c]
        e2 = error[last_half, c]
        for i in range(used[c]):
            for q in range(m):
                weighted[0, q] = w[q] * one[i, q]
                weighted[1, q] = w[q] * two[i, q]
            total = none
            for q in range(m):
                total += weighted[0, q] * e2[q] + weighted[1, q] * e1[q]
            g[place[c, i]] += 0.5 * total
            for j in range(i, used[c]):
                total = none
                if last_half == 0:
                    for q in range(m):
                        total += weighted[0, q] * one[j, q]
                    h[place[c, i], place[c, j]] += total
                else:
                    for q in range(m):
                        total += weighted[0, q] * two[j, q] + weighted[1, q] * one[j, q]
                    h[place[c, i], place[c, j]] += 0.5 * total


@_compiled
def gradient(
    obj,
    base,
    diffuse,  # (n, 1, 3)
    lobes,  # (n, J, 2, 2 x 3)
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
    per = by_params.shape[2]
    last = curve.shape[1] - 1
    value = np.zeros(5)
    is_free = np.zeros(5)
    shine = np.zeros(6)
    shine_slope = np.zeros(6)
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
        j, of_value, of_slope = _bracket(levels, r)
        _shine(lobes[p], j, of_value, shine)
        _shine(lobes[p], j, of_slope, shine_slope)
        e = exposure[p]
        slope_r = -roughness_weight
        slope_m = metallic_weight
        for c in range(3):
            a = value[c]
            ks = 0.04 * (1.0 - m) + m * a
            d = float(diffuse[p, 0, c])
            s0, s1 = shine[c], shine[3 + c]
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
            slope_r += slope * (ks * shine_slope[c] + shine_slope[3 + c])
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
