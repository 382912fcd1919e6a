"""Pure parts of relighting: camera paths, the inserted lamp, the exposure of a picture (METHOD 2.10)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray


def ease(t: ArrayLike) -> Array:
    """Quadratic ease-in and -out of t in [0, 1]: 2 t^2, then 1 - 2 (1 - t)^2; speed is 0 at both ends."""
    t = np.clip(np.asarray(t, np.float64), 0, 1)
    return np.where(t < 0.5, 2 * t * t, 1 - 2 * (1 - t) ** 2)


def frame_times(frames: int) -> Array:
    """(frames,) eased times in [0, 1]; one frame is the start."""
    return ease(np.arange(frames) / max(frames - 1, 1))


def camera_path(poses: ArrayLike, times: ArrayLike) -> Array:
    """(n, 4, 4) poses at `times` (n,) in [0, 1] along key poses (k, 4, 4), evenly spaced in time.

    Rotations are interpolated on the shortest arc (slerp), positions by a natural cubic spline; keys are met exactly.
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
    """Icosphere with outward normals, (v, 3) float32 metres and (f, 3) int32; 20 x 4^subdivisions faces.

    Scaled so that its area is the sphere's, 4 pi radius^2: with a given radiance it sends out the sphere's power.
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
    inward = np.einsum("ij,ij->i", cross, corner[:, 0]) < 0
    faces[inward] = faces[inward][:, ::-1]
    scale = radius * np.sqrt(4 * np.pi / (0.5 * np.linalg.norm(cross, axis=1).sum()))
    return (np.asarray(centre, np.float64) + scale * vertices).astype(np.float32), faces.astype(np.int32)


def _split(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Every triangle into four at the middles of its edges."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = np.split(index.ravel() + len(vertices), 3)
    a, b, c = faces.T
    corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([vertices, vertices[unique].mean(1)]), np.concatenate([np.stack(part, 1) for part in corners])


def exposure_for(radiance: ArrayLike, quantile: float = 0.95, level: float = 0.8) -> float:
    """Factor that brings the `quantile` of the largest channel to `level` of the sensor's range; 1 for black pictures."""
    brightest = float(np.quantile(np.asarray(radiance, np.float64).max(-1), quantile))
    return level / brightest if brightest > 0 else 1.0


def axes_of_map(up: ArrayLike, turn: float) -> Array:
    """(3, 3) rows x, y, z of a map's axes in the world: z is `up`; x the world axis +x (or +y when x is up), turned by
    `turn` degrees about up."""
    z = np.asarray(up, np.float64) / np.linalg.norm(up)
    start = np.array([0.0, 1.0, 0.0]) if abs(z[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
    x = start - z * (start @ z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    angle = np.radians(turn)
    x, y = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    return np.stack([x, y, z])
