"""A normal map: the shape of the photographs' mesh on parts that were simplified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from iif_core.numerics.arrays import unique_rows
from iif_core.numerics.color import to_uint8
from iif_core.surface.atlas import texel_values
from iif_core.surface.closest import closest_points
from iif_core.surface.simplify import clean
from iif_core.surface.tangents import in_tangent_frame, vertex_tangents
from iif_core.surface.triangles import smooth_groups, vertex_normals, weld
from workflow.exporters.atlas import TexturedPart, photographed, texels_of
from workflow.exporters.surface import CREASE_COSINE
from workflow.scene.recovered import Recovered

Array = np.ndarray


def normal_picture(parts: Sequence[TexturedPart], recovered: Recovered, size: int) -> Array:
    """Draw glTF's normal texture, (S, S, 3) uint8: components along tangent, bitangent and normal of `vertex_tangents`, from
    [-1, 1] to [0, 1]. Parts that are as they were have (0, 0, 1).

    A texel has the normal of the nearest point of the photographs' mesh, on the side of the simplified one.
    """
    picture = np.zeros((size * size, 3))
    picture[:, 2] = 1
    texels = texels_of(parts, size)
    first = np.cumsum([0, *(len(part.faces) for part in parts)])
    for number, (part, rows) in enumerate(zip(parts, texels.rows_of_parts(len(parts)), strict=True)):
        if not part.simplified or not len(rows):
            continue
        xyz, faces, normals = _smooth(*photographed(part, recovered))
        found = closest_points(xyz, faces, texels.points[rows])
        wanted = texel_values(normals, faces, found.face, found.barycentric).astype(np.float64)
        wanted /= np.maximum(np.linalg.norm(wanted, axis=1, keepdims=True), 1e-12)
        wanted *= np.where(np.einsum("ij,ij->i", wanted, texels.normals[rows]) < 0, -1, 1)[:, None]
        tangents = vertex_tangents(part.vertices, part.faces, part.uv, part.normals)
        own, weights = texels.face[rows] - first[number], texels.barycentric[rows]
        at = texel_values(tangents, part.faces, own, weights)
        picture[texels.index[rows]] = in_tangent_frame(wanted, texel_values(part.normals, part.faces, own, weights), at)
    return to_uint8(0.5 * picture.reshape(size, size, 3) + 0.5)


def _smooth(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Vertices, faces and normals of a mesh, with two normals at creases."""
    vertices, faces = weld(np.asarray(vertices, np.float64), faces)
    faces = faces[clean(faces, vertices)]
    groups = smooth_groups(vertices, faces, np.zeros(len(faces), np.int64), CREASE_COSINE)
    split, local = unique_rows(np.stack([faces.ravel(), np.repeat(groups, 3)], 1))
    local = local.reshape(-1, 3)
    xyz = vertices[split[:, 0]]
    return xyz, local, vertex_normals(xyz, local)
