"""Compiled loop of the profile: the albedo numbers of one object at one roughness and one metalness.

With both held, a pixel shows e L = a U + V in each channel, U = e ((1 - m) D + m S0), V = e (0.04 (1 - m) S0 + S1): the three
channels part, and each is a problem of at most four numbers over numbers that are at hand. Descended one object and channel at a
time: an object's pixels stay in the cache of the processor. Order of the sums: as in `kernels`.
"""

from __future__ import annotations

import numpy as np

from iif_core.fitting.kernels import _bracket, _compiled, _inlined, _shine, _tone

_DAMPED = 1e-3  # Levenberg-Marquardt's first damping


@_compiled
def fit_albedo(
    base,
    diffuse,
    lobes,
    levels,
    target,
    exposure,
    saturated,
    trust,
    offsets,  # (O + 1,) first pixel of each object
    knee,
    gain,
    curve,
    ends,
    robust_width,
    brightest,
    box,
    free,  # (O, 12) bool
    centre,  # (O, 12) and
    weight,  # (O, 12), of the pull
    metallic,  # (2,) gain and bias
    roughness,  # negative: no lobe at all
    steps,
    tolerance,
    objects,
    affine,  # (O, 12) from where, and where it ends
    cost,  # (O,) data term and pull there
):
    """Damped Gauss-Newton of the albedo of some objects; `affine` and `cost` are written."""
    halves = diffuse.shape[1]
    most = 0
    for x in range(len(objects)):
        most = max(most, offsets[objects[x] + 1] - offsets[objects[x]])
    u = np.zeros((3, halves, most))
    v = np.zeros((3, halves, most))
    g = np.zeros(4)
    h = np.zeros((4, 4))
    new_g = np.zeros(4)
    new_h = np.zeros((4, 4))
    lower = np.zeros((4, 4))
    theta = np.zeros(4)
    tried = np.zeros(4)
    j, weights, _ = _bracket(levels, max(roughness, 0.02))
    shine = np.zeros(lobes.shape[3])
    for x in range(len(objects)):
        o = objects[x]
        low = offsets[o]
        n = offsets[o + 1] - low
        cost[o] = 0.0
        for q in range(n):
            p = low + q
            m = min(max(metallic[0] * base[p, 4] + metallic[1], 0.0), 1.0)
            if roughness >= 0.0:
                _shine(lobes[p], j, weights, shine)
            for half in range(halves):
                for c in range(3):
                    s0 = shine[6 * half + c]
                    u[c, half, q] = exposure[p] * ((1.0 - m) * diffuse[p, half, c] + m * s0)
                    v[c, half, q] = exposure[p] * (0.04 * (1.0 - m) * s0 + shine[6 * half + 3 + c])
        for c in range(3):
            own = free[o, 4 * c : 4 * c + 4]
            middle = centre[o, 4 * c : 4 * c + 4]
            pull = weight[o, 4 * c : 4 * c + 4]
            given = (
                base[low : low + n],
                u[c],
                v[c],
                target[low : low + n, c],
                saturated[low : low + n, c],
                trust[low : low + n, c],
            )
            curves = (knee, gain, curve[c], ends[c, 0], robust_width, brightest, box)
            for i in range(4):
                theta[i] = affine[o, 4 * c + i]
            total, shown, size = _system(theta, given, curves, own, middle, pull, g, h)
            damping = _DAMPED
            for _ in range(steps):
                expected = _solve(h, g, own, damping, lower, tried)
                if 0.5 * expected <= tolerance * size:
                    break
                for i in range(4):
                    tried[i] = theta[i] - tried[i]
                new_total, new_shown, new_size = _system(tried, given, curves, own, middle, pull, new_g, new_h)
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
def _system(theta, given, curves, own, middle, pull, g, h):
    """Objective, its data term with the pull, and its size at theta (4,); gradient and curvature into g, h."""
    base, u, v, target, saturated, trust = given
    knee, gain, curve, end, robust_width, brightest, box = curves
    c2 = robust_width * robust_width
    last_half = len(u) - 1
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
        e1, d1, _, _ = _tone(a * u[0, q] + v[0, q], knee, gain, curve, end)
        e1 -= target[q]
        d1 *= u[0, q]
        e2 = e1
        d2 = d1
        if last_half > 0:
            e2, d2, _, _ = _tone(a * u[1, q] + v[1, q], knee, gain, curve, end)
            e2 -= target[q]
            d2 *= u[1, q]
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
        slope = 0.5 * w * (d1 * e2 + d2 * e1)
        bend = w * d1 * d2
        beyond = raw - a
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
    leaned = 0.0
    for i in range(4):
        away = theta[i] - middle[i]
        leaned += 0.5 * pull[i] * away * away
        g[i] += pull[i] * away
        h[i, i] += pull[i]
    return data + outside + leaned, data + leaned, size + leaned


@_inlined
def _solve(h, g, own, damping, lower, step):
    """step = (H + damping diag H)^-1 g over the free numbers, by Cholesky; returns g' step. H is read below its diagonal.
    It has no negative directions: light and slopes of both halves are positive."""
    for i in range(4):
        for j in range(i + 1):
            total = h[i, j] if own[i] and own[j] else (1.0 if i == j else 0.0)
            if i == j:
                total = total * (1.0 + damping) + 1e-12 * abs(total) + 1e-100
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = np.sqrt(max(total, 1e-12 * abs(h[i, i]) + 1e-100))
            else:
                lower[i, j] = total / lower[j, j]
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
