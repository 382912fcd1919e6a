"""One affine correction per object and the camera response, fitted to the photographs over cached shading (METHOD 7b).

Object o corrects its base texture by sixteen numbers,
    a = A a~ + b (3 x 4),   r = g_r r~ + h_r,   m = g_m m~ + h_m,
and pixel p of it shows I = f(e L), L = (1 - m) a D + [0.04 (1 - m) + m a] S0(r) + S1(r).
Objects meet only in the few response parameters, so the Gauss-Newton system is an arrowhead: small blocks per
object and one small Schur complement. Steps are damped per object (Levenberg-Marquardt) and taken only when the
objective falls.

Noise in the cached shading flattens the slope of log I over log L: a plain fit overestimates gamma and shrinks
gains. With two independent halves 1, 2 of the cache we minimise sum rho(e1 e2) instead of sum rho(e^2): the
expectation of the product of two residuals with independent noise is the squared noise-free residual, and its
Gauss-Newton system is H = (J1' W J2 + J2' W J1) / 2, g = (J1' W e2 + J2' W e1) / 2.

The order of the sixteen numbers: A and b row by row [A00 A01 A02 b0 A10 ...], then (g_r, h_r), then (g_m, h_m).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.errors import InputError
from iif_core.response import Response

PARAMETERS = 16
ROUGHNESS_MIN = 0.02
IDENTITY = np.r_[np.eye(3, 4).ravel(), 1.0, 0.0, 1.0, 0.0]
_GAINS = np.array([0, 5, 10])
_BIASES = np.array([3, 7, 11])
_CROSS = np.array([1, 2, 4, 6, 8, 9])
_ROUGHNESS = np.array([12, 13])
_METALLIC = np.array([14, 15])
# Pull of each number relative to `FitOptions.ridge`. Cross terms of A are weakly determined under coloured light
# (METHOD 7b); gains of an albedo are what the fit is for; predicted metalness is the least trustworthy of all.
_RIDGE = np.r_[np.where(np.isin(np.arange(12), _GAINS), 0.1, 1.0), 2.0, 0.5, 0.1, 0.1]
_BOX = 0.05  # weight of the squared distance to the allowed range; gives clamped values a way back (METHOD H13)
_CHUNK = 1 << 16


@dataclass(frozen=True)
class FitProblem:
    """Pixels of the fit; n pixels, J levels, h = 1 or 2 independent halves of the cache.

    Attributes:
        object_id: (n,) int in [0, n_objects); -1 is left out.
        n_objects: O.
        base: (n, 5) albedo, roughness, metallic of the base texture.
        diffuse: h arrays (n, 3); s0, s1: h arrays (n, J, 3), shading of METHOD 2.7.
        levels: (J,) roughness of the levels, increasing.
        value: (n, 3) sensor value f(e L).
        exposure: (n,) e.
        saturated: (n, 3) bool: `value` is a lower bound.
    """

    object_id: np.ndarray
    n_objects: int
    base: np.ndarray
    diffuse: tuple[np.ndarray, ...]
    s0: tuple[np.ndarray, ...]
    s1: tuple[np.ndarray, ...]
    levels: np.ndarray
    value: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray

    def __post_init__(self) -> None:
        n, j = len(self.object_id), len(self.levels)
        shapes = {"base": (n, 5), "value": (n, 3), "exposure": (n,), "saturated": (n, 3)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"fit: {name} has shape {getattr(self, name).shape}, needed {shape}")
        if not 1 <= len(self.diffuse) <= 2 or not len(self.diffuse) == len(self.s0) == len(self.s1):
            raise InputError(f"fit: {len(self.diffuse)} halves of the cache, needed 1 or 2")
        for d, s0, s1 in zip(self.diffuse, self.s0, self.s1, strict=True):
            if d.shape != (n, 3) or s0.shape != (n, j, 3) or s1.shape != (n, j, 3):
                raise InputError(f"fit: shading of shapes {d.shape}, {s0.shape}, {s1.shape}, needed {(n, 3)}, {(n, j, 3)}")
        if j < 2 or np.any(np.diff(self.levels) <= 0):
            raise InputError("fit: needs at least two increasing roughness levels")


@dataclass(frozen=True)
class FitOptions:
    """How to fit; the defaults are those of METHOD 7b and COMPUTE 6 unless said.

    Attributes:
        iterations: Gauss-Newton steps.
        ridge: pull to the identity per pixel.
        robust_width: Cauchy width of the residual in sensor units.
        min_pixels: objects with fewer keep the identity.
        free_response: fit the response parameters too.
        response_prior: mean (P,) and precision (P, P) of the response parameters, row by row, from their calibration.
            None: the start, and precision one.
        response_ridge: weight of that prior per pixel. 1e-5 is a residual of 0.05 squared over 250 independent errors:
            those of the shading go together over an object in a view, so pixels are no measure of what is known.
            RMS of the curve before and after the joint fit, worst channel, in per cent of the range: built-in kitchen 0.47
            and 0.59, Country Kitchen 0.60 and 0.62; with precision one instead of the calibration's 4.6 and 8.7.
        roughness_weight, metallic_weight: of |r - 1| and |m| in the mean squared error. The paper has 1e-3 and
            5e-3. On the built-in kitchen (draft) roughness L2 is 0.162 with 1e-3, 0.051 with 2e-4 and 0.038 with
            0: the ridge to the prior is the better tie-breaker; metallic L2 is 0.019 with 5e-3, 0.010 with 1e-3,
                0.120 with 0.
        metallic_prior: median predicted metalness from which it is free at once; elsewhere it must earn it.
        metallic_gain: share of the residual that a freed metalness must remove.
        multi_start: try several roughness and metalness levels per object.
        texture_sigma: standard deviation (albedo) above which a direction of the texture is real (2 / 255).
        scale: `prior` multiplies all albedos by one factor so that their mean over the pixels is the base's (LDR leaves
            light x albedo open); `none` keeps the factor that the given light implies.
    """

    iterations: int = 12
    ridge: float = 2e-3
    robust_width: float = 0.1
    min_pixels: int = 20
    free_response: bool = True
    response_prior: tuple[np.ndarray, np.ndarray] | None = None
    response_ridge: float = 1e-5
    roughness_weight: float = 0.0
    metallic_weight: float = 1e-3
    metallic_prior: float = 0.25
    metallic_gain: float = 0.01
    multi_start: bool = True
    texture_sigma: float = 2.0 / 255.0
    scale: str = "none"


@dataclass(frozen=True)
class FitResult:
    """Result of `fit_affines`.

    Attributes:
        affine: (O, 16) float64.
        covariance: (O, 16, 16): residual variance times the inverse normal matrix (ridge included); 0 for fixed
            numbers. Neighbouring pixels are taken as independent, so it is a lower bound.
        free: (O, 16) bool, which numbers were fitted.
        pixels: (O,) int, pixels in the fit.
        residual: (O,) root mean square of f(e L) - I in sensor units over unsaturated channels (HDR: in units of the
            logarithmic tone curve of the fit); 0 without pixels.
        model: O strings, e.g. `gain+bias, roughness`; `identity (12 pixels)`.
        response: the fitted response.
        light_scale: light must be multiplied by this to go with the albedos (1 unless `scale` is `prior`).
        history: objective after each step, never rising.
        converged: the last step no longer changed the objective.
    """

    affine: np.ndarray
    covariance: np.ndarray
    free: np.ndarray
    pixels: np.ndarray
    residual: np.ndarray
    model: list[str]
    response: Response
    light_scale: float
    history: list[float]
    converged: bool


def apply_affines(affine: np.ndarray, object_id: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Materials of base values: (n, 5) float64, albedo and metallic clamped to [0, 1], roughness to [0.02, 1].

    Args:
        affine: (O, 16); object_id: (n,), -1 keeps the base (clamped); base: (n, 5).
    """
    raw = _raw(
        np.where((object_id >= 0)[:, None], affine[object_id], IDENTITY)
        if len(affine)
        else np.broadcast_to(IDENTITY, (len(base), 16)),
        np.asarray(base, np.float64),
    )
    return _clamp(raw)


def albedo_uncertainty(
    affine: np.ndarray, covariance: np.ndarray, object_id: np.ndarray, base: np.ndarray, base_deviation: np.ndarray
) -> np.ndarray:
    """Standard deviation of the fitted albedo, mean over the channels: (n,) float64.

    Adds the fit's covariance at the base colour and the base's own standard deviation through A.

    Args:
        affine: (O, 16); covariance: (O, 16, 16); object_id: (n,), -1 = no fit; base: (n, 5); base_deviation: (n, 3).
    """
    known = object_id >= 0
    o = np.where(known, object_id, 0)
    one = np.concatenate([np.asarray(base, np.float64)[:, :3], np.ones((len(base), 1))], 1)
    variance = np.zeros((len(base), 3))
    spread = np.asarray(base_deviation, np.float64) ** 2
    for c in range(3):
        rows = slice(4 * c, 4 * c + 4)
        if len(affine):
            fit = np.einsum("ni,nij,nj->n", one, covariance[o][:, rows, rows], one)
            through = (affine[o][:, 4 * c : 4 * c + 3] ** 2 * spread).sum(1)
            variance[:, c] = np.where(known, np.maximum(fit, 0) + through, spread[:, c])
        else:
            variance[:, c] = spread[:, c]
    return np.sqrt(variance).mean(1)


def interpolate_levels(shading: np.ndarray, levels: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shading at any roughness, linear between levels, and its derivative: (n, 3), (n, 3).

    Args:
        shading: (n, J, 3); levels: (J,) increasing; roughness: (n,), clamped to the levels' range.
    """
    j, share, width = _bracket(levels, roughness)
    return _interpolate(shading, np.arange(len(roughness)), j, share, width)


def _bracket(levels: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    j = np.clip(np.searchsorted(levels, r, side="right") - 1, 0, len(levels) - 2)
    width = levels[j + 1] - levels[j]
    return j, np.clip((r - levels[j]) / width, 0.0, 1.0), width


def _interpolate(
    s: np.ndarray, k: np.ndarray, j: np.ndarray, share: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    low, high = s[k, j].astype(np.float64), s[k, j + 1].astype(np.float64)
    difference = high - low
    return low + share[:, None] * difference, difference / width[:, None]


def _raw(t: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Affine without clamping: t (n, 16), base (n, 5) -> (n, 5)."""
    a = np.einsum("nci,ni->nc", t[:, :12].reshape(-1, 3, 4)[:, :, :3], base[:, :3]) + t[:, _BIASES]
    r = t[:, 12] * base[:, 3] + t[:, 13]
    m = t[:, 14] * base[:, 4] + t[:, 15]
    return np.concatenate([a, r[:, None], m[:, None]], 1)


_LOW = np.array([0.0, 0.0, 0.0, ROUGHNESS_MIN, 0.0])


def _clamp(raw: np.ndarray) -> np.ndarray:
    return np.clip(raw, _LOW, 1.0)


@dataclass(frozen=True)
class _Tone:
    """What the residual is measured in: the sensor value (LDR), or a logarithmic curve of the radiance (HDR),
    where an error counts relative to the brightness down to a quarter of the median."""

    response: Response
    knee: float = 0.0
    gain: float = 1.0

    @property
    def size(self) -> int:
        return self.response.params.size

    @property
    def per_channel(self) -> bool:
        return self.response.params.ndim == 2

    def value(self, y: np.ndarray) -> np.ndarray:
        return self.gain * np.log1p(np.maximum(y, 0.0) / self.knee) if self.knee else np.asarray(y, np.float64)

    def evaluate(self, x: np.ndarray, jacobian: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self.knee:
            x = np.maximum(x, 0.0)
            return self.gain * np.log1p(x / self.knee), self.gain / (self.knee + x), np.zeros((*x.shape, 0))
        if jacobian:
            return self.response.evaluate(x)
        return self.response(x), x, x

    def at(self, params: np.ndarray) -> _Tone:
        shaped = np.asarray(params).reshape(self.response.params.shape)
        return replace(self, response=self.response.with_params(shaped)) if self.size else self


@dataclass
class _Pixels:
    """The problem, sorted by object."""

    obj: np.ndarray
    offsets: np.ndarray  # (O + 1,)
    base: np.ndarray
    halves: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    levels: np.ndarray
    target: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray
    trust: np.ndarray = field(default_factory=lambda: np.ones((0, 3)))

    @property
    def n_objects(self) -> int:
        return len(self.offsets) - 1

    @property
    def counts(self) -> np.ndarray:
        return np.diff(self.offsets)

    def take(self, index: np.ndarray) -> _Pixels:
        """A subset; `index` increasing."""
        offsets = np.searchsorted(self.obj[index], np.arange(self.n_objects + 1))
        halves = [(d[index], s0[index], s1[index]) for d, s0, s1 in self.halves]
        return _Pixels(
            self.obj[index],
            offsets,
            self.base[index],
            halves,
            self.levels,
            self.target[index],
            self.exposure[index],
            self.saturated[index],
            self.trust[index],
        )


@dataclass
class _Terms:
    """Objective per object, and its Gauss-Newton system when asked for."""

    cost: np.ndarray  # (O,)
    data: np.ndarray  # (O,) the data term alone
    h: np.ndarray  # (O, 16 + P, 16 + P)
    g: np.ndarray  # (O, 16 + P)


def _terms(px: _Pixels, affine: np.ndarray, tone: _Tone, opt: FitOptions, jacobian: bool) -> _Terms:
    n_objects, size = px.n_objects, tone.size
    width = PARAMETERS + size
    cost, data = np.zeros(n_objects), np.zeros(n_objects)
    h = np.zeros((n_objects, width, width)) if jacobian else np.zeros((0, 0, 0))
    g = np.zeros((n_objects, width)) if jacobian else np.zeros((0, 0))
    for start in range(0, len(px.obj), _CHUNK):
        _add_chunk(px, slice(start, min(start + _CHUNK, len(px.obj))), affine, tone, opt, cost, data, h, g, jacobian)
    pull = opt.ridge * _RIDGE * px.counts[:, None]
    away = affine - IDENTITY
    cost += 0.5 * (pull * away**2).sum(1)
    if jacobian:
        i = np.arange(PARAMETERS)
        h[:, i, i] += pull
        g[:, :PARAMETERS] += pull * away
    return _Terms(cost, data, h, g)


def _add_chunk(
    px: _Pixels,
    part: slice,
    affine: np.ndarray,
    tone: _Tone,
    opt: FitOptions,
    cost: np.ndarray,
    data: np.ndarray,
    h: np.ndarray,
    g: np.ndarray,
    jacobian: bool,
) -> None:
    obj, base = px.obj[part], px.base[part]
    k = np.arange(len(obj))
    raw = _raw(affine[obj], base)
    value = _clamp(raw)
    outside = raw - value
    a, r, m = value[:, :3], value[:, 3], value[:, 4:5]
    j, share, width = _bracket(px.levels, r)
    exposure, saturated, target = px.exposure[part, None], px.saturated[part], px.target[part]
    errors, slopes = [], []
    for d_all, s0_all, s1_all in px.halves:
        d = d_all[part].astype(np.float64)
        s0, ds0 = _interpolate(s0_all[part], k, j, share, width)
        s1, ds1 = _interpolate(s1_all[part], k, j, share, width)
        ks = 0.04 * (1.0 - m) + m * a
        radiance = (1.0 - m) * a * d + ks * s0 + s1
        f, df, dparams = tone.evaluate(exposure * radiance, jacobian)
        error = f - target
        idle = saturated & (error > 0)
        errors.append(np.where(idle, 0.0, error))
        if jacobian:
            df = np.where(idle, 0.0, df * exposure)
            slopes.append(
                (
                    df * ((1.0 - m) * d + m * s0),
                    df * (ks * ds0 + ds1),
                    df * (-a * d + (a - 0.04) * s0),
                    np.where(idle[..., None], 0.0, dparams),
                )
            )
    c2 = opt.robust_width**2
    product = errors[0] * errors[-1]
    trust = px.trust[part]
    # Odd in the product: were only positive ones damped, loud noise of opposite signs would pay, and the response
    # would be bent until it amplifies the noise.
    rho = 0.5 * np.sign(product) * c2 * np.log1p(np.abs(product) / c2)
    pixel_data = (trust * rho).sum(1)
    inside = outside[:, 3:] == 0
    # 3/2: the paper adds these to a mean over three channels of the squared error, we sum half the squares.
    light = 1.5 * (opt.roughness_weight * (1.0 - r) + opt.metallic_weight * m[:, 0]) + 0.5 * _BOX * (outside**2).sum(1)
    n_objects = len(cost)
    summed = np.bincount(obj, pixel_data, n_objects)
    data += summed
    cost += summed + np.bincount(obj, light, n_objects)
    if not jacobian:
        return
    weight = trust / (1.0 + np.abs(product) / c2)
    one = np.concatenate([base[:, :3], np.ones((len(obj), 1))], 1)
    rough = np.stack([base[:, 3], np.ones(len(obj))], 1)
    metal = np.stack([base[:, 4], np.ones(len(obj))], 1)
    free = (outside == 0).astype(np.float64)
    designs = []
    for da, dr, dm, dparams in slopes:
        columns = np.concatenate(
            [
                (da * free[:, :3]).T[..., None] * one,
                (dr * free[:, 3:4]).T[..., None] * rough,
                (dm * free[:, 4:5]).T[..., None] * metal,
                dparams.transpose(1, 0, 2),
            ],
            -1,
        )  # (3, n, 8 + P)
        designs.append(columns)
    first, second = designs[0], designs[-1]
    e1, e2 = errors[0], errors[-1]
    per = dparams.shape[-1]
    starts = np.flatnonzero(np.r_[True, np.diff(obj) != 0])
    stops = np.r_[starts[1:], len(obj)]
    for c in range(3):
        offset = PARAMETERS + (c * per if tone.per_channel else 0)
        columns = np.r_[4 * c + np.arange(4), _ROUGHNESS, _METALLIC, offset + np.arange(per)]
        weighted = weight[:, c, None] * second[c]
        gradient = 0.5 * (first[c] * (weight[:, c] * e2[:, c])[:, None] + weighted * e1[:, c, None])
        gradient = np.add.reduceat(gradient, starts, 0)
        for index, (s, t) in enumerate(zip(starts, stops, strict=True)):
            product_c = first[c][s:t].T @ weighted[s:t]
            o = obj[s]
            h[o][np.ix_(columns, columns)] += 0.5 * (product_c + product_c.T)
            g[o][columns] += gradient[index]
    _add_box(outside, inside, one, rough, metal, obj, starts, stops, opt, h, g)


def _add_box(
    outside: np.ndarray,
    inside: np.ndarray,
    one: np.ndarray,
    rough: np.ndarray,
    metal: np.ndarray,
    obj: np.ndarray,
    starts: np.ndarray,
    stops: np.ndarray,
    opt: FitOptions,
    h: np.ndarray,
    g: np.ndarray,
) -> None:
    """Range penalty and the linear regularisers."""
    owners = obj[starts]
    blocks = [(4 * c + np.arange(4), one, outside[:, c]) for c in range(3)]
    blocks += [(_ROUGHNESS, rough, outside[:, 3]), (_METALLIC, metal, outside[:, 4])]
    for columns, design, beyond in blocks:
        gradient = np.add.reduceat(_BOX * beyond[:, None] * design, starts, 0)
        g[owners[:, None], columns] += gradient
        touched = np.add.reduceat((beyond != 0).astype(np.int64), starts) > 0
        for index in np.flatnonzero(touched):
            s, t = starts[index], stops[index]
            x = design[s:t] * (beyond[s:t] != 0)[:, None]
            h[owners[index]][np.ix_(columns, columns)] += _BOX * (x.T @ x)
    for columns, design, sign, mask in (
        (_ROUGHNESS, rough, -1.5 * opt.roughness_weight, inside[:, 0]),
        (_METALLIC, metal, 1.5 * opt.metallic_weight, inside[:, 1]),
    ):
        g[owners[:, None], columns] += np.add.reduceat(sign * mask[:, None] * design, starts, 0)


def _inverse(h: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Inverses of the damped symmetric blocks (O, k, k); negative directions of the cross moment count by their
    size."""
    diagonal = np.abs(np.diagonal(h, axis1=1, axis2=2))
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12 * np.maximum(diagonal.max(1, keepdims=True), 1e-300)))
    unit = h * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(np.abs(values), 1e-10) + damping[:, None]
    inverse = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return inverse * scale[:, :, None] * scale[:, None, :]


def _masked(h: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The object blocks with fixed numbers cut out (identity rows keep them invertible)."""
    keep = free[:, :, None] & free[:, None, :]
    out = np.where(keep, h[:, :PARAMETERS, :PARAMETERS], 0.0)
    i = np.arange(PARAMETERS)
    out[:, i, i] += np.where(free, 0.0, 1.0)
    return out


def _adapt(damping: np.ndarray | float, better: np.ndarray | bool) -> np.ndarray:
    """Levenberg-Marquardt's rule; a refused step jumps to a damping that is felt."""
    return np.where(better, np.maximum(np.asarray(damping) * 0.2, 1e-9), np.clip(np.asarray(damping) * 10.0, 1e-4, 1e6))


@dataclass
class _State:
    affine: np.ndarray
    free: np.ndarray
    params: np.ndarray
    damping: np.ndarray
    response_damping: float
    history: list[float]


def _descend(
    px: _Pixels,
    state: _State,
    tone: _Tone,
    opt: FitOptions,
    iterations: int,
    free_response: bool,
    start_params: np.ndarray,
) -> tuple[_State, bool]:
    """Damped Gauss-Newton steps on all objects and the response; the objective never rises."""
    mean, precision = opt.response_prior or (start_params, np.eye(tone.size))
    pull = opt.response_ridge * len(px.obj) * precision

    def response_cost(params: np.ndarray) -> float:
        return float(0.5 * (params - mean) @ pull @ (params - mean))

    affine, params, damping = state.affine.copy(), state.params.copy(), state.damping.copy()
    history = list(state.history)
    mu = state.response_damping
    fitted = bool(free_response and tone.size)
    terms = _terms(px, affine, tone.at(params), opt, True)
    total = float(terms.cost.sum()) + response_cost(params)
    if not history:
        history.append(total)
    quiet = 0
    for _ in range(iterations):
        inverse = _inverse(_masked(terms.h, state.free), damping)
        g = np.where(state.free, terms.g[:, :PARAMETERS], 0.0)
        accepted = False
        if fitted:
            coupling = np.where(state.free[:, :, None], terms.h[:, :PARAMETERS, PARAMETERS:], 0.0)
            h_w = terms.h[:, PARAMETERS:, PARAMETERS:].sum(0) + pull
            g_w = terms.g[:, PARAMETERS:].sum(0) + pull @ (params - mean)
            through = coupling.transpose(0, 2, 1) @ inverse  # (O, P, 16)
            schur = h_w - (through @ coupling).sum(0)
            right = -g_w + (through @ g[:, :, None])[:, :, 0].sum(0)
            step = (_inverse(schur[None], np.array([mu]))[0] @ right).clip(-0.5, 0.5)
            new_params = tone.at(params + step).response.params.ravel()
            moved = new_params - params
            new_tone = tone.at(new_params)
            stay = _terms(px, affine, new_tone, opt, False).cost
            delta = -(inverse @ (g + (coupling @ moved))[:, :, None])[:, :, 0]
            go = _terms(px, affine + delta, new_tone, opt, False).cost
            better = go < stay
            new_total = float(np.where(better, go, stay).sum()) + response_cost(new_params)
            if new_total < total:
                affine = np.where(better[:, None], affine + delta, affine)
                damping = _adapt(damping, better)
                params, mu, accepted = new_params, float(_adapt(mu, True)), True
            else:
                mu = float(_adapt(mu, False))
        if not accepted:
            delta = -(inverse @ g[:, :, None])[:, :, 0]
            go = _terms(px, affine + delta, tone.at(params), opt, False).cost
            better = go < terms.cost
            affine = np.where(better[:, None], affine + delta, affine)
            damping = _adapt(damping, better)
            new_total = float(np.where(better, go, terms.cost).sum()) + response_cost(params)
        history.append(min(new_total, total))
        quiet = quiet + 1 if total - new_total <= 1e-9 * abs(total) + 1e-300 else 0
        terms = _terms(px, affine, tone.at(params), opt, True)
        total = float(terms.cost.sum()) + response_cost(params)
        if quiet >= 6:
            break
    return _State(affine, state.free, params, damping, mu, history), quiet > 0


def _free_numbers(px: _Pixels, opt: FitOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which numbers each object can carry: (O, 16) with metalness freed where predicted, (O,) rank, (O,) enough
    pixels."""
    n_objects = px.n_objects
    counts = np.maximum(px.counts, 1)[:, None]
    mean = np.stack([np.bincount(px.obj, px.base[:, c], n_objects) for c in range(5)], 1) / counts
    centred = px.base - mean[px.obj]
    covariance = np.zeros((n_objects, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            covariance[:, i, j] = covariance[:, j, i] = np.bincount(px.obj, centred[:, i] * centred[:, j], n_objects)
    rank = (np.linalg.eigvalsh(covariance / counts[:, :, None]) > opt.texture_sigma**2).sum(1)
    spread = np.stack([np.bincount(px.obj, centred[:, c] ** 2, n_objects) for c in (3, 4)], 1) / counts
    varied = spread > opt.texture_sigma**2
    enough = px.counts >= opt.min_pixels
    median_metal = np.array(
        [np.median(px.base[s:t, 4]) if t > s else 0.0 for s, t in zip(px.offsets[:-1], px.offsets[1:], strict=True)]
    )
    free = np.zeros((n_objects, PARAMETERS), bool)
    free[:, _GAINS] = enough[:, None]
    free[:, _BIASES] = (enough & (rank >= 1))[:, None]
    free[:, _CROSS] = (enough & (rank >= 2))[:, None]
    free[:, 12], free[:, 13] = enough & varied[:, 0], enough
    metal = enough & (median_metal > opt.metallic_prior)
    free[:, 14], free[:, 15] = metal & varied[:, 1], metal
    return free, rank, enough


def _starts(
    px: _Pixels, state: _State, tone: _Tone, opt: FitOptions, enough: np.ndarray, varied_metal: np.ndarray
) -> tuple[_State, np.ndarray]:
    """Other levels of roughness and metalness, each followed by a few steps with the response held; the best is kept.

    The objective is piecewise smooth in r and has a diffuse and a metallic valley, so one descent is not enough. A
    metalness that was not free must remove `metallic_gain` of the residual and pass an F test (2 numbers, F > 10)
    to become so.
    """
    n_objects = px.n_objects
    counts = np.maximum(px.counts, 1)
    mean_r, mean_m = (np.bincount(px.obj, px.base[:, c], n_objects) / counts for c in (3, 4))
    # At most 1500 pixels an object, evenly spread, are enough to choose a valley.
    rank_in_object = np.arange(len(px.obj)) - px.offsets[px.obj]
    stride = np.maximum(1, counts // 1500)
    few = px.take(np.flatnonzero(rank_in_object % stride[px.obj] == 0))
    tone_now = tone.at(state.params)
    best = state.affine.copy()
    free = state.free.copy()
    # Bounds alone cannot tell one valley from another.
    measured = np.bincount(few.obj, (~few.saturated).any(1), n_objects) >= opt.min_pixels
    terms = _terms(few, best, tone_now, opt, False)
    cost, data = terms.cost, terms.data
    degrees = np.maximum(3 * few.counts - PARAMETERS, 1)

    def attempt(start: np.ndarray, allowed: np.ndarray, opens_metal: bool) -> None:
        nonlocal best, cost, data, free
        trial = _State(start, allowed, state.params, np.full(n_objects, 1e-3), 1.0, [])
        trial, _ = _descend(few, trial, tone, replace(opt), 5, False, state.params)
        terms = _terms(few, trial.affine, tone_now, opt, False)
        gain = cost - terms.cost
        enough_gain = gain > 1e-3 * np.abs(cost)
        if opens_metal:
            closed = ~state.free[:, 15]
            f_value = 0.5 * (data - terms.data) / np.maximum(terms.data / degrees, 1e-300)
            pays = (data - terms.data > opt.metallic_gain * data) & (f_value > 10.0)
            enough_gain &= ~closed | pays
        take = enough & measured & enough_gain
        best = np.where(take[:, None], trial.affine, best)
        cost, data = np.where(take, terms.cost, cost), np.where(take, terms.data, data)
        free = np.where(take[:, None], allowed, free)

    for level in (0.15, 0.4, 0.7, 1.0):
        start = best.copy()
        start[:, 12], start[:, 13] = 1.0, level - mean_r
        attempt(start, free, False)
    opened = free.copy()
    opened[:, 14] |= enough & varied_metal
    opened[:, 15] |= enough
    for level in (0.0, 1.0):
        start = best.copy()
        start[:, 14] = np.where(varied_metal & (level == 0), 0.0, 1.0)
        start[:, 15] = level - start[:, 14] * mean_m
        attempt(start, opened, True)
    return _State(best, free, state.params, np.full(n_objects, 1e-3), state.response_damping, []), free


def _prepare(problem: FitProblem, response: Response) -> tuple[_Pixels, _Tone]:
    finite = np.isfinite(problem.base).all(1) & np.isfinite(problem.value).all(1)
    finite &= np.isfinite(problem.exposure) & (problem.exposure > 1e-6)
    for d, s0, s1 in zip(problem.diffuse, problem.s0, problem.s1, strict=True):
        finite &= np.isfinite(d).all(1) & np.isfinite(s0).all((1, 2)) & np.isfinite(s1).all((1, 2))
    ids = np.asarray(problem.object_id)
    finite &= (ids >= 0) & (ids < problem.n_objects)
    # METHOD H59: pixels that get next to no light have all leverage and no information.
    brightness = np.mean([d.sum(1) for d in problem.diffuse], 0) * problem.exposure
    if finite.any():
        finite &= brightness > 1e-3 * np.median(brightness[finite])
    index = np.flatnonzero(finite)
    index = index[np.argsort(ids[index], kind="stable")]
    hdr = response.family == "identity"
    knee, gain = 0.0, 1.0
    if hdr:
        positive = problem.value[index][problem.value[index] > 0]
        knee = 0.25 * float(np.median(positive)) if len(positive) else 1.0
        gain = 1.0 / float(np.log1p(np.quantile(positive, 0.99) / knee)) if len(positive) else 1.0
    tone = _Tone(response, knee, gain)
    obj = ids[index].astype(np.int64)
    halves = [(d[index], s0[index], s1[index]) for d, s0, s1 in zip(problem.diffuse, problem.s0, problem.s1, strict=True)]
    px = _Pixels(
        obj,
        np.searchsorted(obj, np.arange(problem.n_objects + 1)),
        problem.base[index].astype(np.float64),
        halves,
        np.asarray(problem.levels, np.float64),
        tone.value(problem.value[index]),
        problem.exposure[index].astype(np.float64),
        problem.saturated[index],
        np.ones((len(index), 3)),
    )
    return px, tone


def _residuals(px: _Pixels, affine: np.ndarray, tone: _Tone) -> list[np.ndarray]:
    """f(e L) - I of each half, (n, 3)."""
    value = _clamp(_raw(affine[px.obj], px.base))
    a, m = value[:, :3], value[:, 4:5]
    out = []
    for d, s0, s1 in px.halves:
        radiance = (1 - m) * a * d + (0.04 * (1 - m) + m * a) * interpolate_levels(s0, px.levels, value[:, 3])[0]
        radiance = radiance + interpolate_levels(s1, px.levels, value[:, 3])[0]
        out.append(tone.evaluate(px.exposure[:, None] * radiance, False)[0] - px.target)
    return out


def fit_affines(problem: FitProblem, response: Response, options: FitOptions | None = None) -> FitResult:
    """Sixteen numbers per object and the response, by Gauss-Newton on all pixels at once (METHOD 7b).

    Which numbers are free follows the texture (METHOD 8): a constant object gets three gains, one with a single
    direction of colour gains and biases, others the full map. Roughness always, metalness where it was predicted
    or where it pays.

    Args:
        problem: pixels, base values, cached shading.
        response: starting response; `identity` means linear radiance (HDR).
        options: see `FitOptions`.

    Returns:
        `FitResult`, always finite; objects with too few pixels keep the identity.
    """
    opt = options or FitOptions()
    if opt.scale not in ("prior", "none"):
        raise InputError(f"fit: scale {opt.scale!r}; allowed: prior, none")
    px, tone = _prepare(problem, response)
    n_objects = problem.n_objects
    free, rank, enough = _free_numbers(px, opt)
    start_params = response.params.ravel().astype(np.float64)
    affine = np.tile(IDENTITY, (n_objects, 1))
    state = _State(affine, free, start_params.copy(), np.full(n_objects, 1e-2), 1e-2, [])
    history, converged = [0.0], True
    if len(px.obj) and enough.any():
        if len(px.halves) == 2:
            first, second = _residuals(px, affine, tone)
            # Fireflies of one half: the distance between the halves, three robust widths wide. Fixed for the whole fit.
            px.trust = 1.0 / (1.0 + (0.5 * (first - second) / (3.0 * opt.robust_width)) ** 2)
            # A one-sided row takes the low side of the noise for a violation; bounds count below their noise only.
            px.target = np.where(px.saturated, px.target - 1.5 * np.abs(first - second), px.target)
        early = max(1, opt.iterations // 2) if opt.multi_start else opt.iterations
        state, converged = _descend(px, state, tone, opt, early, opt.free_response, start_params)
        history = state.history
        if opt.multi_start:
            before = _terms(px, state.affine, tone.at(state.params), opt, False).cost
            varied_metal = _varied(px, 4, opt)
            other, _ = _starts(px, state, tone, opt, enough, varied_metal)
            after = _terms(px, other.affine, tone.at(state.params), opt, False).cost
            take = after < before
            state = replace(
                state,
                affine=np.where(take[:, None], other.affine, state.affine),
                free=np.where(take[:, None], other.free, state.free),
                damping=np.full(n_objects, 1e-3),
                history=history,
            )
            state, converged = _descend(px, state, tone, opt, max(1, opt.iterations - early), opt.free_response, start_params)
            history = state.history
    return _result(px, state, tone, opt, rank, enough, history, converged)


def _varied(px: _Pixels, column: int, opt: FitOptions) -> np.ndarray:
    counts = np.maximum(px.counts, 1)
    mean = np.bincount(px.obj, px.base[:, column], px.n_objects) / counts
    square = np.bincount(px.obj, (px.base[:, column] - mean[px.obj]) ** 2, px.n_objects) / counts
    return square > opt.texture_sigma**2


def _result(
    px: _Pixels,
    state: _State,
    tone: _Tone,
    opt: FitOptions,
    rank: np.ndarray,
    enough: np.ndarray,
    history: list[float],
    converged: bool,
) -> FitResult:
    n_objects = px.n_objects
    final = tone.at(state.params)
    affine, covariance = state.affine.copy(), np.zeros((n_objects, PARAMETERS, PARAMETERS))
    residual = np.zeros(n_objects)
    if len(px.obj):
        terms = _terms(px, affine, final, opt, True)
        freedom = np.maximum(3 * px.counts - state.free.sum(1), 1)
        errors = _residuals(px, affine, final)
        mean_error = np.where(px.saturated, 0.0, 0.5 * (errors[0] + errors[-1]))
        square = np.bincount(px.obj, (mean_error**2).sum(1), n_objects)
        residual = np.sqrt(square / np.maximum(np.bincount(px.obj, (~px.saturated).sum(1), n_objects), 1))
        robust_square = np.bincount(px.obj, (px.trust * np.minimum(mean_error**2, 9 * opt.robust_width**2)).sum(1), n_objects)
        inverse = _inverse(_masked(terms.h, state.free), np.zeros(n_objects)) * (robust_square / freedom)[:, None, None]
        covariance = np.where(state.free[:, :, None] & state.free[:, None, :], inverse, 0.0)
    light_scale = 1.0
    if opt.scale == "prior" and len(px.obj):
        light_scale = _pin(px, affine, enough)
        affine[enough, :12] /= light_scale
        covariance[:, :12, :] /= light_scale
        covariance[:, :, :12] /= light_scale
    models = [_describe(state.free[o], int(rank[o]), bool(enough[o]), int(px.counts[o])) for o in range(n_objects)]
    return FitResult(
        affine,
        covariance,
        state.free & enough[:, None],
        px.counts.astype(np.int64),
        residual,
        models,
        final.response,
        light_scale,
        history,
        converged,
    )


def _pin(px: _Pixels, affine: np.ndarray, enough: np.ndarray) -> float:
    """Factor by which fitted albedos exceed the base's, mean over pixels of fitted objects (at least 1e-3)."""
    mask = enough[px.obj]
    if not mask.any():
        return 1.0
    base, fitted = px.base[mask][:, :3], _clamp(_raw(affine[px.obj[mask]], px.base[mask]))[:, :3]
    return float(max(fitted.mean(), 1e-3) / max(base.mean(), 1e-3))


def _describe(free: np.ndarray, rank: int, enough: bool, pixels: int) -> str:
    if not enough:
        return f"identity ({pixels} pixels)"
    parts = [("gain", "gain+bias", "full", "full")[rank]]
    if free[_ROUGHNESS].any():
        parts.append("roughness")
    if free[_METALLIC].any():
        parts.append("metallic")
    return ", ".join(parts)
