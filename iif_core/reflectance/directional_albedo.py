"""What the specular lobes reflect of light that is the same from everywhere (Eq. S.22, docs/method/shading.md#matte-surface)."""

from __future__ import annotations

import numpy as np

from iif_core.numerics.xp import NUMPY
from iif_core.reflectance import brdf

STRATA = 32
COSINES = np.linspace(0.0, 1.0, 33)
"""Cosines of the table."""


def directional_albedo(roughness: np.ndarray) -> np.ndarray:
    """Integrate the lobes over the hemisphere: A_0 = int spec (1 - F_c), A_1 = int spec F_c, at the cosines of `COSINES`.

    Half vectors are drawn by the midpoint rule on STRATA^2 strata, so the sum has no noise.

    Args:
        roughness: (J,) perceptual.

    Returns:
        (2, J, 33) float64 in [0, 1]; light of radiance L from everywhere is reflected as k_s A_0 L + A_1 L.
    """
    u1, u2 = ((np.indices((STRATA, STRATA)).reshape(2, -1) + 0.5) / STRATA)[:, None, :]
    # All lobes are 0 at NoV = 0; the first entry stands for a view just above the surface.
    NoV = np.maximum(COSINES, 1e-3)[:, None]
    wo = (np.sqrt(1 - NoV**2), np.zeros_like(NoV), NoV)
    normal = (0.0, 0.0, 1.0)
    out = np.zeros((2, len(roughness), len(COSINES)))
    for j, r in enumerate(roughness):
        # Drawing by the lobe follows its peak at any roughness, so a fixed number of strata serves all of them.
        wi = brdf.reflect(wo, brdf.sample_ggx_half(NUMPY, u1, u2, r))
        NoL, cosine, NoH, VoH, sin2_h = brdf.half_angles(NUMPY, normal, wi, wo)
        _, spec, fc = brdf.lobes(NUMPY, NoL, cosine, NoH, VoH, sin2_h, r)
        pdf = brdf.specular_pdf(NUMPY, NoH, VoH, sin2_h, r)
        weight = np.where(pdf > 0, spec / np.where(pdf > 0, pdf, 1.0), 0.0)  # 0 where wi lies below the surface
        out[0, j], out[1, j] = (weight * (1 - fc)).mean(-1), (weight * fc).mean(-1)
    return out


def uniform_lobes(diffuse: np.ndarray, cosine: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the split specular integrals of points, as if all light came from everywhere alike.

    The diffuse integral D = 1/pi int L cos is the radiance of the uniform light of the same irradiance.

    Args:
        diffuse: (..., n, 3) diffuse integrals.
        cosine: (n,) between normal and viewer; roughness: (J,).

    Returns:
        s0 and s1, (..., n, J, 3) in the dtype of `diffuse`.
    """
    table = directional_albedo(np.asarray(roughness, np.float64))
    at = np.clip(cosine, 0.0, 1.0)
    s = [np.stack([np.interp(at, COSINES, row) for row in part], 1).astype(diffuse.dtype) for part in table]
    return tuple(diffuse[..., None, :] * part[:, :, None] for part in s)
