"""Albedo gains of objects, strengths of their gloss, and the level of all light, found together with the emission
(docs/method/light.md#object-gains): the base texture is wrong by a factor for each object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.rows import EmissionRows, light_of

PRIOR_LEVEL_ERROR = 0.35
"""Standard deviation of the logarithm of the level of the light that the mean albedo of the base texture implies."""
SHARED_LEVEL_ERROR = 0.3
"""Systematic error of the logarithm of the level, common to all objects: light that geometry, cache and materials lose."""
_STEPS = 4
BASE_COLOUR_ERROR = 0.05
"""Standard deviation of the logarithm of a channel of the mean base albedo, relative to the mean over the channels."""
SHARED_COLOUR_ERROR = 0.08
"""Systematic error of the logarithm of a channel's level relative to the level of all channels. All objects share this error."""
LARGEST_COLOUR_ERROR = 0.5
"""The logarithm of a channel of the light relative to the mean over the channels is taken to be known at least so well."""
LARGEST_LEVEL_ERROR = 0.5
"""The same of the logarithm of the level."""
LOG_LEVELS = np.linspace(-2.0, 2.0, 161)
"""Logarithms of the level of all light that are tried (Eq. L.38)."""
GAIN_BOUNDS = (0.1, 10.0)
GLOSS_BOUNDS = (0.0, 3.0)
GLOSS_PRIOR_ROWS = 30.0
"""The predicted strength of an object's gloss is taken to be uncertain by 100 % and counts as much as this many rows, because so
many rows of an object may err together (Eq. L.37)."""
MAX_SHARE_ABOVE_WHITE = 0.03
"""Share of the rows whose objects may come out brighter than white: gloss, and lamps that nobody found."""


class BaseAlbedo(NamedTuple):
    """What the base texture says of the albedos of objects.

    Attributes:
        mean: (n_objects, 3) mean base albedo.
        is_limited: no gain brings it above 1.
        level_error: standard deviation of the logarithm of its level.
    """

    mean: np.ndarray
    is_limited: bool = False
    level_error: float = PRIOR_LEVEL_ERROR


@dataclass(frozen=True)
class GainOptions:
    """How gains are estimated.

    Attributes:
        rounds: most alternations between emission and gains.
        shrinkage: weight of the common gain relative to the rows of an object (mu of Eq. L.34).
    """

    rounds: int = 15
    shrinkage: float = 0.05


@dataclass(frozen=True)
class ObjectGains:
    """Result of `estimate_object_gains`.

    Attributes:
        gain: (n_objects, 3) > 0.
        gloss_gain: (n_objects,) >= 0, strength of the specular lobe relative to the predicted one; 1 without lobes.
        level_error: standard error of the logarithm of the level of all light (the same factor on every emitter); infinite
            where the level is not identifiable.
        error_of_group: (G, 3) the same of the light of each group, 0 where it is itself seen unsaturated.
        weight: (n, 3) of the rows, relative to what they are predicted to show.
        level_raised: logarithm by which all light was raised above the level of least cost so that albedos are at most 1; it is
            not part of the errors.
        colour_moved: (3,) logarithm by which the light of each channel was moved from the level of least cost towards the mean
            colour of the base.
        level_moved: the same of all channels, towards its level.
    """

    gain: np.ndarray
    gloss_gain: np.ndarray
    level_error: float
    error_of_group: np.ndarray
    weight: np.ndarray
    level_raised: float = 0.0
    colour_moved: tuple[float, float, float] = (0.0, 0.0, 0.0)
    level_moved: float = 0.0


def estimate_object_gains(
    rows: EmissionRows,
    owner: np.ndarray,
    prior: EmissionPrior,
    scale_is_identifiable: bool,
    albedo: BaseAlbedo | None = None,
    n_objects: int = 0,
    options: GainOptions | None = None,
) -> ObjectGains:
    """Estimate the albedo gain of each object and channel, and the strength of its gloss, together with the light.

    y = g_o (s A_d E + h_d) + t_o (s A_s E + h_s) (Eq. L.33) is solved alternately for E (non-negative least squares) and for
    gains, gloss and level s in closed form (Eq. L.34 to L.38). Each round makes the weights relative to what is predicted
    (docs/method/numerics.md#weights-relative-to-noisy-rows). With `albedo`, colour and level of all light are weighed
    against those of the base (docs/method/light.md#colour-and-level-of-the-light), and if albedos are limited the level is raised
    until at most `MAX_SHARE_ABOVE_WHITE` of the rows belong to objects with an albedo above 1 (Eq. L.47).

    Args:
        rows: the system; without lobes there is one factor for everything that an object reflects.
        owner: (n,) object of each row, -1 = not reflected light (a pixel on an emitter).
        prior: of the groups.
        scale_is_identifiable: the light has its own scale; otherwise the mean of log g over the rows stays 0.
        albedo: of the base; None = nothing is known of it.
        n_objects: gains for at least so many objects; an object without rows gets the common gain.
        options: None = defaults.

    Returns:
        Gains, the level's error and the weights of the rows.
    """
    count = max(int(owner.max(initial=-1)) + 1, n_objects)
    # Objects without rows all get the same gains, so one of them is enough; a scan has many.
    has_rows = np.bincount(owner[owner >= 0], minlength=count) > 0
    asked = np.r_[np.flatnonzero(has_rows), np.flatnonzero(~has_rows)[:1]]
    # Objects without rows share the last place. The extra entry at the end sends the owner -1 to itself.
    number = np.full(count + 1, len(asked) - 1)
    number[asked], number[-1] = np.arange(len(asked)), -1
    if albedo is not None:
        albedo = albedo._replace(mean=np.asarray(albedo.mean)[asked])
    found = _gains_of_asked(rows, number[owner], prior, scale_is_identifiable, albedo, len(asked), options or GainOptions())
    return replace(found, gain=found.gain[number[:-1]], gloss_gain=found.gloss_gain[number[:-1]])


def _gains_of_asked(
    rows: EmissionRows,
    owner: np.ndarray,
    prior: EmissionPrior,
    scale_is_identifiable: bool,
    albedo: BaseAlbedo | None,
    count: int,
    options: GainOptions,
) -> ObjectGains:
    """`estimate_object_gains` for `count` objects, of which at most one has no rows."""
    gain, gloss_gain = np.ones((count, 3)), np.ones(count)
    known = owner >= 0
    if not known.any():
        return ObjectGains(gain, gloss_gain, float("inf"), np.full((rows.groups, 3), np.inf), rows.weight)
    # Every row that belongs to no object is an anchor; anchors are an object of their own at the end, with gain 1.
    column = np.where(known, owner, count)
    of_objects = _ObjectRows(rows, column, count + 1, scale_is_identifiable, options)
    weight, gloss_weight = rows.weight, np.zeros(count)
    # Weights w y^2 of the mean of log g, for light whose level is the prior's.
    share = _by_object(np.where(rows.lower_bound, 0.0, weight) * rows.observed**2, column, count + 1)[:count]
    for _ in range(options.rounds):
        # -------- E under the present gains --------
        of_row, gloss_of_row = np.concatenate([gain, np.ones((1, 3))])[column], np.append(gloss_gain, 1.0)[column]
        scaled = replace(rows, weight=weight).scaled(of_row, gloss_of_row)
        radiance, light = prior.radiance_and_light(scaled, max_rounds=5)
        predicted = light + scaled.cached.sum(1).mean(0)

        # -------- weights relative to the prediction (Eq. L.39) --------
        weight = _relative_to(rows, predicted, known)
        used = np.where(rows.lower_bound, 0.0, weight)
        if rows.has_lobes:  # mean weighted square of what an object's rows leave unexplained
            left = _by_object(used * (rows.observed - predicted) ** 2, column, count + 1)[:count].sum(1)
            gloss_weight = GLOSS_PRIOR_ROWS * left / np.maximum(np.bincount(column, (used > 0).sum(1), count + 1)[:count], 1)

        # -------- level, gains and gloss in closed form (Eq. L.35 to L.38) --------
        moments = of_objects.moments(used, gloss_weight, radiance)
        level = _Level(np.zeros(3))
        if scale_is_identifiable:
            unknown = 1.0 if albedo is None else 1.0 - _share_seen(rows, used, ~known, radiance)
            level = _find_level(moments, column, albedo, unknown)
        new, gloss_gain = moments.gains(level.log_level)
        if not scale_is_identifiable:
            # The level is the prior's, so gains do not move it: the mean of log g stays 0.
            new /= np.exp((share * np.log(new)).sum(0) / np.maximum(share.sum(0), 1e-300))
        done = np.abs(np.log(new / gain)).max() < 1e-3
        gain = new
        if done:
            break

    # -------- errors of the level (Eq. L.45, L.46) --------
    errors = float("inf"), np.full((rows.groups, 3), np.inf)
    if scale_is_identifiable:
        errors = _level_errors(of_objects, weight, gloss_weight, radiance)
    colour = tuple(np.broadcast_to(level.colour, 3).tolist())
    return ObjectGains(gain, gloss_gain, *errors, weight, level.raised, colour, level.moved)


def _level_errors(
    of_objects: _ObjectRows, weight: np.ndarray, gloss_weight: np.ndarray, radiance: np.ndarray
) -> tuple[float, np.ndarray]:
    """(error of the level of all light, (G, 3) of each group's light), Eq. L.45 and L.46.

    What emitters radiate that are seen unsaturated is known like photographed light (h); the level of the other emitters has
    the error e_free. Whether the seen groups are emitters, and radiate elsewhere what they show the camera, is judged by the
    level that the objects alone would give all light.
    """
    rows = of_objects.rows
    anchor = of_objects.column == of_objects.count - 1

    # -------- e_free: the level of light that no row shows unsaturated --------
    # The jackknife over objects leaves anchors and bounds out.
    seen = _seen_unsaturated(rows, weight, anchor)
    used = np.where(anchor[:, None] | rows.lower_bound, 0.0, weight)
    free, shown = (np.where(which, radiance, 0.0) for which in (~seen, seen))
    free_error = of_objects.moments(used, gloss_weight, free, known=shown).level_error()
    if not seen.any():
        return free_error, np.full(seen.shape, free_error)

    # -------- chi: how much of the light on the rows comes from emitters that are seen --------
    phi = _share_seen(rows, weight, anchor, radiance)

    # -------- e_seen: do the objects agree with what is seen of the emitters? --------
    # `log_level` is the level that the objects alone would give to all light; 0 is agreement.
    everything = of_objects.moments(used, gloss_weight, radiance)
    error = everything.level_error()
    log_level = float(_lowest(everything.costs().sum(2).sum(1)[:, None])[0])
    # Objects that know the level less well than the prior are not asked.
    seen_error = log_level**2 / max(np.hypot(log_level, error), 1e-300) if error < PRIOR_LEVEL_ERROR else 0.0
    # Where nothing tells the level of the others it is at most as uncertain as the prior's, the more so the less is seen.
    rest = (1.0 - phi) * min(free_error, PRIOR_LEVEL_ERROR / phi) if phi > 0 else free_error
    return float(np.hypot(rest, phi * seen_error)), np.where(seen, 0.0, free_error)


def _share_seen(rows: EmissionRows, weight: np.ndarray, anchor: np.ndarray, radiance: np.ndarray) -> float:
    """Share of the modelled light on rows that are no anchors which comes from emitters that are seen unsaturated, in [0, 1]."""
    seen = _seen_unsaturated(rows, weight, anchor)
    if not seen.any():
        return 0.0
    used, mean = np.where(anchor[:, None] | rows.lower_bound, 0.0, weight), rows.matrices.mean(0)
    free, shown = (
        float((used * rows.observed * light_of(mean, np.where(which, radiance, 0.0))).sum()) for which in (~seen, seen)
    )
    return float(np.clip(shown / max(free + shown, 1e-300), 0.0, 1.0)) if shown > 0 else 0.0


def _seen_unsaturated(rows: EmissionRows, weight: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """(G, 3) bool: a row `anchor` (n,) shows the group itself, and is no bound."""
    shown = (rows.matrices[0][anchor] > 0) & ~rows.lower_bound[anchor][:, None] & (weight[anchor] > 0)[:, None]
    return shown.any(0)


class _Level(NamedTuple):
    """Logarithm of the level of each channel (3,); what of it comes from colour (3,) and level of the base; and by how much all
    channels were raised so that albedos are at most 1."""

    log_level: np.ndarray
    colour: np.ndarray | float = 0.0
    moved: float = 0.0
    raised: float = 0.0


def _find_level(moments: _Moments, owner: np.ndarray, albedo: BaseAlbedo | None, unknown: float) -> _Level:
    """Find the level of least cost, with its colour weighed against the colour of the base, and then the whole against its level.

    With limited albedos, all channels of the level are then raised alike until albedos are at most 1 (Eq. L.47). They are not
    raised at all if no level achieves that. owner (n,): object of each row, the last = anchors; unknown: share of the modelled
    light that comes from emitters which no row shows unsaturated, and which alone can be moved.
    """
    costs = moments.costs()
    best, objects = _lowest(costs.sum(1)), moments.objects
    if albedo is None:
        return _Level(best)
    base = np.asarray(albedo.mean, np.float64)[:objects]
    rows = np.bincount(owner, minlength=objects + 1)[:objects].astype(np.float64)
    colour, moved = np.zeros(3), 0.0
    if (rows @ base > 0).all():

        def cast(log_level: np.ndarray) -> np.ndarray:
            """(3,) logarithm by which the gains at a level change the mean base albedo."""
            return np.log((rows @ (moments.gains(log_level)[0] * base)) / (rows @ base))

        # What is seen of emitters tells no error of the others.
        free = np.concatenate([costs[:, :-1], np.zeros_like(costs[:, -1:])], 1)
        error = unknown * np.minimum(moments.colour_error(free), LARGEST_COLOUR_ERROR)
        colour = _weighed(lambda shift: _relative(cast(best + shift)), error, BASE_COLOUR_ERROR, _relative)
        best = best + colour
        error = unknown * min(moments.level_error(free), LARGEST_LEVEL_ERROR)
        moved = float(_weighed(lambda shift: cast(best + shift).mean(), np.array(error), albedo.level_error))
        best = best + moved
    for step in LOG_LEVELS[LOG_LEVELS >= 0.0] if albedo.is_limited else ():
        brightest = (moments.gains(best + step)[0] * base).max(1)
        if rows[brightest > 1.0].sum() <= MAX_SHARE_ABOVE_WHITE * rows.sum():
            return _Level(best + step, colour, moved, float(step))
    return _Level(best, colour, moved)


def _relative(channels: np.ndarray) -> np.ndarray:
    return channels - channels.mean()


def _weighed(
    cast: Callable[[np.ndarray], np.ndarray],
    error: np.ndarray,
    base_error: float,
    within: Callable[[np.ndarray], np.ndarray] = lambda shift: shift,
) -> np.ndarray:
    """Return the d that minimises (d / error)^2 + (cast(d) / base_error)^2, kept `within` what may move.

    `cast` is how far the light moved by d lets albedos differ from the base. Where part of the light is given, the albedos follow
    the rest of it only by a share q < 1: cast(d) = cast(0) - q d.
    """
    first, share = cast(np.zeros_like(error)), np.ones_like(error)
    shift = first
    for _ in range(_STEPS):  # the share is not the same everywhere
        moved = np.abs(shift) > 1e-9
        # q as a quotient of differences: by how much this shift changes the cast.
        share = np.where(moved, (first - cast(shift)) / np.where(moved, shift, 1.0), share).clip(0.0, 1.0)
        shift = within(share * first * error**2 / (share**2 * error**2 + base_error**2))
    return shift


def _relative_to(rows: EmissionRows, predicted: np.ndarray, reflects: np.ndarray) -> np.ndarray:
    """Weights (n, 3) relative to what rows are predicted to show instead of what they show."""
    if rows.noise is None:
        return rows.weight
    scale = rows.noise + np.where(reflects, predicted.mean(1) - np.abs(rows.observed).mean(1), 0.0)
    return rows.weight * ((rows.noise / np.maximum(scale, 0.5 * rows.noise)) ** 2)[:, None]


def _by_object(values: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(owner, values[:, c], count) for c in range(3)], 1)


@dataclass(frozen=True)
class _ObjectRows:
    """The rows by object: `column` (n,) is the object. Column count - 1 holds the anchors, whose gains are 1."""

    rows: EmissionRows
    column: np.ndarray
    count: int
    scale_is_identifiable: bool
    options: GainOptions

    def moments(
        self, weight: np.ndarray, gloss_weight: np.ndarray, radiance: np.ndarray, known: np.ndarray | None = None
    ) -> _Moments:
        """Sums for the light `radiance` (G, 3) at any level, plus light `known` (G, 3) at a known level; weight (n, 3)."""

        def lobe(number: int) -> tuple[_Traces, _Traces]:
            """Light at level 1, and light that does not follow the level."""
            emitted = light_of(self.rows.matrix[:, number], radiance)
            constant = self.rows.cached[:, number]
            if known is not None:
                constant = constant + light_of(self.rows.matrix[:, number], known)
            return emitted, constant

        def sums(values: np.ndarray) -> np.ndarray:
            return _by_object(weight * values, self.column, self.count)

        def crossed(a: _Traces, b: _Traces) -> np.ndarray:  # the two traces share no noise
            return sums(0.5 * (a[0] * b[1] + a[1] * b[0]))

        def seen(a: _Traces) -> np.ndarray:
            return sums(self.rows.observed * 0.5 * (a[0] + a[1]))

        # The light is x = s d + h in the albedo lobe and z = s e + k in the gloss. Products of two such sums are polynomials of
        # second degree in s, so their coefficients are summed once for all levels.
        d, h = lobe(0)
        zero = np.zeros((self.count, 3))
        gloss = _Linear(zero, zero), _Quadratic(zero, zero, zero), _Quadratic(zero, zero, zero)
        if self.rows.has_lobes:
            e, k = lobe(1)
            across = _Quadratic(crossed(d, e), crossed(d, k) + crossed(h, e), crossed(h, k))
            gloss = _Linear(seen(e), seen(k)), across, _Quadratic(crossed(e, e), 2 * crossed(e, k), crossed(k, k))
        return _Moments(
            sums(self.rows.observed**2),
            _Linear(seen(d), seen(h)),
            _Quadratic(crossed(d, d), 2 * crossed(d, h), crossed(h, h)),
            *gloss,
            gloss_weight if self.rows.has_lobes else None,
            self.scale_is_identifiable,
            self.options.shrinkage,
        )


_Traces = np.ndarray  # (2, n, 3): a quantity of both traces


class _Linear(NamedTuple):
    """s first + constant, (O + 1, 3) each."""

    first: np.ndarray
    constant: np.ndarray

    def at(self, s: np.ndarray) -> np.ndarray:
        return s * self.first + self.constant


class _Quadratic(NamedTuple):
    """s^2 second + s first + constant, (O + 1, 3) each."""

    second: np.ndarray
    first: np.ndarray
    constant: np.ndarray

    def at(self, s: np.ndarray) -> np.ndarray:
        return s * s * self.second + s * self.first + self.constant


@dataclass(frozen=True)
class _Moments:
    """Sums over the rows of each object, (O + 1, 3), the last object the anchors with g = t = 1:

        sum w (y - g_o x - t_o z)^2,   x = s d + h,   z = s e + k,

    with d, h the modelled and the photographed light in the albedo lobe and e, k the same in the gloss (Eq. L.34).

    Attributes:
        observed_squared: <yy>; observed_albedo: <yx>; albedo_squared: <xx>; observed_gloss: <yz>; albedo_gloss: <xz>;
            gloss_squared: <zz>, all but the first polynomials in s.
        gloss_weight: (O,) weight of (t - 1)^2 before `shrinkage`; None = no lobes, t = 1.
    """

    observed_squared: np.ndarray
    observed_albedo: _Linear
    albedo_squared: _Quadratic
    observed_gloss: _Linear
    albedo_gloss: _Quadratic
    gloss_squared: _Quadratic
    gloss_weight: np.ndarray | None
    scale_is_identifiable: bool
    shrinkage: float

    @property
    def objects(self) -> int:
        return len(self.observed_squared) - 1

    def _at(self, log_level: np.ndarray) -> tuple[np.ndarray, ...]:
        """<yx>, <yz>, <xx>, <xz>, <zz> at log s (..., 1 or 3): (..., O + 1, 3)."""
        s = np.exp(log_level)[..., None, :]
        moments = (self.observed_albedo, self.observed_gloss, self.albedo_squared, self.albedo_gloss, self.gloss_squared)
        return tuple(moment.at(s) for moment in moments)

    def _solve(self, log_level: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(cost, g, t) of all but the last object, at log s (..., 1 or 3): (..., O, 3) twice and (..., O); Eq. L.34 to L.37."""
        yx, yz, xx, xz, zz = (part[..., :-1, :] for part in self._at(log_level))
        xx, zz = np.maximum(xx, 0.0), np.maximum(zz, 0.0)
        # A billionth of the largest moment gives the common gain to objects without rows, whose own moments are 0.
        floor = 1e-9 * np.maximum(xx.max((-2, -1), keepdims=True), 1e-300)
        prior = self.shrinkage * xx + floor  # weight of the common gain

        def common_gain(t: np.ndarray) -> np.ndarray | float:
            total, below = (yx - t[..., None] * xz).sum(-2, keepdims=True), xx.sum(-2, keepdims=True)
            return np.clip((total + floor) / (below + floor), *GAIN_BOUNDS) if self.scale_is_identifiable else 1.0

        t, gloss_prior = np.ones(xx.shape[:-1]), 0.0
        # Gloss as predicted (t = 1) while t is eliminated; again below with the gloss that was found.
        common = common_gain(t)
        if self.gloss_weight is not None:
            # g eliminated, then t; noise may make the information about t negative, which then counts as none.
            gloss_prior = self.gloss_weight + self.shrinkage * zz.sum(-1) + floor[..., 0]
            information = np.maximum((zz - xz**2 / (xx + prior)).sum(-1), 0.0)
            score = (yz - xz * (yx + prior * common) / (xx + prior)).sum(-1)
            t = np.clip(np.where(information > 0, (score + gloss_prior) / (information + gloss_prior), 1.0), *GLOSS_BOUNDS)
            common = common_gain(t)
        of_all = t[..., None]
        gain = np.clip((yx - of_all * xz + prior * common) / (xx + prior), *GAIN_BOUNDS)
        cost = self.observed_squared[:-1] - 2 * gain * yx - 2 * of_all * yz + gain**2 * xx
        cost = cost + 2 * gain * of_all * xz + of_all**2 * zz
        # The level is found channel by channel, so each channel carries a third of the term in t.
        cost = cost + prior * (gain - common) ** 2 + (gloss_prior * (t - 1) ** 2)[..., None] / 3
        return cost, gain, t

    def costs(self) -> np.ndarray:
        """(levels, O + 1, 3)."""
        yx, yz, xx, xz, zz = (part[:, -1:] for part in self._at(LOG_LEVELS[:, None]))
        # sum w (y - x - z)^2: anchors have g = t = 1.
        anchors = self.observed_squared[-1:] - 2 * yx - 2 * yz + xx + 2 * xz + zz
        return np.concatenate([self._solve(LOG_LEVELS[:, None])[0], anchors], 1)

    def gains(self, log_level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(g (O, 3), t (O,)) at log s (3,)."""
        return self._solve(log_level)[1:]

    def colour_error(self, costs: np.ndarray) -> np.ndarray:
        """(3,) standard error of log s of each channel relative to one log s of all, by the jackknife over objects; 0, as if it
        were known, where there is nothing to leave out."""
        has_rows = self.observed_squared[:-1].sum(1) > 0
        n = int(has_rows.sum())
        if n < 2:
            return np.zeros(3)
        whole = costs.sum(1)
        # Costs add up over objects, so leaving one out is a subtraction and needs no further solve.
        left_out = np.moveaxis(whole[:, None] - costs[:, :-1][:, has_rows], 2, 0)  # (3, levels, n)
        # What all channels do together is an error of the level and none of its colour.
        of_all = _lowest(left_out.sum(0)) - _lowest(whole.sum(1)[:, None])
        moved = np.stack([_lowest(own) for own in left_out]) - _lowest(whole)[:, None] - of_all
        at = left_out.argmin(1)
        is_inside = (at > 0).all(1) & (at < len(LOG_LEVELS) - 1).all(1)
        return np.where(is_inside, np.sqrt(SHARED_COLOUR_ERROR**2 + (n - 1) / n * (moved**2).sum(1)), np.inf)

    def level_error(self, costs: np.ndarray | None = None) -> float:
        """Standard error of one log s of all channels by the jackknife over objects (Eq. L.45); `costs`: as of `costs`."""
        costs = (self.costs() if costs is None else costs).sum(2)
        has_rows = self.observed_squared[:-1].sum(1) > 0
        whole, n = costs.sum(1), int(has_rows.sum())
        if n < 2:
            return float("inf")
        left_out = whole[:, None] - costs[:, :-1][:, has_rows]
        if not 0 < left_out.argmin(0).min() <= left_out.argmin(0).max() < len(LOG_LEVELS) - 1:  # flat, or beyond the grid
            return float("inf")
        without = _lowest(left_out)
        own = np.sqrt((n - 1) / n * ((without - _lowest(whole[:, None])) ** 2).sum())
        return float(np.hypot(SHARED_LEVEL_ERROR, own))


def _lowest(costs: np.ndarray) -> np.ndarray:
    """Log level at which each column of (levels, n) is least: a parabola through the smallest value and its neighbours."""
    at = np.clip(costs.argmin(0), 1, len(LOG_LEVELS) - 2)
    column = np.arange(costs.shape[1])
    before, here, after = (costs[at + i, column] for i in (-1, 0, 1))
    bend = before - 2 * here + after
    part = np.divide(before - after, 2 * bend, out=np.zeros(len(at)), where=bend > 0)
    return LOG_LEVELS[at] + np.clip(part, -1.0, 1.0) * (LOG_LEVELS[1] - LOG_LEVELS[0])
