"""The model of the workflow in terms of BSDFs that Mitsuba has: half `diffuse`, half the metal of `principled`.

A `blendbsdf` of weight 1/2 adds half of each of its two BSDFs. `diffuse` with the reflectance 2 k_d is then the diffuse lobe of
the workflow exactly. `principled` with metalness 1 is c (1 - F_c) + F_c times a GGX lobe, as the specular lobe is with c = k_s
(Eq. R.1 to R.13), but half of it, and its microfacets shadow less. Averaged over all directions of light and view, the two
specular lobes reflect k_s A_0 + A_1 and (P + Q c) / 2 of the light; they are made to reflect as much by

    c = (2 (k_s A_0 + A_1) - P) / Q.

What is left is the difference in shape of the specular lobes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iif_core.reflectance.brdf import kd_ks
from iif_core.reflectance.directional_albedo import COSINES, directional_albedo
from workflow.runtime import device

ROUGHNESS = np.linspace(0.05, 1.0, 20)
"""Perceptual roughness of the table; both models change little below."""
_ANGLES, _SAMPLES = 16, 4096


def blended(albedo: NDArray, roughness: NDArray, metallic: NDArray) -> tuple[NDArray, NDArray]:
    """Return the reflectance 2 k_d for `diffuse` and the base colour c for `principled`.

    Args:
        albedo: (n, 3) linear base colour in [0, 1]; roughness, metallic: (n,) in [0, 1].

    Returns:
        Two (n, 3) float32; both go up to about 2.
    """
    kd, ks = kd_ks(albedo, np.asarray(metallic)[:, None])
    black, white = (np.interp(roughness, ROUGHNESS, row)[:, None] for row in metal_reflectance())
    first, second = (np.interp(roughness, ROUGHNESS, row)[:, None] for row in _ours())
    wanted = 2 * (first * ks + second)
    return (2 * kd).astype(np.float32), np.maximum((wanted - black) / (white - black), 0).astype(np.float32)


@lru_cache(maxsize=1)
def metal_reflectance() -> NDArray:
    """Integrate the metal of `principled` over all directions: (2, 20) by base colour 0 or 1, and `ROUGHNESS`.

    Directions are drawn by the plug-in, on strata of its two dimensions, for cosines of the viewer at the middle of equal shares
    of the projected hemisphere.
    """
    mi = device.mitsuba()
    return np.array([[_reflectance(mi, base, r) for r in ROUGHNESS] for base in (0.0, 1.0)])


def _reflectance(mi: Any, base: float, roughness: float) -> float:
    import drjit as dr

    bsdf = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "rgb", "value": base},
            "metallic": 1.0,
            "roughness": float(roughness),
        }
    )
    count = _ANGLES * _SAMPLES
    index = np.arange(count)
    side = int(np.sqrt(_SAMPLES))
    own = index % _SAMPLES
    cosine = np.sqrt((index // _SAMPLES + 0.5) / _ANGLES)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(np.sqrt(1 - cosine**2).astype(np.float32), 0.0, cosine.astype(np.float32))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    square = mi.Point2f(((own % side + 0.5) / side).astype(np.float32), ((own // side + 0.5) / side).astype(np.float32))
    lobe = mi.Float((np.modf(own * 0.6180339887498949)[0]).astype(np.float32))  # golden ratio: every stratum meets every lobe
    _, weight = bsdf.sample(mi.BSDFContext(), si, lobe, square)
    return float(np.array(weight.x, np.float64).mean())


@lru_cache(maxsize=1)
def _ours() -> NDArray:
    """(2, 20): lobes A_0 and A_1 of `directional_albedo`, averaged over the projected hemisphere."""
    table = directional_albedo(ROUGHNESS)
    cosine = np.sqrt((np.arange(256) + 0.5) / 256)
    return np.array([[np.interp(cosine, COSINES, row).mean() for row in part] for part in table])
