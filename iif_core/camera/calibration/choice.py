"""Choice among families of response curves (Eq. C.24), with the exposures given or estimated along with the curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.calibration.likelihood import maximise
from iif_core.camera.calibration.rows import (
    MAX_ROWS,
    MIN_STOPS,
    MIN_VALUE,
    Channel,
    channel_rows,
    concatenate_channels,
    log_factor,
)
from iif_core.camera.gains import CameraGains, GainRows, choose_gains, estimate
from iif_core.camera.overlap import PatchRows
from iif_core.camera.response import SATURATION, START, Response, response, sampled_response

CANDIDATES = ("srgb", "gamma", "ggcm", "spline")
"""Families that `auto` compares, smallest first."""
GAUGE = (
    "exposures were found together with the response: any power p of the exposures goes with f(x^(1 / p)) and fits as well;"
    " the power is the one of a curve near sRGB"
)
STATED = "exposures were found together with the response; their power is that of the exposures that the photographs' files state"
USUAL_POWER = 0.1
"""Standard deviation over cameras of the power that is left open, as found near sRGB."""
STATED_ERROR = 0.07
"""Error of a stated exposure, as a logarithm, before any was compared; it counts as `_PSEUDO_STATED` photographs."""
_PSEUDO_STATED = 4.0
_SURE_POWER = 0.06  # error of a power from stated exposures up to which it is said to be theirs
_FEWEST_STATED = 4  # photographs that state an exposure
_POWERS = 0.5, 2.0  # that a camera may have
_SAME_POWER = 0.01  # from 1, up to which a curve is left alone
_SAMPLES = 1024  # of a curve that is a power of another
_ROUNDS = 10  # of the robust line through stated and found exposures
_SIGNIFICANT = 2.0  # standard errors
_MIN_ROWS = 200  # to fit a curve
_SIGMA = 1.0  # standard deviation of a parameter around its start
_CHANNEL_SIGMA = 0.05  # standard deviation of a parameter of one channel around its value in the common curve


@dataclass(frozen=True)
class Fitted:
    """One candidate.

    Attributes:
        response: parameters (3, P), one row per channel.
        covariance: (3 P, 3 P) of the parameters row by row.
        score: log likelihood less the price of the parameters (Eq. C.22).
        clusters: (L,) log likelihood of every cluster.
        width: robust spread of n.
    """

    response: Response
    covariance: np.ndarray
    score: float
    clusters: np.ndarray
    width: float


@dataclass(frozen=True)
class CalibratedResponse:
    """Result of `calibrate_response`.

    Attributes:
        response: chosen curve, (3, P); the start if the data are insufficient.
        covariance: (3 P, 3 P) of its parameters; the prior's covariance if the data are insufficient.
        stops: largest difference of exposure within a patch, in stops.
        rows: (patch, view, channel) rows used.
        before, after: robust spread of log radiance within patches with the starting curve and with the chosen one.
        candidates: {family, parameters, score, behind, error} each; `behind` is the distance to the best score.
        reason: why this curve was chosen, as text.
        exposure: (V,) of the views, given or estimated (mean over the channels).
        gauge: what cannot be determined, as text; empty with given exposures.
        gains: exposure, white balance and vignetting estimated with the curve; None where exposures are given.
    """

    response: Response
    covariance: np.ndarray
    stops: float
    rows: int
    before: float
    after: float
    candidates: list[dict[str, object]]
    reason: str
    exposure: np.ndarray
    gauge: str = ""
    gains: CameraGains | None = None


def calibrate_response(
    rows: PatchRows,
    exposure: np.ndarray,
    families: Sequence[str] = CANDIDATES,
    saturation: float = SATURATION,
    given: bool = True,
    stated: np.ndarray | None = None,
) -> CalibratedResponse:
    """Fit all families and choose the smallest one that no other beats significantly (Eq. C.24).

    Args:
        rows: `overlap.patch_rows` of all views.
        exposure: (V,) of the views, known up to one factor; only their mean is used unless `given`.
        families: candidates, smallest first. Families without parameters are compared as they are.
        saturation: sensor values from here on are bounds.
        given: exposures are known; otherwise they are estimated together with each candidate.
        stated: (V,) exposures that the files of the photographs state, up to one factor, NaN = none; they tell the power of
            exposures that are not given (docs/method/camera.md#stated-exposures). None: no file states one.

    Returns:
        The chosen curve; the start of the first family if the data are insufficient.
    """
    if not needs_rows(families):
        start = response(families[0])
        reason = "photographs are linear radiance" if start.family == "identity" else "set to srgb"
        return given_response(start, reason, exposure)
    gains, power = CameraGains.plain(exposure), None
    if not given:
        gains = _gains(rows, response(families[0]), gains)
        power = StatedPower.of(gains, stated)
        gains = power.forced(gains)
    channels = [channel_rows(rows, c, gains, saturation) for c in range(3)]
    enough = [c for c in range(3) if len(channels[c].cell) >= _MIN_ROWS]
    stops = max(channel.stops for channel in channels)
    if not enough:
        most = max(len(c.cell) for c in channels)
        plain = gains if given else _gains(rows, response(families[0]), CameraGains.plain(exposure), choose=True)
        return _of_power(_unknown(families[0], stops, most, plain, given), power)
    common = concatenate_channels([channel_rows(rows, c, gains, saturation, MAX_ROWS // len(enough)) for c in enough])
    if not given:
        # The terms of the gains are chosen under the richest curve, fitted with one gain per view: under a wrong curve,
        # channels of different brightness seem to need gains of their own.
        rich = _fit(families[-1], common, channels, enough).response
        gains = _gains(rows, rich, gains, choose=True, power=power)
        logs = log_factor(rows, gains)
        common, channels = common.exposed(logs), [channel.exposed(logs) for channel in channels]
    fits, found = [], []
    for family in families:
        fit, views = _fit(family, common, channels, enough), gains
        if not given:  # the gains under this curve, and the curve under these gains
            # A curve without parameters cannot follow a power; it gets its own at the end, which fits as well.
            views = _gains(rows, fit.response, gains, power=power if START[family] else None)
            logs = log_factor(rows, views)
            fit = _fit(family, common.exposed(logs), [channel.exposed(logs) for channel in channels], enough)
        fits.append(fit)
        found.append(views)
    table, best = _compared(families, fits)
    chosen = next(i for i, entry in enumerate(table) if entry["behind"] <= _SIGNIFICANT * entry["error"])
    # No rounds: the noise under the starting curve alone, for comparison.
    before = maximise(common, response(families[chosen]), np.array(START[families[chosen]]), _SIGMA, 0)
    used = sum(len(channels[c].cell) + len(channels[c].full) for c in enough)
    views = found[chosen]
    out = CalibratedResponse(
        fits[chosen].response,
        fits[chosen].covariance,
        stops,
        used,
        before.width,
        fits[chosen].width,
        table,
        _because(table, chosen, best, used, stops),
        views.exposure,
        "" if given else STATED if power is not None and power.is_sure else GAUGE,
        None if given else views,
    )
    return out if START[families[chosen]] else _of_power(out, power)


def candidates(setting: str, dynamic_range: str) -> tuple[str, ...]:
    """Families that a setting allows: `identity` for HDR in any case; all of `CANDIDATES` for `auto` and LDR."""
    if dynamic_range == "hdr":
        return ("identity",)
    return CANDIDATES if setting == "auto" else (setting,)


def needs_rows(families: Sequence[str]) -> bool:
    """Whether there is a family to choose or a parameter to fit."""
    return len(families) > 1 or bool(START[families[0]])


def given_response(curve: Response, reason: str, exposure: np.ndarray) -> CalibratedResponse:
    """Result for a response that is not fitted."""
    size = curve.params.size
    return CalibratedResponse(curve, np.zeros((size, size)), 0.0, 0, 0.0, 0.0, [], reason, np.asarray(exposure, np.float64))


def calibration_facts(found: CalibratedResponse) -> dict[str, object]:
    """Convert the outcome of the choice to plain values for a JSON file."""
    names = ("stops", "rows", "before", "after", "candidates", "reason", "gauge")
    return {"covariance": found.covariance.tolist(), **{name: getattr(found, name) for name in names}}


def gain_rows(rows: PatchRows, curve: Response) -> GainRows:
    """Convert rows for `gains`: linear under a curve; saturated and dark values become NaN."""
    values = curve.inverse(np.where(rows.clipped | ~(rows.value > MIN_VALUE), np.nan, rows.value))
    radius2 = np.zeros(len(rows.view)) if rows.radius2 is None else rows.radius2
    return GainRows(rows.patch.astype(np.int64), rows.view, values, radius2, rows.block)


def _gains(
    rows: PatchRows, curve: Response, start: CameraGains, choose: bool = False, power: StatedPower | None = None
) -> CameraGains:
    """Gains under a curve, scaled to the mean exposure of `start`.

    With `choose`, the terms of the model that held-out surface supports; otherwise those that `start` was found to need, or
    exposure and vignetting if it has no evidence. The undetermined power is one for all channels (Eq. C.28), and that of stated
    exposures if there is one.
    """
    linear, n_views = gain_rows(rows, curve).thinned(), len(start.gain)
    if choose:
        found = choose_gains(linear, n_views)
    else:
        terms = {name: entry.included for name, entry in start.evidence.items()} or {"white_balance": False}
        found = replace(estimate(linear, n_views, **terms), evidence=start.evidence)
    found = replace(found, gain=_without_powers(found.gain, found.estimated))
    found = power.forced(found) if power is not None else found
    known = start.exposure[np.isfinite(start.exposure) & (start.exposure > 0)]
    mean = float(np.exp(np.mean(np.log(known)))) if len(known) else 1.0
    return replace(found, gain=found.gain * mean)


@dataclass(frozen=True)
class StatedPower:
    """What stated exposures tell of the power of those that are found (docs/method/camera.md#stated-exposures).

    Attributes:
        stated: (V,) up to one factor, NaN = none; None: no file states one.
        power: of the found over the stated exposures with a curve near sRGB; error: its standard error, infinite = not told.
    """

    stated: np.ndarray | None
    power: float = 1.0
    error: float = np.inf

    @classmethod
    def of(cls, found: CameraGains, stated: np.ndarray | None) -> StatedPower:
        """Compare gains that were found with a curve near sRGB."""
        return cls(None) if stated is None else cls(stated, *_line(found, stated))

    @property
    def is_sure(self) -> bool:
        return self.error <= _SURE_POWER

    @property
    def believed(self) -> float:
        """Posterior mean of the power, cameras differing by `USUAL_POWER`; 1 where nothing is told."""
        if not np.isfinite(self.error):
            return 1.0
        return 1.0 + (self.power - 1.0) * USUAL_POWER**2 / (USUAL_POWER**2 + self.error**2)

    def forced(self, found: CameraGains) -> CameraGains:
        """Return the gains raised to the power at which their slope on the stated exposures is `power` over `believed`, whatever
        the curve is with which they were found."""
        if not np.isfinite(self.error):
            return found
        slope, error = _line(found, self.stated)
        return found.raised(self.power / self.believed / slope) if np.isfinite(error) else found


def _line(found: CameraGains, stated: np.ndarray | None) -> tuple[float, float]:
    assert stated is not None
    return power_of_exposures(found.exposure, np.where(found.estimated, stated, np.nan), found.group)


def power_of_exposures(found: np.ndarray, stated: np.ndarray, group: np.ndarray | None = None) -> tuple[float, float]:
    """Return the slope q of ln found_v = q ln stated_v + c_g and its standard error
    (docs/method/camera.md#stated-exposures).

    The line is robust (Student's t of four degrees of freedom): a phone that merges several pictures states the time of one.

    Args:
        found: (V,) exposures > 0; stated: (V,) up to one factor, NaN = none.
        group: (V,) of views that are known relative to one another, each of which has a constant c_g of its own; None: all are.

    Returns:
        (1, infinite) with fewer than `_FEWEST_STATED` of them, if all that are stated in a group are the same, or if the slope is
        no power of a camera: what is stated then belongs to other photographs.
    """
    use = np.isfinite(stated) & np.isfinite(found) & (np.nan_to_num(stated) > 0) & (found > 0)
    own = np.zeros(int(use.sum()), np.int64) if group is None else np.unique(group[use], return_inverse=True)[1]
    count, groups = len(own), int(own.max(initial=-1)) + 1
    if count < _FEWEST_STATED or count - groups < 2:
        return 1.0, np.inf
    x, y = np.log(stated[use].astype(np.float64)), np.log(found[use].astype(np.float64))
    weight = np.ones(count)

    def centred(values: np.ndarray) -> np.ndarray:
        return values - (np.bincount(own, weight * values, groups) / np.bincount(own, weight, groups))[own]

    for _ in range(_ROUNDS):
        x0, y0 = centred(x), centred(y)
        spread = float(weight @ x0**2)
        if spread < 1e-4 * count:  # they differ by less than a seventieth of a stop
            return 1.0, np.inf
        slope = float(weight @ (x0 * y0)) / spread
        away = y0 - slope * x0
        freedom = weight.sum() * (1.0 - (groups + 1) / count)
        scale2 = (float(weight @ away**2) + _PSEUDO_STATED * STATED_ERROR**2) / (freedom + _PSEUDO_STATED)
        weight = 5.0 / (4.0 + away**2 / scale2)
    if not _POWERS[0] <= slope <= _POWERS[1]:
        return 1.0, np.inf
    return slope, float(np.sqrt(2.0 * scale2 / spread))  # the variance of t is twice its scale squared


def _without_powers(gain: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(V, 3) gains without the correlation between chroma and exposure (Eq. C.28)."""
    logs = np.log(gain)
    level = logs.mean(1, keepdims=True)
    # x_v and chi_vc of Eq. C.28. Views that were not estimated take no part: their x is 0.
    chroma, x = logs - level, np.where(seen[:, None], level - level[seen].mean() if seen.any() else 0.0, 0.0)
    return np.exp(level + chroma - x * (x * chroma).sum(0) / max(float((x**2).sum()), 1e-12))


def _unknown(family: str, stops: float, rows: int, gains: CameraGains, given: bool) -> CalibratedResponse:
    start = response(family)
    start = start.with_params(np.tile(start.params, (3, 1)))
    if stops < MIN_STOPS:
        reason = f"exposures differ by less than {MIN_STOPS:g} stop where photographs overlap: taken as {family}"
    else:
        reason = f"{rows} rows of surface under different exposures in the best channel, {_MIN_ROWS} needed: taken as {family}"
    covariance = _SIGMA**2 * np.eye(start.params.size)
    return CalibratedResponse(start, covariance, stops, 0, 0.0, 0.0, [], reason, gains.exposure, gains=None if given else gains)


def _of_power(found: CalibratedResponse, power: StatedPower | None) -> CalibratedResponse:
    """A curve without a parameter that could follow the power that stated exposures tell, f(x^q), and the gains that go with it:
    photographs agree as well as before."""
    if power is None or found.gains is None or not np.isfinite(power.error):
        return found
    gains = power.forced(found.gains)
    slope, forced = _line(found.gains, power.stated)[0], _line(gains, power.stated)[0]
    q = slope / forced
    found = replace(found, gauge=STATED if power.is_sure else GAUGE)
    if abs(q - 1.0) <= _SAME_POWER:
        return found
    x = np.linspace(0.0, 1.0, _SAMPLES) ** 2  # dense where the curve is steep
    curve = sampled_response(x, found.response(np.repeat(x[:, None], 3, 1) ** q).T)
    reason = f"{found.reason}; of the power {q:.2f} of the radiance"
    return replace(found, response=curve, covariance=np.zeros((0, 0)), reason=reason, gains=gains, exposure=gains.exposure)


def _compared(families: Sequence[str], fits: Sequence[Fitted]) -> tuple[list[dict[str, object]], int]:
    """Distance of each family to the best score with its standard error over the clusters, and the best family."""
    scores = np.array([fit.score for fit in fits])
    best = int(scores.argmax())
    table: list[dict[str, object]] = []
    for family, fit in zip(families, fits, strict=True):
        error = float(np.sqrt(((fit.clusters - fits[best].clusters) ** 2).sum()))
        size = int(fit.response.params.size)
        behind = float(scores[best] - fit.score)
        table.append({"family": family, "parameters": size, "score": fit.score, "behind": behind, "error": error})
    return table, best


def _because(table: list[dict[str, object]], chosen: int, best: int, rows: int, stops: float) -> str:
    names = [str(entry["family"]) for entry in table]
    on = f"on {rows} rows of shared surface over {stops:.1f} stops"
    if len(names) == 1:
        return f"{names[0]} fitted {on}"
    text = ", ".join(f"{entry['family']} {entry['behind']:.1f} +- {entry['error']:.1f}" for entry in table)
    verdict = "explains most" if chosen == best else f"is not significantly worse than {names[best]}"
    return f"{names[chosen]} {verdict} {on} (log likelihood behind the best: {text})"


def _fit(family: str, together: Channel, channels: Sequence[Channel], enough: Sequence[int]) -> Fitted:
    """Fit one curve to all channels, then each channel with a narrow prior around the common curve."""
    start = response(family)
    mean = np.array(START[family])
    common = maximise(together, start, mean, _SIGMA)
    size = start.params.size
    params, covariance = np.tile(common.params, (3, 1)), np.zeros((3 * size, 3 * size))
    score, clusters, widths = 0.0, {}, []
    for c in range(3):
        part = slice(c * size, (c + 1) * size)
        # Too few rows to differ from the common curve; the prior of the difference widens its covariance.
        if c not in enough:
            covariance[part, part] = common.covariance + _CHANNEL_SIGMA**2 * np.eye(size)
            continue
        own = maximise(channels[c], start.with_params(common.params), common.params, _CHANNEL_SIGMA)
        params[c], covariance[part, part] = own.params, own.covariance
        score += own.score
        widths.append(own.width)
        # Channels of one object in one view err together, so they share a cluster.
        for name, value in own.clusters.items():
            clusters[name] = clusters.get(name, 0.0) + value
    return Fitted(
        start.with_params(params),
        covariance,
        score,
        np.array([clusters[name] for name in sorted(clusters)]),
        float(np.mean(widths)) if widths else 0.0,
    )
