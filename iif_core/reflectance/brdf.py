"""The Cook-Torrance reflectance of the method, exactly, written once for NumPy, Dr.Jit and torch.

    f cos = k_d NoL / pi + (k_s + (1 - k_s) F_c) * spec          spec = D G NoL / (4 NoL NoV)
    k_d = (1 - m) a      k_s = 0.04 (1 - m) + m a      F_c = (1 - VoH)^5

Every formula is in the form that stays exact in float32 down to r = 0.02 (METHOD sections 3.1, 3.2, 3.4).
`xp` is a namespace of `iif_core.numerics.xp`; vectors are sequences (x, y, z) of arrays. All functions are elementwise
and broadcast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from iif_core.numerics.xp import Namespace

R_MIN = 0.02
"""Smallest perceptual roughness: below it D and its density leave the range of float32 (METHOD H16)."""

F0_DIELECTRIC = 0.04
_TINY = 1e-4
_XYZ = Sequence[Any]


def kd_ks(a: Any, m: Any) -> tuple[Any, Any]:
    """Diffuse and specular reflectance (k_d, k_s) of base colour a and metallic m, linear, each in [0, 1].

    k_d = (1 - m) a,  k_s = 0.04 (1 - m) + m a  (METHOD 3.1). m must broadcast against a.
    """
    return (1 - m) * a, F0_DIELECTRIC * (1 - m) + m * a


def compose(kd: Any, ks: Any, diffuse: Any, s0: Any, s1: Any) -> Any:
    """k_d D + k_s S0 + S1: reflected radiance from cached shading, or f cos from the lobes of one direction.

    For f cos use D = diffuse, S0 = spec (1 - F_c), S1 = spec F_c; then it equals k_d/pi NoL + F spec with
    F = k_s + (1 - k_s) F_c (METHOD 2.7, 3.1).
    """
    return kd * diffuse + ks * s0 + s1


def dot(u: _XYZ, v: _XYZ) -> Any:
    """Inner product of two vectors given as (x, y, z)."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def half_angles(xp: Namespace, normal: _XYZ, wi: _XYZ, wo: _XYZ) -> tuple[Any, Any, Any, Any, Any]:
    """(NoL, NoV, NoH, VoH, sin2_h) of unit vectors: clamped cosines and sin2_h = |n x h|^2.

    h = (wi + wo) / max(|wi + wo|, 1e-8), so opposite directions give finite values (METHOD H19); sin2_h is
    taken from the cross product because 1 - NoH^2 has no digits left near the peak (METHOD 3.4).
    """
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
    """GGX normal distribution D, 1/sr, in the stable form alpha^2 / (pi (alpha^2 NoH^2 + sin2_h)^2), alpha =
    r^2.

    r is clamped to [R_MIN, inf). The bracket is at least alpha^2 for any real angle; it is held there, so
    that opposite directions (h = 0) stay finite. Source: METHOD 3.4.
    """
    r = xp.maximum(r, R_MIN)
    alpha2 = (r * r) * (r * r)
    spread = xp.maximum(alpha2 * NoH * NoH + sin2_h, alpha2)
    return alpha2 / (xp.pi * spread * spread)


def lobes(xp: Namespace, NoL: Any, NoV: Any, NoH: Any, VoH: Any, sin2_h: Any, r: Any) -> tuple[Any, Any, Any]:
    """(diffuse, spec, fc): the material-free lobes times the cosine, for one pair of directions.

    diffuse = NoL / pi,  spec = D G/(NoL NoV) NoL / 4 with g(x) = 1/(x (1 - k) + k), k = (r + 1)^2 / 8,
    fc = (1 - VoH)^5. All 1/sr; zero when NoL <= 0 or NoV <= 0. r in [0.02, 1] (smaller is clamped).
    Source: METHOD 3.1, 3.4.
    """
    r = xp.maximum(r, R_MIN)
    k = (r + 1) * (r + 1) * 0.125
    visibility = 1 / ((NoL * (1 - k) + k) * (NoV * (1 - k) + k))
    spec = normal_distribution(xp, NoH, sin2_h, r) * visibility * NoL * 0.25
    facing = (NoL > 0) & (NoV > 0)
    x = xp.maximum(1 - VoH, 0)
    x2 = x * x
    return xp.where(facing, NoL * (1 / xp.pi), 0.0), xp.where(facing, spec, 0.0), x2 * x2 * x


def specular_pdf(xp: Namespace, NoH: Any, VoH: Any, sin2_h: Any, r: Any) -> Any:
    """Density (1/sr) of wi when h is drawn by `sample_ggx_half` and wi = reflect(wo, h): D NoH / (4 max(VoH,
    1e-4)).

    Source: METHOD 3.2.
    """
    return normal_distribution(xp, NoH, sin2_h, r) * NoH / (4 * xp.maximum(VoH, _TINY))


def specular_chance(xp: Namespace, kd: Any, ks: Any, NoV: Any) -> Any:
    """Probability of drawing from the GGX lobe: its share F / (F + k_d) of what is reflected, F = k_s + (1 - k_s)(1 - NoV)^5,
    kept in [0.05, 0.95].

    kd, ks: of one channel or the largest of all. METHOD 3.2 draws either lobe half of the time; on a diffuse wall that
    squanders half of the paths and lets weights of almost 2 multiply up from bounce to bounce.
    """
    away = xp.maximum(1 - NoV, 0.0)
    fresnel = ks + (1 - ks) * away * away * away * away * away
    share = fresnel / xp.maximum(fresnel + kd, 1e-8)
    return xp.minimum(xp.maximum(share, 0.05), 0.95)


def mixture_pdf(xp: Namespace, NoL: Any, NoH: Any, VoH: Any, sin2_h: Any, r: Any, chance: Any = 0.5) -> Any:
    """Density (1/sr) of choosing the GGX lobe with probability `chance`, else the cosine lobe."""
    return chance * specular_pdf(xp, NoH, VoH, sin2_h, r) + (1 - chance) * NoL * (1 / xp.pi)


def sample_cosine(xp: Namespace, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
    """Local direction (z = normal) with density cos / pi from uniforms in [0, 1): theta = asin sqrt(u1), phi
    = 2 pi u2."""
    sine, phi = xp.sqrt(u1), 2 * xp.pi * u2
    return sine * xp.cos(phi), sine * xp.sin(phi), xp.sqrt(xp.maximum(1 - u1, 0))


def sample_ggx_half(xp: Namespace, u1: Any, u2: Any, r: Any) -> tuple[Any, Any, Any]:
    """Local half vector with density D NoH from uniforms in [0, 1).

    tan^2 theta_h = alpha^2 u1 / (1 - u1), alpha = r^2; sine and cosine are formed separately so that neither
    loses digits at small alpha (METHOD 3.2, 3.4). r below R_MIN is clamped.
    """
    r = xp.maximum(r, R_MIN)
    alpha2 = (r * r) * (r * r)
    head, tail = xp.maximum(1 - u1, 1e-12), u1 * alpha2
    inverse = 1 / (head + tail)
    cosine, sine, phi = xp.sqrt(head * inverse), xp.sqrt(tail * inverse), 2 * xp.pi * u2
    return sine * xp.cos(phi), sine * xp.sin(phi), cosine


def reflect(wo: _XYZ, h: _XYZ) -> tuple[Any, Any, Any]:
    """wi = 2 (wo . h) h - wo, the mirror image of wo about h; it may lie below the surface (its weight is
    then 0)."""
    twice = 2 * dot(wo, h)
    return twice * h[0] - wo[0], twice * h[1] - wo[1], twice * h[2] - wo[2]
