"""Compiled loops of the paper's loss, minimised directly; as `iif_core.fusion.kernels`, whose layouts they share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion.kernels import PIECE, _add, _compiled, _exact, _widen


@_exact
def choose(values: NDArray, chosen: NDArray, start: NDArray) -> NDArray:
    """Return the planes (5, n) float32 of the chosen predictions; `chosen` (S, 3) int64 of albedo, roughness, metallic."""
    out = np.empty((5, values.shape[2]), np.float32)
    bits = out.view(np.int32)
    for s in range(len(start) - 1):
        a, b = start[s], start[s + 1]
        for c in range(5):
            # max(c - 2, 0) is the property of a channel: 0 0 0 1 2.
            _widen(values[chosen[s, max(c - 2, 0)], c, a:b], bits[c, a:b], out[c, a:b], b - a)
    return out


@_compiled
def channel_moments(chosen: NDArray, target: NDArray, weight: NDArray, start: NDArray) -> tuple[NDArray, NDArray]:
    """Sum moments of the chosen predictions, each output channel with its own weights.

    Args:
        chosen, target, weight: (5, n) float32; start: (S + 1,) int64, first pixel of each segment.

    Returns:
        (S, 5, 10) float64 second moments: aa ab ac bb bc cc a b c 1 for the albedo channels, vv v 1 in the first three
        places for roughness and metallic; and (S, 5, 4) float64 products of [r g b 1] or [v 1] with the target.
    """
    second, first_ = np.zeros((len(start) - 1, 5, 10)), np.zeros((len(start) - 1, 5, 4))
    for s in range(len(start) - 1):
        for begin in range(start[s], start[s + 1], PIECE):
            end = min(begin + PIECE, start[s + 1])
            # Each channel weighs a pixel by its own distance (Eq. F.33), so even the channels of albedo have different Gram
            # matrices.
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
                _add(o, (aa, ab, ac, bb, bc, cc, sa, sb, sc, one))
                _add(q, (ta, tb, tc, td))
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
                _add(o, (vv, sv, one))
                _add(q, (tv, td))
    return second, first_
