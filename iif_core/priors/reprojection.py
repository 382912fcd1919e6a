"""What the other photographs show of the surface of one: samples by reprojection, and their statistics per pixel.

Compiled loops over the pixels of one view. Each call runs in one thread and releases the interpreter, so the bytes do not depend
on how many views are worked on at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.compiled import njit

QUANTILES = (0.2, 0.5, 0.8, 1.0)
DEPTH_TOLERANCE = (0.012, 0.004)
"""Two views see the same point if their z-depths differ by less than this share of the depth plus so many metres."""
NORMAL_COSINE = 0.8
"""Two views see the same side of a surface if the cosine between their normals is above this."""
NEAREST = 0.05
"""z-depth in metres below which a point is too close to a camera to be found in its picture."""

_compiled = njit()


LOG_STEPS, NORMAL_STEPS = 1024.0, 127.0
"""Steps of a natural logarithm, and of a component of a normal, in which integers stand for them: compiled loops have no half
precision."""


class ViewTable(NamedTuple):
    """Pixels of one view that other views look up, n = H x W in rows of the picture: 22 bytes each.

    Radiances are relative to the mean of the scene, with the exposure of the view divided out.
    """

    depth: NDArray
    """(n,) float32 z-depth in metres, 0 = no surface."""
    normal: NDArray
    """(n, 3) int8 unit normal towards the camera, in NORMAL_STEPS."""
    used: NDArray
    """(n,) bool: the photograph shows surface there."""
    log_radiance: NDArray
    """(n, 3) int16 natural logarithm, floored at the noise of the view, in LOG_STEPS."""
    luminance: NDArray
    """(n,) float32 mean of the channels."""
    mirrored: NDArray
    """(n,) float32 luminance that the mirrored ray meets; NaN where no photograph shows what it meets."""


def as_steps(log_value: NDArray) -> NDArray:
    """Return logarithms as int16 in LOG_STEPS; beyond -32 and 32 they are cut."""
    return np.rint(np.clip(log_value, -31.9, 31.9) * LOG_STEPS).astype(np.int16)


def from_steps(steps: NDArray) -> NDArray:
    """Return the logarithms (float32) that integers stand for."""
    return steps.astype(np.float32) * np.float32(1 / LOG_STEPS)


class Camera(NamedTuple):
    """A pinhole camera: world-to-camera rotation (3, 3), centre (3,) in metres, fx, fy, cx, cy and size in pixels."""

    rotation: NDArray
    centre: NDArray
    intrinsics: NDArray
    width: int
    height: int


@_compiled
def add_samples(point, normal, own, camera, table, samples, count, sums):
    """Add what one view shows of the surface points of another.

    Args:
        point, normal: (m, 3) float32 surface points in metres and unit normals towards their own camera.
        own: (m,) int64 pixel of `table` where the view is the points' own, else -1.
        camera, table: of the view that is looked up (`Camera`, `ViewTable`).
        samples: (m, U, 3) float32; row `count` of a point takes the log radiance. Points with U samples take no more.
        count: (m,) int32 samples so far.
        sums: (m, 6) float64; where the mirrored ray is known: number, sums of L, X, L L, X X and L X, with L the luminance and X
            what the mirrored ray meets.
    """
    fx, fy, cx, cy = camera.intrinsics
    share, least = DEPTH_TOLERANCE
    for i in range(len(point)):
        at = own[i]
        if at < 0:
            # The point in the frame of the camera, and its pixel.
            x, y, z = point[i, 0] - camera.centre[0], point[i, 1] - camera.centre[1], point[i, 2] - camera.centre[2]
            r = camera.rotation
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
            if depth <= NEAREST:
                continue
            # Pixel (i, j) covers [j, j + 1) x [i, i + 1), so the integer part of (v, u) is its index.
            u = fx * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) / depth + cx
            v = fy * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) / depth + cy
            if not (0 <= u < camera.width and 0 <= v < camera.height):
                continue
            at = int(v) * camera.width + int(u)
            # Whether the pixel shows the same surface: photographed, at the same depth, from the same side.
            if not table.used[at] or abs(table.depth[at] - depth) >= share * depth + least:
                continue
            cosine = np.float32(0.0)
            for a in range(3):
                cosine += normal[i, a] * table.normal[at, a]
            if cosine <= NORMAL_COSINE * NORMAL_STEPS:  # normals of the table are in steps
                continue
        if count[i] == samples.shape[1]:
            continue
        for c in range(3):
            samples[i, count[i], c] = table.log_radiance[at, c] * np.float32(1 / LOG_STEPS)
        count[i] += 1
        mirrored = np.float64(table.mirrored[at])  # NaN differs from itself
        if mirrored == mirrored:
            luminance = np.float64(table.luminance[at])  # float64: centred sums are differences of these
            sums[i, 0] += 1
            sums[i, 1] += luminance
            sums[i, 2] += mirrored
            sums[i, 3] += luminance * luminance
            sums[i, 4] += mirrored * mirrored
            sums[i, 5] += luminance * mirrored


@_compiled
def quantiles(samples, count):
    """Return the QUANTILES of the samples of each point, (m, 4, 3) float32: the nearest of the sorted samples; 0 without any.

    Args:
        samples: (m, U, 3) float32, sorted in place; count: (m,) int32 of those that are there.
    """
    out = np.zeros((len(samples), len(QUANTILES), 3), np.float32)
    for i in range(len(samples)):
        n = count[i]
        for c in range(3):
            for j in range(1, n):  # insertion sort: there are few
                value, k = samples[i, j, c], j
                while k > 0 and samples[i, k - 1, c] > value:
                    samples[i, k, c] = samples[i, k - 1, c]
                    k -= 1
                samples[i, k, c] = value
            for q in range(len(QUANTILES)):
                if n > 0:
                    out[i, q, c] = samples[i, int(np.rint((n - 1) * QUANTILES[q])), c]  # nearest rank
    return out
