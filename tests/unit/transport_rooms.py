"""Boxes, a furnished room and statistics for the tests of light transport."""

import numpy as np
import pytest

from iif_core.camera import pinhole


def quad(corner, edge1, edge2):
    """Two triangles, right-hand normal edge1 x edge2."""
    c, a, b = (np.asarray(v, float) for v in (corner, edge1, edge2))
    return np.array([c, c + a, c + a + b, c + b]), np.array([[0, 1, 2], [0, 2, 3]])


def box(low, high, inward):
    """Axis-aligned box, 12 triangles."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    parts = []
    for axis in range(3):
        e1, e2 = np.zeros(3), np.zeros(3)
        e1[(axis + 1) % 3] = (high - low)[(axis + 1) % 3]
        e2[(axis + 2) % 3] = (high - low)[(axis + 2) % 3]
        lift = np.zeros(3)
        lift[axis] = (high - low)[axis]
        parts += [quad(low, e1, e2), quad(low + lift, e2, e1)] if inward else [quad(low, e2, e1), quad(low + lift, e1, e2)]
    return merge(parts)[:2]


def merge(parts):
    """(vertices, faces, part number of each face)."""
    start, vertices, faces, ids = 0, [], [], []
    for number, (v, f) in enumerate(parts):
        vertices.append(v)
        faces.append(f + start)
        ids.append(np.full(len(f), number))
        start += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(ids).astype(np.int32)


# base colour, roughness, metallic: walls, glossy block, rough metal block, black emitter
ROOM_MATERIALS = np.array(
    [
        [0.7, 0.6, 0.5, 0.9, 0.0],
        [0.3, 0.5, 0.7, 0.25, 0.0],
        [0.9, 0.7, 0.4, 0.35, 1.0],
        [0.0, 0.0, 0.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 1.0, 1.0],
    ],
    np.float32,
)


ROOM_RADIANCE = np.array([[8.0, 7.0, 5.0], [2.0, 3.0, 6.0]], np.float32)


class Room:
    """4 x 3 x 2.5 m, a glossy and a metal block, a ceiling light and a wall light."""

    def __init__(self, T):
        parts = [
            box((0, 0, 0), (4, 3, 2.5), inward=True),
            box((0.6, 1.2, 0.0005), (1.4, 2, 0.9), inward=False),
            box((2.4, 1.0, 0.0005), (3.2, 1.8, 0.7), inward=False),
            quad((1.5, 1.0, 2.45), (0, 0.8, 0), (1, 0, 0)),
            quad((3.95, 0.5, 1), (0, 0, 0.5), (0, 0.6, 0)),
        ]
        self.vertices, self.faces, self.ids = merge(parts)
        self.geometry = T.build_geometry(self.vertices, self.faces, self.ids)
        self.material = T.FaceMaterials(ROOM_MATERIALS[self.ids])
        self.group = np.where(self.ids >= 3, self.ids - 3, -1).astype(np.int32)
        self.radiance = np.where(self.group[:, None] >= 0, ROOM_RADIANCE[self.group], 0)
        self.side = np.where(self.group >= 0, 1, 0).astype(np.int8)
        self.emitters = T.Emitters(self.geometry, self.radiance, self.side)
        pose = pinhole.look_at((2, 0.2, 1.3), (2, 2.2, 0.9), (0, 0, 1))
        self.directions = pinhole.pixel_directions(26, 26, 24, 24, 48, 48, pose).reshape(-1, 3)
        self.origin = pose[:3, 3].astype(np.float32)
        self.face, depth = T.trace(self.geometry, self.origin, self.directions)
        keep = (self.face >= 0) & (self.group[self.face] < 0)
        self.face, self.directions = self.face[keep], self.directions[keep]
        self.points = self.origin + depth[keep, None] * self.directions
        self.wo = -self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        normals = self.geometry.normals[self.face]
        self.normals = np.where((normals * self.wo).sum(1, keepdims=True) < 0, -normals, normals)
        values = ROOM_MATERIALS[self.ids[self.face]]
        self.base_color, self.roughness, self.metallic = values[:, :3], values[:, 3], values[:, 4]
        self.object = self.ids[self.face]

    def render(self, T, samples, seed, cache=None):
        scene = T.Scene(self.geometry, self.material, self.emitters, cache)
        return T.render(scene, self.origin, self.directions, T.PathOptions(samples, 5, seed))


def repeated(vector, count):
    return np.tile(np.asarray(vector, np.float32), (count, 1))


def assert_mean(samples, expected, sigmas=3.0, slack=0.0):
    """The mean of independent rows is the expected number within `sigmas` standard errors (plus a relative
    slack)."""
    samples = np.asarray(samples, np.float64)
    error = samples.std(ddof=1) / np.sqrt(len(samples))
    assert samples.mean() == pytest.approx(expected, abs=sigmas * error + slack * abs(expected) + 1e-7)


def lambertian(rho):
    """Material without the dielectric lobe: metallic chosen so that k_s = 0; only the grazing rest S1 <=
    0.014 is left."""
    import mitsuba as mi

    metallic = -0.04 / (rho - 0.04)
    return lambda point, face, object_id, active: (mi.Color3f(rho), mi.Float(1), mi.Float(metallic)), (1 - metallic) * rho


def constant_cache(T, value, low=(-6, -6, -1), count=26):
    """A cache that covers everything with one radiance."""
    axis = np.arange(count)
    ijk = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return T.RadianceCache(0.5, low, ijk, np.tile(np.asarray(value, np.float32), (len(ijk), 1)))


def bias_over(values, reference, groups, seeds):
    """Relative bias of block means and its standard error, per group, from repeated independent runs."""
    for number in range(groups.max() + 1):
        member = groups == number
        if np.count_nonzero(member) < 30:
            continue
        a = np.array([v[member].mean() for v in values])
        b = np.array([v[member].mean() for v in reference])
        yield (
            number,
            a.mean() / b.mean() - 1,
            np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(seeds) / b.mean(),
        )
