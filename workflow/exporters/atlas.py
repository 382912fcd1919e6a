"""The recovered scene as textured meshes: parts with texture coordinates, and one atlas of materials for all of them."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.numerics.color import srgb_from_linear, to_uint8
from iif_core.reflectance.material import BLACK
from iif_core.surface.atlas import nearest_covered, texel_surface, texel_values, texels_around
from iif_core.surface.closest import closest_points
from iif_core.surface.lookup import values_at
from workflow.artifacts.store import StageReader
from workflow.scene.recovered import Recovered

Array = np.ndarray

UNKNOWN = 1.0
"""Uncertainty of albedo where no photograph shows the surface: the whole range."""
INWARDS = 0.25
"""Texels from the border of a chart to the place that stands for a texel whose centre has no surface."""


@dataclass(frozen=True)
class TexturedPart:
    """One mesh: an object without its emitters, or one emitter of an object. Unit normals point towards the photographs."""

    name: str
    object_id: int
    emitter_id: int
    vertices: Array  # (n, 3) float32, metres
    normals: Array  # (n, 3) float32
    uv: Array  # (n, 2) float32 in [0, 1], v downwards
    faces: Array  # (m, 3) int32
    radiance: Array  # (3,) float32, 0 for what does not emit
    double_sided: bool
    opacity: float = 1.0  # share of the light that does not pass straight through
    simplified: bool = False


@dataclass(frozen=True)
class Atlas:
    """Materials of all parts in one picture of S x S texels; texels between the charts have the values of the nearest chart.

    Attributes:
        base_color: (S, S, 3) float32, linear, in [0, 1].
        roughness, metallic: (S, S) float32 in [0, 1], roughness perceptual.
        uncertainty: (S, S) float32, standard deviation of albedo; `UNKNOWN` where nothing was observed.
        seen: (S, S) bool, a photograph shows the surface; elsewhere the values are means of what is around, or of the object.
        covered: (S, S) bool, the texel belongs to a chart.
    """

    base_color: Array
    roughness: Array
    metallic: Array
    uncertainty: Array
    seen: Array
    covered: Array

    @property
    def size(self) -> int:
        return len(self.base_color)


def read_parts(unwrapped: StageReader, recovered: Recovered) -> list[TexturedPart]:
    """Read the parts that stage unwrap wrote, with the light and the transparency of the recovered scene."""
    vertices, faces, parts = (unwrapped.table(f"{name}.parquet") for name in ("vertices", "faces", "parts"))
    xyz, normal = (np.stack([vertices[p + c] for c in "xyz"], 1) for p in ("", "n"))
    uv = np.stack([vertices["u"], vertices["v"]], 1)
    corners = np.stack([faces[f"v{i}"] for i in range(3)], 1).astype(np.int64)
    bounds = np.searchsorted(faces["part_id"], np.arange(len(parts["part_id"]) + 1))
    transmittance = recovered.surface.transmittance
    out = []
    for p, (name, object_id, emitter_id) in enumerate(zip(parts["name"], parts["object_id"], parts["emitter_id"], strict=True)):
        own = corners[bounds[p] : bounds[p + 1]]
        first, last = int(own.min()), int(own.max()) + 1
        opacity = 1.0 - float(transmittance[object_id]) if transmittance is not None and object_id >= 0 else 1.0
        radiance = recovered.emitter_radiance[emitter_id] if emitter_id >= 0 else np.zeros(3)
        out.append(
            TexturedPart(
                str(name),
                int(object_id),
                int(emitter_id),
                xyz[first:last],
                normal[first:last],
                uv[first:last],
                (own - first).astype(np.int32),
                np.asarray(radiance, np.float32),
                bool(parts["double_sided"][p]) or opacity < 1,
                opacity,
                bool(parts["simplified"][p]),
            )
        )
    return out


@dataclass(frozen=True)
class Texels:
    """The surface under the texels of an atlas that belong to a chart, in the order of their flat index.

    Attributes:
        size: S.
        index: (t,) int64 flat index of each texel.
        part: (t,) int64 number of its part.
        face, barycentric: (t,) int64 face of all parts, counted on, and (t, 3) float32 the place in it.
        points, normals: (t, 3) float32 of its centre, metres; the normals are those of the vertices, interpolated.
    """

    size: int
    index: Array
    part: Array
    face: Array
    barycentric: Array
    points: Array
    normals: Array

    def rows_of_parts(self, parts: int) -> list[Array]:
        """Return the rows of each part."""
        order = np.argsort(self.part, kind="stable")
        return np.split(order, np.searchsorted(self.part[order], np.arange(1, parts)))


@dataclass(frozen=True)
class _Charts:
    """All parts as one mesh: vertices, normals, uv (n, 3), (n, 3), (n, 2); faces (m, 3) and the part (m,) of each."""

    vertices: Array
    normals: Array
    uv: Array
    faces: Array
    part: Array


def _charts(parts: Sequence[TexturedPart]) -> _Charts:
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, first, strict=False)])
    vertices, normals, uv = (np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "uv"))
    return _Charts(vertices, normals, uv, faces, np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]))


def _texels(charts: _Charts, size: int, index: Array, face: Array, weights: Array) -> Texels:
    points, normals = (texel_values(values, charts.faces, face, weights) for values in (charts.vertices, charts.normals))
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-12))
    return Texels(size, index, charts.part[face], face.astype(np.int64), weights, points, unit)


def texels_of(parts: Sequence[TexturedPart], size: int) -> Texels:
    """Find the surface under the texels of an atlas of `size` x `size`, which may be coarser than the atlas of the materials."""
    charts = _charts(parts)
    face, barycentric = texel_surface(charts.uv, charts.faces, size)
    index = np.flatnonzero(face >= 0)
    return _texels(charts, size, index, face.ravel()[index], barycentric.reshape(-1, 3)[index])


def texels_beside(parts: Sequence[TexturedPart], texels: Texels) -> tuple[Texels, Array]:
    """Find the surface that interpolation between texels shows with texels whose centre has none: those at the border of charts,
    and all of a chart that is narrower than a texel.

    Args:
        parts: of the surface.
        texels: of the parts, by `texels_of`.

    Returns:
        The texels, with the nearest point of a chart, moved from its border towards the middle of its face by up to `INWARDS`,
        because where surface ends there often is other surface; and (t,) bool, whether the texel contains surface.
    """
    charts, size = _charts(parts), texels.size
    free = texels_around(charts.uv, charts.faces, size, 1.5).ravel()  # a search for those farther than sqrt(2) would be in vain
    free[texels.index] = False
    index = np.flatnonzero(free)
    plane = np.concatenate([charts.uv * np.float32(size), np.zeros((len(charts.uv), 1), np.float32)], 1)
    centre = np.column_stack([index % size + 0.5, index // size + 0.5, np.zeros(len(index))])
    near = closest_points(plane, charts.faces, centre)
    away = near.points - centre
    read = np.flatnonzero((away**2).sum(1) < 2)
    face, weights = near.face[read], near.barycentric[read]
    corners = plane[charts.faces[face]]
    way = corners.mean(1) - np.einsum("ni,nij->nj", weights, corners)
    step = np.minimum(INWARDS / np.maximum(np.linalg.norm(way, axis=1), 1e-9), 0.5)[:, None]
    weights = ((1 - step) * weights + step / 3).astype(np.float32)
    return _texels(charts, size, index[read], face, weights), np.abs(away[read]).max(1) <= 0.5


def joined(first: Texels, second: Texels) -> Texels:
    """Return the texels of both, those of `first` first."""
    names = ("index", "part", "face", "barycentric", "points", "normals")
    return Texels(first.size, *(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def bake(parts: Sequence[TexturedPart], recovered: Recovered, uncertainty: Array, size: int) -> Atlas:
    """Read the materials of the recovered scene at the texels of an atlas, as the renderer reads them at the hits of its rays.

    A texel of a simplified part is moved to the nearest point of the mesh that was photographed, because the cells lie there.

    Args:
        parts: of the scene.
        recovered: the scene.
        uncertainty: (cells,) standard deviation of albedo of each surface cell.
        size: S.
    """
    surface = recovered.surface
    centres = texels_of(parts, size)
    texels = joined(centres, texels_beside(parts, centres)[0])
    objects = np.array([part.object_id for part in parts])[texels.part]
    emits = np.array([part.emitter_id >= 0 for part in parts])[texels.part]
    points = _on_the_mesh(parts, texels, recovered)
    grid = surface.cell_edge, surface.cell_origin, surface.cell_ijk, surface.cell_object
    values, cell = values_at(points, objects, *grid, surface.cell_values, surface.object_values)
    values[emits] = BLACK
    seen = (cell >= 0) & ~emits
    spread = np.where(seen, np.asarray(uncertainty)[cell] if len(uncertainty) else UNKNOWN, np.where(emits, 0, UNKNOWN))
    covered, known = np.zeros((2, size * size), bool)
    covered[centres.index] = True
    known[texels.index] = True
    nearest = nearest_covered(known.reshape(size, size))
    row = np.zeros(size * size, np.int64)
    row[texels.index] = np.arange(len(texels.index))
    row = row[nearest]
    values = np.clip(values, 0, 1)[row]
    return Atlas(
        values[..., :3], values[..., 3], values[..., 4], spread.astype(np.float32)[row], seen[row], covered.reshape(size, size)
    )


def _on_the_mesh(parts: Sequence[TexturedPart], texels: Texels, recovered: Recovered) -> Array:
    """The points of the texels, those of simplified parts moved to the nearest point of the mesh of the photographs."""
    points = texels.points.copy()
    for part, rows in zip(parts, texels.rows_of_parts(len(parts)), strict=True):
        if part.simplified and len(rows):
            points[rows] = closest_points(*photographed(part, recovered), points[rows]).points
    return points


def photographed(part: TexturedPart, recovered: Recovered) -> tuple[Array, Array]:
    """Return vertices and faces of a part that does not emit as the mesh of the photographs has them."""
    surface = recovered.surface
    faces = surface.faces[(surface.object_id == part.object_id) & (recovered.emitter_id < 0)]
    used, local = np.unique(faces, return_inverse=True)
    return surface.vertices[used], local.reshape(-1, 3)


# -------------------------------------------------------------------------------------------------------------- pictures


def texture_facts(
    parts: Sequence[TexturedPart], atlas: Atlas, unwrapped: Mapping[str, Any], table: Mapping[str, Array], size_in_glb: int
) -> dict[str, Any]:
    """Return what the textures lost: the sizes of a texel and of a surface cell in metres, and how much surface photographs show.

    Args:
        parts, atlas: of the scene.
        unwrapped: unwrap.json; table: parts.parquet, both of stage unwrap.
        size_in_glb: of the textures in scene.glb, which may be coarser than the atlas.
    """
    shown = [p for p, part in enumerate(parts) if part.emitter_id < 0]
    density = np.asarray(table["texels_per_m"])[shown]
    weight = density**2 * np.asarray(table["area_m2"])[shown]
    order = np.argsort(density)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum()) if len(shown) else 0
    texel = 1 / density[order][min(middle, len(shown) - 1)] if len(shown) else 0.0
    return {
        "atlas_size": unwrapped["size"],
        "texel_m": texel,
        "texel_in_glb_m": texel * unwrapped["size"] / size_in_glb,
        "cell_m": unwrapped["cell_edge_m"],
        "seen_share": float((atlas.seen & atlas.covered).sum() / max(atlas.covered.sum(), 1)),
    }


def base_color_picture(atlas: Atlas) -> Array:
    """Return the base colour as (S, S, 3) uint8, sRGB-encoded."""
    return to_uint8(srgb_from_linear(atlas.base_color))


def surface_picture(atlas: Atlas) -> Array:
    """Return glTF's metallic-roughness texture, (S, S, 3) uint8: R = 255 (no occlusion), G roughness, B metallic, all linear."""
    full = np.ones_like(atlas.roughness)
    return to_uint8(np.stack([full, atlas.roughness, atlas.metallic], -1))


def encoded(picture: Array, jpeg: int | None = None) -> bytes:
    """Encode (S, S, 3) or (S, S) uint8 as PNG, or as JPEG of quality `jpeg` without colour subsampling."""
    from PIL import Image

    buffer, image = io.BytesIO(), Image.fromarray(np.ascontiguousarray(picture))
    if jpeg is None:
        image.save(buffer, "PNG", compress_level=6)
    else:
        image.save(buffer, "JPEG", quality=jpeg, subsampling=0)
    return buffer.getvalue()
