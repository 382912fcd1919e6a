"""Lamps that people install to shine alike: in one plane and of one size, or side by side as the panes of a window
(docs/method/light.md#families)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.light.emission.groups import EmitterGroups
from iif_core.numerics.graph import component_labels
from iif_core.surface.closest import closest_points
from iif_core.surface.triangles import face_geometry

SIDE_BY_SIDE = 0.15
"""Metres between groups in one plane that are panes of one window."""
IN_PLANE = 0.05
"""Metres by which lamps of one plane may lie before or behind each other."""
PARALLEL = float(np.cos(np.radians(10.0)))
"""Cosine of the largest angle between them."""
LARGEST = 1.0
"""Area (m^2) up to which lamps of the same size are of one kind: larger surface is wall or ceiling."""
SAME_SIZE = 1.2
"""Largest ratio of the areas, and of the radii about their middle, of lamps of one kind."""
UPRIGHT = 0.5
"""Cosine between the axis of a flat piece and the vertical, below which it stands upright."""
FLAT = 0.8
"""Share of the area of a piece that faces along its axis, from which it is flat."""
LARGE = 0.25
"""Area (m^2) from which a flat upright lamp is called a window, if it is a single pane."""


def of_one_kind(
    groups: EmitterGroups, vertices: np.ndarray, faces: np.ndarray, family: np.ndarray, alike: np.ndarray
) -> np.ndarray:
    """Join families of groups that people install to shine alike: in one plane, lamps of the same size, and panes of one
    window, side by side.

    Args:
        groups: of F faces.
        vertices, faces: (n, 3), metres, and (F, 3).
        family: (G,) int.
        alike: (G,) bool, groups that may be joined with others, as they look alike. A pane that no camera sees is none: it may be
            the wall beside a window.

    Returns:
        (G,) int >= 0, numbers of the families.
    """
    number = np.flatnonzero(alike)
    are_seen = ~groups.is_hidden[number]
    pieces = [Piece.of(vertices, faces[groups.of_face == g]) for g in number]
    first, second = _pairs(pieces, lambda i, j, a, b: a.is_size_of(b) or (are_seen[i] and are_seen[j] and a.is_next_to(b)))
    # Members of a family, with the first of it.
    _, start, of = np.unique(family, return_index=True, return_inverse=True)
    return component_labels(groups.size, np.r_[number[first], np.arange(groups.size)], np.r_[number[second], start[of.ravel()]])


def side_by_side(pieces: Sequence[Piece]) -> np.ndarray:
    """Return (n,) int >= 0, one number for all pieces that lie side by side, as the panes of one window do."""
    return component_labels(len(pieces), *_pairs(pieces, lambda i, j, a, b: a.is_next_to(b)))


def place_names(
    pieces: Sequence[Piece], up: np.ndarray, overhead: np.ndarray, unseen: np.ndarray, power: np.ndarray
) -> list[str]:
    """Call lamps by where they are: `ceiling light`, `window` (flat, upright, and large or of several panes), `lamp`, or
    `unseen lamp`; with a number, the strongest of each sort first. The panes of one window, side by side, have one name.

    Args:
        pieces: n lamps.
        up: (3,) of length 1.
        overhead, unseen: (n,) bool, the lamp hangs overhead; no camera sees it.
        power: (n,) >= 0.
    """
    together = side_by_side(pieces)
    # An unseen piece beside a pane is a lamp of its own: it may be wall.
    together = np.unique(2 * together + unseen, return_inverse=True)[1].ravel()
    sorts = []
    for number in range(len(set(together.tolist()))):
        own = np.flatnonzero(together == number)
        stands = all(pieces[i].is_flat and abs(pieces[i].normal @ up) < UPRIGHT for i in own)
        if unseen[own].any():
            sorts.append("unseen lamp")
        elif overhead[own].any():
            sorts.append("ceiling light")
        elif stands and (len(own) > 1 or pieces[own[0]].area >= LARGE):
            sorts.append("window")
        else:
            sorts.append("lamp")
    names, count = [""] * len(sorts), dict.fromkeys(sorts, 0)
    for number in np.argsort(-np.bincount(together, power, len(sorts)), kind="stable"):
        count[sorts[number]] += 1
        names[number] = f"{sorts[number]} {count[sorts[number]]}"
    return [names[number] for number in together]


def _pairs(pieces: Sequence[Piece], belong: Callable[[int, int, Piece, Piece], bool]) -> np.ndarray:
    """Return the numbers (2, k) of pieces of one plane that `belong` together, by their numbers and themselves."""
    pairs = [
        (i, j)
        for j, second in enumerate(pieces)
        for i, first in enumerate(pieces[:j])
        if first.is_in_plane_of(second) and belong(i, j, first, second)
    ]
    return np.array(pairs, np.int64).reshape(-1, 2).T


@dataclass(frozen=True)
class Piece:
    """Faces (m, 3) of a lamp, their middle, area (m^2), radius about the middle (m), the axis of most of their normals, and
    whether nearly all of them face along it."""

    vertices: np.ndarray
    faces: np.ndarray
    middle: np.ndarray
    area: float
    radius: float
    normal: np.ndarray
    is_flat: bool

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray) -> Piece:
        vertices = np.asarray(vertices, np.float64)
        normal, area = face_geometry(vertices, faces)
        middle = np.average(vertices[faces].mean(1), axis=0, weights=np.maximum(area, 1e-12))
        radius = float(np.linalg.norm(vertices[faces].reshape(-1, 3) - middle, axis=1).max())
        # The side that a normal faces is arbitrary; a lamp all around has none.
        axis = np.linalg.eigh((normal * area[:, None]).T @ normal)[1][:, -1]
        along = float(area[np.abs(normal @ axis) >= PARALLEL].sum())
        return cls(vertices, faces, middle, float(area.sum()), radius, axis, along >= FLAT * float(area.sum()))

    def is_in_plane_of(self, other: Piece) -> bool:
        """Most of both faces the same way, or the opposite one, and lies equally far along it."""
        return abs(self.normal @ other.normal) >= PARALLEL and abs((other.middle - self.middle) @ self.normal) <= IN_PLANE

    def is_size_of(self, other: Piece) -> bool:
        """Area and radius are the same (`SAME_SIZE`), and no larger than those of lamps."""
        ratios = self.area / max(other.area, 1e-12), self.radius / max(other.radius, 1e-12)
        return self.area <= LARGEST and all(1.0 / SAME_SIZE <= ratio <= SAME_SIZE for ratio in ratios)

    def is_next_to(self, other: Piece) -> bool:
        """Some corner of the other is within `SIDE_BY_SIDE`."""
        corners = other.vertices[np.unique(other.faces)]
        apart = np.linalg.norm(closest_points(self.vertices, self.faces, corners).points - corners, axis=1)
        return bool(apart.min() <= SIDE_BY_SIDE)
