"""Compiled loss of a batch and its gradient in closed form (Eqs. F.1 to F.15 and F.50 to F.54).

A batch is sorted by segment; a tile is up to `TILE` pixels of one segment. The raw outputs set the real type: float32 to
solve, float64 to check. One thread makes the sums of a segment, so the bytes do not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from iif_core.fusion.kernels import sorting_network
from iif_core.numerics.compiled import njit
from iif_core.reflectance.material import LOWEST

TILE = 64
_kernel = njit(error_model="numpy", fastmath={"contract", "nsz"})
# Loops that other loops call are inlined: docs/method/numerics.md#sums-that-depend-on-the-compiler.
_inlined = njit(error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
_sums = njit(error_model="numpy", fastmath={"contract", "nsz", "reassoc"}, forceinline=True)

LOCATION = np.array([0, 1, 2, 6, 8])
"""Raw outputs that hold the location of each channel (Eq. F.50)."""
SCALE = np.array([3, 4, 5, 7, 9])
"""Raw outputs that hold the Laplace scale of each channel."""
_PROPERTY = np.array([0, 0, 0, 1, 2])
_LOW = np.float32(LOWEST)

SUMS = 5
"""Number of sums: data, label, regulariser (without its weight), entropy in nats, mean gain, each times the share of the
pixels."""

_LOG2E, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_C2, _C3, _C4, _C5, _C6 = (np.float32(1 / math.factorial(i)) for i in range(2, 7))


class Batch(NamedTuple):
    """Pixels of a batch, sorted by segment. Run r is the pixels start[r] ... start[r + 1] - 1, all of one segment."""

    start: NDArray
    """(R + 1,) int64."""
    segment: NDArray
    """(R,) segment of each run."""
    pool: NDArray
    """(P, K, 5) predictions, words (kernels.as_words) or real."""
    pixels: NDArray
    """(N,) int32 rows of the pool."""
    share: NDArray
    """(N,) real weights of the pixels, sum 1."""
    raw: NDArray
    """(N, 10) real raw outputs of the texture at the pixels."""


class SegmentTables(NamedTuple):
    """Maps and selection of every segment and prediction."""

    affine: NDArray
    """(S, K, CROSS) real."""
    alpha: NDArray
    """(S, K, 3) real selection weights."""
    log_alpha: NDArray
    """(S, K, 3) real."""
    usable: NDArray
    """(S, K) bool."""
    networks: NDArray
    """Comparators by the number of usable predictions, and their counts: `selection_networks`."""
    lengths: NDArray


class LossSettings(NamedTuple):
    """Numbers and choices of the loss; the numbers have the real type of the raw outputs."""

    temperature: np.floating
    """Temperature of the errors."""
    floor: np.floating
    """Smallest Laplace scale."""
    data_weight: np.floating
    regulariser: np.floating
    smooth: bool
    """Floor of the texture's scale: sqrt(s^2 + floor^2) instead of max(s, floor)."""
    median_gradient: bool
    """Follow the derivative of the reference scale b_ref."""
    inward: bool
    """Keep gradients of clamped values that lead back into the valid range."""


class Gradients(NamedTuple):
    """Outputs of `batch_loss`; all but `d_raw` are added to."""

    d_raw: NDArray
    """(N, 10) real derivative of the loss with respect to the raw outputs."""
    d_affine: NDArray
    """(S, K, CROSS) real."""
    d_alpha: NDArray
    """(S, K, 3) real, of the data term alone."""
    votes: NDArray
    """(S, K, 3) real sums of share times q (Eq. F.11)."""
    error: NDArray
    """(S, K, 3) float64 sums of share times L1 error."""
    sums: NDArray
    """(R, SUMS) float64."""


class _Scratch(NamedTuple):
    """Memory of a tile: `bits` and `v` (5, K, TILE) of `_planes`, `u` (5, K, TILE), `distance` (K, TILE), `planes`
    (5, 5, TILE)."""

    bits: NDArray
    v: NDArray
    u: NDArray
    distance: NDArray
    planes: NDArray


def selection_networks(k: int) -> tuple[NDArray, NDArray]:
    """Return comparators that bring the lower median of n values to place (n - 1) // 2, for n = 0 ... k.

    These are sorting networks without the comparators on which that place does not depend: (k + 1, m, 2) int64, and the
    number of comparators that count for each n, (k + 1,).
    """
    pruned = []
    for n in range(k + 1):
        needed, keep = {(n - 1) // 2}, []
        for i, j in sorting_network(n)[::-1].tolist():
            if i in needed or j in needed:
                needed |= {i, j}
                keep.append((i, j))
        pruned.append(keep[::-1])
    length = np.array([len(pairs) for pairs in pruned])
    networks = np.zeros((k + 1, max(1, length.max()), 2), np.int64)
    for n, pairs in enumerate(pruned):
        networks[n, : len(pairs)] = np.array(pairs, np.int64).reshape(-1, 2)
    return networks, length


def _planes(pool, k):
    raise NotImplementedError


@overload(_planes, inline="always")
def _planes_of(pool, k):
    """Scratch for values (5, K, TILE), and its memory as int32 where the pool holds half precision as bits."""
    if pool.dtype == types.uint16:

        def planes(pool, k):
            bits = np.empty((5, k, TILE), np.int32)
            return bits, bits.view(np.float32)

    else:

        def planes(pool, k):
            return np.empty((0, 0, 0), np.int32), np.empty((5, k, TILE), pool.dtype)

    return planes


def _fetch(pool, pixels, which, bits, v):
    raise NotImplementedError


@overload(_fetch)
def _fetch_of(pool, pixels, which, bits, v):
    """v[c, j, i] = pool[pixels[i], which[j], c]."""
    if pool.dtype == types.uint16:

        def fetch(pool, pixels, which, bits, v):
            m = len(pixels)
            for i in range(m):
                row = pool[pixels[i]]
                for j in range(len(which)):
                    for c in range(5):
                        bits[c, j, i] = np.int32(row[which[j], c]) << 13
            for c in range(5):
                for j in range(len(which)):
                    for i in range(m):
                        v[c, j, i] *= np.float32(2.0**112)

    else:

        def fetch(pool, pixels, which, bits, v):
            for i in range(len(pixels)):
                row = pool[pixels[i]]
                for j in range(len(which)):
                    for c in range(5):
                        v[c, j, i] = row[which[j], c]

    return fetch


def _exp(x, m):
    raise NotImplementedError


@overload(_exp)
def _exp_of(x, m):
    """x[:m] = e^x; for float32 a polynomial, accurate to 2 units in the last place and not below e^-87."""
    if x.dtype == types.float32:
        return lambda x, m: _exp_float(x, m)

    def exp(x, m):
        for i in range(m):
            x[i] = math.exp(x[i])

    return exp


@_inlined
def _exp_float(x, m):
    bits = np.empty(TILE, np.int32)
    power = bits.view(np.float32)
    for i in range(m):
        t = min(max(x[i], np.float32(-87)), np.float32(88))
        n = np.floor(t * _LOG2E + np.float32(0.5))
        r = (t - n * _LN2_HIGH) - n * _LN2_LOW
        p = _C4 + r * (_C5 + r * _C6)
        p = np.float32(1) + r * (np.float32(1) + r * (_C2 + r * (_C3 + r * p)))
        bits[i] = (np.int32(n) + np.int32(127)) << 23
        x[i] = p
    for i in range(m):
        x[i] *= power[i]


@_inlined
def _correct(v, affine, which, m, u):
    """u (5, j, m) = T_j v_j, before the clamp."""
    for j in range(len(which)):
        t = affine[which[j]]
        for i in range(m):
            r, g, b = v[0, j, i], v[1, j, i], v[2, j, i]
            u[0, j, i] = t[0] * r + t[1] * g + t[2] * b + t[3]
            u[1, j, i] = t[4] * r + t[5] * g + t[6] * b + t[7]
            u[2, j, i] = t[8] * r + t[9] * g + t[10] * b + t[11]
            u[3, j, i] = t[12] * v[3, j, i] + t[13]
            u[4, j, i] = t[14] * v[4, j, i] + t[15]


@_inlined
def _clamp(x, low):
    return min(max(x, low), np.float32(1))


@_inlined
def _select(planes, network, length, m):
    for x in range(length):
        low, high = planes[network[x, 0]], planes[network[x, 1]]
        for i in range(m):
            a, b = low[i], high[i]
            low[i] = min(a, b)
            high[i] = max(a, b)


@_sums
def _labels(u, mu, share, which, log_alpha, temperature, m, e, votes, error):
    """Add votes q and errors of the predictions of a tile to `votes` and `error`; return its label loss."""
    loss = np.float64(0)
    n_used = len(which)
    low = np.empty(TILE, u.dtype)
    for p in range(3):
        for j in range(n_used):
            for i in range(m):
                if p == 0:
                    d = abs(_clamp(u[0, j, i], _LOW[0]) - mu[0, i]) + abs(_clamp(u[1, j, i], _LOW[1]) - mu[1, i])
                    e[j, i] = (d + abs(_clamp(u[2, j, i], _LOW[2]) - mu[2, i])) / np.float32(3)
                else:
                    e[j, i] = abs(_clamp(u[p + 2, j, i], _LOW[p + 2]) - mu[p + 2, i])
        for i in range(m):
            low[i] = e[0, i]
        for j in range(n_used):
            total = share[0] * 0
            for i in range(m):
                low[i] = min(low[i], e[j, i])
                total += share[i] * e[j, i]
            error[which[j], p] += total
        if n_used == 1:
            continue
        inverse = np.float32(1) / temperature
        for j in range(n_used):
            for i in range(m):
                e[j, i] = (low[i] - e[j, i]) * inverse
            _exp(e[j], m)
        for i in range(m):
            low[i] = share[i] * 0
        for j in range(n_used):
            for i in range(m):
                low[i] += e[j, i]
        for i in range(m):
            low[i] = share[i] / low[i]
        for j in range(n_used):
            vote = share[0] * 0
            for i in range(m):
                vote += low[i] * e[j, i]
            votes[which[j], p] += vote
            if vote > 0:
                loss -= vote * log_alpha[which[j], p]
    return loss / 3


@_inlined
def _texture(raw, floor, smooth, m, mu, b, d_mu, d_b):
    """Location and scale (5, m) from raw outputs (m, 10), and their derivatives with respect to the raw outputs."""
    x = np.empty(TILE, raw.dtype)
    one = np.float32(1)
    for c in range(5):
        low = _LOW[c]
        for part in range(2):
            source = LOCATION[c] if part == 0 else SCALE[c]
            for i in range(m):
                x[i] = -raw[i, source]
            _exp(x, m)
            for i in range(m):
                s = one / (one + x[i])
                slope = s * (one - s)
                if part == 0:
                    mu[c, i] = low + s - low * s  # not 1 - low: it would be rounded to float32
                    d_mu[c, i] = slope - low * slope
                elif smooth:
                    floored = np.sqrt(s * s + floor * floor)
                    b[c, i] = floored
                    d_b[c, i] = slope * s / floored
                else:
                    b[c, i] = max(s, floor)
                    d_b[c, i] = slope if s >= floor else slope * 0


@_sums
def _tile(pool, pixels, share, raw, of_segment, settings, scratch, out):
    """Loss and gradients of one tile: (data, label), both weighted by `share`.

    `of_segment`: (affine, alpha, log alpha, usable predictions, comparators, their number) of the tile's segment; `out`:
    the tile's rows of the `Gradients` without `sums`.
    """
    affine, alpha, log_alpha, which, network, length = of_segment
    temperature, floor, data_weight = settings.temperature, settings.floor, settings.data_weight
    bits, v, u, distance, planes = scratch
    d_raw, d_affine, d_alpha, votes, error = out
    m, n_used = len(pixels), len(which)
    one = np.float32(1)
    mu, b, d_mu, d_b = planes[0], planes[1], planes[2], planes[3]
    mixed, slope, extra = planes[4, 0], planes[4, 1], planes[4, 2]
    decay, spread = planes[4, 3], planes[4, 4]
    zero = share[0] * 0
    _fetch(pool, pixels, which, bits, v)
    _correct(v, affine, which, m, u)
    _texture(raw, floor, settings.smooth, m, mu, b, d_mu, d_b)
    label = _labels(u, mu, share, which, log_alpha, temperature, m, distance, votes, error)
    data = np.float64(0)
    middle = (n_used - 1) // 2
    for c in range(5):
        p, low = _PROPERTY[c], _LOW[c]
        for i in range(m):
            mixed[i] = zero
        for j in range(n_used):
            a = alpha[which[j], p]
            for i in range(m):
                mixed[i] += a * _clamp(u[c, j, i], low)
        for j in range(n_used):
            for i in range(m):
                distance[j, i] = abs(mixed[i] - _clamp(u[c, j, i], low))
        _select(distance, network, length, m)
        for i in range(m):
            spread[i] = distance[middle, i]
            decay[i] = -abs(mixed[i] - mu[c, i]) / max(spread[i], floor)
        _exp(decay, m)
        total = zero
        for i in range(m):
            b_r, b_p = max(spread[i], floor), b[c, i]
            difference = mixed[i] - mu[c, i]
            d = abs(difference)
            inverse = one / b_p
            w = share[i] * data_weight / np.float32(5)
            total += share[i] * (math.log(b_p / b_r) + (d + b_r * decay[i]) * inverse - one)
            force = (one - decay[i]) * inverse * w
            slope[i] = force if difference > 0 else (-force if difference < 0 else zero)
            d_raw[i, LOCATION[c]] = -slope[i] * d_mu[c, i]
            d_raw[i, SCALE[c]] = (one - (d + b_r * decay[i]) * inverse) * inverse * w * d_b[c, i]
            clamped = spread[i] < floor
            extra[i] = zero if clamped else w * ((one + d / b_r) * decay[i] * inverse - one / b_r)
        data += total / 5
        if settings.median_gradient:  # of b_ref, to the first prediction that is the median
            for i in range(m):
                found = False
                sign = zero
                for j in range(n_used):
                    off = mixed[i] - _clamp(u[c, j, i], low)
                    chosen = not found and abs(off) == spread[i]
                    found = found or chosen
                    distance[j, i] = zero
                    if chosen:
                        sign = one if off > 0 else (-one if off < 0 else zero)
                        distance[j, i] = -extra[i] * sign
                slope[i] += extra[i] * sign
        for j in range(n_used):
            k = which[j]
            a = alpha[k, p]
            of_alpha = zero
            for i in range(m):
                of_alpha += slope[i] * _clamp(u[c, j, i], low)
            d_alpha[k, p] += of_alpha
            g_r = g_g = g_b = g_1 = zero
            if settings.median_gradient:
                for i in range(m):
                    decay[i] = a * slope[i] + distance[j, i]
            else:
                for i in range(m):
                    decay[i] = a * slope[i]
            for i in range(m):
                off = u[c, j, i] - _clamp(u[c, j, i], low)
                passes = off == 0 or (settings.inward and off * decay[i] > 0)
                decay[i] = decay[i] if passes else zero
            if c < 3:
                for i in range(m):
                    g_r += decay[i] * v[0, j, i]
                    g_g += decay[i] * v[1, j, i]
                    g_b += decay[i] * v[2, j, i]
                    g_1 += decay[i]
                d_affine[k, 4 * c] += g_r
                d_affine[k, 4 * c + 1] += g_g
                d_affine[k, 4 * c + 2] += g_b
                d_affine[k, 4 * c + 3] += g_1
            else:
                for i in range(m):
                    g_r += decay[i] * v[c, j, i]
                    g_1 += decay[i]
                d_affine[k, 2 * c + 6] += g_r
                d_affine[k, 2 * c + 7] += g_1
    return data, label


@_inlined
def _regulariser(t, weight, gradient):
    """Identity regulariser of one map in the CROSS layout (Eq. F.14); adds weight times its gradient."""
    one, two, four = np.float32(1), np.float32(2), np.float32(4)
    total = t[0] * 0
    for i in range(3):
        for j in range(3):
            d = t[4 * i + j] - (one if i == j else one - one)
            total += d * d
            gradient[4 * i + j] += weight * two * d
        total += t[4 * i + 3] * t[4 * i + 3]
        gradient[4 * i + 3] += weight * two * t[4 * i + 3]
    for i in range(3):
        for j in range(3):
            p = (one if i == j else one - one) * -one
            for x in range(3):
                p += t[4 * i + x] * t[4 * j + x]
            total += p * p
            for x in range(3):
                gradient[4 * i + x] += weight * four * p * t[4 * j + x]
    for c in (12, 14):
        total += (t[c] - one) * (t[c] - one) + t[c + 1] * t[c + 1]
        gradient[c] += weight * two * (t[c] - one)
        gradient[c + 1] += weight * two * t[c + 1]
    return total


@_kernel
def batch_loss(first: int, last: int, batch: Batch, tables: SegmentTables, settings: LossSettings, out: Gradients) -> None:
    """Compute loss and gradients of the runs first ... last - 1 of a batch.

    The derivative of the label loss with respect to the logits is (alpha sum(votes) - votes) / (3 temperature); it follows
    from `out.votes` (Eq. F.54).

    Args:
        first, last: range of runs, which no other call may contain.
        batch: pixels; tables: maps and selection; settings: numbers and choices of the loss.
        out: arrays that are written.
    """
    start, segment, pool, pixels, share, raw = batch
    affine, alpha, log_alpha, usable, networks, lengths = tables
    d_raw, d_affine, d_alpha, votes, error, sums = out
    n_k = pool.shape[1]
    bits, v = _planes(pool, n_k)
    u = np.empty((5, n_k, TILE), raw.dtype)
    distance = np.empty((n_k, TILE), raw.dtype)
    planes = np.empty((5, 5, TILE), raw.dtype)
    scratch = _Scratch(bits, v, u, distance, planes)
    real = np.empty(1, raw.dtype)
    for r in range(first, last):
        s = segment[r]
        which = np.flatnonzero(usable[s])
        if len(which) == 0:
            continue
        of_segment = (affine[s], alpha[s], log_alpha[s], which, networks[len(which)], lengths[len(which)])
        of_run = np.float64(0)
        for low in range(start[r], start[r + 1], TILE):
            high = min(low + TILE, start[r + 1])
            rows = (d_raw[low:high], d_affine[s], d_alpha[s], votes[s], error[s])
            data, label = _tile(pool, pixels[low:high], share[low:high], raw[low:high], of_segment, settings, scratch, rows)
            sums[r, 0] += data
            sums[r, 1] += label
            for i in range(low, high):
                of_run += share[i]
        real[0] = of_run / len(which)
        weight = real[0]
        entropy = gain = np.float64(0)
        for j in range(len(which)):
            k = which[j]
            t = affine[s, k]
            sums[r, 2] += of_run / len(which) * _regulariser(t, weight * settings.regulariser, d_affine[s, k])
            for p in range(3):
                if alpha[s, k, p] > 0:
                    entropy -= alpha[s, k, p] * log_alpha[s, k, p]
            gain += alpha[s, k, 0] * (t[0] + t[5] + t[10]) / 3
        sums[r, 3] = of_run * entropy / 3
        sums[r, 4] = of_run * gain


@_kernel
def add_rows(out: NDArray, rows: NDArray, values: NDArray) -> None:
    """Add values[i] (m, c) to out[rows[i]] in order."""
    for i in range(len(rows)):
        for c in range(values.shape[1]):
            out[rows[i], c] += values[i, c]
