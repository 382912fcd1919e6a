"""Compiled loop of the profile: the albedo numbers of one object at one roughness and one metallic (Eq. M.20).

With both held, the channels separate into problems of at most four numbers. Order of the sums: as in `kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.fitting.kernels import (
    Penalties,
    PixelArrays,
    ResponseTables,
    _apply_curve,
    _compiled,
    _inlined,
    _interpolate_lobes,
    _interpolation_weights,
)

_FIRST_DAMPING = 1e-3  # of Levenberg-Marquardt


class AlbedoTask(NamedTuple):
    """Which albedo numbers are fitted at which gloss; O objects."""

    free: NDArray
    """(O, 12 or more) bool, the numbers that move."""
    centre: NDArray
    """(O, 12 or more) mean of the prior."""
    weight: NDArray
    """(O, 12) diagonal of its weight."""
    metallic: NDArray
    """(2,) gain and bias of the metallic."""
    roughness: float
    """Roughness; negative: no specular lobe at all."""
    steps: int
    """Largest number of Gauss-Newton steps."""
    tolerance: float
    """Expected fall of the objective, as a share of its size, at which a descent ends."""


@_compiled
def fit_albedo(
    pixels: PixelArrays,
    tone: ResponseTables,
    penalties: Penalties,
    task: AlbedoTask,
    objects: NDArray,
    affine: NDArray,
    cost: NDArray,
) -> None:
    """Fit the albedo numbers of some objects by damped Gauss-Newton.

    Args:
        pixels, tone, penalties: the problem.
        task: numbers, prior and gloss.
        objects: indices of the objects to fit.
        affine: (O, 12) start; the rows of these objects are overwritten with the result.
        cost: (O,) receives data term plus prior at the result.
    """
    base, diffuse, lobes, exposure = pixels.base, pixels.diffuse, pixels.lobes, pixels.exposure
    target, saturated, trust = pixels.target, pixels.saturated, pixels.trust
    starts, first = pixels.starts, pixels.first
    free, centre, weight, metallic, roughness = task.free, task.centre, task.weight, task.metallic, task.roughness
    halves = diffuse.shape[1]
    # The work arrays are made once, for the largest of the objects.
    most = 0
    for x in range(len(objects)):
        most = max(most, starts[first[objects[x] + 1]] - starts[first[objects[x]]])
    # U and V of Eq. M.20 by channel, half and pixel: the exposed radiance is a U + V.
    u = np.zeros((3, halves, most))
    v = np.zeros((3, halves, most))
    g = np.zeros(4)
    h = np.zeros((4, 4))
    new_g = np.zeros(4)
    new_h = np.zeros((4, 4))
    lower = np.zeros((4, 4))
    theta = np.zeros(4)
    tried = np.zeros(4)
    # All pixels have the same roughness, hence the same place between the levels. A negative roughness leaves `lobe` at 0: U = e
    # (1 - m) D, V = 0.
    j, weights, _ = _interpolation_weights(pixels.levels, max(roughness, 0.02))
    lobe = np.zeros(lobes.shape[3])
    for x in range(len(objects)):
        o = objects[x]
        low = starts[first[o]]
        n = starts[first[o + 1]] - low

        # -------- U and V of the pixels of one object --------
        cost[o] = 0.0
        for q in range(n):
            p = low + q
            m = min(max(metallic[0] * base[p, 4] + metallic[1], 0.0), 1.0)
            if roughness >= 0.0:
                _interpolate_lobes(lobes[p], j, weights, lobe)
            for half in range(halves):
                for c in range(3):
                    s0 = lobe[6 * half + c]
                    u[c, half, q] = exposure[p] * ((1.0 - m) * diffuse[p, half, c] + m * s0)
                    v[c, half, q] = exposure[p] * (0.04 * (1.0 - m) * s0 + lobe[6 * half + 3 + c])

        # -------- Levenberg-Marquardt on the row of [A | b] of each channel --------
        for c in range(3):
            own = free[o, 4 * c : 4 * c + 4]
            middle = centre[o, 4 * c : 4 * c + 4]
            prior = weight[o, 4 * c : 4 * c + 4]
            given = (
                base[low : low + n],
                u[c],
                v[c],
                target[low : low + n, c],
                saturated[low : low + n, c],
                trust[low : low + n, c],
            )
            curve = (tone.knee, tone.gain, tone.curve[c], tone.ends[c, 0])
            for i in range(4):
                theta[i] = affine[o, 4 * c + i]
            # `total` decides whether a step is taken; `shown`, without the range term (Eq. M.11), is the evidence Q of Eq. M.21.
            total, shown, size = _system(theta, given, curve, penalties, middle, prior, g, h)
            damping = _FIRST_DAMPING
            for _ in range(task.steps):
                # `tried` first receives the step, then the numbers to which it leads.
                expected = _solve(h, g, own, damping, lower, tried)
                # Newton decrement of the damped system: the fall that the quadratic model promises, up to the damping.
                if 0.5 * expected <= task.tolerance * size:
                    break
                for i in range(4):
                    tried[i] = theta[i] - tried[i]
                new_total, new_shown, new_size = _system(tried, given, curve, penalties, middle, prior, new_g, new_h)
                # NaN compares as false, so a step to it is refused.
                if new_total < total:
                    total, shown, size = new_total, new_shown, new_size
                    theta[:] = tried
                    g[:] = new_g
                    h[:] = new_h
                    damping = max(damping * 0.2, 1e-9)
                else:
                    damping = max(damping * 10.0, 1e-4)
            cost[o] += shown
            for i in range(4):
                affine[o, 4 * c + i] = theta[i]


@_inlined
def _system(theta, given, curve, penalties, middle, prior, g, h):
    """Return objective, data term plus prior, and size of the terms at theta (4,); write gradient and curvature."""
    base, u, v, target, saturated, trust = given
    knee, gain, table, end = curve
    brightest, box = penalties.brightest, penalties.box
    c2 = penalties.robust_width * penalties.robust_width
    last_half = len(u) - 1
    # Scalars instead of arrays: the loop over the pixels then only reads.
    t0, t1, t2, t3 = theta[0], theta[1], theta[2], theta[3]
    g0 = g1 = g2 = g3 = 0.0
    h00 = h01 = h02 = h03 = h11 = h12 = h13 = h22 = h23 = h33 = 0.0
    data = 0.0
    size = 0.0
    outside = 0.0
    for q in range(len(base)):
        b0 = float(base[q, 0])
        b1 = float(base[q, 1])
        b2 = float(base[q, 2])
        raw = t0 * b0 + t1 * b1 + t2 * b2 + t3
        a = min(max(raw, 0.0), brightest)
        e1, d1, _, _ = _apply_curve(a * u[0, q] + v[0, q], knee, gain, table, end)
        e1 -= target[q]
        d1 *= u[0, q]
        # A single half stands for both.
        e2 = e1
        d2 = d1
        if last_half > 0:
            e2, d2, _, _ = _apply_curve(a * u[1, q] + v[1, q], knee, gain, table, end)
            e2 -= target[q]
            d2 *= u[1, q]
        # A bound that is met has no residual and no slope (Eq. M.9).
        if saturated[q]:
            if e1 > 0.0:
                e1 = 0.0
                d1 = 0.0
            if e2 > 0.0:
                e2 = 0.0
                d2 = 0.0
        product = e1 * e2
        modulus = abs(product)
        rho = 0.5 * trust[q] * c2 * np.log1p(modulus / c2)
        size += rho
        data += rho if product >= 0.0 else -rho
        w = trust[q] / (1.0 + modulus / c2)
        # First and second derivative by the albedo a of the pixel (Eq. M.8); a = (b, 1) . theta carries them to the four numbers.
        slope = 0.5 * w * (d1 * e2 + d2 * e1)
        bend = w * d1 * d2
        beyond = raw - a
        # A clamped albedo no longer moves the prediction, so the range term (Eq. M.11) replaces both derivatives.
        if beyond != 0.0:
            outside += 0.5 * box * beyond * beyond
            slope = box * beyond
            bend = box
        g0 += slope * b0
        g1 += slope * b1
        g2 += slope * b2
        g3 += slope
        h00 += bend * b0 * b0
        h01 += bend * b0 * b1
        h02 += bend * b0 * b2
        h03 += bend * b0
        h11 += bend * b1 * b1
        h12 += bend * b1 * b2
        h13 += bend * b1
        h22 += bend * b2 * b2
        h23 += bend * b2
        h33 += bend
    g[0], g[1], g[2], g[3] = g0, g1, g2, g3
    h[0, 0], h[1, 0], h[2, 0], h[3, 0] = h00, h01, h02, h03
    h[1, 1], h[2, 1], h[3, 1], h[2, 2], h[3, 2], h[3, 3] = h11, h12, h13, h22, h23, h33
    prior_cost = 0.0
    for i in range(4):
        away = theta[i] - middle[i]
        prior_cost += 0.5 * prior[i] * away * away
        g[i] += prior[i] * away
        h[i, i] += prior[i]
    return data + outside + prior_cost, data + prior_cost, size + prior_cost


@_inlined
def _solve(h, g, own, damping, lower, step):
    """Solve step = (H + damping diag H)^-1 g over the free numbers by Cholesky and return g' step.

    Only the lower triangle of H is read. H has no negative directions, because light and slopes of both halves are positive.
    """
    # Fixed numbers get rows of the identity, and step 0. The small terms keep a pivot positive where no pixel moves a number.
    for i in range(4):
        for j in range(i + 1):
            total = h[i, j] if own[i] and own[j] else (1.0 if i == j else 0.0)
            if i == j:
                total = total * (1.0 + damping) + 1e-12 * abs(total) + 1e-100
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                # Rounding can take a pivot below 0 where two columns are almost the same.
                lower[i, i] = np.sqrt(max(total, 1e-12 * abs(h[i, i]) + 1e-100))
            else:
                lower[i, j] = total / lower[j, j]
    # Forward and back substitution: L y = g, L' step = y.
    for i in range(4):
        total = g[i] if own[i] else 0.0
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for back in range(4):
        i = 3 - back
        total = step[i]
        for k in range(i + 1, 4):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    out = 0.0
    for i in range(4):
        if own[i]:
            out += g[i] * step[i]
    return out
