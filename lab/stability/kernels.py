"""The elementwise kernels of the project with their formulas in mpmath: what `lab.stability.scalar` measures."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import mpmath as mp
import numpy as np

from iif_core.camera import distortion
from iif_core.camera.response import START, Response, response
from iif_core.fusion.selection import selection_weights
from iif_core.light import environment
from iif_core.numerics import color, frames, laplace, normal_tail, xp
from iif_core.reflectance import brdf
from lab.published.fusion import divergence
from lab.stability.scalar import Argument, Form, Kernel
from workflow.runtime import device

UNIT = Argument(0.0, 1.0, (0.5, 1.0), towards_one=True)
COSINE = Argument(0.0, 1.0, (1e-4, 0.5, 1.0), towards_one=True)
UNIFORM = Argument(2.0**-32, 1.0, (0.25, 0.5, 0.75), towards_one=True, zero=True)
"""Random numbers are multiples of 2^-24 or, in double precision, of 2^-53; smaller ones stand for those of finer generators."""
ROUGHNESS = Argument(1e-3, 1.0, (brdf.R_MIN, 0.5, 1.0))
PI = mp.pi

# ------------------------------------------------------------------------------------------------------------- forms


def _torch(function: Callable[..., Any], arrays: list[np.ndarray]) -> Any:
    import torch

    result = function(xp.TORCH, *(torch.from_numpy(array) for array in arrays))
    return tuple(one.numpy() for one in result) if isinstance(result, tuple) else result.numpy()


def _drjit(function: Callable[..., Any], arrays: list[np.ndarray]) -> Any:
    import drjit as dr

    mi = device.mitsuba()
    kind = mi.Float if arrays[0].dtype == np.float32 else mi.Float64
    result = function(xp.DRJIT, *(kind(array) for array in arrays))
    width = len(arrays[0])
    columns = [np.broadcast_to(np.array(one), (width,)) for one in (result if isinstance(result, tuple) else (result,))]
    dr.flush_malloc_cache()
    return tuple(columns) if isinstance(result, tuple) else columns[0]


def of_namespace(function: Callable[..., Any]) -> dict[tuple[str, type], Form]:
    """Return the forms of a function whose first argument is an array namespace (`iif_core.numerics.xp`)."""
    return {
        ("numpy", np.float32): lambda arrays: function(xp.NUMPY, *arrays),
        ("numpy", np.float64): lambda arrays: function(xp.NUMPY, *arrays),
        ("torch", np.float32): partial(_torch, function),
        ("drjit", np.float32): partial(_drjit, function),
    }


def of_numpy(function: Callable[..., Any], *dtypes: type) -> dict[tuple[str, type], Form]:
    """Return the forms of a function of arrays."""
    return {("numpy", dtype): lambda arrays: function(*arrays) for dtype in dtypes or (np.float64,)}


def _above(x: Any, floor: float) -> Any:
    """max(x, floor) with the constant as it stands in the code, in double precision."""
    return max(x, mp.mpf(floor))


# ------------------------------------------------------------------------------------------------------- reflectance


def _distribution(NoH: Any, sin2_h: Any, r: Any) -> Any:
    alpha2 = _above(r, brdf.R_MIN) ** 4
    spread = max(alpha2 * NoH**2 + sin2_h, alpha2)
    return alpha2 / (PI * spread**2)


def _specular(NoL: Any, NoV: Any, NoH: Any, sin2_h: Any, r: Any) -> Any:
    if NoL <= 0 or NoV <= 0:
        return mp.mpf(0)
    k = (_above(r, brdf.R_MIN) + 1) ** 2 / 8
    return _distribution(NoH, sin2_h, r) * NoL / 4 / ((NoL * (1 - k) + k) * (NoV * (1 - k) + k))


def _lobe_pdf(NoH: Any, VoH: Any, sin2_h: Any, r: Any) -> Any:
    return _distribution(NoH, sin2_h, r) * NoH / (4 * _above(VoH, 1e-4))


def _chance(kd: Any, ks: Any, NoV: Any) -> Any:
    fresnel = ks + (1 - ks) * max(1 - NoV, 0) ** 5
    return min(max(fresnel / _above(fresnel + kd, 1e-8), mp.mpf(0.05)), mp.mpf(0.95))


def _half(*v: Any) -> tuple[Any, ...]:
    n, wi, wo = v[:3], v[3:6], v[6:]
    h = [a + b for a, b in zip(wi, wo, strict=True)]
    length = _above(mp.sqrt(sum(x * x for x in h)), 1e-8)
    h = [x / length for x in h]
    cross = (n[1] * h[2] - n[2] * h[1], n[2] * h[0] - n[0] * h[2], n[0] * h[1] - n[1] * h[0])
    inner = [max(sum(a * b for a, b in zip(u, w, strict=True)), 0) for u, w in ((n, wi), (n, wo), (n, h), (wo, h))]
    return (*inner, sum(x * x for x in cross))


def _half_angles(space: Any, *v: Any) -> Any:
    return brdf.half_angles(space, v[:3], v[3:6], v[6:])


def _directions(drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """Unit vectors n, wi, wo; wi close to the mirror image of wo, close to -wo, or anywhere."""
    dtype, count = drawn[0].dtype, len(drawn[0])
    normal, wo, other = (v / np.linalg.norm(v, axis=0) for v in rng.normal(size=(3, 3, count)))
    off = np.exp(rng.uniform(np.log(1e-7), 0, count))
    mirrored = 2 * (normal * wo).sum(0) * normal - wo
    base = np.where(rng.random(count) < 0.5, mirrored, -wo)
    wi = np.where(rng.random(count) < 0.7, base + off * other, other)
    wi /= np.maximum(np.linalg.norm(wi, axis=0), 1e-30)
    return [row.astype(dtype) for row in (*normal, *wi, *wo)]


def _below_one(drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """Uniform numbers end below 1."""
    return [np.minimum(one, np.nextafter(one.dtype.type(1), one.dtype.type(0))) if i < 2 else one for i, one in enumerate(drawn)]


def _cosine_direction(u1: Any, u2: Any) -> tuple[Any, ...]:
    sine, phi = mp.sqrt(u1), 2 * PI * u2
    return sine * mp.cos(phi), sine * mp.sin(phi), mp.sqrt(1 - u1)


def _ggx_half(u1: Any, u2: Any, r: Any) -> tuple[Any, ...]:
    alpha2 = _above(r, brdf.R_MIN) ** 4
    head, tail = _above(1 - u1, 1e-12), u1 * alpha2
    cosine, sine, phi = mp.sqrt(head / (head + tail)), mp.sqrt(tail / (head + tail)), 2 * PI * u2
    return sine * mp.cos(phi), sine * mp.sin(phi), cosine


def _sine2(drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """The last two but one are a cosine and the square of its sine: one angle, each rounded once."""
    *rest, sin2, r = drawn
    place = len(rest) - 1
    rest[place] = np.sqrt(np.maximum(1 - sin2.astype(np.float64), 0)).astype(sin2.dtype)
    return [*rest, sin2, r]


REFLECTANCE = [
    Kernel("reflectances k_d, k_s", lambda a, m: ((1 - m) * a, mp.mpf(0.04) * (1 - m) + m * a), ("k_d", "k_s"),
           {"a": UNIT, "m": UNIT}, of_namespace(lambda space, a, m: brdf.kd_ks(a, m))),
    Kernel("half vector", _half, ("NoL", "NoV", "NoH", "VoH", "sin2_h"),
           {f"v{i}": UNIT for i in range(9)}, of_namespace(_half_angles), _directions),
    Kernel("GGX distribution D", _distribution, ("D",),
           {"NoH": COSINE, "sin2_h": UNIT, "r": ROUGHNESS}, of_namespace(brdf.normal_distribution), _sine2),
    Kernel("specular lobe D G cos / 4", _specular, ("spec",),
           {"NoL": COSINE, "NoV": COSINE, "NoH": COSINE, "sin2_h": UNIT, "r": ROUGHNESS},
           of_namespace(lambda space, NoL, NoV, NoH, s, r: brdf.lobes(space, NoL, NoV, NoH, NoH, s, r)[1]), _sine2),
    Kernel("Fresnel factor (1 - VoH)^5", lambda c: (1 - c) ** 5, ("F_c",), {"VoH": COSINE},
           of_namespace(lambda space, c: brdf.lobes(space, c, c, c, c, 0 * c, 0 * c + 1)[2])),
    Kernel("density of the GGX lobe", lambda VoH, NoH, sin2_h, r: _lobe_pdf(NoH, VoH, sin2_h, r), ("pdf",),
           {"VoH": COSINE, "NoH": COSINE, "sin2_h": UNIT, "r": ROUGHNESS},
           of_namespace(lambda space, VoH, NoH, s, r: brdf.specular_pdf(space, NoH, VoH, s, r)), _sine2),
    Kernel("chance of the GGX lobe", _chance, ("chance",),
           {"k_d": UNIT, "k_s": UNIT, "NoV": COSINE}, of_namespace(brdf.specular_chance)),
    Kernel("cosine sample", _cosine_direction, ("x", "y", "z"),
           {"u1": UNIFORM, "u2": UNIFORM}, of_namespace(brdf.sample_cosine), _below_one, turned=True),
    Kernel("GGX sample of the half vector", _ggx_half, ("x", "y", "z"),
           {"u1": UNIFORM, "u2": UNIFORM, "r": ROUGHNESS}, of_namespace(brdf.sample_ggx_half), _below_one, turned=True),
]  # fmt: skip

# ------------------------------------------------------------------------------------------------------------ fusion

DISTANCE = Argument(0.0, 4.0, (1e-6, 1e-4, 1.0))
SCALE = Argument(1e-4, 4.0, (laplace.SCALE_FLOOR, 1.0))


def _kl(d: Any, b_r: Any, b_p: Any) -> Any:
    b_r, b_p = _above(b_r, laplace.SCALE_FLOOR), _above(b_p, laplace.SCALE_FLOOR)
    with mp.workdps(700):  # of d^2, for d down to 1e-308
        return mp.log(b_p / b_r) + (d + b_r * mp.exp(-d / b_r)) / b_p - 1


def _kl_weight(d: Any, b_r: Any, b_p: Any) -> Any:
    b_r, b_p = _above(b_r, laplace.SCALE_FLOOR), _above(b_p, laplace.SCALE_FLOOR)
    return 1 / (b_r * b_p) if d == 0 else -mp.expm1(-d / b_r) / (d * b_p)


def _contribution(d: Any, b_r: Any) -> Any:
    b_r = _above(b_r, laplace.SCALE_FLOOR)
    return d + b_r * mp.exp(-d / b_r)


def _equal_scales(drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """The two scales are equal, or nearly so, in half of the points."""
    d, b_r, b_p = drawn
    close = (b_r * (1 + np.exp(rng.uniform(np.log(1e-7), 0, len(d))))).astype(b_r.dtype)
    kind = rng.integers(4, size=len(d))
    return [d, b_r, np.where(kind == 0, b_r, np.where(kind == 1, close, b_p))]


def _weights(temperature: float, *errors: Any) -> tuple[Any, ...]:
    lowest, median = min(errors), sorted(errors)[(len(errors) - 1) // 2]
    if temperature == 0:
        weight = [mp.mpf(e - lowest <= mp.mpf(1e-9) * median + mp.mpf(1e-12)) for e in errors]
    else:
        weight = [mp.exp(-(e - lowest) / (mp.mpf(temperature) * (median + mp.mpf(1e-6)))) for e in errors]
    return tuple(w / sum(weight) for w in weight)


def _selection(temperature: float) -> Kernel:
    def computed(arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
        return tuple(selection_weights(np.stack(arrays, -1), temperature).T)

    error = Argument(0.0, 1e3, (1e-12, 1e-6, 1.0))
    return Kernel(f"selection weights, temperature {temperature:g}", partial(_weights, temperature), ("w1", "w2", "w3"),
                  {f"e{k}": error for k in range(3)}, {("numpy", np.float64): computed})  # fmt: skip


FUSION = [
    Kernel("Laplace divergence", _kl, ("KL",), {"d": DISTANCE, "b_ref": SCALE, "b_pred": SCALE},
           of_numpy(divergence.kl, np.float32, np.float64), _equal_scales),
    Kernel("weight of the divergence", _kl_weight, ("w",), {"d": DISTANCE, "b_ref": SCALE, "b_pred": SCALE},
           of_numpy(divergence.kl_weight, np.float32, np.float64)),
    Kernel("contribution to a scale", _contribution, ("E|x|",), {"d": DISTANCE, "b_ref": SCALE},
           of_numpy(laplace.scale_contribution, np.float32, np.float64)),
    *(_selection(temperature) for temperature in (1e-12, 0.05, 1.0, 1e6)),
]  # fmt: skip

# ------------------------------------------------------------------------------------------------------------ camera

TOE = 1e-4
EXPOSED = Argument(0.0, 1.0, (TOE, color.SRGB_KNEE, 0.04045, 0.5, 1.0), towards_one=True)
ANY_EXPOSED = Argument(0.0, 1e6, (TOE, color.SRGB_KNEE, 1.0))


def _srgb(x: Any) -> Any:
    size = abs(x)
    y = (
        mp.mpf(12.92) * size
        if size <= mp.mpf(color.SRGB_KNEE)
        else mp.mpf(1.055) * size ** (mp.mpf(1) / mp.mpf(2.4)) - mp.mpf(0.055)
    )
    return mp.sign(x) * y


def _from_srgb(y: Any) -> Any:
    size = abs(y)
    x = size / mp.mpf(12.92) if size <= mp.mpf(0.04045) else ((size + mp.mpf(0.055)) / mp.mpf(1.055)) ** mp.mpf(2.4)
    return mp.sign(y) * x


def _power(exponent: Callable[[Any], Any], slope: Callable[[Any], Any], x: Any) -> Any:
    """x^p(x) with the parabola of Eq. C.15 below the toe, and the tangent above 1 (Eq. C.16)."""
    toe, inside = mp.mpf(TOE), min(x, mp.mpf(1))
    z = max(inside, toe)
    y = z ** exponent(z)
    local = exponent(z) + z * mp.log(z) * slope(z)  # d log f / d log x
    if inside < toe:
        t = inside / toe
        return y * t * ((2 - local) + (local - 1) * t)
    return y + y * local / z * (x - inside)


def _exact_response(curve: Response, x: Any) -> Any:
    theta = [mp.mpf(float(value)) for value in curve.params]
    if curve.family == "srgb":
        inside = min(x, mp.mpf(1))
        steep = (
            mp.mpf(1.055) / mp.mpf(2.4) * inside ** (1 / mp.mpf(2.4) - 1) if inside > mp.mpf(color.SRGB_KNEE) else mp.mpf(12.92)
        )
        return _srgb(inside) + steep * (x - inside)
    if curve.family == "gamma":
        return _power(lambda z: 1 / theta[0], lambda z: mp.mpf(0), x)
    if curve.family == "ggcm":
        a0, a1, a2 = theta

        def exponent(z: Any) -> Any:
            return mp.exp(a0 + z * (a1 + z * a2))

        return _power(exponent, lambda z: exponent(z) * (a1 + 2 * a2 * z), x)
    return _exact_spline(theta, x)


def _exact_spline(theta: list[Any], x: Any) -> Any:
    """Eq. C.14, and its tangent above 1."""
    bins, power, toe = len(theta) // 2, mp.mpf(0.45), mp.mpf(TOE)
    rise = [mp.exp(value) for value in (*theta[: bins - 1], mp.mpf(0))]
    rise = [value / sum(rise) for value in rise]
    slopes = [mp.exp(value) for value in theta[bins - 1 :]]

    def inside(z: Any) -> Any:
        t = min(z / toe, mp.mpf(1))
        u = max(z, toe) ** power * t * ((2 - power) + (power - 1) * t)
        j = min(int(mp.floor(u * bins)), bins - 1)
        xi, s = u * bins - j, rise[j] * bins
        q = xi * (1 - xi)
        d0, d1 = slopes[j], slopes[j + 1]
        return sum(rise[:j]) + rise[j] * (s * xi**2 + d0 * q) / (s + (d0 + d1 - 2 * s) * q)

    if x <= 1:
        return inside(x)
    return mp.mpf(1) + slopes[bins] * power * (x - 1)


def _inverse_of(exact: Callable[[Any], Any], y: Any) -> Any:
    """Root of an increasing function between 0 and 2; f(1) = 1 holds to the rounding of its constants."""
    if y <= 0:
        return mp.mpf(0)
    low, high = mp.mpf(0), mp.mpf(2)
    x = y
    for _ in range(400):
        value = exact(x)
        low, high = (x, high) if value <= y else (low, x)
        step = x * mp.mpf(10) ** -25
        slope = (exact(x + step) - value) / step
        newton = x - (value - y) / slope if slope > 0 else low
        if abs(newton - x) <= abs(x) * mp.mpf(10) ** -40:
            return newton
        x = newton if low < newton < high else (low + high) / 2
    raise ArithmeticError(f"no root of f(x) = {y} was found")


CURVES = {
    "sRGB": response("srgb"),
    "gamma 2.2": response("gamma"),
    "gamma 6": response("gamma", np.array([6.0])),
    "gamma 0.6": response("gamma", np.array([0.6])),
    "ggcm": response("ggcm", np.array(START["ggcm"])),
    "ggcm, bounds": response("ggcm", np.array([-2.0, 2.5, -4.0])),
    "spline": response("spline"),
    "spline, uneven": response("spline", np.array([2.0, -2.0, 1.0, -3.0, 3.0, -1.0])),
}

CAMERA = [
    Kernel("sRGB", _srgb, ("y",), {"x": Argument(0.0, 1e30, (color.SRGB_KNEE, 1.0), signed=True)},
           of_numpy(color.srgb_from_linear, np.float32, np.float64)),
    Kernel("sRGB inverse", _from_srgb, ("x",), {"y": Argument(0.0, 1e10, (0.04045, 1.0), signed=True)},
           of_numpy(color.linear_from_srgb, np.float32, np.float64)),
    *(Kernel(f"response {name}", partial(_exact_response, curve), ("f",), {"x": ANY_EXPOSED}, of_numpy(curve))
      for name, curve in CURVES.items()),
    *(Kernel(f"response {name}, inverse", partial(_inverse_of, partial(_exact_response, curve)), ("x",),
             {"y": EXPOSED}, of_numpy(curve.inverse)) for name, curve in CURVES.items()),
]  # fmt: skip

LENSES = {
    "barrel": distortion.Distortion("radial_tangential", (-0.28, 0.07, -0.01, 0.0), (1e-3, -5e-4)),
    "fisheye": distortion.Distortion("fisheye", (0.05, -0.01, 2e-3, -1e-4)),
}


def _distorted(lens: distortion.Distortion, x: Any, y: Any) -> tuple[Any, Any]:
    k1, k2, k3, k4 = (mp.mpf(value) for value in lens.k)
    p1, p2 = (mp.mpf(value) for value in lens.p)
    r = mp.sqrt(x * x + y * y)
    t = mp.atan(r) if lens.kind == "fisheye" else r
    s = t * t
    scale = t * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))) / r if r else mp.mpf(1)
    return x * scale + 2 * p1 * x * y + p2 * (r * r + 2 * x * x), y * scale + p1 * (r * r + 2 * y * y) + 2 * p2 * x * y


def _undistorted(lens: distortion.Distortion, x: Any, y: Any) -> tuple[Any, Any]:
    if x == 0 and y == 0:
        return mp.mpf(0), mp.mpf(0)
    start = [mp.mpf(float(value)) for value in distortion.undistort(lens, np.array([float(x), float(y)]))[0]]
    root = mp.findroot(lambda a, b: [p - q for p, q in zip(_distorted(lens, a, b), (x, y), strict=True)], start)
    return root[0], root[1]


def _lens(name: str, function: Callable[..., Any], exact: Callable[..., Any]) -> Kernel:
    lens = LENSES[name.split(",")[0]]
    point = Argument(0.0, 0.6, (0.5,), signed=True)
    return Kernel(f"lens {name}", partial(exact, lens), ("x", "y"), {"x": point, "y": point},
                  {("numpy", np.float64): lambda arrays: tuple(function(lens, np.stack(arrays, -1))[0].T)})  # fmt: skip


CAMERA += [_lens(name, distortion.distort, _distorted) for name in LENSES]
CAMERA += [_lens(f"{name}, inverse", distortion.undistort, _undistorted) for name in LENSES]

# ------------------------------------------------------------------------------------------------------------- light


def _power_weight(p: Any, q: Any) -> Any:
    return p**2 / (p**2 + q**2) if p > 0 else mp.mpf(0)


def _power_form(space: Any, p: Any, q: Any) -> Any:
    from iif_core.light.transport.kernels import power_weight

    return power_weight(p, q)


def _texel_direction(height: int, width: int, row: Any, column: Any, u1: Any, u2: Any) -> tuple[Any, ...]:
    upper, lower = mp.cos(row * PI / height), mp.cos((row + 1) * PI / height)
    z, phi = upper + u1 * (lower - upper), (column + u2) * 2 * PI / width
    sine = mp.sqrt(max((1 - z) * (1 + z), 0))
    return sine * mp.cos(phi), sine * mp.sin(phi), z


def _texels(height: int, width: int, drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    dtype = drawn[0].dtype
    rows = rng.choice([0, 1, height // 2, height - 1], len(drawn[0])).astype(dtype)
    return [rows, rng.integers(width, size=len(rows)).astype(dtype), *drawn[2:]]


def _hazard(z: Any) -> tuple[Any, Any]:
    ratio = mp.npdf(z) / mp.ncdf(-z)
    return ratio, ratio - z


DENSITY = Argument(0.0, 1e38, (1e-30, 1.0, 1e30))


def _frame(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    sign = -1 if z < mp.mpf(frames.SEAM) else 1
    a = -1 / (sign + z)
    return 1 + sign * x * x * a, sign * x * y * a, -sign * x, x * y * a, sign + y * y * a, -y


def _frame_form(space: Any, *normal: Any) -> tuple[Any, ...]:
    tangent, bitangent = frames.tangent_frame(space, *normal)
    return (*tangent, *bitangent)


def _normals(drawn: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """Unit vectors, many of them close to an axis or to the seam."""
    dtype, count = drawn[0].dtype, len(drawn[0])
    n = rng.normal(size=(3, count)) * np.exp(rng.uniform(np.log(1e-12), 0, (3, count)))
    n /= np.linalg.norm(n, axis=0)
    seam = rng.random(count) < 0.2
    n[2, seam] = frames.SEAM * (1 + rng.uniform(-1e-6, 1e-6, seam.sum()))
    n[:2, seam] *= np.sqrt((1 - n[2, seam] ** 2) / np.maximum((n[:2, seam] ** 2).sum(0), 1e-300))
    return [row.astype(dtype) for row in n]


LIGHT = [
    Kernel("frame of a normal", _frame, ("tx", "ty", "tz", "bx", "by", "bz"), {axis: UNIT for axis in "xyz"},
           of_namespace(_frame_form), _normals),
    Kernel("power heuristic", _power_weight, ("weight",), {"p": DENSITY, "q": DENSITY},
           {("drjit", np.float32): partial(_drjit, _power_form)}),
    Kernel("hazard of the normal distribution", _hazard, ("h", "h - z"), {"z": Argument(0.0, 30.0, (4.0, 29.0), signed=True)},
           of_numpy(normal_tail.hazard)),
    Kernel("direction in a texel, 512 x 1024", partial(_texel_direction, 512, 1024), ("x", "y", "z"),
           {"row": UNIT, "column": UNIT, "u1": UNIFORM, "u2": UNIFORM},
           of_namespace(lambda space, row, column, u1, u2: environment.direction_in(space, row, column, u1, u2, 512, 1024)),
           partial(_texels, 512, 1024), turned=True),
]  # fmt: skip

# ----------------------------------------------------------------------------------------------------- interpolation

LEVELS = np.array([0.02, 0.1, 0.4, 1.0])


def _slopes_of(y: tuple[Any, ...], levels: list[Any]) -> list[Any]:
    """Slopes of the monotone cubic (Eq. M.5)."""
    h = [b - a for a, b in itertools.pairwise(levels)]
    mean = [(b - a) / step for (a, b), step in zip(itertools.pairwise(y), h, strict=True)]
    out = []
    for left, right, h_left, h_right in zip(mean, mean[1:], h, h[1:], strict=False):
        w_left, w_right = 2 * h_right + h_left, h_right + 2 * h_left
        alike = left * right > 0
        out.append((w_left + w_right) * left * right / (w_left * right + w_right * left) if alike else mp.mpf(0))

    def end(own: Any, beyond: Any, width: Any, width_beyond: Any) -> Any:
        slope = ((2 * width + width_beyond) * own - width * beyond) / (width + width_beyond)
        return mp.mpf(0) if slope * own <= 0 else 3 * own if abs(slope) > 3 * abs(own) else slope

    return [end(mean[0], mean[1], h[0], h[1]), *out, end(mean[-1], mean[-2], h[-1], h[-2])]


def _exact_slopes(*y: Any) -> tuple[Any, ...]:
    return tuple(_slopes_of(y, [mp.mpf(float(level)) for level in LEVELS]))


def _exact_cubic(*arguments: Any) -> Any:
    *y, r = arguments
    levels = [mp.mpf(float(level)) for level in LEVELS]
    slope = _slopes_of(tuple(y), levels)
    j = min(sum(r >= level for level in levels[1:]), len(levels) - 2)
    h = levels[j + 1] - levels[j]
    t, mean = (r - levels[j]) / h, (y[j + 1] - y[j]) / h
    return y[j] + h * t * (mean + (1 - t) * ((1 - t) * (slope[j] - mean) - t * (slope[j + 1] - mean)))


def _compiled_slopes(arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    from iif_core.fitting.kernels import slopes

    shading = np.ascontiguousarray(np.repeat(np.stack(arrays, 1)[..., None], 3, -1))
    out = np.zeros(shading.shape)
    slopes(shading, LEVELS, out)
    return tuple(out[..., 0].T)


def _cubic(arrays: list[np.ndarray]) -> np.ndarray:
    from iif_core.fitting.levels import interpolate_levels

    *y, r = arrays
    return interpolate_levels(np.repeat(np.stack(y, 1)[..., None], 3, -1), LEVELS, r)[0][:, 0]


SIDE = 5
TABLE = np.random.default_rng(0).uniform(0.5, 2.0, (SIDE**3, 2)).astype(np.float32)
"""A dense level of the hash grid with `SIDE` vertices per side."""


def _exact_level(*u: Any) -> tuple[Any, ...]:
    at = [coordinate * (SIDE - 1) for coordinate in u]
    cell = [min(int(mp.floor(value)), SIDE - 2) for value in at]
    out = [mp.mpf(0), mp.mpf(0)]
    for corner in itertools.product((0, 1), repeat=3):
        weight = mp.mpf(1)
        for value, first, side in zip(at, cell, corner, strict=True):
            weight *= value - first if side else 1 - (value - first)
        row = sum((first + side) * SIDE**axis for axis, (first, side) in enumerate(zip(cell, corner, strict=True)))
        out = [total + weight * mp.mpf(float(value)) for total, value in zip(out, TABLE[row], strict=True)]
    return tuple(out)


def _compiled_level(arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    from lab.published.fusion.hashgrid import kernels as hashgrid

    count = len(arrays[0])
    encoded = np.zeros((-(-count // hashgrid.BLOCK), 2, hashgrid.BLOCK), np.float32)
    hashgrid.encode_level(np.stack(arrays), SIDE, False, TABLE, encoded, 0)
    return tuple(encoded[:, row].reshape(-1)[:count] for row in range(2))


NODE = Argument(1e-6, 1e6)
PLACE = Argument(0.0, 1.0 - 2.0**-24, (0.25, 0.5, 0.75), towards_one=True, zero=True)
INTERPOLATION = [
    Kernel("slopes of the monotone cubic", _exact_slopes, ("d0", "d1", "d2", "d3"),
           {f"y{j}": NODE for j in range(4)}, {("numba", np.float32): _compiled_slopes}),
    Kernel("monotone cubic", _exact_cubic, ("y",),
           {**{f"y{j}": NODE for j in range(4)}, "r": Argument(0.02, 1.0, (0.1, 0.4))}, {("numpy", np.float64): _cubic}),
    Kernel("hash grid, one level", _exact_level, ("feature 1", "feature 2"),
           {axis: PLACE for axis in "xyz"}, {("numba", np.float32): _compiled_level}),
]  # fmt: skip

KERNELS = [*REFLECTANCE, *FUSION, *CAMERA, *LIGHT, *INTERPOLATION]
"""All of them, in the order of the table."""
