"""Compiled loops of the direct solver over the pixels of one view. Sums in, sums out; single-threaded each.

Layout: `values` (K, 5, n), pixels in segment order, segment s = pixels start[s] ... start[s + 1] - 1. It holds float32, or
half precision as its bits in uint16 (the compiler has no half type), widened piece by piece on the way. A loop runs over
the pixels of one plane, so the compiler turns it into vector instructions; it reads each prediction once.

Sums over pixels are float32 within pieces of `PIECE` pixels and float64 beyond (METHOD H45): the error is that of
float32 over 256 terms whatever the size of the segment. `reassoc` lets the compiler add a piece in lanes; the order is
fixed when the code is compiled, so a machine gives the same bytes every time.

Source of the formulae: METHOD 2.3.2-2.3.4, 7c.
"""

from __future__ import annotations

import numba
import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

PIECE = 256
_MATHS = {"reassoc", "contract", "nsz", "arcp"}  # no assumption about NaN or infinity
_compiled = numba.njit(nogil=True, cache=True, fastmath=_MATHS)
_exact = numba.njit(nogil=True, cache=True)
# Loops that other loops call are inlined. Where a copy in the caller and one of its own exist, the linker takes the one
# or the other according to the state of the compiler's cache, and their sums may differ in the last bits.
_inlined = numba.njit(nogil=True, cache=True, fastmath=_MATHS, forceinline=True)
_inlined_exact = numba.njit(nogil=True, cache=True, forceinline=True)

GRAM = 14
"""Sums that `gram` makes: aa ab ac bb bc cc a b c (albedo), rr r, mm m, 1."""
CROSS = 16
"""Sums that `cross` makes: albedo 3 x 4 (row = output channel; inputs r g b 1), roughness (r, 1), metallic (m, 1).
Corrections are kept in the same layout."""
IDENTITY = np.zeros(CROSS, np.float32)
"""The correction that changes nothing."""
IDENTITY[[0, 5, 10, 12, 14]] = 1


# The four functions without a body of their own get one for each type from their `overload`, when a loop is compiled.
def _widen(plane, bits, out, m):
    """out[:m] = plane[:m] as float32; `bits` is the memory of `out` seen as int32."""
    raise NotImplementedError


@overload(_widen, inline="always")
def _widen_of(plane, bits, out, m):
    if plane.dtype == types.uint16:  # half bits, finite and >= 0: shift exponent and mantissa into place, then scale

        def widen(plane, bits, out, m):
            for i in range(m):
                bits[i] = np.int32(plane[i]) << 13
            for i in range(m):
                out[i] *= np.float32(2.0**112)

    else:

        def widen(plane, bits, out, m):
            for i in range(m):
                out[i] = plane[i]

    return widen


def as_words(maps: NDArray) -> NDArray:
    """Half precision as uint16 bits, everything else as float32: what the kernels read."""
    if maps.dtype == np.float16:
        return np.ascontiguousarray(maps).view(np.uint16)
    return np.ascontiguousarray(maps, np.float32)


def as_floats(values: NDArray) -> NDArray:
    """The inverse of `as_words`, always float32."""
    return values.view(np.float16).astype(np.float32) if values.dtype == np.uint16 else values


# ------------------------------------------------------------------------------------------------------------ blocks


def _is_finite(x):
    raise NotImplementedError


@overload(_is_finite, inline="always")
def _is_finite_of(x):
    if x == types.uint16:
        return lambda x: (x & 0x7C00) != 0x7C00
    return lambda x: np.isfinite(x)


def _unit(x):
    raise NotImplementedError


@overload(_unit, inline="always")
def _unit_of(x):
    """The value clamped to [0, 1] in its own representation; half bits of values in [0, 1] are ordered like integers."""
    if x == types.uint16:
        return lambda x: np.uint16(0) if x >= 0x8000 else min(x, np.uint16(0x3C00))
    return lambda x: min(max(x, np.float32(0)), np.float32(1))


def _is_inside(x):
    raise NotImplementedError


@overload(_is_inside, inline="always")
def _is_inside_of(x):
    if x == types.uint16:
        return lambda x: (x > 0) & (x < 0x3C00)
    return lambda x: (x > 0) & (x < 1)


@_exact
def finite_pixels(maps: NDArray) -> NDArray:
    """(K, N) bool: all five values finite; `maps` (K, N, 5) words."""
    out = np.empty(maps.shape[:2], np.bool_)
    for k in range(maps.shape[0]):
        for i in range(maps.shape[1]):
            good = True
            for c in range(5):
                good &= _is_finite(maps[k, i, c])
            out[k, i] = good
    return out


@_exact
def gather(maps: NDArray, pixels: NDArray, usable: NDArray) -> tuple[NDArray, NDArray]:
    """Values (K, 5, n) of the pixels, clamped to [0, 1], 0 where not usable; and (K, n) bool: albedo inside (0, 1)."""
    n_k, n = maps.shape[0], len(pixels)
    out = np.zeros((n_k, 5, n), maps.dtype)
    inside = np.ones((n_k, n), np.bool_)
    for k in range(n_k):
        if not usable[k]:
            continue
        for i in range(n):
            x = pixels[i]
            for c in range(5):
                out[k, c, i] = _unit(maps[k, x, c])
            inside[k, i] = _is_inside(out[k, 0, i]) & _is_inside(out[k, 1, i]) & _is_inside(out[k, 2, i])
    return out, inside


@_compiled
def texture_at(texture: NDArray, cell: NDArray) -> NDArray:
    """(5, n) values of a texture (n_cells, 5) at the cells of the pixels."""
    out = np.empty((5, len(cell)), np.float32)
    for i in range(len(cell)):
        for c in range(5):
            out[c, i] = texture[cell[i], c]
    return out


# -------------------------------------------------------------------------------------------------------------- sums


@_compiled
def gram(values: NDArray, weight: NDArray, start: NDArray, keep: NDArray) -> NDArray:
    """(S, K, GRAM) float64 weighted second moments; `keep` (K, n) bool: pixels that count, or (0, 0) for all."""
    n_k = values.shape[0]
    out = np.zeros((len(start) - 1, n_k, GRAM))
    masked = keep.shape[0] > 0
    w = np.empty(PIECE, np.float32)
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    for s in range(len(start) - 1):
        for first in range(start[s], start[s + 1], PIECE):
            m = min(PIECE, start[s + 1] - first)
            for k in range(n_k):
                for c in range(5):
                    _widen(values[k, c, first : first + m], bits[c], v[c], m)
                for i in range(m):
                    w[i] = weight[first + i]
                if masked:
                    for i in range(m):
                        w[i] = w[i] if keep[k, first + i] else np.float32(0)
                aa = ab = ac = bb = bc = cc = sa = sb = sc = rr = sr = qq = sq = one = np.float32(0)
                for i in range(m):
                    a, b, c_, r, q = v[0, i], v[1, i], v[2, i], v[3, i], v[4, i]
                    wa, wb, wc, wr, wq = w[i] * a, w[i] * b, w[i] * c_, w[i] * r, w[i] * q
                    aa += wa * a
                    ab += wa * b
                    ac += wa * c_
                    bb += wb * b
                    bc += wb * c_
                    cc += wc * c_
                    sa += wa
                    sb += wb
                    sc += wc
                    rr += wr * r
                    sr += wr
                    qq += wq * q
                    sq += wq
                    one += w[i]
                o = out[s, k]
                o[0] += aa
                o[1] += ab
                o[2] += ac
                o[3] += bb
                o[4] += bc
                o[5] += cc
                o[6] += sa
                o[7] += sb
                o[8] += sc
                o[9] += rr
                o[10] += sr
                o[11] += qq
                o[12] += sq
                o[13] += one
    return out


@_compiled
def cross(values: NDArray, target: NDArray, weight: NDArray, start: NDArray, keep: NDArray) -> NDArray:
    """(S, K, CROSS) float64 weighted products of predictions with `target` (5, n) float32; `keep` as in `gram`."""
    n_k = values.shape[0]
    out = np.zeros((len(start) - 1, n_k, CROSS))
    masked = keep.shape[0] > 0
    w = np.empty(PIECE, np.float32)
    t = np.empty((5, PIECE), np.float32)
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    for s in range(len(start) - 1):
        for first in range(start[s], start[s + 1], PIECE):
            m = min(PIECE, start[s + 1] - first)
            for c in range(5):
                for i in range(m):
                    t[c, i] = weight[first + i] * target[c, first + i]
            for i in range(m):
                w[i] = 1
            for k in range(n_k):
                for c in range(5):
                    _widen(values[k, c, first : first + m], bits[c], v[c], m)
                if masked:
                    for i in range(m):
                        w[i] = np.float32(1) if keep[k, first + i] else np.float32(0)
                aa = ab = ac = ad = ba = bb = bc = bd = ca = cb = cc = cd = rr = rd = qq = qd = np.float32(0)
                for i in range(m):
                    a, b, c_ = v[0, i], v[1, i], v[2, i]
                    wa, wb, wc, wr, wq = w[i] * t[0, i], w[i] * t[1, i], w[i] * t[2, i], w[i] * t[3, i], w[i] * t[4, i]
                    aa += wa * a
                    ab += wa * b
                    ac += wa * c_
                    ad += wa
                    ba += wb * a
                    bb += wb * b
                    bc += wb * c_
                    bd += wb
                    ca += wc * a
                    cb += wc * b
                    cc += wc * c_
                    cd += wc
                    rr += wr * v[3, i]
                    rd += wr
                    qq += wq * v[4, i]
                    qd += wq
                o = out[s, k]
                o[0] += aa
                o[1] += ab
                o[2] += ac
                o[3] += ad
                o[4] += ba
                o[5] += bb
                o[6] += bc
                o[7] += bd
                o[8] += ca
                o[9] += cb
                o[10] += cc
                o[11] += cd
                o[12] += rr
                o[13] += rd
                o[14] += qq
                o[15] += qd
    return out


@_compiled
def square(target: NDArray, weight: NDArray, start: NDArray) -> NDArray:
    """(S, 5) float64: weighted sums of the squares of `target` (5, n)."""
    out = np.zeros((len(start) - 1, 5))
    for s in range(len(start) - 1):
        for first in range(start[s], start[s + 1], PIECE):
            m = min(PIECE, start[s + 1] - first)
            for c in range(5):
                total = np.float32(0)
                for i in range(first, first + m):
                    total += weight[i] * target[c, i] * target[c, i]
                out[s, c] += total
    return out


@_inlined
def _correct(values, k, first, m, t, bits, v, out, add):
    """out (5, m) = or += T_k v_k of the pixels first ... first + m - 1."""
    for c in range(5):
        _widen(values[k, c, first : first + m], bits[c], v[c], m)
    if not add:
        for c in range(5):
            for i in range(m):
                out[c, i] = 0
    for i in range(m):
        a, b, c_ = v[0, i], v[1, i], v[2, i]
        out[0, i] += t[0] * a + t[1] * b + t[2] * c_ + t[3]
        out[1, i] += t[4] * a + t[5] * b + t[6] * c_ + t[7]
        out[2, i] += t[8] * a + t[9] * b + t[10] * c_ + t[11]
        out[3, i] += t[12] * v[3, i] + t[13]
        out[4, i] += t[14] * v[4, i] + t[15]


@_compiled
def mixture(values: NDArray, blend: NDArray, start: NDArray, low: NDArray) -> NDArray:
    """(5, n) float32 sum_k alpha_k T_k v_k within [low, 1]; `blend` (S, K, CROSS) float32 = alpha_k T_k."""
    out = np.zeros((5, values.shape[2]), np.float32)
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    for s in range(len(start) - 1):
        for k in range(values.shape[0]):
            t = blend[s, k]
            if not np.any(t != 0):
                continue
            for first in range(start[s], start[s + 1], PIECE):
                m = min(PIECE, start[s + 1] - first)
                _correct(values, k, first, m, t, bits, v, out[:, first : first + m], True)
    for c in range(5):
        for i in range(out.shape[1]):
            out[c, i] = min(max(out[c, i], low[c]), np.float32(1))
    return out


@_exact
def add_to_cells(total: NDArray, summed: NDArray, cell: NDArray, value: NDArray, weight: NDArray) -> None:
    """Add pixels to their cells, in order: total (n_cells, 5) += weight, summed (n_cells, 5) += weight value.

    `value` is (5, n); `weight` (5, n), or (1, n) for all channels alike.
    """
    same = weight.shape[0] == 1
    for i in range(len(cell)):
        x = cell[i]
        for c in range(5):
            w = weight[0 if same else c, i]
            total[x, c] += w
            summed[x, c] += w * value[c, i]


@_exact
def cell_means(total: NDArray, summed: NDArray, fallback: NDArray) -> NDArray:
    """(n_cells, 5) float32 summed / total; `fallback` (n_cells, 5) where there is no weight."""
    out = np.empty(summed.shape, np.float32)
    for x in range(len(summed)):
        for c in range(5):
            out[x, c] = summed[x, c] / total[x, c] if total[x, c] > 0 else fallback[x, c]
    return out


# ------------------------------------------------------------------------------------------------------ order statistics


def sorting_network(n: int) -> NDArray:
    """(m, 2) int64 comparators that sort n values: Batcher's odd-even merge sort, about n log^2 n / 4 of them.

    All pixels of a piece are sorted at once, plane by plane, without a branch.
    """
    pairs = []
    p = 1
    while p < n:
        k = p
        while k >= 1:
            for j in range(k % p, n - k, 2 * k):
                for i in range(min(k, n - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):
                        pairs.append((i + j, i + j + k))
            k //= 2
        p *= 2
    return np.array(pairs, np.int64).reshape(-1, 2)


@_inlined_exact
def _sort_planes(planes, network, m):
    for x in range(len(network)):
        low, high = planes[network[x, 0]], planes[network[x, 1]]
        for i in range(m):
            a, b = low[i], high[i]
            low[i] = min(a, b)
            high[i] = max(a, b)


@_exact
def medians(values: NDArray, usable: NDArray, network: NDArray) -> NDArray:
    """(5, n) float32 median over the usable predictions of each pixel and channel (mean of the middle two if even)."""
    n = values.shape[2]
    which = np.flatnonzero(usable)
    n_used = len(which)
    bits = np.empty((n_used, PIECE), np.int32)
    planes = bits.view(np.float32)
    out = np.zeros((5, n), np.float32)
    if n_used == 0:
        return out
    for c in range(5):
        for first in range(0, n, PIECE):
            m = min(PIECE, n - first)
            for j in range(n_used):
                _widen(values[which[j], c, first : first + m], bits[j], planes[j], m)
            _sort_planes(planes, network, m)
            low, high = planes[(n_used - 1) // 2], planes[n_used // 2]
            for i in range(m):
                out[c, first + i] = (low[i] + high[i]) * np.float32(0.5)
    return out


@_exact
def disagreement(
    values: NDArray,
    affine: NDArray,
    mixed: NDArray,
    target: NDArray,
    weight: NDArray,
    start: NDArray,
    usable: NDArray,
    network: NDArray,
    low: NDArray,
    floor: float,
) -> tuple[NDArray, NDArray]:
    """How far the corrected predictions of each pixel disagree with their mixture, and which is nearest to the texture.

    Args:
        affine: (S, K, CROSS) float32 corrections; mixed: (5, n) the mixture; target: (5, n) the texture.
        network: comparators for as many values as there are usable predictions.

    Returns:
        b_ref (5, n) float32: max(lower median over k of |mixed - v_k|, floor) (METHOD 2.3.3);
        votes (S, K, 3) float64: weight of the pixels at which prediction k is the nearest to the texture, in L1 as in
        the label loss (METHOD 2.3.6); ties go to the first.
    """
    which = np.flatnonzero(usable)
    n_used = len(which)
    b_ref = np.full(mixed.shape, np.float32(floor))
    votes = np.zeros((len(start) - 1, values.shape[0], 3))
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    corrected = np.empty((5, PIECE), np.float32)
    planes = np.empty((5, n_used, PIECE), np.float32)
    best = np.empty((3, PIECE), np.float32)
    chosen = np.empty((3, PIECE), np.int64)
    error = np.empty((3, PIECE), np.float32)
    for s in range(len(start) - 1):
        for first in range(start[s], start[s + 1], PIECE):
            m = min(PIECE, start[s + 1] - first)
            best[:] = np.inf
            chosen[:] = 0
            for j in range(n_used):
                _correct(values, which[j], first, m, affine[s, which[j]], bits, v, corrected, False)
                for c in range(5):
                    for i in range(m):
                        x = min(max(corrected[c, i], low[c]), np.float32(1))
                        planes[c, j, i] = abs(mixed[c, first + i] - x)
                        corrected[c, i] = abs(x - target[c, first + i])
                for i in range(m):
                    error[0, i] = corrected[0, i] + corrected[1, i] + corrected[2, i]
                    error[1, i] = corrected[3, i]
                    error[2, i] = corrected[4, i]
                for p in range(3):
                    for i in range(m):
                        nearer = error[p, i] < best[p, i]
                        chosen[p, i] = which[j] if nearer else chosen[p, i]
                        best[p, i] = error[p, i] if nearer else best[p, i]
            for p in range(3):
                for i in range(m):
                    votes[s, chosen[p, i], p] += weight[first + i]
            for c in range(5):
                _sort_planes(planes[c], network, m)
                middle = planes[c, (n_used - 1) // 2]
                for i in range(m):
                    b_ref[c, first + i] = max(middle[i], np.float32(floor))
    return b_ref, votes


# ------------------------------------------------------------------------------------------- the paper's objective


@_exact
def choose(values: NDArray, chosen: NDArray, start: NDArray) -> NDArray:
    """(5, n) float32 planes of the chosen predictions; `chosen` (S, 3) int64 of albedo, roughness, metallic."""
    out = np.empty((5, values.shape[2]), np.float32)
    bits = out.view(np.int32)
    for s in range(len(start) - 1):
        a, b = start[s], start[s + 1]
        for c in range(5):
            _widen(values[chosen[s, max(c - 2, 0)], c, a:b], bits[c, a:b], out[c, a:b], b - a)
    return out


@_compiled
def channel_moments(chosen: NDArray, target: NDArray, weight: NDArray, start: NDArray) -> tuple[NDArray, NDArray]:
    """Weighted moments of the chosen predictions, each output channel with its own weight (5, n).

    Returns (S, 5, 10) float64: aa ab ac bb bc cc a b c 1 for channels 0-2, vv v 1 first for 3 and 4; and (S, 5, 4):
    products with the target, [r g b 1] or [v 1].
    """
    second, first_ = np.zeros((len(start) - 1, 5, 10)), np.zeros((len(start) - 1, 5, 4))
    for s in range(len(start) - 1):
        for begin in range(start[s], start[s + 1], PIECE):
            end = min(begin + PIECE, start[s + 1])
            for ch in range(3):
                aa = ab = ac = bb = bc = cc = sa = sb = sc = one = ta = tb = tc = td = np.float32(0)
                for i in range(begin, end):
                    w, t = weight[ch, i], target[ch, i]
                    a, b, c = chosen[0, i], chosen[1, i], chosen[2, i]
                    wa, wb, wc = w * a, w * b, w * c
                    aa += wa * a
                    ab += wa * b
                    ac += wa * c
                    bb += wb * b
                    bc += wb * c
                    cc += wc * c
                    sa += wa
                    sb += wb
                    sc += wc
                    one += w
                    ta += wa * t
                    tb += wb * t
                    tc += wc * t
                    td += w * t
                o, q = second[s, ch], first_[s, ch]
                o[0] += aa
                o[1] += ab
                o[2] += ac
                o[3] += bb
                o[4] += bc
                o[5] += cc
                o[6] += sa
                o[7] += sb
                o[8] += sc
                o[9] += one
                q[0] += ta
                q[1] += tb
                q[2] += tc
                q[3] += td
            for ch in range(3, 5):
                vv = sv = one = tv = td = np.float32(0)
                for i in range(begin, end):
                    w, v, t = weight[ch, i], chosen[ch, i], target[ch, i]
                    vv += w * v * v
                    sv += w * v
                    one += w
                    tv += w * v * t
                    td += w * t
                o, q = second[s, ch], first_[s, ch]
                o[0] += vv
                o[1] += sv
                o[2] += one
                q[0] += tv
                q[1] += td
    return second, first_
