"""Mesh, base materials and pixels as the light-transport stages (emission, shading, affines) need them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.gains import CameraGains, radius_squared
from iif_core.surface.cells import grid_origin
from iif_core.surface.mesh import face_geometry
from workflow.artifacts.store import StageReader, ids_from_disk, rgb
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials

MATERIAL = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
UNKNOWN_MATERIAL = (0.5, 0.5, 0.5, 0.9, 0.0)  # METHOD H40: surface of an object that nobody saw
BLACK = (0.0, 0.0, 0.0, 1.0, 0.0)  # kept emitters do not reflect: what is seen of them is their emission


@dataclass(frozen=True)
class BaseScene:
    """The mesh with the base texture; ids int32 with -1 = none.

    Attributes:
        vertices (n, 3), faces (m, 3), object_id (m,) of the faces, normals (m, 3), areas (m,).
        n_objects: objects are 0 ... n_objects - 1.
        cell_edge, cell_origin, cell_ijk (c, 3), cell_object (c,), cell_values (c, 5): surface cells of the base
            texture.
        object_values: (n_objects, 5) means, for surface that nobody saw.
    """

    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    n_objects: int
    cell_edge: float
    cell_origin: np.ndarray
    cell_ijk: np.ndarray
    cell_object: np.ndarray
    cell_values: np.ndarray
    object_values: np.ndarray

    def with_gains(self, gain: np.ndarray) -> BaseScene:
        """The scene with the albedos of its objects multiplied by gain (n_objects, 3), at most 1."""
        cells, objects = self.cell_values.copy(), self.object_values.copy()
        objects[:, :3] = np.minimum(objects[:, :3] * gain, 1.0)
        cells[:, :3] = np.minimum(cells[:, :3] * gain[self.cell_object], 1.0)
        return replace(self, cell_values=cells, object_values=objects)

    def traceable(
        self, black: np.ndarray | None = None, extra: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[Geometry, CellMaterials]:
        """Geometry and materials on the device; faces in `black` (m,) bool reflect nothing.

        extra: vertices (v, 3) and faces (f, 3) of a black thing to add; its faces come last.
        """
        material = self.materials()
        from iif_core.light.transport.geometry import build_geometry

        object_id = self.object_id if black is None else np.where(black, self.n_objects, self.object_id)
        if extra is None:
            return build_geometry(self.vertices, self.faces, object_id), material
        vertices = np.concatenate([self.vertices, extra[0]])
        faces = np.concatenate([self.faces, extra[1] + len(self.vertices)])
        object_id = np.concatenate([object_id, np.full(len(extra[1]), self.n_objects, np.int32)])
        return build_geometry(vertices, faces, object_id), material

    def materials(self) -> CellMaterials:
        """On the device; object n_objects is black."""
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        from iif_core.light.transport.materials import CellMaterials

        object_values = np.concatenate([self.object_values, np.float32([BLACK])])
        return CellMaterials(self.cell_edge, self.cell_origin, self.cell_ijk, self.cell_object, self.cell_values, object_values)


def read_base_scene(job: Job) -> BaseScene:
    """The scene as stage base left it. Needs capture, segmentation and base upstream."""
    capture, segmentation, base = CaptureReader(job.read("capture")), job.read("segmentation"), job.read("base")
    vertices, faces = capture.mesh()
    object_id = segmentation.table("faces.parquet")["object_id"].astype(np.int32)
    known = segmentation.table("objects.parquet")["object_id"]
    n_objects = int(max(object_id.max(initial=-1), known.max(initial=-1))) + 1
    cells, facts = base.table("cells.parquet"), base.json("base.json")
    means = base.table("objects.parquet")
    object_values = np.tile(np.float32(UNKNOWN_MATERIAL), (n_objects, 1))
    seen = means["cells"] > 0
    object_values[means["object_id"][seen]] = _rows(means)[seen]
    normals, areas = face_geometry(vertices, faces)
    return BaseScene(
        vertices,
        faces,
        object_id,
        normals,
        areas,
        n_objects,
        float(facts["cell_edge_m"]),
        np.asarray(facts["origin"], np.float32),
        np.stack([cells[c] for c in "ijk"], 1).astype(np.int32),
        cells["object_id"].astype(np.int32),
        _rows(cells),
        object_values,
    )


def _rows(table: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([table[name] for name in MATERIAL], 1).astype(np.float32)


@dataclass(frozen=True)
class ViewPixels:
    """The pixels of one view that hit the mesh, in reading order; n pixels.

    Attributes:
        index: (n,) into the flattened image.
        points, normals, wo: (n, 3) float32, metres and unit vectors; normals face the camera.
        face, object_id: (n,) int32; from_front: (n,) bool, the camera is on the side of the face normal.
        value: (n, 3) photograph; valid, interior: (n,) bool.
    """

    index: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    wo: np.ndarray
    face: np.ndarray
    object_id: np.ndarray
    from_front: np.ndarray
    value: np.ndarray
    valid: np.ndarray
    interior: np.ndarray

    def take(self, choice: np.ndarray) -> ViewPixels:
        """Some of the pixels."""
        return ViewPixels(**{name: array[choice] for name, array in self.__dict__.items()})


def sensor_bounds(value: np.ndarray, is_hdr: bool, saturation: float) -> tuple[np.ndarray, np.ndarray]:
    """Sensor values, and which of them are bounds: at the top of the range, whatever is stored above it. Radiance has no top."""
    if is_hdr:
        return value, np.zeros(value.shape, bool)
    return np.minimum(value, saturation), value >= saturation


def view_pixels(job: Job, capture: CaptureReader, scene: BaseScene, view: View) -> ViewPixels:
    """Photograph, G-buffer and segmentation of a view, a row a pixel that hits the mesh; no pixel of a held-out view is valid."""
    if view.split == "test":  # geometry alone: no stage that finds anything sees what it shows
        photo, valid = np.zeros((view.height, view.width, 3), np.float32), np.zeros((view.height, view.width), bool)
    else:
        photo, valid = capture.photo(view)
    depth, face = capture.gbuffer(view)
    maps = job.read("segmentation").exr(f"maps/{view.name}.exr")
    hit = np.flatnonzero((face.ravel() >= 0) & (depth.ravel() > 0))
    directions = capture.directions(view).reshape(-1, 3)[hit]
    points = (view.world_from_camera[:3, 3] + depth.reshape(-1, 1)[hit] * directions).astype(np.float32)
    wo = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    face = face.ravel()[hit]
    normals = scene.normals[face].astype(np.float32)
    front = np.einsum("ij,ij->i", normals, wo) >= 0
    # Degenerate faces have no normal; any unit vector towards the camera will do.
    flat = np.einsum("ij,ij->i", normals, normals) < 0.5
    normals = np.where(flat[:, None], wo, np.where(front[:, None], normals, -normals)).astype(np.float32)
    value = photo.reshape(-1, 3)[hit]
    return ViewPixels(
        hit,
        points,
        normals,
        wo.astype(np.float32),
        face,
        ids_from_disk(maps["object.id"]).ravel()[hit],
        front,
        value,
        valid.ravel()[hit] & np.isfinite(value).all(1),
        maps["interior"].ravel()[hit] > 0.5,
    )


def base_maps(job: Job, view: View) -> np.ndarray:
    """(H * W, 5) float32 base albedo, roughness and metallic of a view."""
    maps = job.read("base").exr(f"maps/{view.name}.exr")
    parts = [rgb(maps, "albedo"), maps["roughness"][..., None], maps["metallic"][..., None]]
    return np.concatenate(parts, -1).reshape(-1, 5).astype(np.float32)


def cache_origin(scene: BaseScene, edge: float) -> np.ndarray:
    """Corner (3,) of the radiance-cache grid, the same wherever it is needed."""
    return grid_origin(scene.vertices[scene.faces.ravel()], edge)


@dataclass(frozen=True)
class Light:
    """What stage emission found, per face.

    Attributes:
        radiance: (m, 3); side: (m,) int8; emits: (m,) bool; environment: (3,), or (H, W, 3) as in `iif_core.light.environment`.
    """

    radiance: np.ndarray
    side: np.ndarray
    emits: np.ndarray
    environment: np.ndarray

    def emitters(self, geometry: Geometry) -> Emitters:
        """On the device."""
        from iif_core.light.transport.emitters import Emitters

        return Emitters(geometry, self.radiance, self.side, self.environment)


def read_light(job: Job, n_faces: int) -> Light:
    """Kept emitters and environment. Needs emission upstream."""
    reader = job.read("emission")
    table, faces = reader.table("emitters.parquet"), reader.table("emitter_faces.parquet")
    rows = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float32).reshape(-1, 3)
    kept = table["kept"].astype(bool)
    by_id = np.zeros((int(table["emitter_id"].max(initial=-1)) + 1, 3), np.float32)
    area = kept & (table["kind"] == "area")
    by_id[table["emitter_id"][area]] = rows[area]
    radiance, side, emits = np.zeros((n_faces, 3), np.float32), np.zeros(n_faces, np.int8), np.zeros(n_faces, bool)
    shines = np.isin(faces["emitter_id"], table["emitter_id"][area])
    ids = faces["face_id"][shines]
    radiance[ids], side[ids], emits[ids] = by_id[faces["emitter_id"][shines]], faces["side"][shines], True
    return Light(radiance, side, emits, _environment(reader, table, rows, kept & (table["kind"] == "environment")))


def _environment(reader: StageReader, emitters: dict[str, np.ndarray], rows: np.ndarray, shines: np.ndarray) -> np.ndarray:
    """(H, W, 3) where the stage wrote the texels of its environment emitters, else (3,), one radiance everywhere."""
    name = "environment_texels.parquet"
    if not reader.has(name):
        return rows[shines].sum(0, dtype=np.float32)
    texels = reader.table(name)
    height, width = (int(texels[c].max(initial=0)) + 1 for c in ("row", "column"))
    by_id = np.zeros((int(max(emitters["emitter_id"].max(initial=-1), texels["emitter_id"].max(initial=-1))) + 1, 3), np.float32)
    by_id[emitters["emitter_id"][shines]] = rows[shines]
    out = np.zeros((height, width, 3), np.float32)
    lit = texels["emitter_id"] >= 0
    out[texels["row"][lit], texels["column"][lit]] = by_id[texels["emitter_id"][lit]]
    return out


def read_object_gains(job: Job, n_objects: int) -> np.ndarray:
    """(n_objects, 3) factors on the base albedo that go with the light. Needs emission upstream."""
    table = job.read("emission").table("object_gains.parquet")
    gain = np.ones((n_objects, 3), np.float32)
    gain[table["object_id"]] = np.stack([table[f"gain_{c}"] for c in "rgb"], 1)
    return gain


def read_gains(job: Job) -> CameraGains:
    """Exposure, white balance and vignetting of every view of the capture, in order, as stage emission used them. Needs
    emission upstream."""
    facts = job.read("emission").json("emission.json")
    gain = np.asarray(facts["gain"], np.float64)
    return CameraGains(gain, np.asarray(facts["vignetting"], np.float64), np.ones(len(gain), bool))


def pixel_gains(gains: CameraGains, number: int, view: View, index: np.ndarray) -> np.ndarray:
    """(n, 3) what the radiance of pixels (flattened indices) of the view at `number` in the capture is multiplied by."""
    return gains.factor(number, radius_squared(index, view.width, view.height))


def read_radiance_cache(job: Job, with_bounds: bool = True) -> RadianceCache:
    """The radiance cache on the device; `with_bounds`: also voxels that were only ever seen saturated."""
    from iif_core.light.transport.cache import RadianceCache

    reader = job.read("emission")
    table, facts = reader.table("radiance_cache.parquet"), reader.json("emission.json")
    use = np.ones(len(table["i"]), bool) if with_bounds else ~table["censored"].astype(bool)
    ijk = np.stack([table[c] for c in "ijk"], 1)[use].astype(np.int32)
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1)[use].astype(np.float32)
    return RadianceCache(facts["cache_edge_m"], np.asarray(facts["cache_origin"], np.float32), ijk, radiance)
