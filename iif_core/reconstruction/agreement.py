"""What depth maps say about each other's surface: that it is there, or that they look through it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from iif_core.reconstruction.sweep import Picture

THROUGH = 0.05
"""Relative distance behind a surface from which depth shows that it is not there."""


def votes(
    depth: NDArray, reference: Picture, others: Sequence[tuple[NDArray, NDArray, Picture]], tolerance: float = 0.015
) -> tuple[NDArray, NDArray]:
    """Count the depth maps that show the surface of one, and those that look through it.

    Args:
        depth: (H, W) z-depth of the reference, NaN = unknown.
        others: of each other picture the depth that speaks for a surface, the depth that speaks against it, both (H, W) with
            NaN = unknown, and the picture.
        tolerance: largest relative difference of depths of the same surface.

    Returns:
        Two (H, W) int64.
    """
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(reference.intrinsics).T
    camera = reference.camera_from_world
    points = (rays * depth[..., None] - camera[:, 3]) @ camera[:, :3]
    same, through = np.zeros(depth.shape, np.int64), np.zeros(depth.shape, np.int64)
    for shows, denies, picture in others:
        row, column, z, inside = picture.pixels(points, shows.shape)
        with np.errstate(invalid="ignore"):
            same += inside & (np.abs(shows[row, column] - z) <= tolerance * z)
            through += inside & (denies[row, column] - z > THROUGH * z)
    return same, through


def agreed(
    depth: NDArray, reference: Picture, others: Sequence[tuple[NDArray, Picture]], tolerance: float = 0.015, least: int = 1
) -> NDArray:
    """Return the depth (H, W) where at least `least` other depth maps have the same surface, NaN elsewhere.

    Args:
        depth: z-depth of the reference, NaN = unknown.
        others: depth maps with their pictures.
        tolerance: largest relative difference of depths.
        least: number of maps that must agree.
    """
    same, _ = votes(depth, reference, [(other, other, picture) for other, picture in others], tolerance)
    return np.where(same >= least, depth, np.nan).astype(np.float32)
