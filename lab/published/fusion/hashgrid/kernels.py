"""CPU kernels of the hash grid: one level or one run of sample blocks per call, without locks.

Every call writes arrays that no other call writes, so a pool of any size gives the same bytes. Layouts, all float32:

* coordinates (3, N): a batch in Morton order, inside [0, 1 - 1e-6];
* a block holds `BLOCK` consecutive samples in its last axis, the last one filled up with zeros: `encoded` (blocks, inputs,
  BLOCK), `hidden` (blocks, layers, width, BLOCK); the widths of the network are multiples of `TILE`, filled up with zeros.

Indices are unsigned, or rows are taken out as views first, so that numba drops the test for negative indices and LLVM vectorises.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.compiled import njit

BLOCK = 512  # samples; inputs, hidden values and derivatives of one block stay in a second-level cache of 1 MB
TILE = 4  # rows and columns of a register tile in the matrix products
SPAN = 128  # floats per flag of `live`
MORTON_BITS = 10  # per axis

_ONE = np.uint64(1)
_PRIME_Y = np.uint64(2654435761)
_PRIME_Z = np.uint64(805459861)
_TOP = np.float32(1 - 1e-6)
_kernel = {"error_model": "numpy"}
_exact = {**_kernel, "fastmath": {"contract", "nsz"}}
_sums = {**_kernel, "fastmath": {"contract", "nsz", "reassoc"}}
# Loops that other loops call are inlined: docs/method/numerics.md#sums-that-depend-on-the-compiler.
_inlined = {"forceinline": True}


class Weights(NamedTuple):
    """Weights of the network (or their gradients), filled up to multiples of TILE."""

    w_in: NDArray
    """(width, inputs)."""
    w_mid: NDArray
    """(layers - 1, width, width)."""
    w_out: NDArray
    """(outputs, width)."""
    biases: NDArray
    """(layers, width)."""
    b_out: NDArray
    """(outputs,)."""


class Transposed(NamedTuple):
    """The matrices of `Weights`, each transposed and contiguous."""

    w_in: NDArray
    w_mid: NDArray
    w_out: NDArray


@njit(**_kernel)
def sort_points(u, coordinates):
    """Write the clamped coordinates `u` (N, 3) in Morton order to `coordinates` (3, N), so that neighbours in the batch read
    the same rows of the table.

    Returns the order (N,) uint32, in which ties keep the order of the batch, and whether all coordinates are finite.
    """
    n = u.shape[0]
    key = np.empty(n, np.uint32)
    finite = True
    cells = np.float32(1 << MORTON_BITS)
    for i in range(n):
        code = np.uint64(0)
        for axis in range(3):
            value = u[i, axis]
            if not np.isfinite(value):
                finite = False
                value = np.float32(0)
            value = min(max(value, np.float32(0)), _TOP)
            coordinates[axis, i] = value
            q = np.uint64(value * cells)  # spread 10 bits to every third place
            q = (q | (q << np.uint64(16))) & np.uint64(0x030000FF)
            q = (q | (q << np.uint64(8))) & np.uint64(0x0300F00F)
            q = (q | (q << np.uint64(4))) & np.uint64(0x030C30C3)
            q = (q | (q << np.uint64(2))) & np.uint64(0x09249249)
            code |= q << np.uint64(axis)
        key[i] = code
    order, other = np.arange(n).astype(np.uint32), np.empty(n, np.uint32)
    digit = np.uint64((1 << MORTON_BITS) - 1)
    for sweep in range(3):
        shift = np.uint64(sweep * MORTON_BITS)
        start = np.zeros((1 << MORTON_BITS) + 1, np.int64)
        for i in range(n):
            start[((np.uint64(key[i]) >> shift) & digit) + _ONE] += 1
        for i in range(1 << MORTON_BITS):
            start[i + 1] += start[i]
        for i in range(n):
            d = (np.uint64(key[order[i]]) >> shift) & digit
            other[start[d]] = order[i]
            start[d] += 1
        order, other = other, order
    for axis in range(3):
        row = coordinates[axis].copy()
        for i in range(n):
            coordinates[axis, i] = row[order[i]]
    return order, finite


@njit(**_sums)
def fetch(table):
    """Read a table once in order, which brings it into cache sooner than the scattered reads after it would."""
    total = np.float32(0)
    for i in range(0, table.shape[0], 8):
        total += table[i, 0]
    return total


@njit(**_exact, **_inlined)
def _strides(entries, resolution, hashed):
    """Scale of the coordinates, last cell, mask of the hash, and factors on y and z in the index of a vertex."""
    stride_y = _PRIME_Y if hashed else np.uint64(resolution)
    stride_z = _PRIME_Z if hashed else np.uint64(resolution) * np.uint64(resolution)
    return np.float32(resolution - 1), np.uint64(resolution - 2), np.uint64(entries - 1), stride_y, stride_z


@njit(**_exact, **_inlined)
def _corners(ux, uy, uz, grid, hashed):
    """Rows of the table of the eight vertices around a point, x fastest, and the point's place in its cell."""
    scale, last, mask, stride_y, stride_z = grid
    px, py, pz = ux * scale, uy * scale, uz * scale
    x, y, z = min(np.uint64(px), last), min(np.uint64(py), last), min(np.uint64(pz), last)
    wx, wy, wz = px - np.float32(x), py - np.float32(y), pz - np.float32(z)
    y0, z0, x1 = y * stride_y, z * stride_z, x + _ONE
    y1, z1 = y0 + stride_y, z0 + stride_z
    if hashed:
        r00, r10, r01, r11 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        i0, i1, i2, i3 = (x ^ r00) & mask, (x1 ^ r00) & mask, (x ^ r10) & mask, (x1 ^ r10) & mask
        i4, i5, i6, i7 = (x ^ r01) & mask, (x1 ^ r01) & mask, (x ^ r11) & mask, (x1 ^ r11) & mask
    else:
        i0, i2, i4, i6 = x + y0 + z0, x + y1 + z0, x + y0 + z1, x + y1 + z1
        i1, i3, i5, i7 = i0 + _ONE, i2 + _ONE, i4 + _ONE, i6 + _ONE
    return (i0, i1, i2, i3, i4, i5, i6, i7), (wx, wy, wz)


@njit(**_exact)
def encode_level(coordinates, resolution, hashed, table, encoded, row) -> None:
    """Interpolate the features of one level trilinearly (Eq. F.58).

    Args:
        coordinates: (3, N); resolution: vertices per side; hashed: whether vertices are hashed or indexed directly.
        table: (entries, 2) entries of this level; their number is a power of two where `hashed`.
        encoded: rows `row` and `row + 1` of every block are written.
        row: first row of the level.
    """
    n = coordinates.shape[1]
    grid = _strides(table.shape[0], resolution, hashed)
    for block in range(encoded.shape[0]):
        low = block * BLOCK
        count = min(BLOCK, n - low)
        high = low + count
        xs, ys, zs = coordinates[0, low:high], coordinates[1, low:high], coordinates[2, low:high]
        first, second = encoded[block, row], encoded[block, row + 1]
        for s in range(count):
            (i0, i1, i2, i3, i4, i5, i6, i7), (wx, wy, wz) = _corners(xs[s], ys[s], zs[s], grid, hashed)
            a0, b0, a1, b1 = table[i0, 0], table[i0, 1], table[i1, 0], table[i1, 1]
            a2, b2, a3, b3 = table[i2, 0], table[i2, 1], table[i3, 0], table[i3, 1]
            a4, b4, a5, b5 = table[i4, 0], table[i4, 1], table[i5, 0], table[i5, 1]
            a6, b6, a7, b7 = table[i6, 0], table[i6, 1], table[i7, 0], table[i7, 1]
            a0, b0, a2, b2 = a0 + wx * (a1 - a0), b0 + wx * (b1 - b0), a2 + wx * (a3 - a2), b2 + wx * (b3 - b2)
            a4, b4, a6, b6 = a4 + wx * (a5 - a4), b4 + wx * (b5 - b4), a6 + wx * (a7 - a6), b6 + wx * (b7 - b6)
            a0, b0, a4, b4 = a0 + wy * (a2 - a0), b0 + wy * (b2 - b0), a4 + wy * (a6 - a4), b4 + wy * (b6 - b4)
            first[s] = a0 + wz * (a4 - a0)
            second[s] = b0 + wz * (b4 - b0)
        first[count:] = 0
        second[count:] = 0


@njit(**_exact)
def scatter_level(coordinates, resolution, hashed, slopes, row, gradient) -> None:
    """Add the gradient of one level's table: the transpose of `encode_level`.

    Args:
        coordinates, resolution, hashed, row: as in `encode_level`.
        slopes: (blocks, inputs, BLOCK) derivatives of the loss with respect to the encoded samples.
        gradient: (entries, 2), is added to.
    """
    n = coordinates.shape[1]
    grid = _strides(gradient.shape[0], resolution, hashed)
    one = np.float32(1)
    for block in range(slopes.shape[0]):
        low = block * BLOCK
        count = min(BLOCK, n - low)
        high = low + count
        xs, ys, zs = coordinates[0, low:high], coordinates[1, low:high], coordinates[2, low:high]
        first, second = slopes[block, row], slopes[block, row + 1]
        for s in range(count):
            (i0, i1, i2, i3, i4, i5, i6, i7), (wx, wy, wz) = _corners(xs[s], ys[s], zs[s], grid, hashed)
            a, b = first[s], second[s]
            vx, vy, vz = one - wx, one - wy, one - wz
            for w, near, far in ((vy * vz, i0, i1), (wy * vz, i2, i3), (vy * wz, i4, i5), (wy * wz, i6, i7)):
                aw, bw = a * w, b * w
                gradient[near, 0] += vx * aw
                gradient[near, 1] += vx * bw
                gradient[far, 0] += wx * aw
                gradient[far, 1] += wx * bw


@njit(**_exact)
def adam(parameters, first, second, gradient, live, factors) -> None:
    """Update flat arrays by one step of Adam (Eq. F.55) and zero the gradient.

    m <- m + (1 - beta1)(g - m), v <- beta2 v + (1 - beta2) g^2, p <- p - rate m / (root sqrt(v) + eps).

    Args:
        parameters, first, second, gradient: (n,) float32 p, m, v and g.
        live: (ceil(n / SPAN),) bool, spans whose moments are not all zero. A span that is not live and has no gradient is
            skipped; the formula would leave it unchanged too.
        factors: lab.published.adam.AdamFactors.
    """
    beta1, beta2, rate, root, eps = factors
    zero = np.float32(0)
    fresh1, fresh2 = np.float32(1) - beta1, np.float32(1) - beta2
    for span in range(live.shape[0]):
        low = span * SPAN
        high = min(low + SPAN, parameters.shape[0])
        g, p, m, v = gradient[low:high], parameters[low:high], first[low:high], second[low:high]
        if not live[span]:
            largest = zero
            for j in range(g.shape[0]):
                largest = max(largest, abs(g[j]))
            if largest == zero:
                continue
            live[span] = True
        for j in range(g.shape[0]):
            slope = g[j]
            mean = m[j] + fresh1 * (slope - m[j])
            square = beta2 * v[j] + fresh2 * slope * slope
            m[j] = mean
            v[j] = square
            g[j] = zero
            p[j] -= rate * mean / (np.sqrt(square) * root + eps)


@njit(**_exact, **_inlined)
def _product(w, x, y):
    """y += w x for w (J, I), x (I, BLOCK), y (J, BLOCK); J and I are multiples of TILE = 4."""
    for j in range(0, w.shape[0], 4):
        y0, y1, y2, y3 = y[j], y[j + 1], y[j + 2], y[j + 3]
        for i in range(0, w.shape[1], 4):
            x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
            w00, w01, w02, w03 = w[j, i], w[j, i + 1], w[j, i + 2], w[j, i + 3]
            w10, w11, w12, w13 = w[j + 1, i], w[j + 1, i + 1], w[j + 1, i + 2], w[j + 1, i + 3]
            w20, w21, w22, w23 = w[j + 2, i], w[j + 2, i + 1], w[j + 2, i + 2], w[j + 2, i + 3]
            w30, w31, w32, w33 = w[j + 3, i], w[j + 3, i + 1], w[j + 3, i + 2], w[j + 3, i + 3]
            for s in range(BLOCK):
                a, b, c, d = x0[s], x1[s], x2[s], x3[s]
                y0[s] += w00 * a + w01 * b + w02 * c + w03 * d
                y1[s] += w10 * a + w11 * b + w12 * c + w13 * d
                y2[s] += w20 * a + w21 * b + w22 * c + w23 * d
                y3[s] += w30 * a + w31 * b + w32 * c + w33 * d


@njit(**_sums, **_inlined)
def _outer(d, x, g, h):
    """g += d x^T and h += row sums of d, for d (J, BLOCK), x (I, BLOCK), g (J, I), h (J,)."""
    zero = np.float32(0)
    for j in range(0, d.shape[0], 4):
        d0, d1, d2, d3 = d[j], d[j + 1], d[j + 2], d[j + 3]
        h0 = h1 = h2 = h3 = zero
        for s in range(BLOCK):
            h0 += d0[s]
            h1 += d1[s]
            h2 += d2[s]
            h3 += d3[s]
        h[j] += h0
        h[j + 1] += h1
        h[j + 2] += h2
        h[j + 3] += h3
        for i in range(0, x.shape[0], 4):
            x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
            g00 = g01 = g02 = g03 = g10 = g11 = g12 = g13 = zero
            g20 = g21 = g22 = g23 = g30 = g31 = g32 = g33 = zero
            for s in range(BLOCK):
                a, b, c, e = x0[s], x1[s], x2[s], x3[s]
                p, q, r, t = d0[s], d1[s], d2[s], d3[s]
                g00 += p * a
                g01 += p * b
                g02 += p * c
                g03 += p * e
                g10 += q * a
                g11 += q * b
                g12 += q * c
                g13 += q * e
                g20 += r * a
                g21 += r * b
                g22 += r * c
                g23 += r * e
                g30 += t * a
                g31 += t * b
                g32 += t * c
                g33 += t * e
            rows = ((g00, g01, g02, g03), (g10, g11, g12, g13), (g20, g21, g22, g23), (g30, g31, g32, g33))
            for r in range(4):
                for c in range(4):
                    g[j + r, i + c] += rows[r][c]


@njit(**_exact, **_inlined)
def _layer(w, bias, x, y, rectified):
    """y = w x + bias, rectified or not."""
    for j in range(y.shape[0]):
        y[j, :] = bias[j]
    _product(w, x, y)
    if rectified:
        for j in range(y.shape[0]):
            row = y[j]
            for s in range(BLOCK):
                row[s] = max(row[s], np.float32(0))


@njit(**_exact, **_inlined)
def _backed(w_transposed, d, hidden, out):
    """out = (w^T d) where hidden > 0, else 0: through a layer and the rectifier before it."""
    out[:] = 0
    _product(w_transposed, d, out)
    for j in range(out.shape[0]):
        row, active = out[j], hidden[j]
        for s in range(BLOCK):
            row[s] = row[s] if active[s] > np.float32(0) else np.float32(0)


@njit(**_exact)
def network_forward(low, high, order, encoded, weights, hidden, output) -> None:
    """Send the blocks low ... high - 1 through the network.

    Args:
        low, high: range of blocks; order: (N,) of `sort_points`; encoded: inputs of the network; weights: `Weights`.
        hidden: (blocks, layers, width, BLOCK) and output: (N, outputs), in the order of the batch, are written.
    """
    w_in, w_mid, w_out, biases, b_out = weights
    n = order.shape[0]
    layers = biases.shape[0]
    y = np.empty((w_out.shape[0], BLOCK), np.float32)
    for block in range(low, high):
        h = hidden[block]
        _layer(w_in, biases[0], encoded[block], h[0], True)
        for layer in range(1, layers):
            _layer(w_mid[layer - 1], biases[layer], h[layer - 1], h[layer], True)
        _layer(w_out, b_out, h[layers - 1], y, False)
        for s in range(min(BLOCK, n - block * BLOCK)):
            line = output[order[block * BLOCK + s]]
            for j in range(line.shape[0]):
                line[j] = y[j, s]


@njit(**_exact)
def network_backward(low, high, order, encoded, hidden, slope, transposed, gradient, slopes) -> None:
    """Propagate derivatives of the loss back through the network: the transpose of `network_forward`.

    Args:
        low, high, order, encoded, hidden: as in `network_forward`.
        slope: (N, outputs) derivatives of the loss with respect to the outputs.
        transposed: `Transposed` weights; gradient: `Weights`, is added to.
        slopes: derivatives with respect to `encoded`, are written.
    """
    w_in_t, w_mid_t, w_out_t = transposed
    g_in, g_mid, g_out, g_biases, g_bias_out = gradient
    n = order.shape[0]
    layers, width = g_biases.shape
    d_out = np.zeros((g_out.shape[0], BLOCK), np.float32)
    d, other = np.empty((width, BLOCK), np.float32), np.empty((width, BLOCK), np.float32)
    for block in range(low, high):
        count = min(BLOCK, n - block * BLOCK)
        for s in range(count):
            line = slope[order[block * BLOCK + s]]
            for j in range(line.shape[0]):
                d_out[j, s] = line[j]
        d_out[:, count:] = 0
        h = hidden[block]
        _outer(d_out, h[layers - 1], g_out, g_bias_out)
        _backed(w_out_t, d_out, h[layers - 1], d)
        for layer in range(layers - 1, 0, -1):
            _outer(d, h[layer - 1], g_mid[layer - 1], g_biases[layer])
            _backed(w_mid_t[layer - 1], d, h[layer - 1], other)
            d, other = other, d
        _outer(d, encoded[block], g_in, g_biases[0])
        slopes[block] = 0
        _product(w_in_t, d, slopes[block])
