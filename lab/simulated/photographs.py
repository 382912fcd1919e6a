"""Simulated photographs: rendered radiance through exposure, response curve and eight bits (Eq. C.34).

The S-shaped curves (Eq. C.35) belong to none of the families that the solver fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import luminance, srgb_from_linear

STOPS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Exposures of the five groups of views, brightest group first (lab/docs/simulated.md#photographs)."""

_THIRD = 2.0 ** (-1 / 3)


@dataclass(frozen=True)
class ResponseCurve:
    """f_c(x) = y + s_c y (1 - y) (2 y - p_c), y = sRGB(x^g_c): an S-curve of strength s and pivot p (Eq. C.35).

    It increases strictly from f(0) = 0 to f(1) = 1 for s_c max(p_c, 2 - p_c) < 1, which is checked.

    Attributes:
        name: name for `response_curve`.
        gamma, strength, pivot: one value per channel; gamma 1 and strength 0 give sRGB itself.
        linear: use y = x^g without sRGB, for a camera that stores radiance.
    """

    name: str
    gamma: tuple[float, float, float] = (1.0, 1.0, 1.0)
    strength: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pivot: tuple[float, float, float] = (1.0, 1.0, 1.0)
    linear: bool = False

    def __post_init__(self) -> None:
        steep = [s * max(p, 2 - p) for s, p in zip(self.strength, self.pivot, strict=True)]
        if min(self.gamma) <= 0 or min(self.strength) < 0 or max(steep) >= 1:
            raise InputError(
                f"response {self.name}: gamma {self.gamma}, strength {self.strength}, pivot {self.pivot}"
                " does not rise; needed: gamma > 0, strength >= 0, strength * max(pivot, 2 - pivot) < 1"
            )

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Sensor values in [0, 1] of exposed radiance x (..., 3), clipped to [0, 1]; float64."""
        y = np.clip(np.asarray(x, np.float64), 0, 1) ** np.array(self.gamma)
        if not self.linear:
            y = srgb_from_linear(y)
        return y + np.array(self.strength) * y * (1 - y) * (2 * y - np.array(self.pivot))

    def samples(self, count: int = 101) -> np.ndarray:
        """f at `count` even steps from 0 to 1, (3, count) float64."""
        return self(np.linspace(0, 1, count)[:, None] * np.ones(3)).T


_CURVES = {
    curve.name: curve
    for curve in (
        ResponseCurve("filmic", (1.0, 0.97, 1.04), (0.42, 0.38, 0.46), (1.05, 1.0, 0.95)),
        ResponseCurve("soft", (0.92, 0.94, 0.90), (0.18, 0.20, 0.16), (0.85, 0.90, 0.80)),
        ResponseCurve("srgb"),
        ResponseCurve("linear", linear=True),
    )
}


def response_curve(name: str = "filmic") -> ResponseCurve:
    """Look up a response by name: `filmic` and `soft` differ between channels; `srgb`; `linear`.

    Raises:
        InputError: unknown name.
    """
    if name not in _CURVES:
        raise InputError(f"response curve {name!r}: unknown; allowed: {', '.join(_CURVES)}")
    return _CURVES[name]


def exposures(
    radiance: Sequence[np.ndarray] | np.ndarray,
    valid: Sequence[np.ndarray] | np.ndarray | None = None,
    stops: Sequence[float] = STOPS,
    grey: float = 0.18,
    saturated: float = 0.03,
    used: Sequence[bool] | np.ndarray | None = None,
) -> np.ndarray:
    """Choose the exposure of every view, shorter for brighter views.

    Views are sorted by the mean luminance of their valid pixels and cut into len(stops) groups of nearly equal size, the
    brightest group with stops[0]. One common gain puts the geometric mean over views of stop x median luminance at `grey`. A
    view with more than the share `saturated` of its valid pixels above 1 in any channel is then reduced by whole thirds of
    a stop. A black view keeps the exposure of its group. A held-out view has no say in groups and gain; it joins the group of the
    next darker view that is used.

    Args:
        radiance: linear radiance, one (..., 3) array per view, or one stack (V, ..., 3), or mean radiances (V, 3).
        valid: masks (...) of the pixels that should not clip, i.e. neither lamps nor windows; all if None.
        stops: relative exposures of the groups, ascending, positive.
        grey: linear value of the median luminance of a typical view.
        saturated: share of pixels in [0, 1).
        used: (V,) views that are not held out; all if None.

    Returns:
        (V,) float64, the factors that multiply radiance before the response.

    Raises:
        InputError: no view, none used, shapes that do not match, negative or non-finite radiance, stops not ascending.
    """
    views = [np.asarray(r, np.float64) for r in radiance]
    if not views:
        raise InputError("exposures: no view given; at least one is needed")
    stops = np.asarray(stops, np.float64)
    if stops.ndim != 1 or not len(stops) or not (stops > 0).all() or (np.diff(stops) < 0).any():
        raise InputError(f"exposures: stops {stops.tolist()}; they must be positive and ascending")
    if not (grey > 0 and 0 <= saturated < 1):
        raise InputError(f"exposures: grey={grey}, saturated={saturated}; allowed: grey > 0, 0 <= saturated < 1")
    pixels = [_valid_pixels(v, r, None if valid is None else valid[v]) for v, r in enumerate(views)]

    bright = [luminance(p) for p in pixels]
    mean = np.array([y.mean() if len(y) else 0.0 for y in bright])
    median = np.array([np.median(y) if len(y) else 0.0 for y in bright])
    own = np.ones(len(views), bool) if used is None else np.asarray(used, bool)
    count = np.count_nonzero(own)
    if not count:
        raise InputError("exposures: every view is held out; at least one must be used")
    darkness = np.sort(-mean[own])
    rank = np.minimum(np.searchsorted(darkness, -mean), count - 1)
    rank[np.flatnonzero(own)[np.argsort(-mean[own], kind="stable")]] = np.arange(count)
    stop = stops[rank * len(stops) // count] if count > 1 else np.full(len(views), np.median(stops))
    lit = own & (median > 0)
    gain = grey / np.exp(np.mean(np.log(stop[lit] * median[lit]))) if lit.any() else 1.0
    return gain * stop * np.array([_closing(gain * s, p, saturated) for s, p in zip(stop, pixels, strict=True)])


def _valid_pixels(view: int, radiance: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    if radiance.ndim < 1 or radiance.shape[-1] != 3:
        raise InputError(f"exposures: view {view} has shape {radiance.shape}; the last axis must be R, G, B")
    if not np.isfinite(radiance).all() or (radiance < 0).any():
        raise InputError(f"exposures: view {view} has negative or non-finite radiance; render it again or mask it to 0")
    flat = radiance.reshape(-1, 3)
    if mask is None:
        return flat
    mask = np.asarray(mask, bool)
    if mask.shape != radiance.shape[:-1]:
        raise InputError(f"exposures: view {view}: mask of shape {mask.shape} for radiance of shape {radiance.shape}")
    return flat[mask.ravel()]


def _closing(exposure: float, pixels: np.ndarray, saturated: float) -> float:
    """Factor 2^(-n/3) with the smallest n >= 0 such that at most the share `saturated` of the pixels exceeds 1."""
    if not len(pixels):
        return 1.0
    peak = np.sort(pixels.max(-1))
    limit = exposure * peak[len(peak) - 1 - int(saturated * len(peak))]
    return _THIRD ** max(0, np.ceil(3 * np.log2(limit) - 1e-9)) if limit > 1 else 1.0


def expose(radiance: np.ndarray, exposure: float, curve: Callable[[np.ndarray], np.ndarray] | None = None) -> np.ndarray:
    """Simulate a photograph of linear radiance (..., 3) without sensor noise (Eq. C.34): float32 multiples of 1 / 255.

    `curve` is a `ResponseCurve` or any function of (..., 3) into [0, 1]; `response_curve()` if None.

    Raises:
        InputError: exposure not positive and finite, or non-finite radiance.
    """
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure is {exposure}; it must be positive and finite")
    radiance = np.asarray(radiance, np.float64)
    if not np.isfinite(radiance).all():
        raise InputError(f"{np.count_nonzero(~np.isfinite(radiance))} non-finite radiance values; nothing to photograph")
    curve = response_curve() if curve is None else curve
    return (np.rint(255 * curve(np.clip(exposure * radiance, 0, 1))) / 255).astype(np.float32)
