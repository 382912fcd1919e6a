"""Lamps that were found, against those of the room."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from iif_core.surface.closest import closest_points
from iif_core.surface.triangles import face_geometry
from lab.rooms.room import Room

Array = np.ndarray

NEAR = 0.1
"""Metres within which surface that shines is part of a true lamp, and a true lamp was found."""


@dataclass(frozen=True)
class LampsFound:
    """Result of `lamps_found`.

    Attributes:
        area: (m,) of the faces that were found to shine, m^2 of the true room; strength: (m,) their area times radiance.
        false: (m,) bool, those that are no lamp.
        lamp: (L,) object ids of the true lamps; power: (L,) their area times radiance; missed: (L,) share of it that is farther
            than `NEAR` from all surface that was found to shine.
    """

    area: Array
    strength: Array
    false: Array
    lamp: Array
    power: Array
    missed: Array

    def false_m2(self, of: Array | None = None) -> float:
        """Return the area that is taken for a lamp and is none, of the faces of a mask (m,) alone."""
        return float(self.area[self._wrong(of)].sum())

    def false_power(self, of: Array | None = None) -> float:
        """Return its share of the power of all that was found."""
        return float(self.strength[self._wrong(of)].sum() / max(self.strength.sum(), 1e-12))

    def _wrong(self, of: Array | None) -> Array:
        return self.false if of is None else self.false & of

    def missed_power(self, of: Array | None = None) -> float:
        """Return the share of the power of the true lamps that was missed, of those with an id in `of` alone; NaN without one."""
        own = np.ones(len(self.lamp), bool) if of is None else np.isin(self.lamp, of)
        total = self.power[own].sum()
        return float((self.power * self.missed)[own].sum() / total) if total > 0 else float("nan")


def lamps_found(
    room: Room, vertices: Array, faces: Array, radiance: Array, through: Collection[int] = (), back: Array | None = None
) -> LampsFound:
    """Compare surface that was found to shine with the lamps of a room.

    Args:
        room: the truth.
        vertices: (n, 3) metres.
        faces: (m, 3), those that were found to shine.
        radiance: (m,) what they were found to emit, mean of the channels.
        through: ids of objects through which light passes and which a scan shows closed: no lamp that is found there is false.
        back: (4, 4) from the found to the true room; None = it is the same.
    """
    scan = room.scan
    lit = scan.emission.any(1) | np.isin(scan.material_id, list(through))
    back = np.eye(4) if back is None else back
    area = face_geometry(vertices, faces)[1] * abs(np.linalg.det(back[:3, :3])) ** (2 / 3)
    found = vertices @ back[:3, :3].T + back[:3, 3]
    power = area * radiance
    wrong = away(scan.vertices, scan.faces[lit], found[faces].mean(1), NEAR)

    own = np.flatnonzero(scan.emission.any(1))
    strength = face_geometry(scan.vertices, scan.faces)[1][own] * scan.emission[own].mean(1)
    unfound = away(found, faces, scan.vertices[scan.faces[own]].mean(1), NEAR)
    lamp, of = np.unique(scan.material_id[own], return_inverse=True)
    total = np.bincount(of, strength, len(lamp))
    missed = np.bincount(of, strength * unfound, len(lamp)) / np.maximum(total, 1e-30)
    return LampsFound(area, power, wrong, lamp, total, missed)


def away(vertices: Array, faces: Array, points: Array, distance: float) -> Array:
    """Return which points (n,) are farther than a distance from all faces."""
    if not (len(faces) and len(points)):
        return np.ones(len(points), bool)
    return np.linalg.norm(closest_points(vertices, faces, points).points - points, axis=1) > distance
