"""Renderings of the project against Mitsuba's path tracer, pixel by pixel.

Both estimate the same pixels in independent replicates. Under the hypothesis of equal means the statistic of Welch (1947) is
Student's t of each pixel and channel, and the smallest of n probabilities is compared with 1 - (1 - 0.05)^(1 / n) (Sidak 1967;
the test of Mitsuba's own renderings, Subr and Arvo 2007).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.stability import mitsuba_twin
from lab.stability.mitsuba_twin import Part, Room

REPLICATES = 32
SAMPLES = 256
BOUNCES = 5
LEVEL = 0.05
SIGMAS = 3.5
"""Largest difference of the means, in standard errors; 1 % must be at least so many."""
ALONE = 0.01
"""Metres. New rays start 0.1 mm off a surface here and 0.27 mm in Mitsuba, which moves shadows at the foot of things; surface of
the kitchen that is closer to another thing is left out."""
_BLACK = (0.0, 0.0, 0.0, 1.0, 1.0)
FIREFLY = 10.0
"""A replicate of a pixel that is so many times the median of its replicates counts as a firefly."""


class Agreement(NamedTuple):
    """Test of one room.

    Attributes:
        room: its name; tests: pixels times channels that both see lit.
        smallest: smallest probability, and threshold: of the correction.
        bias: relative difference of the means over all pixels, and error: its standard error.
        fireflies, of_reference: share of replicates of a pixel that are fireflies, ours and Mitsuba's.
    """

    room: str
    tests: int
    smallest: float
    threshold: float
    bias: float
    error: float
    fireflies: float
    of_reference: float

    @property
    def sigmas(self) -> float:
        """Difference of the means in standard errors."""
        return abs(self.bias) / self.error if self.error > 0 else 0.0


def _quad(corner: Sequence[float], u: Sequence[float], v: Sequence[float], cuts: int = 1) -> tuple[NDArray, NDArray]:
    """A parallelogram of cuts x cuts x 2 triangles, normal u x v."""
    s, t = np.meshgrid(np.linspace(0, 1, cuts + 1), np.linspace(0, 1, cuts + 1), indexing="ij")
    vertices = np.asarray(corner, float) + s[..., None] * np.asarray(u, float) + t[..., None] * np.asarray(v, float)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(cuts), np.arange(cuts), indexing="ij"))
    a = i * (cuts + 1) + j
    b = a + cuts + 1
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    return vertices.reshape(-1, 3), faces.astype(np.int32)


def _box(low: Sequence[float], high: Sequence[float], inward: bool = False) -> tuple[NDArray, NDArray]:
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.diag(high - low)
    sides = [(low, y, x), (low, x, z), (low, z, y), (high, -x, -y), (high, -z, -x), (high, -y, -z)]
    vertices, faces = [], []
    for number, (corner, u, v) in enumerate(sides):
        own, triangles = _quad(corner, v, u) if inward else _quad(corner, u, v)
        vertices.append(own)
        faces.append(triangles + 4 * number)
    return np.concatenate(vertices), np.concatenate(faces)


def _rays(eye: Sequence[float], target: Sequence[float], size: int) -> tuple[NDArray, NDArray]:
    from iif_core.camera.pinhole import look_at, pixel_directions

    pose = look_at(eye, target, (0, 0, 1))
    focal = 0.6 * size
    return pose[:3, 3], pixel_directions(focal, focal, size / 2, size / 2, size, size, pose).reshape(-1, 3)


def rooms(size: int = 32) -> dict[str, Room]:
    """Return the rooms of the test, seen by size x size pixels: a furnished room, objects under the sky, and the built-in kitchen
    with one material for each object; and each of them under other light."""
    kitchen = _kitchen(size)
    fewer = [part for part in kitchen.parts if not any(part.radiance)]
    panel = _quad((1.5, 1.2, 2.6), (0, 1.6, 0), (2.0, 0, 0))
    night = replace(kitchen, parts=[*fewer, Part(*panel, _BLACK, (2.0, 1.6, 0.9))])
    return {**small_rooms(size), "kitchen": kitchen, "kitchen, relit": night}


def small_rooms(size: int = 32) -> dict[str, Room]:
    """Return the rooms of `rooms` but the kitchen."""
    furnished = [
        Part(*_box((0, 0, 0), (4, 3, 2.5), inward=True), (0.7, 0.6, 0.5, 0.9, 0.0)),
        Part(*_box((0.6, 1.2, 0.0005), (1.4, 2, 0.9)), (0.3, 0.5, 0.7, 0.25, 0.0)),
        Part(*_box((2.4, 1.0, 0.0005), (3.2, 1.8, 0.7)), (0.9, 0.7, 0.4, 0.35, 1.0)),
    ]
    ceiling, wall = _quad((1.5, 1.0, 2.45), (0, 0.8, 0), (1, 0, 0)), _quad((3.95, 0.5, 1), (0, 0, 0.5), (0, 0.6, 0))
    eye = _rays((2, 0.2, 1.3), (2, 2.2, 0.9), size)
    own = Room([*furnished, Part(*ceiling, _BLACK, (8, 7, 5)), Part(*wall, _BLACK, (2, 3, 6))], (0, 0, 0), *eye)
    lamp = _quad((0.8, 1.5, 1.6), (0, 0.1, 0), (0.1, 0, 0))
    relit = replace(own, parts=[*furnished, Part(*ceiling, _BLACK), Part(*wall, _BLACK), Part(*lamp, _BLACK, (300, 250, 150))])
    floor = _quad((-3, -3, 0), (6, 0, 0), (0, 6, 0), 2)
    outside = Room(
        [
            Part(*floor, (0.4, 0.45, 0.35, 0.5, 0.0)),
            Part(*_box((-1.2, -0.5, 0.0005), (-0.2, 0.5, 1.0)), (0.8, 0.3, 0.2, 0.3, 0.0)),
            Part(*_box((0.4, -0.4, 0.0005), (1.2, 0.4, 0.8)), (0.9, 0.8, 0.6, 0.2, 1.0)),
        ],
        (0.6, 0.8, 1.0),
        *_rays((0, -2.6, 1.4), (0, 0, 0.4), size),
    )
    flash = _quad((-1.5, -2.0, 2.5), (0.3, 0, 0), (0, 0, 0.3))
    dusk = replace(outside, parts=[*outside.parts, Part(*flash, _BLACK, (60, 40, 20))], sky=(0.05, 0.06, 0.1))
    return {
        "furnished room": own,
        "furnished room, relit": relit,
        "under the sky": outside,
        "under the sky, relit": dusk,
    }


def _kitchen(size: int) -> Room:
    """The built-in kitchen as the first camera sees it; an object has the material of the middle of its faces, in the mean."""
    from iif_core.camera.pinhole import pixel_directions
    from lab import rooms as builtin

    room = builtin.build("kitchen")
    middle = room.vertices[room.faces].mean(1)
    albedo, roughness, metallic = room.materials.numpy(middle, room.object_id)
    values = np.column_stack([albedo, roughness, metallic]).astype(np.float64)
    parts = []
    for number in range(len(room.names)):
        of_object = np.flatnonzero(room.object_id == number)
        red, green, blue, rough, metal = values[of_object].mean(0).tolist()
        for radiance in np.unique(room.emission[of_object], axis=0):
            own = of_object[(room.emission[of_object] == radiance).all(1)]
            used, corner = np.unique(room.faces[own], return_inverse=True)
            material = (red, green, blue, rough, metal)
            parts.append(Part(room.vertices[used], corner.reshape(-1, 3).astype(np.int32), material, tuple(radiance.tolist())))
    pose, focal = room.cameras(1)[0], 0.7 * size
    ways = pixel_directions(focal, focal, size / 2, size / 2, size, size, pose).reshape(-1, 3)
    return Room(parts, (0, 0, 0), pose[:3, 3], ways[_alone(parts, pose[:3, 3], ways)])


def _alone(parts: Sequence[Part], origin: NDArray, ways: NDArray) -> NDArray:
    """Return which rays (n,) meet a part no closer than `ALONE` to another one."""
    import open3d as o3d

    def scene_of(part: Part) -> o3d.t.geometry.RaycastingScene:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(part.vertices.astype(np.float32)), o3d.core.Tensor(part.faces.astype(np.uint32)))
        return scene

    scenes = [scene_of(part) for part in parts]
    rays = np.concatenate([np.tile(origin, (len(ways), 1)), ways], 1).astype(np.float32)
    along = np.stack([scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() for scene in scenes])
    first = along.argmin(0)
    point = (rays[:, :3] + along.min(0)[:, None] * rays[:, 3:]).astype(np.float32)
    near = np.stack([scene.compute_distance(o3d.core.Tensor(point)).numpy() for scene in scenes])
    near[first, np.arange(len(ways))] = np.inf
    return near.min(0) > ALONE


def extremes(size: int = 32) -> dict[str, Room]:
    """Return rooms with heavy tails: a lamp of 4 cm^2 and radiance 10^6, without and with a mirror (r = 0.02) next to it."""
    shell = Part(*_box((0, 0, 0), (4, 3, 2.5), inward=True), (0.6, 0.6, 0.6, 0.8, 0.0))
    lamp = Part(*_quad((2.0, 1.5, 2.4), (0, 0.02, 0), (0.02, 0, 0)), _BLACK, (1e6, 1e6, 1e6))
    mirror = Part(*_box((0.6, 1.2, 0.0005), (1.4, 2, 0.9)), (0.9, 0.9, 0.9, 0.02, 1.0))
    eye = _rays((2, 0.2, 1.3), (2, 2.2, 0.9), size)
    return {
        "lamp of 4 cm2 and 1e6": Room([shell, lamp], (0, 0, 0), *eye),
        "the same beside a mirror, r = 0.02": Room([shell, lamp, mirror], (0, 0, 0), *eye),
    }


Estimate = Callable[[int], NDArray]


def compare(name: str, first: Estimate, second: Estimate, replicates: int) -> Agreement:
    """Test whether two estimators of the same pixels agree.

    Args:
        name: of the room.
        first, second: seed -> radiance (n, 3).
        replicates: of each.
    """
    from scipy import stats

    a = np.stack([first(2 * seed) for seed in range(replicates)]).astype(np.float64)
    b = np.stack([second(2 * seed + 1) for seed in range(replicates)]).astype(np.float64)
    lit = (a.mean(0) > 0) & (b.mean(0) > 0) & ((a.std(0) > 0) | (b.std(0) > 0))
    one, two = a[:, lit], b[:, lit]
    probability = stats.ttest_ind(one, two, axis=0, equal_var=False).pvalue
    whole = [of.mean((1, 2)) for of in (a, b)]
    means, errors = [of.mean() for of in whole], [of.std(ddof=1) / np.sqrt(replicates) for of in whole]
    return Agreement(
        name,
        int(lit.sum()),
        float(probability.min()),
        1 - (1 - LEVEL) ** (1 / max(int(lit.sum()), 1)),
        float(means[0] / means[1] - 1),
        float(np.hypot(*errors) / means[1]),
        _fireflies(one),
        _fireflies(two),
    )


def _fireflies(replicates: NDArray) -> float:
    return float((replicates > FIREFLY * np.maximum(np.median(replicates, axis=0), 1e-300)).mean())


def measure(size: int = 32, samples: int = SAMPLES, replicates: int = REPLICATES) -> Iterator[Agreement]:
    """Compare all rooms."""
    for name, room in {**rooms(size), **extremes(size)}.items():
        scene = mitsuba_twin.scene_of(room)

        def theirs(seed: int, scene: object = scene, room: Room = room) -> NDArray:
            return mitsuba_twin.reference(scene, room, samples, BOUNCES, seed)

        def own(seed: int, room: Room = room) -> NDArray:
            return mitsuba_twin.ours(room, samples, BOUNCES, seed)

        yield compare(name, own, theirs, replicates)
