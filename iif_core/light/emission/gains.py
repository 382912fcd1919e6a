"""Albedo gains of objects that go with the light: the base texture is off by a factor per object."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.light.emission.direct import solve_emission
from iif_core.light.emission.rows import EmissionRows, GlossRows, scale_rows

LEVEL_OF_PRIOR = 0.35
"""Standard deviation of the logarithm of the level that the mean albedo of the base texture gives the light: it is off by
factors of 1.22, 1.36 and 1.41 on the three scenes with truth (docs/method/fitting.md)."""
SHARED_ERROR = 0.1
"""Error of the logarithm of the level that no object tells from another's: light that geometry, cache and materials lose
everywhere. The built-in kitchen's light comes out 10 % too dim, 2 % with the true materials."""
_LEVELS = np.linspace(-2.0, 2.0, 161)
"""Logarithms of the level of all light that are tried."""
_BOUNDS = (0.1, 10.0)
_GLOSS_BOUNDS = (0.0, 3.0)
GLOSS_ROWS = 30.0
"""The predicted strength of an object's gloss is off by 100 %, say, and that is held against this many rows: so many of an object
may err together (design effects, docs/method/light.md)."""
WHITE_SHARE = 0.03
"""Share of the rows whose objects may come out brighter than white: gloss, and lamps that nobody found."""


@dataclass(frozen=True)
class ObjectGains:
    """Result of `object_gains`.

    Attributes:
        gain: (n_objects, 3) > 0.
        level_error: standard error of the logarithm of the level of all light (the same factor on every emitter); infinite
            where nothing tells it.
        error_of_group: (G, 3) the same of the light of each group: 0 where it is itself seen unsaturated.
        weight: (n, 3) of the rows, relative to what they are predicted to show.
        raised: logarithm by which all light is brighter than of least cost, for albedos of at most 1; not in the errors.
        gloss_gain: (n_objects,) >= 0 strength of the specular lobe relative to the predicted one; 1 without `gloss`.
    """

    gain: np.ndarray
    level_error: float
    error_of_group: np.ndarray
    weight: np.ndarray
    raised: float = 0.0
    gloss_gain: np.ndarray = field(default_factory=lambda: np.ones(0))


def object_gains(
    rows: EmissionRows,
    observed: np.ndarray,
    owner: np.ndarray,
    initial: np.ndarray,
    pinned: bool,
    cross: bool = True,
    rounds: int = 15,
    shrink: float = 0.05,
    albedo: np.ndarray | None = None,
    n_objects: int = 0,
    gloss: GlossRows | None = None,
) -> ObjectGains:
    """Albedo gain of each object and channel that goes with the light.

    The base texture is off by a factor per object, and light solved with wrong albedos comes out wrong where an object
    faces one emitter more than another. y = g_o (A E + h) is solved by turns for E (non-negative least squares)
    and for g (a ratio per object, pulled to what all have in common). By turns alone the level of E would creep, a few per cent a
    turn, so with each g goes the level s that is best for it: y = g_o (s A E + h), g eliminated. Where neither an emitter is seen
    unsaturated nor photographed light (h) shares in what is reflected, only the product g E is known: the mean of log g over the
    rows stays 0 then, as the prior has it.

    Rows have relative noise, and come with weights relative to what was seen, so what is too dark by its noise counts for
    more, and lights and gains come out too dim (10 % on the built-in kitchen). Each turn makes them relative to what is
    predicted (iteratively re-weighted least squares), at least to half of what is seen: a highlight that the model lacks must
    not count for more.

    The level is found from how unlike the shares of h are. What that is worth is told by the jackknife over objects (Tukey 1958):
    errors of geometry, cache and texture are shared within an object, not between objects. What all share is added
    (`SHARED_ERROR`). An emitter that is seen unsaturated is known in the units of the photographs, others are not by that: see
    `_level_errors`.

    With `gloss`, what the specular lobe reflects has a factor t_o of its own, common to the channels (F_0 of a dielectric does
    not follow its albedo), y = g_o (s A_d E + h_d) + t_o (s A_s E + h_s), leaning on 1 (`GLOSS_ROWS`). Predicted gloss is often
    wrong: plaster with lobes shows lamps that the photographs do not, and the light comes out too dim (8 % in the kitchen).

    Nothing reflects more than it receives. With `albedo`, the level is the lowest from there upwards at which the largest channel
    of g_o albedo_o is above 1 for at most `WHITE_SHARE` of the rows.

    Args:
        rows, observed, initial, cross: as in `scale_rows` and `solve_emission`.
        owner: (n,) object of each row, -1 = not reflected light (a pixel on an emitter).
        pinned: E has a scale of its own.
        rounds: of the alternation.
        shrink: pull of g to the common one (not `pinned`: to 1) relative to the rows.
        albedo: (n_objects, 3) mean base albedo; None: no ceiling.
        n_objects: at least so many gains come back; an object without rows has what all have in common.
        gloss: the specular part of the rows.
    """
    count = max(int(owner.max(initial=-1)) + 1, n_objects)
    gain, gloss_gain = np.ones((count, 3)), np.ones(count)
    known = owner >= 0
    if not known.any() or rows.groups == 0:
        nothing = np.full((rows.groups, 3), np.inf)
        return ObjectGains(gain, float("inf"), nothing, rows.weight, gloss_gain=gloss_gain)
    # Every row that is no object's is an anchor, its gain is 1: an object of its own at the end.
    column = np.where(known, owner, count)
    weight = rows.weight
    parts = _Parts(rows, [observed - rows.target, observed - rows.target_second], gloss, column, count + 1, cross, shrink, pinned)
    doubt = np.zeros(count)
    share = _by_object(np.where(rows.lower_bound, 0.0, weight) * observed**2, column, count + 1)[:count]
    profile = None
    for _ in range(rounds):
        of_row, gloss_of_row = np.concatenate([gain, np.ones((1, 3))])[column], np.append(gloss_gain, 1.0)[column]
        weighed = scale_rows(replace(rows, weight=weight), observed, of_row, gloss, gloss_of_row)
        radiance = solve_emission(weighed, initial, cross, max_rounds=5).radiance
        mean_a, mean_h = 0.5 * (weighed.first + weighed.second), observed - weighed.mean_target
        predicted = np.einsum("ngc,gc->nc", mean_a, radiance) + mean_h
        weight = _relative_to(rows, observed, predicted, known)
        used = np.where(rows.lower_bound, 0.0, weight)
        if gloss is not None:  # what an object's rows leave unexplained, a row
            left = _by_object(used * (observed - predicted) ** 2, column, count + 1)[:count].sum(1)
            doubt = GLOSS_ROWS * left / np.maximum(np.bincount(column, (used > 0).sum(1), count + 1)[:count], 1)
        profile = parts.profile(observed, used, doubt, radiance)
        level, raised = _below_white(profile, column, albedo) if pinned else (np.zeros(3), 0.0)
        new, gloss_gain = profile.gain(level)
        if not pinned:
            new /= np.exp((share * np.log(new)).sum(0) / np.maximum(share.sum(0), 1e-300))
        done = np.abs(np.log(new / gain)).max() < 1e-3
        gain = new
        if done:
            break
    errors = float("inf"), np.full((rows.groups, 3), np.inf)
    if pinned:
        errors = _level_errors(replace(rows, weight=weight), parts, observed, doubt, radiance)
    return ObjectGains(gain, *errors, weight, raised, gloss_gain)


def _level_errors(
    rows: EmissionRows, parts: _Parts, observed: np.ndarray, doubt: np.ndarray, radiance: np.ndarray
) -> tuple[float, np.ndarray]:
    """(error of the level of all light, (G, 3) of each group's).

    What emitters radiate that are seen unsaturated (share phi of the light on the rows) is as good as photographed, so for the
    level of the others it stands beside h: y = g_o (s A_free E_free + (A_seen E_seen + h)), with error e_free. Whether those
    that are seen are emitters at all, and radiate elsewhere what they show the camera, is told by the level that objects would
    give all light without them: its log s, as far as its own error e_all does not explain it, is theirs,
    e_seen^2 = log^4 s / (log^2 s + e_all^2). Of all light: e^2 = ((1 - phi) e_free)^2 + (phi e_seen)^2.
    """
    anchor = parts.column == parts.count - 1
    seen = _seen(rows, anchor)
    used = np.where(anchor[:, None] | rows.lower_bound, 0.0, rows.weight)
    free, shown = (np.where(which, radiance, 0.0) for which in (~seen, seen))
    free_error = parts.profile(observed, used, doubt, free, beside=shown).level_error()
    if not seen.any():
        return free_error, np.full(seen.shape, free_error)
    mean = 0.5 * (rows.first + rows.second)
    size = [float((used * observed * np.einsum("ngc,gc->nc", mean, e)).sum()) for e in (free, shown)]
    phi = float(np.clip(size[1] / max(sum(size), 1e-300), 0.0, 1.0)) if size[1] > 0 else 0.0
    everything = parts.profile(observed, used, doubt, radiance)
    error = everything.level_error()
    off = float(_lowest(everything.costs().sum(2).sum(1)[:, None])[0])
    # Objects that know less than the prior does are no witnesses.
    seen_error = off**2 / max(np.hypot(off, error), 1e-300) if error < LEVEL_OF_PRIOR else 0.0
    # Where nothing tells the level of the others, it is at most as uncertain as the prior's, the more so the less is seen.
    rest = (1.0 - phi) * min(free_error, LEVEL_OF_PRIOR / phi) if phi > 0 else free_error
    return float(np.hypot(rest, phi * seen_error)), np.where(seen, 0.0, free_error)


def _seen(rows: EmissionRows, direct: np.ndarray) -> np.ndarray:
    """(G, 3) bool: a row `direct` (n,) shows the group itself, and is no bound."""
    shown = (rows.first[direct] > 0) & ~rows.lower_bound[direct][:, None] & (rows.weight[direct] > 0)[:, None]
    return shown.any(0)


def _below_white(profile: _Profile, owner: np.ndarray, albedo: np.ndarray | None) -> tuple[np.ndarray, float]:
    """(3,) log s of least cost, raised in all channels alike until albedos are possible, and by how much; not raised where no
    level makes them so. owner: (n,), the last = anchors."""
    best, objects = profile.level(), profile.objects
    if albedo is None:
        return best, 0.0
    base = np.asarray(albedo, np.float64)[:objects]
    rows = np.bincount(owner, minlength=objects + 1)[:objects].astype(np.float64)
    for step in _LEVELS[_LEVELS >= 0.0]:
        whitest = (profile.gain(best + step)[0] * base).max(1)
        if rows[whitest > 1.0].sum() <= WHITE_SHARE * rows.sum():
            return best + step, float(step)
    return best, 0.0


def _relative_to(rows: EmissionRows, observed: np.ndarray, predicted: np.ndarray, reflects: np.ndarray) -> np.ndarray:
    """Weights (n, 3) of rows that were weighed relative to what they show, with what they are predicted to show instead."""
    if rows.noise is None:
        return rows.weight
    scale = rows.noise + np.where(reflects, predicted.mean(1) - np.abs(observed).mean(1), 0.0)
    return rows.weight * ((rows.noise / np.maximum(scale, 0.5 * rows.noise)) ** 2)[:, None]


def _by_object(values: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(owner, values[:, c], count) for c in range(3)], 1)


@dataclass(frozen=True)
class _Parts:
    """The rows as objects see them: `column` (n,) is the object, count - 1 that of the anchors, whose gains are 1."""

    rows: EmissionRows
    cached: list[np.ndarray]
    gloss: GlossRows | None
    column: np.ndarray
    count: int
    cross: bool
    shrink: float
    pinned: bool

    def profile(
        self, y: np.ndarray, weight: np.ndarray, doubt: np.ndarray, radiance: np.ndarray, beside: np.ndarray | None = None
    ) -> _Profile:
        """Costs at all levels of the light `radiance` (G, 3), with `beside` (G, 3) of a level that is known; weight (n, 3)."""

        def lobe(matrices: list[np.ndarray], cached: list[np.ndarray]) -> tuple[_Halves, _Halves]:
            emitted = [np.einsum("ngc,gc->nc", a, radiance) for a in matrices]
            known = [np.einsum("ngc,gc->nc", a, beside) for a in matrices] if beside is not None else (0.0, 0.0)
            constant = [h + k for h, k in zip(cached, known, strict=True)]
            if not self.cross:
                emitted, constant = ([0.5 * (a + b)] * 2 for a, b in (emitted, constant))
            return tuple(emitted), tuple(constant)

        def sums(values: np.ndarray) -> np.ndarray:
            return _by_object(weight * values, self.column, self.count)

        def both(a: _Halves, b: _Halves) -> np.ndarray:  # the two traces share no noise
            return sums(0.5 * (a[0] * b[1] + a[1] * b[0]))

        d, h = lobe([self.rows.first, self.rows.second], self.cached)
        if self.gloss is None:
            e, k, holds = d, h, None
            zero = np.zeros((self.count, 3))
            lobes = zero, zero, (zero,) * 3, (zero,) * 3
        else:
            e, k = lobe([self.gloss.first, self.gloss.second], [self.gloss.cached, self.gloss.cached_second])
            d, h = (tuple(whole - part for whole, part in zip(*pair, strict=True)) for pair in ((d, e), (h, k)))
            holds = doubt
            crossed = both(d, e), both(d, k) + both(h, e), both(h, k)
            lobes = (
                sums(y * 0.5 * (e[0] + e[1])),
                sums(y * 0.5 * (k[0] + k[1])),
                crossed,
                (both(e, e), 2 * both(e, k), both(k, k)),
            )
        return _Profile(
            sums(y * y),
            sums(y * 0.5 * (d[0] + d[1])),
            sums(y * 0.5 * (h[0] + h[1])),
            (both(d, d), 2 * both(d, h), both(h, h)),
            *lobes,
            holds,
            self.shrink,
            self.pinned,
        )


_Halves = tuple[np.ndarray, np.ndarray]
_Quadratic = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Profile:
    """sum w (y - g_o (s d + h) - t_o (s e + k))^2 as polynomials in s, coefficients (O + 1, 3); the last object's g and t are 1.

    yy; yd, yh, ye, yk: products with y; xx, xz, zz: of x = s d + h and z = s e + k, from s^2 to 1. doubt: (O,) weight of
    (t - 1)^2, None: there is no e and k."""

    yy: np.ndarray
    yd: np.ndarray
    yh: np.ndarray
    xx: _Quadratic
    ye: np.ndarray
    yk: np.ndarray
    xz: _Quadratic
    zz: _Quadratic
    doubt: np.ndarray | None
    shrink: float
    pinned: bool

    @property
    def objects(self) -> int:
        return len(self.yy) - 1

    def _at(self, level: np.ndarray) -> tuple[np.ndarray, ...]:
        """y x, y z, x x, x z, z z at log s (..., 1 or 3): (..., O + 1, 3)."""
        s = np.exp(level)[..., None, :]
        linear = [s * a + b for a, b in ((self.yd, self.yh), (self.ye, self.yk))]
        return *linear, *(s * s * q[0] + s * q[1] + q[2] for q in (self.xx, self.xz, self.zz))

    def _solve(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(cost, g, t) of all but the last object, at log s (..., 1 or 3): (..., O, 3) twice and (..., O)."""
        yx, yz, xx, xz, zz = (part[..., :-1, :] for part in self._at(level))
        xx, zz = np.maximum(xx, 0.0), np.maximum(zz, 0.0)
        floor = 1e-9 * np.maximum(xx.max((-2, -1), keepdims=True), 1e-300)
        pull = self.shrink * xx + floor

        def common_gain(t: np.ndarray) -> np.ndarray | float:
            total, below = (yx - t[..., None] * xz).sum(-2, keepdims=True), xx.sum(-2, keepdims=True)
            return np.clip((total + floor) / (below + floor), *_BOUNDS) if self.pinned else 1.0

        t, held = np.ones(xx.shape[:-1]), 0.0
        common = common_gain(t)
        if self.doubt is not None:
            # g eliminated, then t; noise may make the rest negative, which then knows nothing.
            held = self.doubt + self.shrink * zz.sum(-1) + floor[..., 0]
            knows = np.maximum((zz - xz**2 / (xx + pull)).sum(-1), 0.0)
            asks = (yz - xz * (yx + pull * common) / (xx + pull)).sum(-1)
            t = np.clip(np.where(knows > 0, (asks + held) / (knows + held), 1.0), *_GLOSS_BOUNDS)
            common = common_gain(t)
        of_all = t[..., None]
        gain = np.clip((yx - of_all * xz + pull * common) / (xx + pull), *_BOUNDS)
        cost = self.yy[:-1] - 2 * gain * yx - 2 * of_all * yz + gain**2 * xx + 2 * gain * of_all * xz + of_all**2 * zz
        cost = cost + pull * (gain - common) ** 2 + (held * (t - 1) ** 2)[..., None] / 3
        return cost, gain, t

    def costs(self) -> np.ndarray:
        """(levels, O + 1, 3)."""
        yx, yz, xx, xz, zz = (part[:, -1:] for part in self._at(_LEVELS[:, None]))
        anchors = self.yy[-1:] - 2 * yx - 2 * yz + xx + 2 * xz + zz
        return np.concatenate([self._solve(_LEVELS[:, None])[0], anchors], 1)

    def gain(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(g (O, 3), t (O,)) at log s (3,)."""
        return self._solve(level)[1:]

    def level(self) -> np.ndarray:
        """(3,) log s of least cost."""
        return _lowest(self.costs().sum(1))

    def level_error(self) -> float:
        """Standard error of one log s of all channels, objects left out in turn; see `SHARED_ERROR`."""
        costs = self.costs().sum(2)
        there = self.yy[:-1].sum(1) > 0
        whole, n = costs.sum(1), int(there.sum())
        if n < 2:
            return float("inf")
        left = whole[:, None] - costs[:, :-1][:, there]
        if not 0 < left.argmin(0).min() <= left.argmin(0).max() < len(_LEVELS) - 1:  # flat, or beyond what is tried
            return float("inf")
        without = _lowest(left)
        own = np.sqrt((n - 1) / n * ((without - _lowest(whole[:, None])) ** 2).sum())
        return float(np.hypot(SHARED_ERROR, own))


def _lowest(costs: np.ndarray) -> np.ndarray:
    """Where each column of (levels, n) is least: a parabola through the smallest value and its neighbours."""
    at = np.clip(costs.argmin(0), 1, len(_LEVELS) - 2)
    column = np.arange(costs.shape[1])
    before, here, after = (costs[at + i, column] for i in (-1, 0, 1))
    bend = before - 2 * here + after
    part = np.divide(before - after, 2 * bend, out=np.zeros(len(at)), where=bend > 0)
    return _LEVELS[at] + np.clip(part, -1.0, 1.0) * (_LEVELS[1] - _LEVELS[0])
