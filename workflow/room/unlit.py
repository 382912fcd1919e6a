"""The lit room as a texture, for scene_unlit.glb: what room.html shows with all lamps on, without the direction of the viewer."""

from __future__ import annotations

import numpy as np

from iif_core.numerics.color import to_uint8, tone_map
from iif_core.reflectance.brdf import R_MIN, kd_ks
from iif_core.reflectance.directional_albedo import COSINES, directional_albedo
from iif_core.surface.atlas import nearest_covered
from workflow.exporters.atlas import Atlas
from workflow.room.light import LitTexels

Array = np.ndarray

LEVELS = 33
"""Levels of roughness of the table of lobes."""


def mean_reflectance(base_color: Array, roughness: Array, metallic: Array) -> Array:
    """Return the share of even light from everywhere that surface reflects in all directions together: k_d + k_s a_0 + a_1, where
    a_0 and a_1 are A_0 and A_1 of Eq. S.22, averaged over directions of the viewer with weight 2 cos.

    Args:
        base_color: (..., 3) linear; roughness, metallic: (...).
    """
    table = directional_albedo(np.maximum(np.linspace(0, 1, LEVELS), R_MIN))
    means = np.trapezoid(table * 2 * COSINES, COSINES, axis=-1)
    first, second = (np.interp(roughness, np.linspace(0, 1, LEVELS), row)[..., None] for row in means)
    kd, ks = kd_ks(base_color, np.asarray(metallic)[..., None])
    return kd + ks * first + second


def unlit_picture(atlas: Atlas, texels: LitTexels, light: Array, exposure: float) -> Array:
    """Draw the atlas as the lit room appears on a screen.

    Args:
        atlas: materials, S x S.
        texels: of the light map, which may be coarser.
        light: (n, 3) diffuse light of all lamps at `texels`, radiance.
        exposure: factor on radiance.

    Returns:
        (S, S, 3) uint8, sRGB-encoded.
    """
    from scipy.ndimage import map_coordinates

    covered = np.zeros(texels.size**2, bool)
    covered[texels.stored] = True
    row = np.zeros(texels.size**2, np.int64)
    row[texels.stored] = texels.source
    coarse = np.asarray(light)[row[nearest_covered(covered.reshape(texels.size, texels.size))]] if len(light) else None
    if coarse is None:
        return np.zeros((atlas.size, atlas.size, 3), np.uint8)
    at = (np.arange(atlas.size) + 0.5) * texels.size / atlas.size - 0.5
    places = np.meshgrid(at, at, indexing="ij")
    fine = np.stack([map_coordinates(coarse[..., c], places, order=1, mode="nearest") for c in range(3)], -1)
    shown = mean_reflectance(atlas.base_color, atlas.roughness, atlas.metallic) * fine
    return to_uint8(tone_map(shown.astype(np.float32), exposure))
