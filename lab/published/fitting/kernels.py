"""Compiled loop of the descent on the paper's loss; the model of a pixel is that of `iif_core.fitting.kernels`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fitting.kernels import (
    Penalties,
    PixelArrays,
    ResponseTables,
    _apply_curve,
    _by_param,
    _compiled,
    _interpolate_lobes,
    _interpolation_weights,
)


@_compiled
def gradient(pixels: PixelArrays, tone: ResponseTables, penalties: Penalties, affine: NDArray, rows: NDArray, g: NDArray) -> None:
    """Sum the gradient of the paper's loss over some pixels: (sum over channels of e^2) / 3 + w_r (1 - r) + w_m m (Eq. M.45).

    Args:
        pixels: with one half of the cache; tone, penalties: the problem.
        affine: (O, 16) float64 numbers of the objects.
        rows: indices of the pixels.
        g: (O, 16 + P) to which the gradient is added.
    """
    base, diffuse, lobes, target, saturated = pixels.base, pixels.diffuse, pixels.lobes, pixels.target, pixels.saturated
    curve, ends = tone.curve, tone.ends
    per = tone.by_params.shape[2]
    value = np.zeros(5)
    is_free = np.zeros(5)
    lobe = np.zeros(6)
    lobe_slope = np.zeros(6)
    for row in range(len(rows)):
        p = rows[row]
        o = pixels.obj[p]
        t = affine[o]
        b = base[p]
        for i in range(5):
            if i < 3:
                raw = t[4 * i] * b[0] + t[4 * i + 1] * b[1] + t[4 * i + 2] * b[2] + t[4 * i + 3]
            else:
                raw = t[6 + 2 * i] * b[i] + t[7 + 2 * i]
            # This optimiser clamps albedos at 1 and has no range term (Eq. M.11), so a clamped value has no gradient.
            value[i] = min(max(raw, 0.02 if i == 3 else 0.0), 1.0)
            is_free[i] = 1.0 if raw == value[i] else 0.0
        r = value[3]
        m = value[4]
        j, of_value, of_slope = _interpolation_weights(pixels.levels, r)
        _interpolate_lobes(lobes[p], j, of_value, lobe)
        _interpolate_lobes(lobes[p], j, of_slope, lobe_slope)
        e = pixels.exposure[p]
        # All channels share roughness and metallic: their slopes are added up and applied after the loop.
        slope_r = -penalties.roughness_weight
        slope_m = penalties.metallic_weight
        for c in range(3):
            a = value[c]
            ks = 0.04 * (1.0 - m) + m * a
            d = float(diffuse[p, 0, c])
            s0, s1 = lobe[c], lobe[3 + c]
            x_shown = e * ((1.0 - m) * a * d + ks * s0 + s1)
            f, df, node, part = _apply_curve(x_shown, tone.knee, tone.gain, curve[c], ends[c, 0])
            error = f - target[p, c]
            if saturated[p, c] and error > 0.0:
                continue
            # Derivative of error^2 / 3, because Eq. M.45 takes the mean over the channels.
            by_value = 2.0 / 3.0 * error
            slope = by_value * df * e
            da = slope * ((1.0 - m) * d + m * s0) * is_free[c]
            g[o, 4 * c] += da * b[0]
            g[o, 4 * c + 1] += da * b[1]
            g[o, 4 * c + 2] += da * b[2]
            g[o, 4 * c + 3] += da
            slope_r += slope * (ks * lobe_slope[c] + lobe_slope[3 + c])
            slope_m += slope * (-a * d + (a - 0.04) * s0)
            at = 16 + (c * per if tone.per_channel else 0)
            for i in range(per):
                g[o, at + i] += by_value * _by_param(tone, c, node, part, i)
        g[o, 12] += slope_r * b[3] * is_free[3]
        g[o, 13] += slope_r * is_free[3]
        g[o, 14] += slope_m * b[4] * is_free[4]
        g[o, 15] += slope_m * is_free[4]
