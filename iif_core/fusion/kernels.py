"""Compiled loops of the direct solver over the pixels of one view; every loop is single-threaded.

`values` (K, 5, n) holds the predictions of pixels in segment order: segment s is pixels start[s] ... start[s + 1] - 1. The
numbers are float32, or half precision as its bits in uint16 (the compiler has no half type). Sums over pixels are float32
within pieces of `PIECE` pixels and float64 beyond (docs/method/numerics.md#sums-in-single-precision). `reassoc` lets the
compiler add a piece in lanes, in an order that is fixed when the code is compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from iif_core.numerics.compiled import njit

# Pixels that are summed in float32 at a time, and the length of all scratch arrays.
PIECE = 256
_MATHS = {"reassoc", "contract", "nsz", "arcp"}  # no assumption about NaN or infinity
_compiled = njit(fastmath=_MATHS)
# Without reassociation, so that `add_to_cells` adds the pixels in their order.
_exact = njit()
# Loops that other loops call are inlined: docs/method/numerics.md#sums-that-depend-on-the-compiler.
_inlined = njit(fastmath=_MATHS, forceinline=True)
_inlined_exact = njit(forceinline=True)

GRAM = 14
"""Number of sums of `gram`: aa ab ac bb bc cc a b c (albedo), rr r, mm m, 1."""
CROSS = 16
"""Number of sums of `cross`: albedo 3 x 4 (row = output channel; inputs r g b 1), roughness (r, 1), metallic (m, 1).
Affine maps are kept in the same layout."""


# The four functions without a body get one for each type from their `overload` when a loop is compiled.
def _widen(plane, bits, out, m):
    """out[:m] = plane[:m] as float32; `bits` is the memory of `out` seen as int32."""
    raise NotImplementedError


@overload(_widen, inline="always")
def _widen_of(plane, bits, out, m):
    # Half has 5 bits of exponent, biased by 15, and 10 of mantissa; float32 has 8, biased by 127, and 23. Shifted by the 13 bits
    # of difference the number is too small by 2^(127 - 15). The product restores it, exactly for subnormal halves too
    # (docs/method/numerics.md#half-precision-read-as-bits).
    if plane.dtype == types.uint16:  # half bits, finite and >= 0: shift exponent and mantissa into place, then scale

        def widen(plane, bits, out, m):
            for i in range(m):  # writes the memory of `out`
                bits[i] = np.int32(plane[i]) << 13
            for i in range(m):
                out[i] *= np.float32(2.0**112)

    else:

        def widen(plane, bits, out, m):
            for i in range(m):
                out[i] = plane[i]

    return widen


def as_words(maps: NDArray) -> NDArray:
    """Return half precision as its bits in uint16 and everything else as float32, which the kernels read."""
    if maps.dtype == np.float16:
        return np.ascontiguousarray(maps).view(np.uint16)
    return np.ascontiguousarray(maps, np.float32)


# ------------------------------------------------------------------------------------------------------------ blocks


def _is_finite(x):
    raise NotImplementedError


@overload(_is_finite, inline="always")
def _is_finite_of(x):
    if x == types.uint16:
        return lambda x: (x & 0x7C00) != 0x7C00  # all bits of the exponent: infinity or NaN
    return lambda x: np.isfinite(x)


def _unit(x):
    raise NotImplementedError


@overload(_unit, inline="always")
def _unit_of(x):
    """The value clamped to [0, 1] in its own representation; half bits of values in [0, 1] are ordered like integers."""
    if x == types.uint16:
        # 0x8000 is the sign bit, 0x3C00 are the bits of 1. Minus zero becomes 0, as `_widen` needs it.
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
    """Return where all five values are finite, (K, N) bool; `maps` (K, N, 5) words."""
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
    """Return the values (K, 5, n) of the pixels, clamped to [0, 1] and 0 where not usable, and (K, n) bool: no albedo
    channel is 0 or 1."""
    n_k, n = maps.shape[0], len(pixels)
    # From pixel by pixel (K, N, 5) to plane by plane (K, 5, n), which the loops below read in order.
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
    """Return the values (5, n) float32 of a texture (n_cells, 5) at the cells of the pixels."""
    out = np.empty((5, len(cell)), np.float32)
    for i in range(len(cell)):
        for c in range(5):
            out[c, i] = texture[cell[i], c]
    return out


# -------------------------------------------------------------------------------------------------------------- sums


@_inlined
def _add(out, sums):
    """out[i] += sums[i] for a tuple of sums."""
    for i in range(len(sums)):
        out[i] += sums[i]


@_compiled
def gram(values: NDArray, weight: NDArray, start: NDArray, keep: NDArray) -> NDArray:
    """Sum the weighted second moments of every segment and prediction.

    Args:
        values: (K, 5, n) words; weight: (n,) float32; start: (S + 1,) int64, first pixel of each segment.
        keep: (K, n) bool, pixels that count, or (0, 0) for all.

    Returns:
        (S, K, GRAM) float64.
    """
    n_k = values.shape[0]
    out = np.zeros((len(start) - 1, n_k, GRAM))
    masked = keep.shape[0] > 0
    w = np.empty(PIECE, np.float32)
    # `bits` and `v` are one memory, which `_widen` needs. In these loops q is metallic, m counts the pixels of the piece.
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
                # -------- moments of one piece, float32: aa = sum w a a, sa = sum w a, ... --------
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
                # -------- over the pieces, float64 --------
                o = out[s, k]
                _add(o, (aa, ab, ac, bb, bc, cc, sa, sb, sc, rr, sr, qq, sq, one))
    return out


@_compiled
def cross(values: NDArray, target: NDArray, weight: NDArray, start: NDArray, keep: NDArray) -> NDArray:
    """Sum the weighted products of predictions and texture for every segment and prediction.

    Args:
        values, weight, start, keep: as in `gram`.
        target: (5, n) float32 texture at the pixels.

    Returns:
        (S, K, CROSS) float64.
    """
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
            # t is weight times texture, the same for all predictions; w only masks the clipped pixels of single ones.
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
                # -------- products of one piece, float32: ab = sum w mu_r v_g, ad = sum w mu_r, ...; q is metallic --------
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
                _add(o, (aa, ab, ac, ad, ba, bb, bc, bd, ca, cb, cc, cd, rr, rd, qq, qd))
    return out


@_compiled
def square(target: NDArray, weight: NDArray, start: NDArray) -> NDArray:
    """Return the weighted sums (S, 5) float64 of the squares of `target` (5, n)."""
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
        # t is a map of 16 numbers in the CROSS layout; 3, 7, 11, 13 and 15 are the offsets.
        out[0, i] += t[0] * a + t[1] * b + t[2] * c_ + t[3]
        out[1, i] += t[4] * a + t[5] * b + t[6] * c_ + t[7]
        out[2, i] += t[8] * a + t[9] * b + t[10] * c_ + t[11]
        out[3, i] += t[12] * v[3, i] + t[13]
        out[4, i] += t[14] * v[4, i] + t[15]


@_compiled
def mixture(values: NDArray, blend: NDArray, start: NDArray, low: NDArray) -> NDArray:
    """Form the mixture of the corrected predictions, clamped to [low, 1] (Eq. F.30).

    Args:
        values: (K, 5, n) words; blend: (S, K, CROSS) float32 maps times selection weights, alpha_k T_k.
        start: (S + 1,) int64, first pixel of each segment; low: (5,) float32.

    Returns:
        (5, n) float32.
    """
    out = np.zeros((5, values.shape[2]), np.float32)
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    for s in range(len(start) - 1):
        for k in range(values.shape[0]):
            t = blend[s, k]
            if not np.any(t != 0):  # has no weight in any property
                continue
            for first in range(start[s], start[s + 1], PIECE):
                m = min(PIECE, start[s + 1] - first)
                _correct(values, k, first, m, t, bits, v, out[:, first : first + m], True)
    # The clamp acts on the mixture, not on each prediction as in Eq. F.1.
    for c in range(5):
        for i in range(out.shape[1]):
            out[c, i] = min(max(out[c, i], low[c]), np.float32(1))
    return out


@_exact
def add_to_cells(total: NDArray, summed: NDArray, cell: NDArray, value: NDArray, weight: NDArray) -> None:
    """Add pixels to their cells, in order.

    Args:
        total, summed: (n_cells, 5) float64, to which weight and weight times value are added.
        cell: (n,) int32; value: (5, n); weight: (5, n), or (1, n) for all channels alike.
    """
    same = weight.shape[0] == 1
    for i in range(len(cell)):
        x = cell[i]
        for c in range(5):
            w = weight[0 if same else c, i]  # float32; the sums are float64
            total[x, c] += w
            summed[x, c] += w * value[c, i]


@_exact
def cell_means(total: NDArray, summed: NDArray, fallback: NDArray) -> NDArray:
    """Return summed / total (n_cells, 5) as float32, and `fallback` (n_cells, 5) where there is no weight."""
    out = np.empty(summed.shape, np.float32)
    for x in range(len(summed)):
        for c in range(5):
            out[x, c] = summed[x, c] / total[x, c] if total[x, c] > 0 else fallback[x, c]
    return out


# ------------------------------------------------------------------------------------------------------ order statistics


def sorting_network(n: int) -> NDArray:
    """Return the comparators (m, 2) int64 of Batcher's odd-even merge sort of n values.

    All pixels of a piece are sorted at once, plane by plane, without a branch.

    Example:
        >>> sorting_network(3).tolist()
        [[0, 1], [0, 2], [1, 2]]
    """
    # p is the length of the runs that are in order already, k the distance between compared values.
    pairs = []
    p = 1
    while p < n:
        k = p
        while k >= 1:
            for j in range(k % p, n - k, 2 * k):
                for i in range(min(k, n - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):  # both lie in one pair of runs
                        pairs.append((i + j, i + j + k))
            k //= 2
        p *= 2
    return np.array(pairs, np.int64).reshape(-1, 2)


@_inlined_exact
def _sort_planes(planes, network, m):
    # planes (n, PIECE): a comparator puts the smaller value of every pixel into one plane, the larger into the other.
    for x in range(len(network)):
        low, high = planes[network[x, 0]], planes[network[x, 1]]
        for i in range(m):
            a, b = low[i], high[i]
            low[i] = min(a, b)
            high[i] = max(a, b)


@_exact
def medians(values: NDArray, usable: NDArray, network: NDArray) -> NDArray:
    """Return the median (5, n) float32 over the usable predictions, the mean of the middle two for an even number."""
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
            low, high = planes[(n_used - 1) // 2], planes[n_used // 2]  # the same plane for an odd number
            for i in range(m):
                out[c, first + i] = (low[i] + high[i]) * np.float32(0.5)
    return out


class Pixels(NamedTuple):
    """Pixels of a view in segment order, as `disagreement` reads them."""

    values: NDArray
    """(K, 5, n) words."""
    mixed: NDArray
    """(5, n) float32 mixture of the corrected predictions."""
    target: NDArray
    """(5, n) float32 texture."""
    weight: NDArray
    """(n,) float32."""
    start: NDArray
    """(S + 1,) int64, first pixel of each segment."""


@_exact
def disagreement(
    pixels: Pixels, affine: NDArray, usable: NDArray, network: NDArray, low: NDArray, floor: float
) -> tuple[NDArray, NDArray]:
    """Measure how far the corrected predictions lie from their mixture and which one is the nearest to the texture.

    Args:
        pixels: pixels of a view; affine: (S, K, CROSS) float32 maps; usable: (K,) bool.
        network: comparators for as many values as there are usable predictions.
        low: (5,) float32 lower end of the values; floor: smallest reference scale.

    Returns:
        (5, n) float32 reference scale, the lower median of Eq. F.4, and (S, K, 3) float64 votes: weight of the pixels at
        which prediction k is the nearest to the texture in L1 (Eq. F.11); of equal ones the first counts.
    """
    values, mixed, target, weight, start = pixels
    which = np.flatnonzero(usable)
    n_used = len(which)
    # A block without a usable prediction has no pixel, and then none of the loops runs.
    b_ref = np.full(mixed.shape, np.float32(floor))
    votes = np.zeros((len(start) - 1, values.shape[0], 3))
    bits = np.empty((5, PIECE), np.int32)
    v = bits.view(np.float32)
    corrected = np.empty((5, PIECE), np.float32)  # v_k after its map; then its distance from the texture
    planes = np.empty((5, n_used, PIECE), np.float32)  # |mixture - v_k|, to be sorted over k
    best = np.empty((3, PIECE), np.float32)  # smallest L1 error of each property so far
    chosen = np.empty((3, PIECE), np.int64)
    error = np.empty((3, PIECE), np.float32)
    for s in range(len(start) - 1):
        for first in range(start[s], start[s + 1], PIECE):
            m = min(PIECE, start[s + 1] - first)
            best[:] = np.inf
            chosen[:] = 0
            # -------- distances of each prediction from mixture and texture; the nearest one --------
            for j in range(n_used):
                _correct(values, which[j], first, m, affine[s, which[j]], bits, v, corrected, False)
                for c in range(5):
                    for i in range(m):
                        x = min(max(corrected[c, i], low[c]), np.float32(1))  # clamp of Eq. F.1
                        planes[c, j, i] = abs(mixed[c, first + i] - x)
                        corrected[c, i] = abs(x - target[c, first + i])
                for i in range(m):
                    # Eq. F.11 without the factor 1 / 3, which changes no comparison.
                    error[0, i] = corrected[0, i] + corrected[1, i] + corrected[2, i]
                    error[1, i] = corrected[3, i]
                    error[2, i] = corrected[4, i]
                for p in range(3):
                    for i in range(m):
                        nearer = error[p, i] < best[p, i]  # of equal errors the first stays
                        chosen[p, i] = which[j] if nearer else chosen[p, i]
                        best[p, i] = error[p, i] if nearer else best[p, i]
            # -------- votes (Eq. F.13 for a temperature of 0) and scale (Eq. F.4) --------
            for p in range(3):
                for i in range(m):
                    votes[s, chosen[p, i], p] += weight[first + i]
            for c in range(5):
                _sort_planes(planes[c], network, m)
                middle = planes[c, (n_used - 1) // 2]  # lower median
                for i in range(m):
                    b_ref[c, first + i] = max(middle[i], np.float32(floor))
    return b_ref, votes
