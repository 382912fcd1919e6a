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

import numpy as np
from numpy.typing import NDArray

from iif_core.reflectance.brdf import kd_ks
from iif_core.reflectance.directional_albedo import COSINES, directional_albedo

ROUGHNESS = np.linspace(0.05, 1.0, 20)
"""Perceptual roughness of the table; both models change little below."""
METAL = np.array(
    [
        0.04431793768216618, 0.044157480951222, 0.04353011760007414, 0.04167000374257049, 0.038707815145325515,
        0.03470289691811104, 0.03025047692524713, 0.02567139732287569, 0.021350738449451737, 0.01773958042677241,
        0.014511957248653756, 0.011737782794381943, 0.009427509486921577, 0.007540946988427617, 0.006015309221439343,
        0.004794729322214921, 0.003823303539682204, 0.0030497571053666813, 0.0024292384248790024, 0.001937011846264946,
        0.9999940649131531, 0.9999042444824227, 0.9994366935570724, 0.9972521560989662, 0.9929285830298795,
        0.985357623229568, 0.9728461920880989, 0.9454103647095051, 0.9032422543694025, 0.8822223028600149,
        0.8401879756853949, 0.7980184119044011, 0.7473817266676175, 0.696462988376837, 0.6422369103671235,
        0.5869355027499727, 0.5316228235444753, 0.477390032714352, 0.425340454503796, 0.3762271659781389,
    ]
).reshape(2, 20)  # fmt: skip
"""P and P + Q: the metal of `principled` with base colour 0 and 1 at each `ROUGHNESS`, averaged over all directions. They
depend on Mitsuba alone; tests/oracles/mitsuba_lobes.py integrates them."""


def blended(albedo: NDArray, roughness: NDArray, metallic: NDArray) -> tuple[NDArray, NDArray]:
    """Return the reflectance 2 k_d for `diffuse` and the base colour c for `principled`.

    Args:
        albedo: (n, 3) linear base colour in [0, 1]; roughness, metallic: (n,) in [0, 1].

    Returns:
        Two (n, 3) float32; both go up to about 2.
    """
    kd, ks = kd_ks(albedo, np.asarray(metallic)[:, None])
    black, white = (np.interp(roughness, ROUGHNESS, row)[:, None] for row in METAL)
    first, second = (np.interp(roughness, ROUGHNESS, row)[:, None] for row in _ours())
    wanted = 2 * (first * ks + second)
    return (2 * kd).astype(np.float32), np.maximum((wanted - black) / (white - black), 0).astype(np.float32)


@lru_cache(maxsize=1)
def _ours() -> NDArray:
    """(2, 20): lobes A_0 and A_1 of `directional_albedo`, averaged over the projected hemisphere."""
    table = directional_albedo(ROUGHNESS)
    cosine = np.sqrt((np.arange(256) + 0.5) / 256)
    return np.array([[np.interp(cosine, COSINES, row).mean() for row in part] for part in table])
