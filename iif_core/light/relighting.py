"""Numerical parts of relighting: camera paths, the inserted lamp, the exposure of pictures
(docs/method/light.md#relighting)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.numerics.color import luminance

Array = np.ndarray


def ease(t: ArrayLike) -> Array:
    """Ease times in [0, 1] in and out: 2 t^2, then 1 - 2 (1 - t)^2, with speed 0 at both ends (Eq. L.52).

    >>> ease([0.0, 0.25, 0.5, 1.0]).tolist()
    [0.0, 0.125, 0.5, 1.0]
    """
    t = np.clip(np.asarray(t, np.float64), 0, 1)
    return np.where(t < 0.5, 2 * t * t, 1 - 2 * (1 - t) ** 2)


def frame_times(frames: int) -> Array:
    """Return (frames,) eased times in [0, 1]; a single frame is at 0."""
    return ease(np.arange(frames) / max(frames - 1, 1))


def camera_path(poses: ArrayLike, times: ArrayLike) -> Array:
    """Interpolate poses (n, 4, 4) at `times` (n,) in [0, 1] between key poses (k, 4, 4) that are evenly spaced in time.

    Rotations follow the shortest arc (slerp), positions a natural cubic spline; key poses are met exactly.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    poses, times = np.asarray(poses, np.float64), np.asarray(times, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InputError(f"camera path: found poses of shape {poses.shape}; at least one 4x4 pose is needed")
    out = np.tile(np.eye(4), (len(times), 1, 1))
    if len(poses) == 1:
        out[:] = poses[0]
        return out
    keys = np.linspace(0, 1, len(poses))
    out[:, :3, :3] = Slerp(keys, Rotation.from_matrix(poses[:, :3, :3]))(np.clip(times, 0, 1)).as_matrix()
    out[:, :3, 3] = CubicSpline(keys, poses[:, :3, 3], bc_type="natural")(np.clip(times, 0, 1))
    return out


def sphere_mesh(centre: ArrayLike, radius: float, subdivisions: int = 3) -> tuple[Array, Array]:
    """Build an icosphere with outward normals: (v, 3) float32 metres and (f, 3) int32, 20 x 4^subdivisions faces.

    It is scaled to the area of the sphere, so that a given radiance sends out the power of the sphere (Eq. L.53).
    """
    golden = (1 + 5**0.5) / 2
    vertices = np.array([[0, s, t * golden] for s in (1, -1) for t in (1, -1)], np.float64)
    vertices = np.concatenate([np.roll(vertices, shift, 1) for shift in range(3)])
    # The 20 faces are the triples of corners that are neighbours of one another, edges of length 2.
    near = np.abs(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) - 2) < 1e-9
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]]
    faces = np.array(triples)
    for _ in range(subdivisions):
        vertices, faces = _split(vertices, faces)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    corner = vertices[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    # The centre is the origin, so an outward normal points the same way as a corner.
    inward = np.einsum("ij,ij->i", cross, corner[:, 0]) < 0
    faces[inward] = faces[inward][:, ::-1]
    scale = radius * np.sqrt(4 * np.pi / (0.5 * np.linalg.norm(cross, axis=1).sum()))
    return (np.asarray(centre, np.float64) + scale * vertices).astype(np.float32), faces.astype(np.int32)


def _split(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Split every triangle into four at the middles of its edges."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    # Two faces share an edge and thereby its middle.
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = np.split(index.ravel() + len(vertices), 3)
    a, b, c = faces.T
    corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([vertices, vertices[unique].mean(1)]), np.concatenate([np.stack(part, 1) for part in corners])


def exposure_for(radiance: ArrayLike, quantile: float = 0.95, level: float = 0.8) -> float:
    """Return the factor that brings the `quantile` of the largest channel to `level`, 1 for black pictures (Eq. L.54)."""
    brightest = float(np.quantile(np.asarray(radiance, np.float64).max(-1), quantile))
    return level / brightest if brightest > 0 else 1.0


def coloured(radiance: ArrayLike, factor: float, colour: ArrayLike | None = None) -> Array:
    """Return the radiance (3,) of a lamp of radiance `radiance` (3,) that is dimmed by `factor` and has another colour.

    With a colour c (3,), linear, the radiance is factor x Y(radiance) / Y(c) x c: the luminance Y stays (Eq. L.64).

    >>> coloured([1.0, 1.0, 1.0], 0.5).tolist()
    [0.5, 0.5, 0.5]

    Raises:
        InputError: a colour without light.
    """
    found = np.asarray(radiance, np.float64)
    if colour is None:
        return factor * found
    wanted = np.asarray(colour, np.float64)
    if not luminance(wanted) > 0:
        raise InputError(f"colour of a lamp: found {wanted.tolist()}; one of the three numbers must be above 0")
    return factor * wanted * (luminance(found) / luminance(wanted))


def sum_of_lamps(pictures: ArrayLike, weights: ArrayLike) -> Array:
    """Return the picture under other light: sum over l of weights_l pictures_l (Eq. L.63).

    Args:
        pictures: (L, ..., 3) radiance that each lamp gives by itself; weights: (L, 3) factors on the light of each.

    Returns:
        (..., 3) float32.
    """
    pictures, weights = np.asarray(pictures), np.asarray(weights, np.float64)
    total = np.zeros(pictures.shape[1:], np.float64)
    for picture, weight in zip(pictures, weights, strict=True):
        if weight.any():
            total += picture * weight
    return total.astype(np.float32)


def axes_of_map(up: ArrayLike, turn: float) -> Array:
    """Return the axes x, y, z of a map in the world as rows (3, 3): z is `up`; x is the world axis +x (+y when x is up), made
    orthogonal to up and turned by `turn` degrees about it."""
    z = np.asarray(up, np.float64) / np.linalg.norm(up)
    start = np.array([0.0, 1.0, 0.0]) if abs(z[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
    x = start - z * (start @ z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    angle = np.radians(turn)
    x, y = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    return np.stack([x, y, z])
