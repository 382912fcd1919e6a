"""The recovered scene put together from the artefacts of the stages that found its parts; what render, export and report read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.affines import apply_affines
from iif_core.errors import InputError
from iif_core.response import Response, response, sampled_response
from workflow.artifacts.store import StageReader
from workflow.job import Job
from workflow.normal_form import CaptureReader

MATERIAL = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
UNKNOWN_MATERIAL = (0.5, 0.5, 0.5, 0.9, 0.0)  # METHOD H40: surface of an object that nobody saw


@dataclass(frozen=True)
class Recovered:
    """Geometry, materials and light of a scene; ids int32 with -1 = none, lengths in metres, colours linear.

    Attributes:
        vertices, faces: (n, 3) float32, (m, 3) int32; object_id (m,) of each face; object_names, one per id.
        cell_edge, cell_origin: the voxel grid of the cells; cell_ijk (c, 3), cell_centres (c, 3), cell_object (c,).
        cell_values: (c, 5) fitted albedo R G B, roughness, metallic; object_values: (objects, 5).
        emitter_id, emitter_side: (m,) kept emitter of each face and the side that emits (+1 front, -1 back, 0 both).
        emitter_radiance: (emitters, 3); rows of dropped emitters and environments are 0.
        environment: (3,).
        light_scale: what the radiance of stage emission was multiplied by to go with the fitted albedo.
    """

    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    object_names: list[str]
    cell_edge: float
    cell_origin: np.ndarray
    cell_ijk: np.ndarray
    cell_centres: np.ndarray
    cell_object: np.ndarray
    cell_values: np.ndarray
    object_values: np.ndarray
    emitter_id: np.ndarray
    emitter_side: np.ndarray
    emitter_radiance: np.ndarray
    environment: np.ndarray
    light_scale: float

    @property
    def face_radiance(self) -> np.ndarray:
        """(m, 3) float32 radiance of every face, 0 for what does not emit."""
        out = np.zeros((len(self.faces), 3), np.float32)
        lit = self.emitter_id >= 0
        out[lit] = self.emitter_radiance[self.emitter_id[lit]]
        return out

    def emission_map(self, face_id: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """(H, W, 3) float32 radiance that the seen faces emit towards `eye` (3,); `face_id` (H, W), -1 = miss."""
        corners = self.vertices[self.faces].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.sign(np.einsum("ij,ij->i", normal, np.asarray(eye, np.float64) - corners[:, 0]))
        emits = (self.emitter_side == 0) | (self.emitter_side == facing)
        radiance = np.where(emits[:, None], self.face_radiance, 0)
        return np.where((face_id >= 0)[..., None], radiance[face_id], 0).astype(np.float32)


def read_recovered(job: Job) -> Recovered:
    """The scene as stage affines left it. Needs capture, segmentation, base, emission and affines upstream."""
    capture = CaptureReader(job.read("capture"))
    vertices, faces = capture.mesh()
    segmentation, base, affines = job.read("segmentation"), job.read("base"), job.read("affines")
    object_id = segmentation.table("faces.parquet")["object_id"].astype(np.int32)
    objects = segmentation.table("objects.parquet")
    n_objects = max(int(objects["object_id"].max(initial=-1)), int(object_id.max(initial=-1))) + 1
    names = [f"object{i}" for i in range(n_objects)]
    for i, name in zip(objects["object_id"], objects["name"], strict=True):
        names[int(i)] = str(name)
    cells, fitted, grid = base.table("cells.parquet"), affines.table("cells.parquet"), base.json("base.json")
    if not np.array_equal(cells["cell_id"], fitted["cell_id"]):
        raise InputError(
            f"{affines.directory / 'cells.parquet'}: {len(fitted['cell_id'])} cells that are not the"
            f" {len(cells['cell_id'])} of base/cells.parquet; rebuild with --forcerun affines"
        )
    light_scale = float(affines.json("affines.json").get("light_scale", 1.0)) if affines.has("affines.json") else 1.0
    emitter_id, side, radiance, environment = _emitters(job.read("emission"), len(faces))
    return Recovered(
        vertices,
        faces,
        object_id,
        names,
        float(grid["cell_edge_m"]),
        np.asarray(grid["origin"], np.float32),
        np.stack([cells[c] for c in "ijk"], 1).astype(np.int32),
        np.stack([cells[c] for c in "xyz"], 1).astype(np.float32),
        cells["object_id"].astype(np.int32),
        material_rows(fitted),
        _object_values(base, affines, n_objects),
        emitter_id,
        side,
        (radiance * light_scale).astype(np.float32),
        (environment * light_scale).astype(np.float32),
        light_scale,
    )


def material_rows(table: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 5) float32 albedo R G B, roughness, metallic from the columns of a table."""
    return np.stack([table[name] for name in MATERIAL], 1).astype(np.float32)


def read_affines(reader: StageReader, n_objects: int) -> np.ndarray:
    """(objects, 16) float64 [T_albedo row by row, T_roughness, T_metallic]; identity where the table has no row."""
    table = reader.table("objects.parquet")
    out = np.tile(np.r_[np.eye(3, 4).ravel(), 1.0, 0.0, 1.0, 0.0], (n_objects, 1))
    rows = np.concatenate([table[name] for name in ("T_albedo", "T_roughness", "T_metallic")], 1)
    out[table["object_id"]] = rows
    return out


def read_response(reader: StageReader) -> Response:
    """The camera response that stage affines found, from its samples; identity when it wrote none (HDR)."""
    name = "camera_response.parquet"
    if not reader.has(name):
        return response("identity")
    x, curves = response_samples(reader.table(name))
    return sampled_response(x, curves) if len(x) else response("identity")


def response_samples(table: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """x (S,) and f(x) (3, S) of a camera_response table; empty when it holds parameters only."""
    rows = np.flatnonzero((table["kind"] == "sample") & (table["x"] >= 0) & (table["x"] <= 1))
    if not len(rows):
        return np.zeros(0), np.zeros((3, 0))
    channel, x, value = (table[c][rows] for c in ("channel", "x", "value"))
    curves = []
    for c in np.unique(channel) if channel.dtype.kind in "iu" else [c for c in ("R", "G", "B")]:
        own = np.flatnonzero(np.char.upper(channel.astype(str)) == str(c).upper())
        order = own[np.argsort(x[own])]
        curves.append((x[order], value[order]))
    if len({len(grid) for grid, _ in curves}) != 1 or not all(np.array_equal(grid, curves[0][0]) for grid, _ in curves):
        raise InputError("camera_response.parquet: the channels are sampled at different x; rebuild with --forcerun affines")
    return curves[0][0], np.stack([np.broadcast_to(y, curves[0][1].shape) for _, y in curves])


def _object_values(base: StageReader, affines: StageReader, n_objects: int) -> np.ndarray:
    """(max(n_objects, 1), 5) float32: mean base material of each object through its affine."""
    out = np.tile(np.float64(UNKNOWN_MATERIAL), (max(n_objects, 1), 1))
    means = base.table("objects.parquet")
    seen = means["cells"] > 0
    out[means["object_id"][seen]] = material_rows(means)[seen]
    if n_objects:
        out = apply_affines(read_affines(affines, n_objects), np.arange(n_objects), out)
    return out.astype(np.float32)


def _emitters(reader: StageReader, n_faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per face the kept emitter (or -1) and its side; radiance per emitter id (0 unless a kept area); environment."""
    table, faces = reader.table("emitters.parquet"), reader.table("emitter_faces.parquet")
    ids = table["emitter_id"].astype(np.int64)
    rows = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float64).reshape(-1, 3)
    kept = table["kept"].astype(bool)
    area, around = kept & (table["kind"] == "area"), kept & (table["kind"] == "environment")
    radiance = np.zeros((int(ids.max(initial=-1)) + 1, 3))
    radiance[ids[area]] = rows[area]
    emitter_id, side = np.full(n_faces, -1, np.int32), np.zeros(n_faces, np.int8)
    shines = np.isin(faces["emitter_id"], ids[area])
    emitter_id[faces["face_id"][shines]] = faces["emitter_id"][shines]
    side[faces["face_id"][shines]] = faces["side"][shines]
    return emitter_id, side, radiance, rows[around].sum(0)
