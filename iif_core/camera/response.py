"""Camera response: the sensor value f(x) of exposed radiance x = e L, its derivatives and its inverse.

Every family (docs/method/camera.md#response-families, Eq. C.11 to C.14) increases from f(0) = 0 to f(1) = 1. Beyond [0, 1] it
continues as a straight line (Eq. C.16, docs/method/numerics.md#response-above-white); below x = 1e-4 a parabola replaces powers,
whose slope is infinite at 0 (Eq. C.15, docs/method/numerics.md#pow-at-zero).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import SRGB_KNEE, srgb_from_linear

FAMILIES = ("identity", "srgb", "gamma", "ggcm", "spline", "sampled")
START: dict[str, tuple[float, ...]] = {
    "identity": (),
    "srgb": (),
    "gamma": (2.2,),
    "ggcm": (-0.8, 0.0, 0.0),
    "spline": (0.0,) * 6,
    "sampled": (),
}
"""Starting parameters, near sRGB."""
SATURATION = 0.99
"""Sensor value from which a pixel counts as saturated."""
SPLINE_BINS = (2, 8)
"""Smallest and largest number of bins K of a spline, which has 2 K parameters; 3 by default."""
_SPLINE_POWER = 0.45
_SPLINE_BOUND = 5.0  # of all parameters; allows slopes between 1/150 and 150 times the slope of x^0.45
_TOE = 1e-4  # end of the parabola that replaces a power near 0
_GAMMA_BOUNDS = (0.6, 6.0)
_A0_BOUNDS = (-2.0, 0.5)  # exponent at 0 between 0.135 and 1.65
_A_BOUND = 4.0
# x^exp(P(x)) rises wherever 1 + x log(x) P'(x) > 0; x log x >= -1/e, so P' < e on [0, 1] is enough.
_SLOPE_BOUND = 2.5
_MIN_INCREMENT = 1e-6  # flat pieces of a measured curve have no inverse (docs/method/numerics.md#flat-pieces-of-a-response)


@dataclass(frozen=True)
class Response:
    """A camera response; made by `response(family)` or `sampled_response(x, y)`.

    Attributes:
        family: one of `FAMILIES`.
        params: (P,) float64, shared by the channels, or (C, P), one row for each entry of the last axis of the input.
        samples: of `sampled` only: x (S,) and y (S,) or (C, S), increasing, from 0 to 1.
    """

    family: str
    params: np.ndarray
    samples: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return parameter_names(self.family, self.params.shape[-1])

    def with_params(self, params: np.ndarray) -> Response:
        """Return the same family with other parameters, moved into the range in which the curve is monotone."""
        return replace(self, params=project(self.family, np.asarray(params, np.float64)))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute f(x) for any real x: float64, shape of x."""
        return self._evaluate(x)[0]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Compute df/dx > 0: float64, shape of x."""
        return self._evaluate(x)[1]

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute f, df/dx and df/dparams in one pass: float64 of the shapes x, x, x + (P,)."""
        return self._evaluate(x, True)

    def inverse(self, y: np.ndarray) -> np.ndarray:
        """Find x with f(x) = y for any real y: float64, shape of y.

        A value at the top of the sensor's range only bounds x from below and is treated as censored (Eq. C.10,
        docs/method/numerics.md#saturated-pixels).
        """
        y = np.asarray(y, np.float64)
        if self.family == "identity":
            return y.copy()
        if self.params.ndim == 1 and (self.samples is None or self.samples[1].ndim == 1):
            return self._inverse_shared(y)
        channels = max(self.params.shape[0] if self.params.ndim == 2 else 1, self._sample_channels())
        if y.shape[-1] != channels:
            raise InputError(f"response with {channels} channels, values of shape {y.shape}: the last axis must match")
        return np.stack([self.channel(c)._inverse_shared(y[..., c]) for c in range(channels)], -1)

    def channel(self, index: int) -> Response:
        """Return the response of one channel."""
        params = self.params[index] if self.params.ndim == 2 else self.params
        samples = self.samples
        if samples is not None and samples[1].ndim == 2:
            samples = (samples[0], samples[1][index])
        return replace(self, params=params, samples=samples)

    def _sample_channels(self) -> int:
        return self.samples[1].shape[0] if self.samples is not None and self.samples[1].ndim == 2 else 1

    def _evaluate(self, x: np.ndarray, jacobian: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x = np.asarray(x, np.float64)
        inside = np.clip(x, 0.0, 1.0)
        f, slope, dparams, dslope = self._core(inside, jacobian)
        # Beyond an end: f(end) + f'(end) (x - end); the slope of the end depends on the parameters.
        beyond = x - inside
        f = f + slope * beyond
        if jacobian and dparams.shape[-1]:
            dparams = dparams + np.where(beyond[..., None] != 0, dslope * beyond[..., None], 0.0)
        return f, slope, dparams

    def _core(self, x: np.ndarray, jacobian: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """f, f', df/dparams, df'/dparams on [0, 1]; the last is filled at the two ends only."""
        none = np.zeros((*x.shape, 0))
        if self.family == "identity":
            return x, np.ones_like(x), none, none
        if self.family == "srgb":
            steep = 1.055 / 2.4 * np.maximum(x, SRGB_KNEE) ** (1 / 2.4 - 1)
            return srgb_from_linear(x), np.where(x <= SRGB_KNEE, 12.92, steep), none, none
        if self.family == "sampled":
            f, slope = self._interpolate(x)
            return f, slope, none, none
        if self.family == "spline":
            return self._spline(x, jacobian)
        return self._power(x, jacobian)

    def _interpolate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self.samples is not None
        grid, values = self.samples
        j = np.clip(np.searchsorted(grid, x, side="right") - 1, 0, len(grid) - 2)
        if values.ndim == 1:
            low, high = values[j], values[j + 1]
        else:
            c = np.arange(values.shape[0])
            low, high = values[c, j], values[c, j + 1]
        slope = (high - low) / (grid[j + 1] - grid[j])
        return low + slope * (x - grid[j]), slope

    def _power(self, x: np.ndarray, jacobian: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """x^p(x) and its derivatives, with the parabola near 0."""
        theta = self.params
        count = theta.shape[-1]

        # -------- exponent p(x), its derivatives by x and by the parameters --------
        # Below the toe everything is evaluated at its end, where the parabola takes over; the logarithm never meets 0.
        z = np.maximum(x, _TOE)
        log_z = np.log(z)
        if self.family == "gamma":
            p = 1.0 / theta[..., 0] + 0.0 * z
            dp_dx = np.zeros_like(z)
            dp = np.broadcast_to(-1.0 / theta[..., 0] ** 2, z.shape)[..., None]
            ddp_dx = np.zeros((*z.shape, 1))  # of dp/dx by the parameters
        else:
            a0, a1, a2 = theta[..., 0], theta[..., 1], theta[..., 2]
            p = np.exp(a0 + z * (a1 + z * a2))
            polynomial_slope = a1 + 2.0 * a2 * z
            dp_dx = p * polynomial_slope
            powers = np.stack([np.ones_like(z), z, z * z], -1)
            dp = p[..., None] * powers
            ddp_dx = dp * polynomial_slope[..., None] + p[..., None] * np.stack([np.zeros_like(z), np.ones_like(z), 2.0 * z], -1)

        # -------- x^p, and the parabola below the toe (Eq. C.15) --------
        y = np.exp(p * log_z)
        rate = dp_dx * log_z + p / z  # d log f / dx
        slope = y * rate
        toe = x < _TOE
        any_toe = bool(toe.any())
        t = np.where(toe, x / _TOE, 1.0)
        q = z * rate  # local exponent at the end of the toe
        # Equal value and slope at the end of the toe make the curve and its derivative continuous.
        f = np.where(toe, y * t * ((2.0 - q) + (q - 1.0) * t), y) if any_toe else y
        slope_out = np.where(toe, y / _TOE * ((2.0 - q) + 2.0 * (q - 1.0) * t), slope) if any_toe else slope
        if not jacobian:
            empty = np.zeros((*x.shape, count))
            return f, slope_out, empty, empty

        # -------- derivatives by the parameters --------
        dy = (y * log_z)[..., None] * dp
        drate = ddp_dx * log_z[..., None] + dp / z[..., None]
        dslope = dy * rate[..., None] + y[..., None] * drate
        if not any_toe:
            return f, slope_out, dy, dslope
        # In the toe the parameters act through the value y and the exponent q at its end; x / x_t is fixed.
        dq = z[..., None] * drate
        shape = (t * ((2.0 - q) + (q - 1.0) * t))[..., None]
        df_toe = dy * shape + y[..., None] * dq * (t * (t - 1.0))[..., None]
        end = ((2.0 - q) + 2.0 * (q - 1.0) * t)[..., None]
        dslope_toe = (dy * end + y[..., None] * dq * (2.0 * t - 1.0)[..., None]) / _TOE
        return f, slope_out, np.where(toe[..., None], df_toe, dy), np.where(toe[..., None], dslope_toe, dslope)

    def _knots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rises (..., K), heights (..., K + 1) and slopes (..., K + 1) of the spline at its knots."""
        bins = self.params.shape[-1] // 2
        # Softmax with the last logit fixed at 0: rises are positive, add up to 1 and have K - 1 parameters.
        rise = np.exp(np.concatenate([self.params[..., : bins - 1], np.zeros((*self.params.shape[:-1], 1))], -1))
        rise /= rise.sum(-1, keepdims=True)
        height = np.concatenate([np.zeros_like(rise[..., :1]), np.cumsum(rise, -1)], -1)
        # The last height is 1 up to rounding of the sum.
        return rise, height / height[..., -1:], np.exp(self.params[..., bins - 1 :])

    def _spline(self, x: np.ndarray, jacobian: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """S(u) with u = x^0.45 and its derivatives (Eq. C.14).

        Within a bin, with s = h K and q = xi (1 - xi): S = y + h [s xi^2 + d0 q] / [s + (d0 + d1 - 2 s) q].
        """
        rise, height, slopes = self._knots()
        bins = rise.shape[-1]

        # -------- u = x^0.45 and du/dx, with the parabola of Eq. C.15 near 0 --------
        # The exponent is constant, so it is q as well.
        t = np.minimum(x / _TOE, 1.0)
        z = np.maximum(x, _TOE)
        u, p = z**_SPLINE_POWER, _SPLINE_POWER
        rate = np.where(x < _TOE, ((2.0 - p) + 2.0 * (p - 1.0) * t) / _TOE, p / z) * u  # du/dx
        u = u * t * ((2.0 - p) + (p - 1.0) * t)

        # -------- bin of each value, and what Eq. C.14 needs there --------
        j = np.minimum((u * bins).astype(np.int64), bins - 1)
        at = (j,) if self.params.ndim == 1 else (np.broadcast_to(np.arange(len(self.params)), x.shape), j)
        nxt = (*at[:-1], j + 1)
        h, low, d0, d1 = rise[at], height[at], slopes[at], slopes[nxt]
        xi = u * bins - j
        s, q = h * bins, xi * (1.0 - xi)

        # -------- S and dS/du --------
        above, below = s * xi**2 + d0 * q, s + (d0 + d1 - 2.0 * s) * q
        f = low + h * above / below
        end = s**2 * (d1 * xi**2 + 2.0 * s * q + d0 * (1.0 - xi) ** 2) / below**2  # dS/du
        if not jacobian:
            empty = np.zeros((*x.shape, 2 * bins))
            return f, end * rate, empty, empty

        # -------- derivatives by rises and slopes --------
        # h enters directly and through s = h K.
        df, dslope = np.zeros((*x.shape, 2 * bins)), np.zeros((*x.shape, 2 * bins))
        by_h = above / below + s * (xi**2 * below - above * (1.0 - 2.0 * q)) / below**2
        knot = np.arange(bins + 1)
        by_d0, by_d1 = h * q * (below - above) / below**2, -h * q * above / below**2
        # Slopes are exponentials of their parameters, hence the factors d0 and d1.
        df[..., bins - 1 :] = (by_d0 * d0)[..., None] * (knot == j[..., None]) + (by_d1 * d1)[..., None] * (
            knot == j[..., None] + 1
        )
        # df/d rise_i = [i < j] + [i = j] by_h; the softmax turns it into r_i (df/d rise_i - sum_k r_k df/d rise_k).
        by_rise = (knot[:-1] < j[..., None]) + by_h[..., None] * (knot[:-1] == j[..., None])
        df[..., : bins - 1] = (rise * (by_rise - (rise * by_rise).sum(-1, keepdims=True)))[..., :-1]
        for k, where in ((0, x <= 0.0), (bins, x >= 1.0)):  # the slope at an end is the slope of its knot
            dslope[..., bins - 1 + k] = np.where(where, end * rate, 0.0)
        return f, end * rate, df, dslope

    def _inverse_spline(self, y: np.ndarray) -> np.ndarray:
        rise, height, slopes = self._knots()
        bins = len(rise)
        j = np.clip(np.searchsorted(height, y, side="right") - 1, 0, bins - 1)
        h, d0, d1, part = rise[j], slopes[j], slopes[j + 1], y - height[j]
        s = h * bins
        # Eq. C.14 times its denominator is a quadratic in xi: a xi^2 + b xi + c = 0.
        bend = part * (d0 + d1 - 2.0 * s)
        a, b, c = h * (s - d0) + bend, h * d0 - bend, -s * part
        # This form of the root stays finite where a vanishes.
        xi = 2.0 * c / (-b - np.sqrt(np.maximum(b**2 - 4.0 * a * c, 0.0)))
        u, p = (j + xi) / bins, _SPLINE_POWER
        return _invert_power(u, p)

    def _inverse_shared(self, y: np.ndarray) -> np.ndarray:
        inside = np.clip(y, 0.0, 1.0)
        if self.family == "srgb":
            x = np.where(inside <= 12.92 * SRGB_KNEE, inside / 12.92, ((inside + 0.055) / 1.055) ** 2.4)
        elif self.family == "gamma":
            x = _invert_power(inside, 1.0 / self.params[0])
        elif self.family == "sampled":
            assert self.samples is not None
            x = np.interp(inside, self.samples[1], self.samples[0])
        elif self.family == "spline":
            x = self._inverse_spline(inside)
        else:
            x = self._invert_by_table(inside)
        # Beyond the range of the sensor: the inverse of the straight lines of Eq. C.16.
        ends = self.derivative(np.array([0.0, 1.0]))
        return x + (y - inside) / np.where(y < 0, ends[0], ends[1])

    def _invert_by_table(self, y: np.ndarray) -> np.ndarray:
        """Bracket the solution with a table of 2049 values and refine it by Newton steps safeguarded by bisection."""
        # Fourth powers put most of the grid near 0, where curves are steep.
        grid = np.linspace(0.0, 1.0, 2049) ** 4
        table = self(grid)
        j = np.clip(np.searchsorted(table, y, side="right") - 1, 0, len(grid) - 2)
        low, high = grid[j], grid[j + 1]
        x = low + (high - low) * (y - table[j]) / (table[j + 1] - table[j])
        for _ in range(8):
            f, slope, _ = self._evaluate(x)
            # The bracket shrinks around the solution. A Newton step that leaves it is replaced by bisection.
            low, high = np.where(f <= y, x, low), np.where(f >= y, x, high)
            newton = x - (f - y) / slope
            x = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        return x


def _invert_power(y: np.ndarray, p: float) -> np.ndarray:
    """x with x^p = y; below the end of the toe, with y = y_t t ((2 - p) + (p - 1) t) for x = t x_t (Eq. C.15)."""
    low = np.minimum(y / _TOE**p, 1.0)
    # Root of the quadratic of Eq. C.15, in the form that has no cancellation near 0.
    t = 2.0 * low / ((2.0 - p) + np.sqrt(np.maximum((2.0 - p) ** 2 + 4.0 * (p - 1.0) * low, 0.0)))
    return np.where(low < 1.0, _TOE * t, y ** (1.0 / p))


def response(family: str, params: np.ndarray | None = None) -> Response:
    """Make a response of a named family (any of `FAMILIES` but `sampled`) with parameters (P,) or (C, P); None = `START`, near
    sRGB.

    Raises:
        InputError: unknown family, wrong number of parameters, or a parameter that is not finite.

    Example:
        >>> round(float(response("gamma")(0.5)), 4)
        0.7297
    """
    if family not in FAMILIES or family == "sampled":
        allowed = ", ".join(f for f in FAMILIES if f != "sampled")
        raise InputError(f"camera response {family!r}: unknown; allowed: {allowed} (sampled curves: `sampled_response`)")
    theta = np.asarray(START[family] if params is None else params, np.float64)
    size = theta.shape[-1] if theta.ndim else 0
    fits = size % 2 == 0 and SPLINE_BINS[0] <= size // 2 <= SPLINE_BINS[1] if family == "spline" else size == len(START[family])
    if theta.ndim not in (1, 2) or not fits or not np.isfinite(theta).all():
        names = parameter_names(family, len(START[family]))
        raise InputError(f"camera response {family}: parameters {theta.tolist()}, needed {names}, finite")
    return Response(family, project(family, theta))


def parameter_names(family: str, size: int) -> tuple[str, ...]:
    """Return the names of the `size` parameters of a family."""
    if family == "spline":
        bins = size // 2
        return (*(f"rise_{k}" for k in range(1, bins)), *(f"slope_{k}" for k in range(bins + 1)))
    return {"gamma": ("gamma",), "ggcm": ("a0", "a1", "a2")}.get(family, ())


def sampled_response(x: np.ndarray, y: np.ndarray) -> Response:
    """Make the response of a measured curve: straight lines between samples, made increasing and scaled to f(0) = 0, f(1) = 1.

    `x` (S,) increases from 0 to 1; `y` is (S,) or (C, S). Increments below 1e-6 of the range are raised to it
    (docs/method/numerics.md#flat-pieces-of-a-response).

    Raises:
        InputError: wrong shapes, x not from 0 to 1, samples that are not finite, or a curve that never rises.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    shapes_ok = x.ndim == 1 and len(x) >= 2 and y.ndim in (1, 2) and y.shape[-1] == len(x)
    if not shapes_ok or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"response samples of shapes {x.shape} and {y.shape}: need (S,) and (S,) or (C, S), finite")
    if x[0] != 0 or x[-1] != 1 or np.any(np.diff(x) <= 0):
        raise InputError(f"response samples: x runs from {x[0]} to {x[-1]}; it must rise from 0 to 1")
    raw = np.diff(y, axis=-1)
    if np.any(np.maximum(raw, 0.0).sum(-1) <= 0):
        raise InputError("response samples: the curve never rises; check the order of the samples")
    span = np.maximum(raw, 0.0).sum(-1, keepdims=True)
    # Flat and falling pieces rise by the least that an inverse needs.
    increments = np.maximum(raw / span, _MIN_INCREMENT)
    values = np.concatenate([np.zeros((*y.shape[:-1], 1)), np.cumsum(increments, -1)], -1)
    values /= values[..., -1:]
    return Response("sampled", np.zeros((0,)), (x, values))


def project(family: str, params: np.ndarray) -> np.ndarray:
    """Clip parameters to the range in which the curve is strictly monotone on [0, 1]."""
    theta = np.array(params, np.float64)
    if family == "gamma":
        theta = np.clip(theta, *_GAMMA_BOUNDS)
    elif family == "ggcm":
        a0 = np.clip(theta[..., 0], *_A0_BOUNDS)
        a1 = np.clip(theta[..., 1], -_A_BOUND, _SLOPE_BOUND)
        # P' = a1 + 2 a2 x is linear, so it is largest at an end of [0, 1]: a1 at 0, a1 + 2 a2 at 1.
        a2 = np.minimum(np.clip(theta[..., 2], -_A_BOUND, _A_BOUND), (_SLOPE_BOUND - a1) / 2.0)
        theta = np.stack([a0, a1, a2], -1)
    elif family == "spline":
        theta = np.clip(theta, -_SPLINE_BOUND, _SPLINE_BOUND)
    return theta


def response_facts(curve: Response) -> dict[str, Any]:
    """Convert a response to plain values for a JSON file; the inverse of `response_from_facts`."""
    facts: dict[str, Any] = {"family": curve.family, "names": list(curve.names), "parameters": curve.params.tolist()}
    if curve.samples is not None:
        facts["samples"] = {"x": curve.samples[0].tolist(), "y": curve.samples[1].tolist()}
    return facts


def response_from_facts(facts: dict[str, Any]) -> Response:
    """Convert the result of `response_facts` back to a response."""
    if facts["family"] == "sampled":
        return sampled_response(facts["samples"]["x"], facts["samples"]["y"])
    return response(facts["family"], np.asarray(facts["parameters"], np.float64))
