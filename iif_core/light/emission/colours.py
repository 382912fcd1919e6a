"""Colours of lamps: light that people live by lies along one line of colours, from warm to cold
(docs/method/light.md#colours-of-lamps)."""

from __future__ import annotations

import numpy as np

AXES = np.array([[1.0, 0.0, -1.0], [-1.0, 2.0, -1.0]]) / np.sqrt([[2.0], [6.0]])
"""Directions of the logarithm of a colour: from cold to warm, and from magenta to green."""
SPREAD = np.array([0.5, 0.1])
"""Standard deviations of the lamps of a room along them: colour temperatures between 2700 and 6500 K spread by 0.5 along the
first; along the second daylight and lamps differ by less than a tenth."""
_DARK = 1e-100  # radiance up to which a lamp has no colour
_DARKEST = 1e-3  # of the brightest channel; darker ones have no logarithm
_ERRORS = 1e-3, 3.0  # relative errors beyond which a channel is known, or unknown


def likely_colours(radiance: np.ndarray, error: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Return the radiance of lamps with colours that are likely as well: the posterior mean, with the brightness kept.

    d_i = m + s^2 / (s^2 + e_i^2) (d_i - m)   along each of `AXES`

    of the logarithm of the radiance, with the spread s of lamps (`SPREAD`), the errors e_i, and the mean of the room's lamps,

    m = sum_i w_i d_i / (sum_i w_i + 1 / s^2),   w_i = (P_i / max P) / (s^2 + e_i^2),

    by power P and certainty. It is near white, too, because cameras balance what they photograph.

    Args:
        radiance: (G, 3) >= 0.
        error: (G, 3) standard errors.
        area: (G,) m^2.

    Returns:
        (G, 3) radiance with the mean of the channels that it had; lamps that are dark stay so.
    """
    out = np.array(radiance, np.float64)
    lit = out.max(1, initial=0.0) > _DARK
    if not lit.any():
        return out
    found = out[lit]
    found = np.maximum(found, _DARKEST * found.max(1, keepdims=True))
    with np.errstate(over="ignore"):  # an error beyond all numbers is unknown, too
        relative = np.clip(np.nan_to_num(error[lit] / found, nan=_ERRORS[1]), *_ERRORS)

    # -------- along each axis: the colour of each lamp, its error, and the mean of all --------
    colour, variance = np.log(found) @ AXES.T, relative**2 @ (AXES**2).T
    prior = SPREAD**2
    power = area[lit] * found.mean(1)
    weight = (power / max(power.max(), 1e-300))[:, None] / (prior + variance)
    mean = (weight * colour).sum(0) / (weight.sum(0) + 1.0 / prior)
    posterior = mean + prior / (prior + variance) * (colour - mean)

    likely = np.exp(posterior @ AXES)
    out[lit] = likely * (out[lit].mean(1, keepdims=True) / likely.mean(1, keepdims=True))
    return out
