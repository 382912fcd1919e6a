"""Two estimates of the brightness of each object, by the photographs and by the base texture, and what follows from both
(docs/method/fitting.md#two-estimates-of-a-level).

The photographs know the brightness of an object up to the error of the light there, the base up to the error of the predictions.
Both errors are learnt from the scene, unless the prior states how it errs. What the light is believed to err by is taken out
of it before the last descent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.fitting.pixels import Pixels, evaluate_clusters
from iif_core.fitting.problem import SHARED_LIGHT_ERROR, FitOptions
from iif_core.fitting.tone import Tone
from iif_core.numerics.color import srgb_from_linear
from iif_core.reflectance.material import BIASES, NUMBERS

_LARGEST_STEP = 1.5
"""Largest logarithm of a ratio that one linear step may report."""
_PSEUDO_PATCHES = 4.0
"""Weight of the room's error of light in the error of an object, in patches."""
_BASE_FACTOR, _BASE_FACTORS, _BASE_FACTOR_WIDTH = 1.4, np.geomspace(0.3, 6.0, 15) / 1.4, 0.4
"""The factor that is usual between the error of the base and the scatter of the predictions; values relative to it among which it
is sought; width (of the logarithm) of its prior."""
_LIGHT_FACTORS, _LIGHT_FACTOR, _LIGHT_FACTOR_WIDTH = np.geomspace(0.5, 4.0, 13), 1.5, 0.35
"""The same for the factor between the error that all pixels of an object share and its smooth part within the object."""
_PER_ROOT_MISFIT, _SHARED_LIGHT_ERRORS = 0.7, (0.03, 0.6)
"""`SHARED_LIGHT_ERROR` for a root mean square of 1 of what the light leaves unexplained; its limits."""
_OWN_SHARE = 0.8
"""Share of the stated error of the base that the light does not have too: only this part shows in a discrepancy."""
_BASE_OF_METAL, _LIGHT_ON_METAL, _NO_METAL = 0.6, 0.3, 1.0
"""Where the prior states its errors, those of a metal's base (a metal that reflects something dark looks like dark paint) and of
the light on it as a whole; and of the light on what was wrongly taken for one."""
_QUARTILES = 1.349
"""Distance of the quartiles of a normal distribution, in standard deviations."""
_MIDDLE_ALBEDO = 0.3
"""Albedo to which the room's scatter of predictions refers."""
UNKNOWN_SCATTER = 0.15
"""Scatter of predictions whose scatter is not known."""
_DARKEST_LEVEL = 0.01
"""Levels of the base below this count as this."""
_SMALLEST_ERROR = 0.02
"""Of the light on an object, as a logarithm."""
_DEGREES_OF_FREEDOM = 4.0
"""Of Student's t of both errors."""
_T_INTERVAL = 1.142
"""Half the width of the central 68 % interval of Student's t of four degrees of freedom, in units of its scale."""
_MOST_OBJECTS = 200
"""Objects from which the errors are learnt, the largest."""
_INTERVAL = (0.1587, 0.8413)
"""Shares of a normal distribution below one standard deviation either side."""
_NODES = np.sinh(np.linspace(-5.0, 5.0, 121)) / 2.0
"""Nodes of the quadrature around each of the two estimates, in units of its error."""


@dataclass(frozen=True)
class ObjectLevels:
    """Both estimates of the brightness of each object, and what follows.

    Attributes:
        base: (O, 3) mean base albedo; shown: (O, 3) the level that the photographs ask for.
        discrepancy: (O,) logarithm of the brightness that the photographs ask for over the brightness of the base.
        light_error, base_error: (O,) scale of the error of either estimate, as a logarithm.
        gain: (3,) mean of `shown` over `base`.
        light_gain: (O,) factor by which the light is brighter than computed, posterior mean (Eq. M.36).
        deviation: (O,) half the width of the central 68 % interval of its logarithm.
        pixels: (O,) usable pixels.
        is_divided: discrepancies were divided between both; otherwise the photographs alone tell the levels.
    """

    base: np.ndarray
    shown: np.ndarray
    discrepancy: np.ndarray
    light_error: np.ndarray
    base_error: np.ndarray
    gain: np.ndarray
    light_gain: np.ndarray
    deviation: np.ndarray
    pixels: np.ndarray
    is_divided: bool = True

    def facts(self) -> dict[str, object]:
        """Return both errors, root mean squares over the pixels, the mean square of the normalised discrepancy, and whether
        discrepancies were divided."""
        share = self.pixels / max(self.pixels.sum(), 1)
        # The variance of Student's t of four degrees of freedom is twice the square of its scale.
        away = self.discrepancy**2 / (2.0 * (self.light_error**2 + self.base_error**2))
        return {
            "base": float(np.sqrt(share @ self.base_error**2)),
            "light": float(np.sqrt(share @ self.light_error**2)),
            "normalised_discrepancy": float(share @ np.minimum(away, 10.0)),
            "divided": self.is_divided,
        }


def shared_light_error(misfit: float | None) -> float:
    """Return the error of the light on an object as a whole, as a logarithm, from the misfit of the light (Eq. L.40), None = not
    known."""
    if misfit is None or not np.isfinite(misfit):
        return SHARED_LIGHT_ERROR
    return float(np.clip(_PER_ROOT_MISFIT * np.sqrt(max(misfit, 0.0)), *_SHARED_LIGHT_ERRORS))


def prediction_scatter(
    affine: np.ndarray, weight: np.ndarray, object_of_segment: np.ndarray, mean_base: np.ndarray
) -> np.ndarray:
    """Return how far the predictions of each object are apart, as a standard deviation of log brightness (Eq. M.33).

    Args:
        affine: (S, K, 3, 4) maps that correct the predictions of each segment to the base.
        weight: (S,) weight of each segment, 0 = unused; object_of_segment: (S,); mean_base: (O, 3) mean base albedo.

    Returns:
        (O,); objects that few predictions show are drawn towards the median of the scene.
    """
    n = len(mean_base)
    base = np.maximum(mean_base, _DARKEST_LEVEL)[object_of_segment]
    # (S, K, 3): mean base albedo through the map that corrects each prediction to the base (Eq. M.33).
    moved = np.einsum("skci,si->skc", affine[..., :3], base) + affine[..., 3]
    if not len(affine):
        return np.full(n, UNKNOWN_SCATTER)
    # A map that brightens corrects a prediction that is too dark, hence the sign.
    away = -np.log(np.clip(moved.sum(2) / base.sum(1)[:, None], 0.2, 5.0))
    own, used = np.repeat(object_of_segment, affine.shape[1]), np.repeat(weight > 0, affine.shape[1])
    own, away = own[used], away.ravel()[used]
    # Quartiles of each object: sorted within the object, read at a quarter and three quarters of its count.
    order = np.lexsort((away, own))
    own, away = own[order], away[order]
    count = np.bincount(own, minlength=n)
    low = np.r_[0, np.cumsum(count)[:-1]]
    quarter, three = (away[np.minimum(low + (q * (count - 1)).astype(np.int64), max(len(away) - 1, 0))] for q in (0.25, 0.75))
    known = count > 2
    variance = np.where(known, ((three - quarter) / _QUARTILES) ** 2, 0.0)
    room = float(np.median(variance[known])) if known.any() else UNKNOWN_SCATTER**2
    freedom = np.where(known, count - 1.0, 0.0)
    return np.sqrt((_PSEUDO_PATCHES * room + freedom * variance) / (_PSEUDO_PATCHES + freedom))


def measure_levels(
    px: Pixels,
    affine: np.ndarray,
    tone: Tone,
    opt: FitOptions,
    mean_base: np.ndarray,
    scatter: np.ndarray,
    light_gain: np.ndarray,
    metal: np.ndarray | None = None,
) -> ObjectLevels:
    """Compare both estimates of each level and learn the error of each (Eq. M.32 to M.36).

    Of objects whose pixels are saturated the photographs tell no level: nothing is learnt from them, and their light is left
    alone.

    Args:
        px: pixels; affine: (O, 16) current numbers; tone: curve with the current response; opt: loss and limits.
        mean_base: (O, 3) mean base albedo; scatter: (O,) of the predictions (`prediction_scatter`), which counts where the prior
            does not state its errors.
        light_gain: (O,) factor on the light of each object that is in the exposure of `px`.
        metal: (O,) probability that what is taken for a metal is one, 0 for everything else; None = there is none.
    """
    n = px.n_objects
    base = np.maximum(np.asarray(mean_base, np.float64), _DARKEST_LEVEL)

    # -------- direction in which the brightness of a channel changes --------
    # `level` (O, 3) is the fitted albedo of the mean base colour. Multiplying a channel's row of [A | b] by s multiplies its
    # albedo by s, so the derivative of the numbers by ln s is the row itself.
    linear = affine[:, :12].reshape(n, 3, 4)[:, :, :3]
    level = np.maximum(np.einsum("oci,oi->oc", linear, base) + affine[:, BIASES], _DARKEST_LEVEL)
    rows = np.zeros((n, 3, NUMBERS))
    for c in range(3):
        rows[:, c, 4 * c : 4 * c + 4] = affine[:, 4 * c : 4 * c + 4]

    # -------- what the photographs ask for: Newton steps of ln s, by channel of an object and for each patch --------
    gradient, curvature = np.zeros((n, 3)), np.zeros((n, 3))
    clusters = len(px.starts) - 1
    step, weight = np.zeros(clusters), np.zeros(clusters)
    owner = np.repeat(np.arange(n), np.diff(px.first))
    for part, g, h in evaluate_clusters(px, affine, tone, opt):
        own = rows[owner[part]]
        # Gradient (k, 3) and system (k, 3, 3) of each patch along the logarithms of the three channels.
        slope = np.einsum("kcj,kj->kc", own, g[:, :NUMBERS])
        bend = np.einsum("kci,kij,kdj->kcd", own, h[:, :NUMBERS, :NUMBERS], own)
        np.add.at(gradient, owner[part], slope)
        np.add.at(curvature, owner[part], np.diagonal(bend, axis1=1, axis2=2))
        # All three channels by one factor: delta_k = -u_k / H_k of Eq. M.32.
        weight[part] = np.maximum(bend.sum((1, 2)), 0.0)
        step[part] = -slope.sum(1) / np.maximum(weight[part], 1e-100)

    # -------- both estimates compared --------
    away = np.clip(-gradient / np.maximum(curvature, 1e-100), -_LARGEST_STEP, _LARGEST_STEP)
    # Relative to the light as it was computed: the exposure of `px` holds `light_gain` already.
    shown = light_gain[:, None] * level * np.exp(away)
    is_told = px.unsaturated() >= opt.min_pixels
    pixels = np.where(is_told, px.usable, 0.0)
    smooth = _smooth_error_of_light(np.clip(step, -_LARGEST_STEP, _LARGEST_STEP), weight, owner, pixels)
    stated = None if opt.prediction_errors is None else opt.prediction_errors.brightness
    levels = compare_levels(base, shown, scatter, smooth, pixels, opt.base_tells_levels, stated, opt.light_error, metal)
    return replace(levels, light_gain=np.where(is_told, levels.light_gain, 1.0))


def _smooth_error_of_light(step: np.ndarray, weight: np.ndarray, owner: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return how much the logarithm of the photograph over the prediction varies smoothly over each object (Eq. M.32).

    That is the root of its covariance between patches that follow one another on the surface; noise and texture, which
    neighbouring patches do not share, are not in it. Objects of few patches are drawn towards the room.

    Args:
        step, weight: (C,) the logarithm in each patch, and its weight; owner: (C,) object, sorted; pixels: (O,).
    """
    n = len(pixels)
    filled = weight > 0
    step, weight, owner = step[filled], weight[filled], owner[filled]
    patches = np.bincount(owner, minlength=n)
    total = np.maximum(np.bincount(owner, weight, n), 1e-100)
    away = step - (np.bincount(owner, weight * step, n) / total)[owner]
    variance = np.bincount(owner, weight * away**2, n) / total * patches / np.maximum(patches - 1, 1)
    # Neighbours in the array are neighbours on the surface (`clusters.patches`); the last factor drops pairs across two objects.
    both = np.sqrt(weight[1:] * weight[:-1]) * (owner[1:] == owner[:-1])
    pairs = np.maximum(np.bincount(owner[1:], both, n), 1e-100)
    # The subtracted mean lowers the covariance by about the variance of the mean.
    shared = np.bincount(owner[1:], both * away[1:] * away[:-1], n) / pairs + variance / np.maximum(patches, 1)
    known = patches > 2
    share = np.where(known, pixels, 0.0)
    room = max(float(share @ shared / share.sum()) if share.sum() else UNKNOWN_SCATTER**2, 0.0)
    # Objects of few patches are drawn towards the room. Where light is even, noise may leave `shared` below 0.
    freedom = np.where(known, patches - 2.0, 0.0)
    return np.sqrt(np.maximum(_PSEUDO_PATCHES * room + freedom * shared, 0.0) / (_PSEUDO_PATCHES + freedom))


def relative_error_of_base(brightness: np.ndarray) -> np.ndarray:
    """Return the error of the logarithm of the brightness of the base, relative to that at an albedo of 0.3 (Eq. M.33)."""
    bright = np.clip(np.maximum(np.asarray(brightness, np.float64), _DARKEST_LEVEL), 0.0, 1.0)
    return srgb_from_linear(np.array(_MIDDLE_ALBEDO)) / srgb_from_linear(bright)


def compare_levels(
    base: np.ndarray,
    shown: np.ndarray,
    scatter: np.ndarray,
    smooth: np.ndarray,
    pixels: np.ndarray,
    base_tells_levels: bool = True,
    stated: float | None = None,
    shared: float = SHARED_LIGHT_ERROR,
    metal: np.ndarray | None = None,
) -> ObjectLevels:
    """Learn the errors of both estimates and divide each discrepancy between them (Eq. M.34 to M.36).

    Both errors follow Student's t. If two estimates disagree strongly, the one that claims the smaller error therefore prevails.

    Args:
        base: (O, 3) mean base albedo; shown: (O, 3) level that the photographs ask for.
        scatter: (O,) of the logarithm of the brightness over predictions; smooth: (O,) smooth error of the light.
        pixels: (O,) by which objects count.
        stated: error of the base for an albedo of 0.3 (`PredictionErrors.brightness`), and neither error is learnt; None = both
            are, by means of `scatter` and `smooth`.
        shared: error of the light on an object as a whole, where an error of the base is stated.
        metal: (O,) probability that what is taken for a metal is one, 0 for everything else, where an error of the base is
            stated; None = there is none.
        base_tells_levels: False = both errors are what is usual, no discrepancy is divided, and the light keeps its whole error.
    """
    pixels = pixels if pixels.any() else np.ones(len(pixels))
    base, shown, smooth = np.maximum(base, _DARKEST_LEVEL), np.maximum(shown, _DARKEST_LEVEL), np.maximum(smooth, _SMALLEST_ERROR)

    # -------- the usual error of the base (Eq. M.33) --------
    size = relative_error_of_base(base.mean(1))
    if stated is None:
        # Median over the pixels, so that many small objects do not decide.
        order = np.argsort(scatter / size)
        middle = (scatter / size)[order][np.searchsorted(np.cumsum(pixels[order]), 0.5 * pixels.sum())]
        usual = _BASE_FACTOR * np.maximum(middle, _SMALLEST_ERROR) * size
    else:
        usual = _OWN_SHARE * stated * size
        is_one = np.zeros(len(base)) if metal is None else metal
        usual = np.sqrt((1.0 - is_one) * usual**2 + is_one * np.maximum(usual, _BASE_OF_METAL) ** 2)

    # -------- factors kappa_B and kappa_L on both errors, from the scatter of the discrepancies (Eq. M.35) --------
    # `share` is w_o, `count` the effective number N of objects.
    some = np.argsort(-pixels, kind="stable")[:_MOST_OBJECTS]
    share = pixels[some] / max(pixels[some].sum(), 1e-100)
    count = 1.0 / max(float((share**2).sum()), 1e-100)
    best = (-np.inf, 1.0, _LIGHT_FACTOR, np.ones(3))
    is_learnt = base_tells_levels and stated is None
    of_object = np.zeros(len(base))
    if stated is not None:
        of_metal = is_one * _LIGHT_ON_METAL**2 + (1.0 - is_one) * _NO_METAL**2
        of_object = np.sqrt(shared**2 + np.where(is_one > 0, of_metal, 0.0))
    for of_base in _BASE_FACTORS if is_learnt else (1.0,):
        for of_light in _LIGHT_FACTORS if is_learnt else (_LIGHT_FACTOR,):
            own, light = of_base * usual[some], np.hypot(of_light * smooth[some], of_object[some])
            gain, away = _mean_gain(base[some], shown[some], share, np.hypot(own, light))
            # `usual` contains the factor 1.4 already, so `of_base` is relative to it.
            log_prior = -0.5 * (np.log(of_base) / _BASE_FACTOR_WIDTH) ** 2
            log_prior -= 0.5 * (np.log(of_light / _LIGHT_FACTOR) / _LIGHT_FACTOR_WIDTH) ** 2
            found = count * (share @ _divide(away, own, light)[0]) + log_prior
            if found > best[0]:
                best = (found, float(of_base), float(of_light), gain)
    _, of_base, of_light, gain = best

    # -------- what of each discrepancy belongs to the light (Eq. M.34, M.36) --------
    discrepancy = np.log(shown.sum(1) / (base @ gain))
    base_error, light_error = of_base * usual, np.hypot(of_light * smooth, of_object)
    if not base_tells_levels:
        found = np.ones(len(base)), _T_INTERVAL * light_error
        return ObjectLevels(base, shown, discrepancy, light_error, base_error, gain, *found, pixels, is_divided=False)
    _, mean, deviation = _divide(discrepancy, base_error, light_error)
    return ObjectLevels(base, shown, discrepancy, light_error, base_error, gain, np.exp(mean), deviation, pixels)


def _mean_gain(base: np.ndarray, shown: np.ndarray, share: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean gain (3,) and the logarithm of each object's brightness over it; robust against few large ones."""
    # Colour by the geometric mean of each channel; then one factor for all channels, so that the mean of `away` is 0.
    ratio = np.log(shown / base)
    weight = share / error**2
    for _ in range(8):
        gain = np.exp(weight @ ratio / weight.sum())
        away = np.log(shown.sum(1) / (base @ gain))
        # Student's weights, updated together with the gain: iteratively reweighted least squares.
        weight = share / error**2 * (_DEGREES_OF_FREEDOM + 1) / (_DEGREES_OF_FREEDOM + (away / error) ** 2)
        middle = weight @ away / weight.sum()
        gain, away = gain * np.exp(middle), away - middle
    return gain, away


def _divide(
    discrepancy: np.ndarray, base_error: np.ndarray, light_error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide d = error of the light - error of the base, both Student's t: log likelihood, mean of the light's part, and half
    the width of its central 68 % interval, each (O,), by quadrature."""
    # (O, 242) values of the light's error. The product of both densities has a peak near 0 and another near d where the estimates
    # disagree strongly, so nodes are dense around both.
    around_base = discrepancy[:, None] - base_error[:, None] * _NODES
    light = np.sort(np.concatenate([light_error[:, None] * _NODES, around_base], 1), 1)
    density = np.exp(_log_t(light, light_error[:, None]) + _log_t(discrepancy[:, None] - light, base_error[:, None]))
    step = np.diff(light, axis=1)
    weight = 0.5 * (np.pad(step, ((0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 1)))) * density
    total = np.maximum(weight.sum(1), 1e-300)
    mean = (weight * light).sum(1) / total
    # Tails hardly matter for an interval of 68 %, but they would for a standard deviation.
    below = (np.cumsum(weight, 1) - 0.5 * weight) / total[:, None]
    low, high = (_crossing(light, below, share) for share in _INTERVAL)
    return np.log(total), mean, 0.5 * (high - low)


def _crossing(x: np.ndarray, share: np.ndarray, level: float) -> np.ndarray:
    """Return where increasing shares (O, n) at increasing x (O, n) cross a level, (O,)."""
    row = np.arange(len(x))
    after = np.clip((share < level).sum(1), 1, x.shape[1] - 1)
    before = after - 1
    rise = np.maximum(share[row, after] - share[row, before], 1e-300)
    part = np.clip((level - share[row, before]) / rise, 0.0, 1.0)
    return x[row, before] + part * (x[row, after] - x[row, before])


def _log_t(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the log density of Student's t up to a constant."""
    return -np.log(scale) - 0.5 * (_DEGREES_OF_FREEDOM + 1) * np.log1p((x / scale) ** 2 / _DEGREES_OF_FREEDOM)


def gain_of_the_rest(levels: ObjectLevels, affine: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the gain (3,) of objects that were not fitted, and half the width of the 68 % interval of its logarithm.

    The interval is for one object: it covers the error of the base and the error of the mean.

    The gain is the mean brightness that fitted objects have relative to their base. The gains of their affines would not do:
    they trade with offsets.

    Args:
        levels: both estimates of the fitted objects; affine: (O, 16) their numbers.
    """
    linear = affine[:, :12].reshape(-1, 3, 4)[:, :, :3]
    fitted = np.maximum(np.einsum("oci,oi->oc", linear, levels.base) + affine[:, BIASES], _DARKEST_LEVEL)
    share = levels.pixels / max(levels.pixels.sum(), 1e-100)
    error = np.hypot(levels.base_error, levels.light_error)
    gain, _ = _mean_gain(levels.base, fitted, share, error)
    weight = share / error**2
    # Standard error of the weighted mean, errors of the objects taken as independent.
    of_mean = np.sqrt(weight**2 @ error**2) / max(weight.sum(), 1e-100)
    return gain, _T_INTERVAL * float(np.hypot(np.sqrt(share @ levels.base_error**2), of_mean))


def light_scatter(levels: ObjectLevels, system: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Return the covariance (O, 16, 16) that the error of the light on each object adds to the gradient (Eq. M.37).

    Args:
        levels: both estimates; system: (O, 16, 16) Gauss-Newton system of the data at the solution; affine: (O, 16).
    """
    # Light that is too bright by exp(d) asks for all albedo numbers times exp(-d); to first order it moves the gradient by H
    # theta_A d.
    brighter = np.where(np.arange(NUMBERS) < 12, affine, 0.0)
    moved = np.einsum("oij,oj->oi", system, brighter)
    return levels.deviation[:, None, None] ** 2 * moved[:, :, None] * moved[:, None, :]


def level_deviation(affine: np.ndarray, covariance: np.ndarray, mean_base: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the logarithm of the brightness of each object, (O,); 0 where it has no albedo.

    Args:
        affine: (O, 16) numbers; covariance: (O, 16, 16) of them; mean_base: (O, 3) mean base albedo.
    """
    # The brightness is row . theta, linear in the numbers; to first order its logarithm has its relative deviation.
    row = np.zeros((len(affine), NUMBERS))
    for c in range(3):
        row[:, 4 * c : 4 * c + 3], row[:, 4 * c + 3] = mean_base, 1.0
    brightness = np.einsum("oi,oi->o", row, affine)
    variance = np.maximum(np.einsum("oi,oij,oj->o", row, covariance, row), 0.0)
    return np.where(brightness > 0, np.sqrt(variance) / np.maximum(brightness, 1e-12), 0.0)
