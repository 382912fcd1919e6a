"""Albedo gains of objects that go with the light: the base texture is off by a factor per object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .direct import solve_emission
from .rows import EmissionRows, scale_rows

LEVEL_OF_PRIOR = 0.35
"""Standard deviation of the logarithm of the level that the mean albedo of the base texture gives the light: it is off by
factors of 1.22, 1.36 and 1.41 on the three scenes with truth (docs/affines.md)."""
SHARED_ERROR = 0.1
"""Error of the logarithm of the level that no object tells from another's: light that geometry, cache and materials lose
everywhere. The built-in kitchen's light comes out 11 % too dim, 5 % with the true materials."""
_LEVELS = np.linspace(-2.0, 2.0, 161)
"""Logarithms of the level of all light that are tried."""
_BOUNDS = (0.1, 10.0)
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
    """

    gain: np.ndarray
    level_error: float
    error_of_group: np.ndarray
    weight: np.ndarray
    raised: float = 0.0


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
    """
    count = max(int(owner.max(initial=-1)) + 1, n_objects)
    gain = np.ones((count, 3))
    known = owner >= 0
    if not known.any() or rows.groups == 0:
        return ObjectGains(gain, float("inf"), np.full((rows.groups, 3), np.inf), rows.weight)
    # Every row that is no object's is an anchor, its gain is 1: an object of its own at the end.
    column = np.where(known, owner, count)
    weight = rows.weight
    cached = [observed - rows.target, observed - rows.target_second]
    share = _by_object(np.where(rows.lower_bound, 0.0, weight) * observed**2, column, count + 1)[:count]
    profile = None
    for _ in range(rounds):
        of_row = np.concatenate([gain, np.ones((1, 3))])[column]
        weighed = replace(rows, weight=weight)
        radiance = solve_emission(scale_rows(weighed, observed, of_row), initial, cross, max_rounds=5).radiance
        emitted = [np.einsum("ngc,gc->nc", a, radiance) for a in (rows.first, rows.second)]
        predicted = of_row * 0.5 * (emitted[0] + emitted[1] + cached[0] + cached[1])
        weight = _relative_to(rows, observed, predicted, known)
        used = np.where(rows.lower_bound, 0.0, weight)
        profile = _Profile.of(observed, emitted, cached, used, column, count + 1, cross, shrink, pinned)
        level, raised = _below_white(profile, column, albedo) if pinned else (np.zeros(3), 0.0)
        new = profile.gain(level)
        if not pinned:
            new /= np.exp((share * np.log(new)).sum(0) / np.maximum(share.sum(0), 1e-300))
        done = np.abs(np.log(new / gain)).max() < 1e-3
        gain = new
        if done:
            break
    errors = float("inf"), np.full((rows.groups, 3), np.inf)
    if pinned:
        errors = _level_errors(replace(rows, weight=weight), observed, cached, radiance, column, count + 1, cross, shrink)
    return ObjectGains(gain, *errors, weight, raised)


def _level_errors(
    rows: EmissionRows,
    observed: np.ndarray,
    cached: list[np.ndarray],
    radiance: np.ndarray,
    column: np.ndarray,
    count: int,
    cross: bool,
    shrink: float,
) -> tuple[float, np.ndarray]:
    """(error of the level of all light, (G, 3) of each group's).

    What emitters radiate that are seen unsaturated (share phi of the light on the rows) is as good as photographed, so for the
    level of the others it stands beside h: y = g_o (s A_free E_free + (A_seen E_seen + h)), with error e_free. Whether those
    that are seen are emitters at all, and radiate elsewhere what they show the camera, is told by the level that objects would
    give all light without them: its log s, as far as its own error e_all does not explain it, is theirs,
    e_seen^2 = log^4 s / (log^2 s + e_all^2). Of all light: e^2 = ((1 - phi) e_free)^2 + (phi e_seen)^2.
    """
    seen = _seen(rows, column == count - 1)
    parts = [
        [np.einsum("ngc,gc->nc", a, np.where(which, radiance, 0.0)) for a in (rows.first, rows.second)] for which in (~seen, seen)
    ]
    reflects = (column < count - 1)[:, None] & ~rows.lower_bound
    used = np.where(reflects, rows.weight, 0.0)

    def profile(emitted: list[np.ndarray], known: list[np.ndarray]) -> _Profile:
        return _Profile.of(observed, emitted, known, used, column, count, cross, shrink, True)

    beside = [h + d for h, d in zip(cached, parts[1], strict=True)]
    free_error = profile(parts[0], beside).level_error()
    if not seen.any():
        return free_error, np.full(seen.shape, free_error)
    size = [float((used * observed * 0.5 * (d[0] + d[1])).sum()) for d in parts]
    phi = float(np.clip(size[1] / max(sum(size), 1e-300), 0.0, 1.0)) if size[1] > 0 else 0.0
    everything = profile([a + b for a, b in zip(*parts, strict=True)], cached)
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
    best, objects = profile.level(), len(profile.yy) - 1
    if albedo is None:
        return best, 0.0
    base = np.asarray(albedo, np.float64)[:objects]
    rows = np.bincount(owner, minlength=objects + 1)[:objects].astype(np.float64)
    for step in _LEVELS[_LEVELS >= 0.0]:
        whitest = (profile.gain(best + step) * base).max(1)
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
class _Profile:
    """sum w (y - g_o (s d + h))^2 as quadratic forms of (1, s), each (O + 1, 3); the last object's gain is 1."""

    yy: np.ndarray
    yd: np.ndarray
    yh: np.ndarray
    dd: np.ndarray
    dh: np.ndarray
    hh: np.ndarray
    shrink: float
    pinned: bool

    @classmethod
    def of(
        cls,
        y: np.ndarray,
        emitted: list[np.ndarray],
        cached: list[np.ndarray],
        weight: np.ndarray,
        owner: np.ndarray,
        count: int,
        cross: bool,
        shrink: float,
        pinned: bool,
    ) -> _Profile:
        """With `cross`, products of the two traces, which share no noise."""
        (d1, d2), (h1, h2) = emitted, cached
        d, h = 0.5 * (d1 + d2), 0.5 * (h1 + h2)
        if not cross:
            d1 = d2 = d
            h1 = h2 = h
        products = (y * y, y * d, y * h, d1 * d2, 0.5 * (d1 * h2 + d2 * h1), h1 * h2)
        return cls(*[_by_object(weight * p, owner, count) for p in products], shrink, pinned)

    def _solve(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(cost, gain) of all but the last object, at log s (..., 1 or 3): (..., O, 3)."""
        s = np.exp(level)[..., None, :]
        top = (s * self.yd + self.yh)[..., :-1, :]
        bottom = np.maximum((s * s * self.dd + 2 * s * self.dh + self.hh)[..., :-1, :], 0.0)
        floor = 1e-9 * np.maximum(bottom.max((-2, -1), keepdims=True), 1e-300)
        pull = self.shrink * bottom + floor
        total, below = top.sum(-2, keepdims=True), bottom.sum(-2, keepdims=True)
        common = np.clip((total + floor) / (below + floor), *_BOUNDS) if self.pinned else 1.0
        gain = np.clip((top + pull * common) / (bottom + pull), *_BOUNDS)
        cost = self.yy[:-1] - 2 * gain * top + gain**2 * bottom + pull * (gain - common) ** 2
        return cost, gain

    def costs(self) -> np.ndarray:
        """(levels, O + 1, 3)."""
        s = np.exp(_LEVELS)[:, None, None]
        anchors = self.yy[-1:] - 2 * (s * self.yd + self.yh)[:, -1:] + (s * s * self.dd + 2 * s * self.dh + self.hh)[:, -1:]
        return np.concatenate([self._solve(_LEVELS[:, None])[0], anchors], 1)

    def gain(self, level: np.ndarray) -> np.ndarray:
        """(O, 3) at log s (3,)."""
        return self._solve(level)[1]

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
