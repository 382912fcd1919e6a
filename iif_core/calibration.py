"""Camera response from surface that photographs of different, known exposure share; needs no light and no material.

A patch c is equally bright in every view, up to gloss, so log f^-1(I_vc) = log e_v + s_c + n. Known exposures fix the
exponent of f. Unknown ones leave it open: f(x^(1 / p)) with exposures e^p and levels p s fits as well for every p, so the
exponent stays near that of sRGB and the result says so (`CalibratedResponse.gauge`). We maximise the likelihood of the
sensor values over the parameters of f with the levels s_c eliminated:

* n has Student's t distribution (4 degrees of freedom): gloss and misregistration have heavy tails. Its width is
  estimated for every block (object), so that glossy objects lose their say without a word about materials.
* The density of I brings in log dI / d log x. Without it the fit would flatten the noise by bending the curve.
* A patch of m rows spends one of them on its own level, hence the factor (m - 1) / m on its rows. This amounts to a
  level that is as likely to lie anywhere in the sensor's range.
* Rounding to 8 bits is noise of 0.29 steps; it limits dark rows.
* Saturated rows enter as what they are, e exp(s) >= x(saturation): they tie down the scale of x, which f(1) = 1 would
  otherwise leave to extrapolation.

Errors of neighbouring patches go together (a glossy table is too bright in one view as a whole). Rows of one block in
one view are one cluster; the spread of the clusters' scores gives the covariance (sandwich), the price of a parameter
(Takeuchi's criterion) and the weight of the data against the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.camera_gains import CameraGains, GainRows, choose_gains, estimate
from iif_core.overlap import PatchRows
from iif_core.response import START, Response, response

CANDIDATES = ("srgb", "gamma", "ggcm", "spline")
"""What `auto` chooses from, smallest first."""
GAUGE = (
    "exposures were found together with the response: any power p of the exposures goes with f(x^(1 / p)) and fits as well;"
    " the power is the one of a curve near sRGB"
)
DARK = 4.0 / 255.0
_FREEDOM = 4.0
_ROUNDING = 0.29 / 255.0
_SIGNIFICANT = 2.0
_PRIOR = 1.0  # standard deviation of a parameter around its start
_CHANNEL_PRIOR = 0.05  # and of a channel around the curve of all channels
_BLOCK_ROWS = 50.0  # rows' worth of the common width in the width of a block
_FIT_ROWS = 8_000
_ROUNDS = 5
_KNOTS = np.linspace(0.1, 1.0, 257) ** 2  # sensor values where log x and the gain are tabulated


@dataclass(frozen=True)
class Fitted:
    """One candidate.

    Attributes:
        response: parameters (3, P), one row a channel.
        covariance: (3 P, 3 P) of the parameters row by row.
        score: log likelihood less the price of the parameters (Takeuchi), in units of independent rows.
        clusters: (L,) the score's parts, whose spread says what a difference is worth.
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
        response: chosen curve, (3, P); the start where the data say nothing.
        covariance: (3 P, 3 P) of its parameters; the prior's where the data say nothing.
        exposure: (V,) of the views: the given ones, or those found with the curve (mean over the channels).
        gains: exposure, white balance and vignetting found with the curve; None where exposures are given.
        gauge: what cannot be known, in words; empty with given exposures.
        stops: largest difference of exposure within a patch, in stops.
        rows: (patch, view, channel) rows used.
        before, after: robust spread of log radiance within patches with the starting curve and with the chosen one.
        candidates: {family, parameters, score, behind, error} each: `behind` the best by so much, +- `error`.
        reason: the choice in words.
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
    saturation: float = 0.99,
    min_stops: float = 1.0,
    min_rows: int = 200,
    given: bool = True,
) -> CalibratedResponse:
    """The smallest of `families` that no other beats significantly, fitted.

    Significantly: its score is behind the best one's by more than two standard errors of the difference, which the
    spread over clusters gives.

    Args:
        rows: `overlap.patch_rows` of all views; exposure: (V,) of the views, known up to one factor.
        families: candidates, smallest first; one = no choice. Families without parameters are compared as they are.
        saturation: sensor values from here on are bounds.
        min_stops, min_rows: below, the start of the first family comes back.
        given: exposures are known. Otherwise they are found together with each candidate; `exposure` gives their mean.
    """
    if not needs_rows(families):
        start = response(families[0])
        reason = "photographs are linear radiance" if start.family == "identity" else "set to srgb"
        return given_response(start, reason, exposure)
    gains = CameraGains.plain(exposure)
    if not given:
        gains = _gains(rows, response(families[0]), gains)
    channels = [_channel(rows, c, gains, saturation, min_stops) for c in range(3)]
    enough = [c for c in range(3) if len(channels[c].cell) >= min_rows]
    stops = max(channel.stops for channel in channels)
    if not enough:
        gains = gains if given else _gains(rows, response(families[0]), CameraGains.plain(exposure), choose=True)
        return _unknown(families[0], stops, sum(len(c.cell) for c in channels), min_stops, min_rows, gains, given)
    common = _joined([_channel(rows, c, gains, saturation, min_stops, _FIT_ROWS // len(enough)) for c in enough])
    fits, found = [], []
    if not given:
        # Which terms it takes is asked of the richest curve, fitted with one gain a view: under a wrong curve, channels of
        # different brightness seem to need gains of their own.
        rich = _fit(families[-1], common, channels, enough).response
        gains = _gains(rows, rich, gains, choose=True)
        logs = _log_factor(rows, gains)
        common, channels = common.exposed(logs), [channel.exposed(logs) for channel in channels]
    for family in families:
        fit, views = _fit(family, common, channels, enough), gains
        if not given:  # the gains that go with this curve, and the curve that goes with them
            views = _gains(rows, fit.response, gains)
            logs = _log_factor(rows, views)
            fit = _fit(family, common.exposed(logs), [channel.exposed(logs) for channel in channels], enough)
        fits.append(fit)
        found.append(views)
    scores = np.array([fit.score for fit in fits])
    best = int(scores.argmax())
    table: list[dict[str, object]] = []
    for family, fit in zip(families, fits, strict=True):
        error = float(np.sqrt(((fit.clusters - fits[best].clusters) ** 2).sum()))
        size = int(fit.response.params.size)
        table.append(
            {"family": family, "parameters": size, "score": fit.score, "behind": float(scores[best] - fit.score), "error": error}
        )
    chosen = next(i for i, entry in enumerate(table) if entry["behind"] <= _SIGNIFICANT * entry["error"])
    before = _maximise(common, response(families[chosen]), np.array(START[families[chosen]]), _PRIOR, 0)
    used = sum(len(channels[c].cell) + len(channels[c].full) for c in enough)
    views = found[chosen] if given else found[chosen]
    return CalibratedResponse(
        fits[chosen].response,
        fits[chosen].covariance,
        stops,
        used,
        before.width,
        fits[chosen].width,
        table,
        _because(table, chosen, best, used, stops),
        views.exposure,
        "" if given else GAUGE,
        None if given else views,
    )


def candidates(setting: str, dynamic_range: str) -> tuple[str, ...]:
    """Families that a setting allows: `identity` for HDR whatever is set; `auto` is any of `CANDIDATES` for LDR."""
    if dynamic_range == "hdr":
        return ("identity",)
    return CANDIDATES if setting == "auto" else (setting,)


def needs_rows(families: Sequence[str]) -> bool:
    """Whether there is anything to choose or to fit."""
    return len(families) > 1 or bool(START[families[0]])


def given_response(curve: Response, reason: str, exposure: np.ndarray) -> CalibratedResponse:
    """A response that is not to be fitted."""
    size = curve.params.size
    return CalibratedResponse(curve, np.zeros((size, size)), 0.0, 0, 0.0, 0.0, [], reason, np.asarray(exposure, np.float64))


def calibration_facts(found: CalibratedResponse) -> dict[str, object]:
    """What is known about the choice, as plain values for a JSON file."""
    names = ("stops", "rows", "before", "after", "candidates", "reason", "gauge")
    return {"covariance": found.covariance.tolist(), **{name: getattr(found, name) for name in names}}


def gain_rows(rows: PatchRows, curve: Response) -> GainRows:
    """The rows as `camera_gains` wants them: linear under a curve, unsaturated, not dark."""
    values = curve.inverse(np.where(rows.clipped | ~(rows.value > DARK), np.nan, rows.value))
    radius2 = np.zeros(len(rows.view)) if rows.radius2 is None else rows.radius2
    return GainRows(rows.patch.astype(np.int64), rows.view, values, radius2, rows.block)


def _gains(rows: PatchRows, curve: Response, start: CameraGains, choose: bool = False) -> CameraGains:
    """Gains that a curve implies where views overlap, their mean that of `start`: with the terms that `start` was found to
    need (exposure and vignetting if nobody asked), or, to `choose`, those that held-out surface speaks for.

    The power that is open is one for all channels: white balance is taken as uncorrelated with exposure.
    """
    linear, n_views = gain_rows(rows, curve).thinned(), len(start.gain)
    if choose:
        found = choose_gains(linear, n_views)
    else:
        terms = {name: entry.included for name, entry in start.evidence.items()} or {"white_balance": False}
        found = replace(estimate(linear, n_views, **terms), evidence=start.evidence)
    found = replace(found, gain=_without_powers(found.gain, found.estimated))
    known = start.exposure[np.isfinite(start.exposure) & (start.exposure > 0)]
    mean = float(np.exp(np.mean(np.log(known)))) if len(known) else 1.0
    return replace(found, gain=found.gain * mean)


def _without_powers(gain: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(V, 3) gains whose chroma does not go with exposure."""
    logs = np.log(gain)
    level = logs.mean(1, keepdims=True)
    chroma, x = logs - level, np.where(seen[:, None], level - level[seen].mean() if seen.any() else 0.0, 0.0)
    return np.exp(level + chroma - x * (x * chroma).sum(0) / max(float((x**2).sum()), 1e-12))


def _log_factor(rows: PatchRows, gains: CameraGains) -> np.ndarray:
    """(n, 3) log of what radiance was multiplied by in each row; NaN where the exposure is not known."""
    radius2 = np.zeros(len(rows.view)) if rows.radius2 is None else rows.radius2
    factor = gains.factor(rows.view, radius2)
    return np.log(np.where(np.isfinite(factor) & (factor > 0), factor, np.nan))


def _unknown(
    family: str, stops: float, rows: int, min_stops: float, min_rows: int, gains: CameraGains, given: bool
) -> CalibratedResponse:
    start = response(family)
    start = start.with_params(np.tile(start.params, (3, 1)))
    if stops < min_stops:
        reason = f"exposures differ by less than {min_stops:g} stop where photographs overlap: taken as {family}"
    else:
        reason = f"{rows} rows of surface under different exposures, {min_rows} needed: taken as {family}"
    covariance = _PRIOR**2 * np.eye(start.params.size)
    return CalibratedResponse(start, covariance, stops, 0, 0.0, 0.0, [], reason, gains.exposure, gains=None if given else gains)


def _because(table: list[dict[str, object]], chosen: int, best: int, rows: int, stops: float) -> str:
    names = [str(entry["family"]) for entry in table]
    on = f"on {rows} rows of shared surface over {stops:.1f} stops"
    if len(names) == 1:
        return f"{names[0]} fitted {on}"
    text = ", ".join(f"{entry['family']} {entry['behind']:.1f} +- {entry['error']:.1f}" for entry in table)
    verdict = "explains most" if chosen == best else f"is not significantly worse than {names[best]}"
    return f"{names[chosen]} {verdict} {on} (log likelihood behind the best: {text})"


# -------------------------------------------------------------------------------------------------------------- data


@dataclass
class _Channel:
    """Rows of one channel (or of several one after another); n unsaturated ones and b bounds on C patches."""

    cell: np.ndarray
    value: np.ndarray
    log_e: np.ndarray
    block: np.ndarray
    cluster: np.ndarray
    full: np.ndarray  # (b,) patch of the bounds
    full_e: np.ndarray
    full_cluster: np.ndarray
    row: np.ndarray  # (n,) entry of the flattened (rows, 3) table
    full_row: np.ndarray
    stops: float
    saturation: float
    knot: np.ndarray = field(init=False)
    part: np.ndarray = field(init=False)
    share: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.knot = np.clip(np.searchsorted(_KNOTS, self.value, side="right") - 1, 0, len(_KNOTS) - 2)
        self.part = (self.value - _KNOTS[self.knot]) / (_KNOTS[self.knot + 1] - _KNOTS[self.knot])
        members = np.bincount(self.cell, minlength=self.cells)
        self.share = (1.0 - 1.0 / np.maximum(members, 1))[self.cell]

    def exposed(self, log_factor: np.ndarray) -> _Channel:
        """The same rows under other gains: `_log_factor`, (all rows, 3)."""
        return replace(self, log_e=log_factor.ravel()[self.row], full_e=log_factor.ravel()[self.full_row])

    @property
    def cells(self) -> int:
        return int(max(self.cell.max(initial=-1), self.full.max(initial=-1))) + 1

    def at(self, table: np.ndarray) -> np.ndarray:
        """(n, ...) values of a table on the knots."""
        part = self.part.reshape(-1, *[1] * (table.ndim - 1))
        return table[self.knot] * (1.0 - part) + table[self.knot + 1] * part

    def spread(self, row: np.ndarray) -> np.ndarray:
        """(knots,) sums of row values at the knots: the transpose of `at`."""
        size = len(_KNOTS)
        return np.bincount(self.knot, row * (1.0 - self.part), size) + np.bincount(self.knot + 1, row * self.part, size)


def _channel(
    rows: PatchRows, c: int, gains: CameraGains, saturation: float, min_stops: float, budget: int = _FIT_ROWS
) -> _Channel:
    """About `budget` rows on patches whose exposures span `min_stops` and that some view saw unsaturated."""
    value, clipped = rows.value[:, c], rows.clipped[:, c]
    log_e = _log_factor(rows, gains)[:, c]
    use = np.flatnonzero(np.isfinite(value) & (value > DARK) & np.isfinite(log_e))
    owner = np.unique(rows.patch[use], return_inverse=True)[1]
    size = int(owner.max(initial=-1)) + 1
    low, high = np.full(size, np.inf), np.full(size, -np.inf)
    np.minimum.at(low, owner, log_e[use])
    np.maximum.at(high, owner, log_e[use])
    span = (high - low) / np.log(2.0)
    kept = np.flatnonzero((span >= min_stops - 1e-9) & (np.bincount(owner, ~clipped[use], size) > 0))
    stops = float(span.max(initial=0.0))
    index = use[_thinned(owner, value[use], clipped[use], kept, budget)[owner]]
    cell = np.unique(rows.patch[index], return_inverse=True)[1]
    cluster = rows.block[index].astype(np.int64) * (len(gains.gain) + 1) + rows.view[index]
    block = np.unique(rows.block[index], return_inverse=True)[1]
    full = clipped[index]
    clear = ~full
    return _Channel(
        cell[clear],
        value[index[clear]],
        log_e[index[clear]],
        block[clear],
        cluster[clear],
        cell[full],
        log_e[index[full]],
        cluster[full],
        3 * index[clear] + c,
        3 * index[full] + c,
        stops,
        saturation,
    )


def _thinned(owner: np.ndarray, value: np.ndarray, clipped: np.ndarray, kept: np.ndarray, budget: int) -> np.ndarray:
    """(patches,) bool: of the patches `kept` whole ones for about `budget` rows, evenly over ten ranges of brightness:
    the few that come near saturation tie down the scale of x."""
    size = int(owner.max(initial=-1)) + 1
    top = np.zeros(size)
    np.maximum.at(top, owner, np.where(clipped, 0.0, value))
    order = kept[np.argsort(np.minimum((10.0 * top[kept]).astype(int), 9), kind="stable")]
    members = np.bincount(owner, minlength=size)
    tenth = np.minimum((10.0 * top[order]).astype(int), 9)
    rows = np.bincount(tenth, members[order], 10)
    level = np.sort(rows)
    room = (budget - np.r_[0.0, np.cumsum(level)[:-1]]) / np.arange(10, 0, -1)
    limit = room[np.argmax(room <= level)] if rows.sum() > budget else np.inf
    share = np.minimum(1.0, limit / np.maximum(rows, 1.0))[tenth]
    wanted = np.zeros(size, bool)
    wanted[order[np.floor(np.cumsum(share) + 1e-9) > np.floor(np.cumsum(share) - share + 1e-9)]] = True
    return wanted


def _joined(channels: Sequence[_Channel]) -> _Channel:
    """Several channels as one: patches of their own, common clusters."""
    offsets = np.cumsum([0] + [channel.cells for channel in channels])
    names = ("value", "log_e", "block", "cluster", "full_e", "full_cluster", "row", "full_row")
    parts = {name: np.concatenate([getattr(channel, name) for channel in channels]) for name in names}
    return _Channel(
        np.concatenate([channel.cell + o for channel, o in zip(channels, offsets, strict=False)]),
        parts["value"],
        parts["log_e"],
        parts["block"],
        parts["cluster"],
        np.concatenate([channel.full + o for channel, o in zip(channels, offsets, strict=False)]),
        parts["full_e"],
        parts["full_cluster"],
        parts["row"],
        parts["full_row"],
        max(channel.stops for channel in channels),
        channels[0].saturation,
    )


# --------------------------------------------------------------------------------------------------------------- fit


@dataclass
class _Noise:
    """Width of n: of all rows, and of every block relative to it."""

    width: float
    block: np.ndarray

    def scale2(self, data: _Channel, log_gain: np.ndarray) -> np.ndarray:
        return (self.width * self.block[data.block]) ** 2 + (_ROUNDING * np.exp(-log_gain)) ** 2


def _tables(curve: Response) -> tuple[np.ndarray, np.ndarray]:
    """log x and log dI / d log x at the knots."""
    log_x = np.log(curve.inverse(_KNOTS))
    return log_x, -np.log(np.maximum(np.gradient(log_x, _KNOTS), 1e-12))


def _table_slopes(curve: Response, log_x: np.ndarray, log_gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Their derivatives by the parameters, (knots, P): d log x = -df / (x f') where I is held."""
    x = np.exp(log_x)
    _, slope, by_params = curve.evaluate(x)
    dx = -by_params / (x * slope)[:, None]
    return dx, -np.gradient(dx, _KNOTS, axis=0) * np.exp(log_gain)[:, None]


def _levels(data: _Channel, y: np.ndarray, scale2: np.ndarray, rounds: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Robust level of every patch (C,) and the weights (n,) that make it."""
    size = data.cells
    weight = 1.0 / scale2
    for _ in range(rounds):
        level = np.bincount(data.cell, weight * y, size) / np.maximum(np.bincount(data.cell, weight, size), 1e-300)
        weight = (_FREEDOM + 1.0) / (_FREEDOM * scale2 + (y - level[data.cell]) ** 2)
    return level, weight


def _reached(above: np.ndarray, width: float) -> np.ndarray:
    """Probability that a level `above` the edge of saturation is seen saturated: logistic stand-in for the normal
    distribution; 2 % of the saturated rows may be highlights or errors."""
    return 0.02 + 0.98 / (1.0 + np.exp(np.clip(-1.702 * above / width, -60.0, 60.0)))


@dataclass
class _Fit:
    params: np.ndarray
    covariance: np.ndarray
    score: float
    clusters: dict[int, float]
    width: float


def _maximise(data: _Channel, curve: Response, mean: np.ndarray, deviation: float, rounds: int = _ROUNDS) -> _Fit:
    """Parameters (P,) of one curve: robust weights and the width of the noise in turn with a smooth inner problem.

    `rounds` 0: the noise alone, at the parameters of `curve`."""
    noise, worth = _Noise(0.05, np.ones(int(data.block.max(initial=-1)) + 1)), 1.0
    noise, weight, deviations = _settle(data, curve, noise)
    for number in range(rounds if curve.names else 0):
        last = number == rounds - 1
        if last:
            worth = _curvature(data, curve, weight, noise, mean, deviation, 1.0)[1]
        curve = _improve(data, curve, weight, noise, mean, deviation, worth, 30 if last else 12)
        noise, weight, deviations = _settle(data, curve, noise)
    covariance, _, price = _curvature(data, curve, weight, noise, mean, deviation, worth)
    score, clusters = _likelihood(data, curve, noise)
    width = float(1.4826 * np.median(np.abs(deviations))) if len(deviations) else 0.0
    return _Fit(curve.params, covariance, score - price, clusters, width)


def _settle(data: _Channel, curve: Response, noise: _Noise) -> tuple[_Noise, np.ndarray, np.ndarray]:
    """Width of the noise at a curve, weights (n,) and deviations (n,) from the patches' levels."""
    log_x, log_gain = (data.at(table) for table in _tables(curve))
    y = log_x - data.log_e
    for _ in range(5):
        level, weight = _levels(data, y, noise.scale2(data, log_gain))
        noise = _widths(data, noise, data.share * weight * (y - level[data.cell]) ** 2)
    return noise, weight, y - level[data.cell]


def _improve(
    data: _Channel,
    curve: Response,
    weight: np.ndarray,
    noise: _Noise,
    mean: np.ndarray,
    deviation: float,
    worth: float,
    steps: int,
) -> Response:
    """The curve at the minimum of `_inner` with weights and noise held."""
    from scipy.optimize import minimize

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        return _inner(data, curve, theta, weight, noise.width, mean, deviation, worth)

    options = {"maxiter": steps, "ftol": 1e-10}
    return curve.with_params(minimize(objective, curve.params, jac=True, method="L-BFGS-B", options=options).x)


def _widths(data: _Channel, noise: _Noise, ratio: np.ndarray) -> _Noise:
    """One step of the fixed point at which the mean of weight x squared deviation is one, overall and per block."""
    total = max(float(data.share.sum()), 1e-12)
    overall = ratio.sum() / total
    size = len(noise.block)
    own = np.bincount(data.block, ratio, size) + _BLOCK_ROWS * overall
    rows = np.bincount(data.block, data.share, size) + _BLOCK_ROWS
    block = noise.block * np.sqrt(np.clip(own / rows / max(overall, 1e-12), 0.1, 10.0))
    block /= np.exp(np.average(np.log(block), weights=rows))
    return _Noise(float(np.clip(noise.width * np.sqrt(np.clip(overall, 0.1, 10.0)), 1e-3, 1.0)), np.clip(block, 0.2, 20.0))


def _inner(
    data: _Channel,
    curve: Response,
    theta: np.ndarray,
    weight: np.ndarray,
    width: float,
    mean: np.ndarray,
    deviation: float,
    worth: float,
) -> tuple[float, np.ndarray]:
    """Negative log posterior with fixed weights, and its gradient."""
    inside = curve.with_params(theta)
    log_x, log_gain = _tables(inside)
    dx, dg = _table_slopes(inside, log_x, log_gain)
    y = data.at(log_x) - data.log_e
    size = data.cells
    total = np.maximum(np.bincount(data.cell, weight, size), 1e-300)
    level = np.bincount(data.cell, weight * y, size) / total
    n = y - level[data.cell]
    cost = float((data.share * (0.5 * weight * n**2 + data.at(log_gain))).sum())
    by_x, by_g = data.share * weight * n, data.share
    pull = np.zeros(len(theta))
    if len(data.full):
        edge, edge_slope = np.interp(data.saturation, _KNOTS, log_x), _at(dx, data.saturation)
        above = level[data.full] + data.full_e - edge
        reached = _reached(above, width)
        cost -= float(np.log(reached).sum())
        by_level = -1.702 / width * (reached - 0.02) * (1.0 - (reached - 0.02) / 0.98) / reached
        pull -= by_level.sum() * edge_slope
        by_x = by_x + weight * (np.bincount(data.full, by_level, size) / total)[data.cell]
    gradient = dx.T @ data.spread(by_x) + dg.T @ data.spread(by_g) + pull
    away, beyond = (theta - mean) / deviation**2, theta - inside.params
    cost = worth * cost + 0.5 * float(((theta - mean) * away).sum()) + 1e3 * float((beyond**2).sum())
    return cost, worth * gradient + away + 2e3 * beyond


def _at(table: np.ndarray, value: float) -> np.ndarray:
    j = int(np.clip(np.searchsorted(_KNOTS, value, side="right") - 1, 0, len(_KNOTS) - 2))
    part = (value - _KNOTS[j]) / (_KNOTS[j + 1] - _KNOTS[j])
    return (1.0 - part) * table[j] + part * table[j + 1]


def _curvature(
    data: _Channel,
    curve: Response,
    weight: np.ndarray,
    noise: _Noise,
    mean: np.ndarray,
    deviation: float,
    worth: float,
) -> tuple[np.ndarray, float, float]:
    """Covariance of the parameters, (P, P); how many independent rows a row is worth (at most 1); and the price of the
    parameters in log likelihood.

    The sandwich H^-1 J H^-1 of scores summed over clusters says how far the likelihood overstates what it knows.
    `_inner` majorises the likelihood; H has the curvature of Student's t itself, which is flatter."""
    theta, size = curve.params, curve.params.size
    if not size:
        return np.zeros((0, 0)), 1.0, 0.0
    hessian = np.zeros((size, size))
    for k, step in enumerate(1e-3 * np.eye(size)):
        up = _inner(data, curve, theta + step, weight, noise.width, mean, np.inf, 1.0)[1]
        down = _inner(data, curve, theta - step, weight, noise.width, mean, np.inf, 1.0)[1]
        hessian[k] = (up - down) / 2e-3
    log_x, log_gain = _tables(curve)
    dx, dg = (data.at(t) for t in _table_slopes(curve, log_x, log_gain))
    y = data.at(log_x) - data.log_e
    cells = data.cells
    total = np.maximum(np.bincount(data.cell, weight, cells), 1e-300)
    n = y - (np.bincount(data.cell, weight * y, cells) / total)[data.cell]
    centre = np.stack([np.bincount(data.cell, weight * dx[:, k], cells) / total for k in range(size)], -1)
    lever = dx - centre[data.cell]
    # psi' = w (nu s^2 - n^2) / (nu s^2 + n^2), and nu s^2 + n^2 = (nu + 1) / w.
    excess = weight * 2.0 * n**2 * weight / (_FREEDOM + 1.0)
    hessian = 0.5 * (hessian + hessian.T) - lever.T @ ((data.share * excess)[:, None] * lever)
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, 1e-6 * max(float(values.max()), 1e-6))
    # A row's deviation has lost the part that its patch's level took up.
    score = np.sqrt(data.share)[:, None] * (weight * n)[:, None] * lever + data.share[:, None] * dg
    owner = np.unique(data.cluster, return_inverse=True)[1]
    summed = np.stack([np.bincount(owner, score[:, k]) for k in range(size)], -1)
    spread = summed.T @ summed * len(summed) / max(len(summed) - 1, 1)
    prior = np.eye(size) / deviation**2
    known = np.linalg.inv((vectors * values) @ vectors.T + prior)
    price = float(np.trace(known @ spread))
    # Free directions alone: what the prior decides is no sign of rows that err together.
    worth = float(np.clip(np.trace(known @ (vectors * values) @ vectors.T) / max(price, 1e-12), 1e-4, 1.0))
    adjusted = np.linalg.inv(worth * (vectors * values) @ vectors.T + prior)
    return adjusted @ (worth**2 * spread + prior) @ adjusted, worth, price


def _likelihood(data: _Channel, curve: Response, noise: _Noise) -> tuple[float, dict[int, float]]:
    """Log likelihood of the sensor values, and of every cluster."""
    log_x, log_gain = _tables(curve)
    gain = data.at(log_gain)
    y, scale2 = data.at(log_x) - data.log_e, noise.scale2(data, gain)
    level, _ = _levels(data, y, scale2)
    n = y - level[data.cell]
    tail = 0.5 * (_FREEDOM + 1.0) * np.log1p(n**2 / (_FREEDOM * scale2))
    rows = -data.share * (tail + 0.5 * np.log(scale2) + gain)
    bounds = np.log(_reached(level[data.full] + data.full_e - np.interp(data.saturation, _KNOTS, log_x), noise.width))
    names, owner = np.unique(np.concatenate([data.cluster, data.full_cluster]), return_inverse=True)
    summed = np.bincount(owner, np.concatenate([rows, bounds]))
    return float(rows.sum() + bounds.sum()), dict(zip(names.tolist(), summed.tolist(), strict=True))


def _fit(family: str, joined: _Channel, channels: Sequence[_Channel], enough: Sequence[int]) -> Fitted:
    """One curve for all channels first; each channel then has to earn its difference."""
    start = response(family)
    mean = np.array(START[family])
    common = _maximise(joined, start, mean, _PRIOR)
    size = start.params.size
    params, covariance = np.tile(common.params, (3, 1)), np.zeros((3 * size, 3 * size))
    score, clusters, widths = 0.0, {}, []
    for c in range(3):
        part = slice(c * size, (c + 1) * size)
        if c not in enough:
            covariance[part, part] = common.covariance + _CHANNEL_PRIOR**2 * np.eye(size)
            continue
        own = _maximise(channels[c], start.with_params(common.params), common.params, _CHANNEL_PRIOR)
        params[c], covariance[part, part] = own.params, own.covariance
        score += own.score
        widths.append(own.width)
        for name, value in own.clusters.items():
            clusters[name] = clusters.get(name, 0.0) + value
    return Fitted(
        start.with_params(params),
        covariance,
        score,
        np.array([clusters[name] for name in sorted(clusters)]),
        float(np.mean(widths)) if widths else 0.0,
    )
