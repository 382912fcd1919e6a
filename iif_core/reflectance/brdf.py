"""The Cook-Torrance reflectance of the method, written once for NumPy, Dr.Jit and torch (Eq. R.1 to R.13), in forms that keep
their digits in float32 (docs/method/reflectance.md#forms-that-hold-in-single-precision).

In all functions `xp` is a namespace of `iif_core.numerics.xp`; a vector is a sequence (x, y, z) of arrays; r is the perceptual
roughness, alpha = r^2; colours and reflectances are linear. All functions are elementwise and broadcast. The cosines NoL, NoV,
NoH, VoH and sin2_h are those of `half_angles`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from iif_core.numerics.xp import Namespace

R_MIN = 0.02
"""Smallest perceptual roughness; D exceeds the range of float32 below it (docs/method/numerics.md#roughness-at-zero)."""

F0_DIELECTRIC = 0.04
_MIN_VOH = 1e-4  # keeps the density finite where viewer and half vector are nearly at right angles
_XYZ = Sequence[Any]


def kd_ks(a: Any, m: Any) -> tuple[Any, Any]:
    """Compute the diffuse and specular reflectance of base colour a and metalness m (Eq. R.2), each in [0, 1].

    k_d = (1 - m) a,  k_s = 0.04 (1 - m) + m a.  m must broadcast against a.
    """
    return (1 - m) * a, F0_DIELECTRIC * (1 - m) + m * a


def compose(kd: Any, ks: Any, diffuse: Any, s0: Any, s1: Any) -> Any:
    """Compute k_d D + k_s S0 + S1: radiance from cached shading, or f cos from the lobes of one direction (Eq. R.7, S.2).

    Args:
        kd, ks: reflectances of `kd_ks`.
        diffuse, s0, s1: cached shading, or for f cos the factors diffuse, spec (1 - F_c) and spec F_c of `lobes`.

    Returns:
        Reflected radiance, or f cos in 1/sr.
    """
    return kd * diffuse + ks * s0 + s1


def dot(u: _XYZ, v: _XYZ) -> Any:
    """Compute the inner product of two vectors (x, y, z)."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def half_angles(xp: Namespace, normal: _XYZ, wi: _XYZ, wo: _XYZ) -> tuple[Any, Any, Any, Any, Any]:
    """Compute the cosines of a pair of directions and of their half vector.

    h = (wi + wo) / max(|wi + wo|, 1e-8), so opposite directions give finite values
    (docs/method/numerics.md#opposite-directions). sin2_h = |n x h|^2 comes from the cross product, because 1 - NoH^2 loses
    all digits near the peak of the lobe (docs/method/numerics.md#cancellation-at-the-ggx-peak).

    Args:
        xp: array namespace.
        normal, wi, wo: unit vectors; wi points to the light, wo to the viewer.

    Returns:
        NoL, NoV, NoH, VoH (clamped to >= 0) and sin2_h.
    """
    # The floor leaves h = 0 for opposite directions instead of 0 / 0.
    hx, hy, hz = wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2]
    scale = 1 / xp.maximum(xp.sqrt(hx * hx + hy * hy + hz * hz), 1e-8)
    h = (hx * scale, hy * scale, hz * scale)
    cx = normal[1] * h[2] - normal[2] * h[1]
    cy = normal[2] * h[0] - normal[0] * h[2]
    cz = normal[0] * h[1] - normal[1] * h[0]
    return (
        xp.maximum(dot(normal, wi), 0),
        xp.maximum(dot(normal, wo), 0),
        xp.maximum(dot(normal, h), 0),
        xp.maximum(dot(wo, h), 0),
        cx * cx + cy * cy + cz * cz,
    )


def normal_distribution(xp: Namespace, NoH: Any, sin2_h: Any, r: Any) -> Any:
    """Compute the GGX normal distribution D = alpha^2 / (pi (alpha^2 NoH^2 + sin2_h)^2) (Eq. R.8).

    The bracket is at least alpha^2 for unit vectors; it is clamped there, so that opposite directions (h = 0) stay finite.

    Args:
        xp: array namespace.
        NoH, sin2_h: of `half_angles`.
        r: roughness; raised to R_MIN.

    Returns:
        D in 1/sr.
    """
    r = xp.maximum(r, R_MIN)
    alpha2 = (r * r) * (r * r)
    # A sum of positive terms, where the textbook form subtracts two numbers near 1 (Eq. R.4, R.8).
    spread = xp.maximum(alpha2 * NoH * NoH + sin2_h, alpha2)
    return alpha2 / (xp.pi * spread * spread)


def lobes(xp: Namespace, NoL: Any, NoV: Any, NoH: Any, VoH: Any, sin2_h: Any, r: Any) -> tuple[Any, Any, Any]:
    """Compute the factors of Eq. R.7 that depend on no material but the roughness, times the cosine (Eq. R.6).

    diffuse = NoL / pi,  spec = D g(NoL) g(NoV) NoL / 4 with g(x) = 1 / (x (1 - k) + k), k = (r + 1)^2 / 8,
    fc = (1 - VoH)^5.

    Args:
        xp: array namespace.
        NoL, NoV, NoH, VoH, sin2_h: of `half_angles`.
        r: roughness in [0.02, 1]; smaller values are raised to R_MIN.

    Returns:
        diffuse and spec in 1/sr, both 0 where NoL or NoV is 0, and fc.
    """
    r = xp.maximum(r, R_MIN)
    k = (r + 1) * (r + 1) * 0.125
    # G / (NoL NoV) in one expression (Eq. R.5): the cosines in the denominator of Eq. R.1 cancel, so nothing is divided by 0.
    visibility = 1 / ((NoL * (1 - k) + k) * (NoV * (1 - k) + k))
    spec = normal_distribution(xp, NoH, sin2_h, r) * visibility * NoL * 0.25
    facing = (NoL > 0) & (NoV > 0)
    # Rounding may bring VoH above 1.
    x = xp.maximum(1 - VoH, 0)
    x2 = x * x
    return xp.where(facing, NoL * (1 / xp.pi), 0.0), xp.where(facing, spec, 0.0), x2 * x2 * x


def specular_pdf(xp: Namespace, NoH: Any, VoH: Any, sin2_h: Any, r: Any) -> Any:
    """Compute the density of wi when `sample_ggx_half` draws h and wi = reflect(wo, h) (Eq. R.11).

    Args:
        xp: array namespace.
        NoH, VoH, sin2_h: of `half_angles`.
        r: roughness.

    Returns:
        D NoH / (4 max(VoH, 1e-4)) in 1/sr.
    """
    return normal_distribution(xp, NoH, sin2_h, r) * NoH / (4 * xp.maximum(VoH, _MIN_VOH))


def specular_chance(xp: Namespace, kd: Any, ks: Any, NoV: Any) -> Any:
    """Compute the probability of drawing from the GGX lobe, its share of the reflectance (Eq. R.12).

    F / (F + k_d) with F = k_s + (1 - k_s)(1 - NoV)^5, clamped to [0.05, 0.95]. An even choice would make path weights grow
    (docs/method/numerics.md#path-weights-that-grow).

    Args:
        xp: array namespace.
        kd, ks: reflectances of one channel, or the largest of all channels.
        NoV: cosine between normal and viewer.

    Returns:
        Probability.
    """
    away = xp.maximum(1 - NoV, 0.0)
    fresnel = ks + (1 - ks) * away * away * away * away * away
    # A black metal that is seen head-on reflects nothing in either lobe.
    share = fresnel / xp.maximum(fresnel + kd, 1e-8)
    return xp.minimum(xp.maximum(share, 0.05), 0.95)


def mixture_pdf(xp: Namespace, NoL: Any, NoH: Any, VoH: Any, sin2_h: Any, r: Any, chance: Any = 0.5) -> Any:
    """Compute the density of a direction drawn from the GGX lobe with probability `chance`, else the cosine lobe (Eq. R.13).

    Args:
        xp: array namespace.
        NoL, NoH, VoH, sin2_h: of `half_angles`.
        r: roughness.
        chance: probability of the GGX lobe.

    Returns:
        Density in 1/sr.
    """
    return chance * specular_pdf(xp, NoH, VoH, sin2_h, r) + (1 - chance) * NoL * (1 / xp.pi)


def sample_cosine(xp: Namespace, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
    """Draw a direction with density cos / pi, in a frame with z = normal, from uniforms in [0, 1) (Eq. R.9)."""
    sine, phi = xp.sqrt(u1), 2 * xp.pi * u2
    return sine * xp.cos(phi), sine * xp.sin(phi), xp.sqrt(xp.maximum(1 - u1, 0))


def sample_ggx_half(xp: Namespace, u1: Any, u2: Any, r: Any) -> tuple[Any, Any, Any]:
    """Draw a half vector with density D NoH, in a frame with z = normal (Eq. R.10).

    tan^2 theta = alpha^2 u1 / (1 - u1). Sine and cosine are formed separately, so neither loses digits at small alpha.

    Args:
        xp: array namespace.
        u1, u2: uniforms in [0, 1).
        r: roughness; raised to R_MIN.

    Returns:
        Unit vector (x, y, z).
    """
    r = xp.maximum(r, R_MIN)
    alpha2 = (r * r) * (r * r)
    # cos^2 and sin^2 are `head` and `tail` over their sum.
    head, tail = xp.maximum(1 - u1, 1e-12), u1 * alpha2
    inverse = 1 / (head + tail)
    cosine, sine, phi = xp.sqrt(head * inverse), xp.sqrt(tail * inverse), 2 * xp.pi * u2
    return sine * xp.cos(phi), sine * xp.sin(phi), cosine


def reflect(wo: _XYZ, h: _XYZ) -> tuple[Any, Any, Any]:
    """Mirror wo about h: wi = 2 (wo . h) h - wo. The result may lie below the surface, where its weight is 0."""
    twice = 2 * dot(wo, h)
    return twice * h[0] - wo[0], twice * h[1] - wo[1], twice * h[2] - wo[2]
