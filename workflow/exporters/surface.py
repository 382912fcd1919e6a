"""Converts the mesh of a scene to the parts that every exporter writes: one mesh per object or emitter, turned towards the
photographs, cleaned and, where it has too many faces, simplified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.arrays import unique_rows
from iif_core.numerics.graph import component_labels
from iif_core.surface.simplify import MIN_AREA, clean, simplify
from iif_core.surface.triangles import face_crosses, smooth_groups, vertex_normals, weld

Array = np.ndarray

CREASE_COSINE = 0.7660444  # cos 40 degrees; sharper edges get two normals
TWO_SIDED_SHARE = 0.02  # an object with more of its pixels on the back of faces is a sheet seen from both sides


@dataclass(frozen=True)
class SeenSurface:
    """The mesh of a scene with what was seen of it; lengths in metres, ids int32 with -1 = none.

    Attributes:
        vertices, faces: (n, 3) float32, (m, 3) int32.
        object_id: (m,) of each face; object_names: one per object id.
        emitter_id: (m,) of each face; emitter_side: (m,) +1 front, -1 back, 0 both.
        seen_front, seen_back: (m,) numbers of pixels that see each side of a face.
    """

    vertices: Array
    faces: Array
    object_id: Array
    object_names: Sequence[str]
    emitter_id: Array
    emitter_side: Array
    seen_front: Array
    seen_back: Array


@dataclass(frozen=True)
class Part:
    """One mesh: an object without its emitters, or one emitter of an object. Unit normals point towards the photographs."""

    name: str
    object_id: int
    emitter_id: int
    vertices: Array  # (n, 3) float64
    normals: Array  # (n, 3) float64
    faces: Array  # (m, 3) int64
    double_sided: bool
    simplified: bool = False


def build_parts(surface: SeenSurface, max_faces: int) -> list[Part]:
    """Turn, clean and simplify the mesh: parts in order of object and emitter, with unique names.

    Faces without an area and second copies of a face are dropped. With more than `max_faces`, the parts that do not emit are
    simplified together; an emitter keeps its faces, because its power goes with its area.

    Raises:
        InputError: no face with an area.
    """
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)
    turned, double_sided = _orientation(surface)
    vertices, oriented = weld(vertices, np.where(turned[:, None], faces[:, ::-1], faces))
    keys, part_of = unique_rows(np.stack([surface.object_id, surface.emitter_id], 1))
    rows, local = unique_rows(np.stack([oriented.ravel(), np.repeat(part_of, 3)], 1))  # no vertex belongs to two parts
    vertices, oriented = vertices[rows[:, 0]], local.reshape(-1, 3)
    kept = clean(oriented, vertices)
    if not kept.any():
        raise InputError(f"mesh of {len(faces)} faces: none has an area above {MIN_AREA} m^2; nothing can be exported")
    sides = np.zeros(len(keys), bool)
    np.logical_or.at(sides, part_of, np.where(surface.emitter_id >= 0, surface.emitter_side == 0, double_sided))
    vertices, oriented, part_of, simplified = _simplified(vertices, oriented[kept], part_of[kept], keys[:, 1] >= 0, max_faces)
    groups = smooth_groups(vertices, oriented, part_of, CREASE_COSINE)
    order = np.argsort(part_of, kind="stable")
    bounds = np.searchsorted(part_of[order], np.arange(len(keys) + 1))
    names, parts = _Names(), []
    for p, (object_id, emitter_id) in enumerate(keys.tolist()):
        own = order[bounds[p] : bounds[p + 1]]
        if not len(own):
            continue
        split, local = unique_rows(np.stack([oriented[own].ravel(), np.repeat(groups[own], 3)], 1))
        local = local.reshape(-1, 3)
        xyz = vertices[split[:, 0]]
        name = surface.object_names[object_id] if 0 <= object_id < len(surface.object_names) else "unlabelled"
        name = names.unique(name if emitter_id < 0 else f"{name}.emitter{emitter_id}")
        normals = vertex_normals(xyz, local)
        parts.append(Part(name, object_id, emitter_id, xyz, normals, local, bool(sides[p]), bool(simplified[p])))
    return parts


def _simplified(vertices: Array, faces: Array, part: Array, emits: Array, max_faces: int) -> tuple[Array, Array, Array, Array]:
    """Simplify the parts that do not emit (`emits` (parts,)); a part that would vanish stays as it was.

    Returns:
        vertices, faces, part of each face, and which parts (parts,) have become simpler.
    """
    fixed = emits[part]
    target = max(max_faces - int(fixed.sum()), 1)
    if (~fixed).sum() <= target:
        return vertices, faces, part, np.zeros(len(emits), bool)
    new_vertices, new_faces, new_part = simplify(vertices, faces[~fixed], part[~fixed], target)
    gone = np.setdiff1d(part[~fixed], new_part)
    as_before = fixed | np.isin(part, gone)
    joined = np.concatenate([faces[as_before], new_faces + len(vertices)])
    of = np.concatenate([part[as_before], new_part])
    count = np.bincount(of, minlength=len(emits))
    return np.concatenate([vertices, new_vertices]), joined, of, count < np.bincount(part, minlength=len(emits))


def seen_sides(vertices: Array, faces: Array, face_id: Array, eye: Array) -> tuple[Array, Array]:
    """Count the pixels of one view that see the front and the back of every face.

    Args:
        vertices, faces: the mesh.
        face_id: (H, W), -1 = none.
        eye: (3,) position of the camera, metres.

    Returns:
        (m,) and (m,) int64 counts of front and back; front is the side of the right-hand normal.
    """
    count = np.bincount(face_id[face_id >= 0].ravel(), minlength=len(faces))
    normal = face_crosses(vertices, faces)
    front = np.einsum("ij,ij->i", normal, np.asarray(eye, np.float64) - vertices[faces[:, 0]]) > 0
    return np.where(front, count, 0), np.where(front, 0, count)


# ----------------------------------------------------------------------------------------------------------- internals


class _Names:
    """Makes names unique, because those of objects may repeat and those of files and glTF nodes should not."""

    def __init__(self) -> None:
        self._used: set[str] = set()

    def unique(self, name: str) -> str:
        candidate, number = name, 1
        while candidate in self._used:
            number += 1
            candidate = f"{name}.{number}"
        self._used.add(candidate)
        return candidate


def _orientation(surface: SeenSurface) -> tuple[Array, Array]:
    """Return which faces to turn (m,), and whether the object of a face was seen from both sides (m,).

    A face is turned if most of its pixels see its back; a face that no pixel sees follows the majority of its connected piece.
    Emitters are turned such that they emit to their front.
    """
    front, back = surface.seen_front.astype(np.int64), surface.seen_back.astype(np.int64)
    group = _components(surface)
    n = int(group.max()) + 1
    group_turned = np.bincount(group, back, n) > np.bincount(group, front, n)
    turned = np.where(front + back > 0, back > front, group_turned[group])
    objects = np.unique(surface.object_id, return_inverse=True)[1]
    minority = np.bincount(objects, np.minimum(front, back))
    total = np.bincount(objects, front + back)
    # If no pixel sees an object, its orientation is unknown and both sides are drawn.
    double = (minority > TWO_SIDED_SHARE * total) | (total == 0)
    emits = surface.emitter_id >= 0
    turned = np.where(emits & (surface.emitter_side != 0), surface.emitter_side < 0, turned)
    return turned, double[objects]


def _components(surface: SeenSurface) -> Array:
    """Label the connected pieces of each object, (m,); faces are connected if they share a vertex position."""
    _, weld = unique_rows(surface.vertices)
    corner = weld[surface.faces]
    key = np.stack([corner.ravel(), np.repeat(surface.object_id, 3)], 1)
    node = unique_rows(key)[1]
    m, n = len(surface.faces), int(node.max()) + 1
    face = np.repeat(np.arange(m), 3)
    return component_labels(m + n, face, m + node)[:m]
