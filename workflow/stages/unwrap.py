"""unwrap: the mesh as people take it away: one part per object and emitter, with texture coordinates in one atlas."""

from __future__ import annotations

import numpy as np

from iif_core.surface.atlas import texel_density, unwrap
from iif_core.surface.triangles import face_geometry
from workflow.exporters.surface import Part, SeenSurface, build_parts, seen_sides
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene
from workflow.scene.named import shown_names
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import emitter_of_faces

EMITTER_TEXELS = 4.0
"""Side of a square of texels for an emitter, whose material is black all over."""
NEAR = 0.1
"""Quantile of the sizes of a pixel on an object that counts as seen from near."""
_BINS = np.geomspace(1e-5, 10.0, 241)  # m; sizes of pixels are counted in steps of 6 %


def run(job: Job) -> None:
    """Write vertices.parquet, faces.parquet, parts.parquet and unwrap.json."""
    capture = CaptureReader(job.read("capture"))
    base, light = read_lit_scene(job)
    wanted = job.settings.export
    n_objects = base.n_objects
    front, back, footprint = _observed(job, capture, base.vertices, base.faces, base.object_id, n_objects)
    emitter_id = emitter_of_faces(job, light)
    surface = SeenSurface(
        base.vertices,
        base.faces,
        base.object_id,
        shown_names(job, n_objects),
        emitter_id,
        light.side,
        front,
        back,
    )
    parts = build_parts(surface, wanted.max_faces_glb)
    count = sum(len(part.faces) for part in parts)
    job.log.info("%d parts of %d faces; the mesh has %d", len(parts), count, len(base.faces))
    area = np.array([face_geometry(part.vertices, part.faces)[1].sum() for part in parts])
    density = _densities(parts, area, footprint, np.bincount(base.cell_object, minlength=n_objects), base.cell_edge)
    made = unwrap([(part.vertices, part.faces) for part in parts], density, wanted.texture_size)
    job.log.info("atlas of %d x %d texels, %d charts, densities times %.3f", made.size, made.size, made.charts, made.shrunk)
    if made.size > wanted.texture_size:
        job.log.warning("larger than `export.texture_size`, %d: the mesh has so many charts", wanted.texture_size)
    first = np.cumsum([0, *(len(rows) for rows in made.source)])
    xyz = np.concatenate([part.vertices[rows] for part, rows in zip(parts, made.source, strict=True)])
    normal = np.concatenate([part.normals[rows] for part, rows in zip(parts, made.source, strict=True)])
    uv = np.concatenate(made.uv)
    columns = {name: xyz[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    columns |= {f"n{name}": normal[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    job.writer.table("vertices.parquet", columns | {"u": uv[:, 0], "v": uv[:, 1]}, {name: "m" for name in "xyz"})
    faces = np.concatenate([own + start for own, start in zip(made.faces, first, strict=False)])
    of = np.repeat(np.arange(len(parts)), [len(own) for own in made.faces])
    job.writer.table(
        "faces.parquet", {"part_id": of.astype(np.int32), **{f"v{i}": faces[:, i].astype(np.int32) for i in range(3)}}
    )
    rows = {
        "part_id": np.arange(len(parts), dtype=np.int32),
        "name": [part.name for part in parts],
        "object_id": np.array([part.object_id for part in parts], np.int32),
        "emitter_id": np.array([part.emitter_id for part in parts], np.int32),
        "double_sided": np.array([part.double_sided for part in parts]),
        "simplified": np.array([part.simplified for part in parts]),
        "area_m2": area,
        "texels_per_m": density * made.shrunk,
    }
    job.writer.table("parts.parquet", rows, {"area_m2": "m^2", "texels_per_m": "1/m"})
    facts = {
        "size": made.size,
        "charts": made.charts,
        "densities_times": made.shrunk,
        "faces": {"mesh": len(base.faces), "parts": count},
        "cell_edge_m": base.cell_edge,
        "double_sided": [part.name for part in parts if part.double_sided],
    }
    job.writer.json("unwrap.json", facts)


def _observed(
    job: Job, capture: CaptureReader, vertices: np.ndarray, faces: np.ndarray, object_id: np.ndarray, n_objects: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how many pixels see the front and the back of each face, (m,) each, and the size of a pixel on each object, (n,)
    metres at its quantile `NEAR`, infinite where none was seen. The last object stands for surface without one."""
    vertices = vertices.astype(np.float64)
    front, back = np.zeros((2, len(faces)), np.int64)
    counts = np.zeros((n_objects + 1, len(_BINS)), np.int64)
    for done, view in enumerate(capture.views):
        job.progress(done, len(capture.views), "views looked at")
        depth, face_id = capture.gbuffer(view)
        sides = seen_sides(vertices, faces, face_id, view.world_from_camera[:3, 3])
        front += sides[0]
        back += sides[1]
        hit = face_id >= 0
        place = np.minimum(np.searchsorted(_BINS, depth[hit] / view.fx), len(_BINS) - 1)
        rows = object_id[face_id[hit]]  # -1 is the last row
        counts += np.bincount((rows % (n_objects + 1)) * len(_BINS) + place, minlength=counts.size).reshape(counts.shape)
    job.progress(len(capture.views), len(capture.views), "views looked at")
    total = counts.sum(1)
    near = (np.cumsum(counts, 1) < NEAR * total[:, None]).sum(1)
    return front, back, np.where(total > 0, _BINS[np.minimum(near, len(_BINS) - 1)], np.inf)


def _densities(parts: list[Part], area: np.ndarray, footprint: np.ndarray, cells: np.ndarray, edge: float) -> np.ndarray:
    """Texels a metre of each part."""
    objects = np.array([part.object_id for part in parts])
    known = (objects >= 0) & (objects < len(cells))
    seen = np.where(known, np.append(cells, 0)[np.where(known, objects, -1)], 0) * edge**2
    density = texel_density(area, seen, footprint[np.where(known, objects, -1)], edge)
    emits = np.array([part.emitter_id for part in parts]) >= 0
    return np.where(emits, np.minimum(density, EMITTER_TEXELS / np.sqrt(area)), density)
