"""A closed room with 32 planted emitter groups and known materials: 24 window triangles with a gradient, 4 ceiling
triangles, a lamp, and 3 surfaces that are taken for emitters and are none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.pinhole import look_at, pixel_directions
from iif_core.camera.response import response
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import EmissionProblem, assemble, initial_radiance
from iif_core.light.emission.rows import EmissionRows, TracedTransport
from iif_core.light.emission.sensor import Sensor

SIZE = np.array([5.0, 4.0, 2.7])
WINDOW, CEILING, LAMP, NONE = 24, 4, 1, 3
GROUPS = WINDOW + CEILING + LAMP + NONE
BOUNCES = 8


def _quads(origin, u, v, n, m):
    """n x m quads of two triangles, normal u x v."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    vertices = np.array(origin, float) + s[..., None] * np.array(u, float) + t[..., None] * np.array(v, float)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a = (i * (m + 1) + j).ravel()
    b = a + m + 1
    return vertices.reshape(-1, 3), np.stack([a, b, b + 1, a, b + 1, a + 1], 1).reshape(-1, 3)


def _box(low, high):
    low, high = np.array(low, float), np.array(high, float)
    dx, dy, dz = np.diag(high - low)
    sides = [(low, dy, dx), (low, dx, dz), (low, dz, dy), (high, -dx, -dy), (high, -dz, -dx), (high, -dy, -dz)]
    return [_quads(o, u, v, 1, 1) for o, u, v in sides]


@dataclass(frozen=True)
class Room:
    """Mesh, per-face object, material (F, 5) and group (-1 = none); truth (G, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    material: np.ndarray
    group: np.ndarray
    truth: np.ndarray


def build_room(variant: int = 0, coarse: bool = False) -> Room:
    """Variants differ in colours, furniture and light. `coarse` makes nine groups that are easy to separate: three rows
    of the window, two ceiling lights, the lamp, and the three that do not shine."""
    rng = np.random.default_rng(variant)
    x, y, z = SIZE
    walls = [
        ((0, 0, 0), (x, 0, 0), (0, y, 0)),
        ((0, 0, z), (0, y, 0), (x, 0, 0)),
        ((0, 0, 0), (0, y, 0), (0, 0, z)),
        ((x, 0, 0), (0, 0, z), (0, y, 0)),
        ((0, 0, 0), (0, 0, z), (x, 0, 0)),
        ((0, y, 0), (x, 0, 0), (0, 0, z)),
    ]
    parts = [[_quads(*wall, 6, 6)] for wall in walls]
    for _ in range(8):
        low = rng.uniform([0.4, 0.4, 0], [x - 1.2, y - 1.2, 0.01])
        parts.append(_box(low, low + rng.uniform([0.3, 0.3, 0.3], [0.8, 0.8, 1.1])))
    n_lit = len(parts)
    parts.append([_quads((0.01, 1.0, 0.9), (0, 2.0, 0), (0, 0, 1.3), 4, 3)])
    parts.append(
        [
            _quads((1.5, 1.2, z - 0.02), (0, 0.5, 0), (0.5, 0, 0), 1, 1),
            _quads((3.3, 2.2, z - 0.02), (0, 0.5, 0), (0.5, 0, 0), 1, 1),
        ]
    )
    parts.append(_box((2.4, 2.9, 1.3), (2.6, 3.1, 1.5)))
    for i in range(NONE):
        parts.append([_quads((4.98, 0.6 + i, 1.2), (0, 0, 0.5), (0, 0.5, 0), 1, 1)])
    vertices, faces, owner, offset = [], [], [], 0
    for number, pieces in enumerate(parts):
        for v, f in pieces:
            vertices.append(v)
            faces.append(f + offset)
            owner.append(np.full(len(f), number, np.int32))
            offset += len(v)
    object_id, faces = np.concatenate(owner), np.concatenate(faces)
    looks = np.column_stack([rng.uniform(0.2, 0.8, (len(parts), 3)), rng.uniform(0.3, 1.0, len(parts)), np.zeros(len(parts))])
    looks[n_lit : n_lit + 3, :4] = (0, 0, 0, 1)
    material = looks[object_id].astype(np.float32)
    group, start = np.full(len(faces), -1, np.int32), 0
    for number, single in ((n_lit, True), (n_lit + 1, True), (n_lit + 2, False), *((n_lit + 3 + i, False) for i in range(NONE))):
        own = np.flatnonzero(object_id == number)
        group[own] = start + (np.arange(len(own)) if single else 0)
        start += len(own) if single else 1
    truth = np.zeros((GROUPS, 3))
    height = np.repeat(np.tile(np.arange(3), 4), 2)
    truth[:WINDOW] = (3 + 4 * height + rng.uniform(0, 1, WINDOW))[:, None] * [0.8, 0.95, 1.1]
    truth[WINDOW : WINDOW + CEILING] = rng.uniform(12, 16, CEILING)[:, None] * [1, 0.95, 0.8]
    truth[WINDOW + CEILING] = np.array([20, 17, 12])
    if coarse:
        merged = np.r_[height, 3 + np.repeat(np.arange(2), 2), 5, 6, 7, 8]
        first = np.unique(merged, return_index=True)[1]
        group, truth = np.where(group >= 0, merged[group], -1).astype(np.int32), truth[first]
    return Room(np.concatenate(vertices), faces, object_id, material, group, truth)


class PlantedScene:
    """Views of a room: surface points once, photographs and traces with noise of their own by seed."""

    def __init__(self, room: Room, views: int = 8, size: int = 48):
        from iif_core.light.transport.emitters import Emitters
        from iif_core.light.transport.geometry import build_geometry, trace
        from tests.oracles.face_materials import FaceMaterials

        self.room, self.size = room, size
        self.geometry = build_geometry(room.vertices, room.faces, room.object_id)
        self.material = FaceMaterials(room.material)
        lit = np.concatenate([room.truth, np.zeros((1, 3))])[room.group].astype(np.float32)
        self.side = np.where(room.group >= 0, 1, 0).astype(np.int8)
        self.emitters = Emitters(self.geometry, lit, self.side)
        origins, directions = [], []
        for i in range(views):
            angle = 2 * np.pi * i / views
            eye = SIZE / 2 + [1.9 * np.cos(angle), 1.4 * np.sin(angle), 0.5]
            pose = look_at(eye, SIZE / 2 - [np.cos(angle + 0.4), np.sin(angle + 0.4), 0.2 - 0.4 * (i % 3)], (0, 0, 1))
            focal = 0.5 * size / np.tan(np.radians(75) / 2)
            directions.append(pixel_directions(focal, focal, size / 2, size / 2, size, size, pose).reshape(-1, 3))
            origins.append(np.tile(eye, (size * size, 1)))
        self.origins, self.directions = np.concatenate(origins), np.concatenate(directions)
        self.directions /= np.linalg.norm(self.directions, axis=1, keepdims=True)
        self.face, depth = trace(self.geometry, self.origins, self.directions)
        self.points = (self.origins + depth[:, None] * self.directions).astype(np.float32)
        edges = room.vertices[room.faces]
        normal = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[self.face]
        away = np.einsum("ij,ij->i", normal, self.directions) > 0
        self.normals = np.where(away[:, None], -normal, normal).astype(np.float32)
        pixel = np.arange(len(self.face))
        self.view = pixel // (size * size)
        row, column = pixel % (size * size) // size, pixel % size
        self.tile = (row // 4) * (size // 4) + column // 4

    def photographs(self, seed: int, samples: int) -> np.ndarray:
        """(n, 3) radiance with the noise of `samples` paths."""
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions, Scene

        scene = Scene(self.geometry, self.material, self.emitters)
        return render(scene, self.origins, self.directions, PathOptions(samples, BOUNCES, 7919 * seed + 1)).astype(np.float64)

    def transport(self, seed: int, samples: int) -> TracedTransport:
        """Two independent traces of `samples` paths a pixel each; emitters do not reflect, so their rows are 0."""
        from iif_core.light.transport.matrix import transport_matrix
        from iif_core.light.transport.scene import EmitterColumns, PathOptions, Scene, ShadingPoints

        base = self.room.material[self.face]
        points = ShadingPoints(self.points, self.normals, -self.directions, base[:, :3], base[:, 3], base[:, 4])
        columns = EmitterColumns(self.room.group, len(self.room.truth), self.side)
        scene = Scene(self.geometry, self.material, None)
        paths = [PathOptions(samples, BOUNCES, 7919 * seed + 11 + half) for half in range(2)]
        found = (transport_matrix(scene, points, columns, half) for half in paths)
        return TracedTransport(*(np.stack(part).sum(2)[:, None] for part in zip(*found, strict=True)))

    def problem(self, photographs: np.ndarray, transport: TracedTransport, kind: str) -> tuple[EmissionProblem, np.ndarray]:
        """(problem, initial radiance) of linear (`hdr`) or 8-bit photographs through sRGB (`ldr`, `ldr_one`).

        `ldr`: the views have five exposures, two stops apart; in the shortest some emitters are not saturated.
        `ldr_one`, `hdr_hidden`: no emitter is seen unsaturated, or at all; what is known is the light that they send.
        """
        linear = kind.startswith("hdr")
        sensor = Sensor(response("identity" if linear else "srgb"), linear, 0.99)
        group = self.room.group[self.face]
        exposure = np.ones(len(group))
        if not linear:
            exposure *= 0.6 / np.quantile(photographs[group < 0], 0.9)
            exposure *= 4.0 ** -(self.view % 5 - 1.0) if kind == "ldr" else 1.0
        value = photographs
        if not linear:
            value = np.round(255 * sensor.curve(np.clip(exposure[:, None] * photographs, 0, 1))) / 255
        radiance, bound = sensor.radiance(value, exposure[:, None])
        group = np.where(self.room.truth[group].any(1) & (group >= 0), group, -1)
        if kind == "hdr_hidden":
            bound, radiance = bound | (group >= 0)[:, None], np.where((group >= 0)[:, None], 1.0, radiance)
        rows = EmissionPixels(
            radiance=radiance, bound=bound, object_id=self.room.object_id[self.face], view=self.view, tile=self.tile, group=group
        )
        problem = assemble(rows, transport, len(self.room.truth))
        return problem, initial_radiance(rows, np.ones((len(self.room.truth), 3)), linear and kind == "hdr")

    def families(self) -> np.ndarray:
        """(G,) object of every group."""
        first = np.unique(self.room.group, return_index=True)
        return self.room.object_id[first[1][first[0] >= 0]]


def averaged(rows: EmissionRows) -> EmissionRows:
    """The rows with the mean of the two traces in the place of each, whose noise then attenuates the answer (Eq. L.21)."""
    matrix, cached = (np.repeat(trace.mean(0, keepdims=True), 2, 0) for trace in (rows.matrix, rows.cached))
    return replace(rows, matrix=matrix, cached=cached)


def relative_errors(room: Room, radiance: np.ndarray) -> np.ndarray:
    """(29,) |E - truth| / truth of the emitting groups, channels summed."""
    lit = room.truth.any(1)
    return np.abs(radiance[lit].sum(1) / room.truth[lit].sum(1) - 1)
