"""Mesh, base materials and pixels as the light-transport stages (emission, shading, affines) need them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iif_core.camera.gains import CameraGains, radius_squared
from iif_core.reflectance.material import BLACK, CHANNELS, NEUTRAL
from iif_core.surface.cells import grid_origin
from iif_core.surface.triangles import face_geometry
from workflow.artifacts.store import StageReader, ids_from_disk, rgb
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials


SECOND_LOOK = "second_look.json"
"""Says whether stage second_look made its own base."""


def read_base(job: Job) -> StageReader:
    """Return the base texture that a stage starts from: the texture of the second look, if one was made before the stage."""
    if "second_look" in job.stage.upstream:
        again = job.read("second_look")
        if again.json(SECOND_LOOK)["made"]:
            return again
    return job.read("base")


@dataclass(frozen=True)
class BaseScene:
    """The mesh with the base texture; ids are int32 with -1 = none, lengths metres, colours linear.

    Attributes:
        vertices (n, 3), faces (m, 3), object_id (m,) of the faces, normals (m, 3), areas (m,).
        n_objects: objects are 0 ... n_objects - 1.
        cell_edge, cell_origin, cell_ijk (c, 3), cell_object (c,), cell_values (c, 5): surface cells of the base
            texture.
        object_values: (n_objects, 5) means, for surface that no photograph shows.
        transmittance: (n_objects,) share of the light that passes straight through the surface of each object; None = none.
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
    transmittance: np.ndarray | None = None

    @property
    def is_sheer(self) -> np.ndarray:
        """(m,) bool: light passes through the face, so that pixels on it show what lies behind as well."""
        return self.passes > 0

    @property
    def passes(self) -> np.ndarray:
        """(m,) float32 share of the light that passes straight through each face."""
        share = np.zeros(self.n_objects, np.float32) if self.transmittance is None else self.transmittance
        return np.append(share, np.float32(0.0))[self.object_id]  # the last for surface of no object, -1

    def with_gains(self, gain: np.ndarray) -> BaseScene:
        """Return the scene with the albedos of its objects multiplied by `gain` (n_objects, 3) and limited to 1."""
        cells, objects = self.cell_values.copy(), self.object_values.copy()
        objects[:, :3] = np.minimum(objects[:, :3] * gain, 1.0)
        cells[:, :3] = np.minimum(cells[:, :3] * gain[self.cell_object], 1.0)
        return replace(self, cell_values=cells, object_values=objects)

    def traceable(
        self, black: np.ndarray | None = None, extra: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[Geometry, CellMaterials]:
        """Build geometry and materials on the device; faces of `black` reflect nothing, those of `extra` come last, black."""
        material = self.materials()
        from iif_core.light.transport.geometry import build_geometry

        object_id = self.object_id if black is None else np.where(black, self.n_objects, self.object_id)
        passes = self.passes
        if extra is None:
            return build_geometry(self.vertices, self.faces, object_id, passes), material
        vertices = np.concatenate([self.vertices, extra[0]])
        faces = np.concatenate([self.faces, extra[1] + len(self.vertices)])
        object_id = np.concatenate([object_id, np.full(len(extra[1]), self.n_objects, np.int32)])
        passes = np.concatenate([passes, np.zeros(len(extra[1]), np.float32)])
        return build_geometry(vertices, faces, object_id, passes), material

    def materials(self) -> CellMaterials:
        """Build the materials on the device; an object of id `n_objects` is black."""
        device.mitsuba()
        from iif_core.light.transport.materials import CellMaterials

        grid = self.cell_edge, self.cell_origin, self.cell_ijk, self.cell_object
        return CellMaterials(*grid, self.cell_values, self._values_of_objects)

    def repainted(self, materials: CellMaterials) -> CellMaterials:
        """Return a copy of `materials`, which must be of the same cells, with the values of this scene."""
        return materials.repainted(self.cell_values, self._values_of_objects)

    @property
    def _values_of_objects(self) -> np.ndarray:
        return np.concatenate([self.object_values, np.float32([BLACK])])


def read_base_scene(job: Job) -> BaseScene:
    """Read the mesh with its base texture (`read_base`); the job needs capture, segmentation and base upstream."""
    capture, segmentation, base = CaptureReader(job.read("capture")), job.read("segmentation"), read_base(job)
    vertices, faces = capture.mesh()
    object_id = segmentation.table("faces.parquet")["object_id"].astype(np.int32)
    known = segmentation.table("objects.parquet")["object_id"]
    n_objects = int(max(object_id.max(initial=-1), known.max(initial=-1))) + 1
    cells, facts = base.table("cells.parquet", (*"ijk", "object_id", *CHANNELS)), base.json("base.json")
    means = base.table("objects.parquet")
    object_values = np.tile(np.float32(NEUTRAL), (n_objects, 1))
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
    return np.stack([table[name] for name in CHANNELS], 1).astype(np.float32)


@dataclass(frozen=True)
class ViewPixels:
    """The pixels of one view that hit the mesh, in reading order; n pixels.

    Attributes:
        index: (n,) into the flattened image.
        points, normals, wo: (n, 3) float32, metres and unit vectors; normals face the camera.
        face, object_id: (n,) int32; from_front: (n,) bool, the camera is on the side of the face normal.
        value: (n, 3) photograph; valid, interior: (n,) bool.
        number: (n,) uint32 of view and pixel, by which rays that start there draw their random numbers.
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
    number: np.ndarray

    def take(self, choice: np.ndarray) -> ViewPixels:
        """Return the chosen pixels."""
        return ViewPixels(**{name: array[choice] for name, array in self.__dict__.items()})


def sensor_bounds(value: np.ndarray, is_hdr: bool, saturation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sensor values limited to `saturation`, and a mask of those that are at it and thus only lower bounds.

    Radiance (`is_hdr`) has no upper limit and no bounds.
    """
    if is_hdr:
        return value, np.zeros(value.shape, bool)
    return np.minimum(value, saturation), value >= saturation


class DecodedView(NamedTuple):
    """Photograph, G-buffer and segmentation of a view as they are stored, (H, W) and (H, W, 3) arrays."""

    photo: np.ndarray
    valid: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    object_id: np.ndarray
    interior: np.ndarray


def decode_view(job: Job, capture: CaptureReader, view: View) -> DecodedView:
    """Read the three files of a view; the photograph of a held-out view is not read, and none of its pixels is valid."""
    if view.split == "test":
        photo, valid = np.zeros((view.height, view.width, 3), np.float32), np.zeros((view.height, view.width), bool)
    else:
        photo, valid = capture.photo(view)
    depth, face = capture.gbuffer(view)
    maps = job.read("segmentation").exr(f"maps/{view.name}.exr")
    return DecodedView(photo, valid, depth, face, ids_from_disk(maps["object.id"]), maps["interior"] > 0.5)


def view_pixels(
    job: Job,
    capture: CaptureReader,
    scene: BaseScene,
    view: View,
    decoded: DecodedView | None = None,
    among: np.ndarray | None = None,
) -> ViewPixels:
    """Collect the pixels of a view that hit the mesh; no pixel of a held-out view is valid.

    Args:
        job: with capture and segmentation upstream.
        capture: of the job.
        scene: mesh.
        view: of the capture.
        decoded: what the files of the view hold; None = read them.
        among: (H * W,) bool, pixels that may be collected; None = all.

    Returns:
        One row for each pixel that hits the mesh.
    """
    photo, valid, depth, face, object_id, interior = decoded or decode_view(job, capture, view)
    hit = (face.ravel() >= 0) & (depth.ravel() > 0)
    hit = np.flatnonzero(hit if among is None else hit & among)
    directions = view.directions().reshape(-1, 3)[hit]
    points = (view.world_from_camera[:3, 3] + depth.reshape(-1, 1)[hit] * directions).astype(np.float32)
    wo = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    face = face.ravel()[hit]
    normals = scene.normals[face].astype(np.float32)
    front = np.einsum("ij,ij->i", normals, wo) >= 0
    # Degenerate faces have no normal; the unit vector towards the camera takes its place.
    flat = np.einsum("ij,ij->i", normals, normals) < 0.5
    normals = np.where(flat[:, None], wo, np.where(front[:, None], normals, -normals)).astype(np.float32)
    value = photo.reshape(-1, 3)[hit]
    return ViewPixels(
        hit,
        points,
        normals,
        wo.astype(np.float32),
        face,
        object_id.ravel()[hit],
        front,
        value,
        valid.ravel()[hit] & np.isfinite(value).all(1),
        interior.ravel()[hit],
        ((hit + view.view_id * 0x9E3779B1) & 0xFFFFFFFF).astype(np.uint32),
    )


def base_maps(job: Job, view: View) -> np.ndarray:
    """Read the base albedo, roughness and metallic of a view, (H * W, 5) float32."""
    maps = read_base(job).exr(f"maps/{view.name}.exr")
    parts = [rgb(maps, "albedo"), maps["roughness"][..., None], maps["metallic"][..., None]]
    return np.concatenate(parts, -1).reshape(-1, 5).astype(np.float32)


def cache_origin(scene: BaseScene, edge: float) -> np.ndarray:
    """Return the corner (3,) of the radiance-cache grid, in metres."""
    return grid_origin(scene.vertices[scene.faces.ravel()], edge)


@dataclass(frozen=True)
class Light:
    """The light that stage emission estimated, per face.

    Attributes:
        radiance: (m, 3) linear.
        side: (m,) int8, side of the face that emits: +1 front, -1 back, 0 both.
        emits: (m,) bool.
        environment: (3,), or (H, W, 3) as in `iif_core.light.environment`.
    """

    radiance: np.ndarray
    side: np.ndarray
    emits: np.ndarray
    environment: np.ndarray

    def emitters(self, geometry: Geometry) -> Emitters:
        """Build the emitters on the device."""
        from iif_core.light.transport.emitters import Emitters

        return Emitters(geometry, self.radiance, self.side, self.environment)


def _read_light(job: Job, n_faces: int) -> Light:
    """The emitters that were kept, and the environment."""
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
    """Return (H, W, 3) where the stage wrote texels of environment emitters, else (3,), one radiance for all directions."""
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
    """Read the factors (n_objects, 3) on the base albedo that belong to the estimated light; the job needs emission upstream."""
    table = job.read("emission").table("object_gains.parquet")
    gain = np.ones((n_objects, 3), np.float32)
    gain[table["object_id"]] = np.stack([table[f"gain_{c}"] for c in "rgb"], 1)
    return gain


def read_lit_scene(job: Job) -> tuple[BaseScene, Light]:
    """Read the scene with what stage emission found: which surface lets light through, and the light. The job needs emission
    upstream."""
    scene, table = read_base_scene(job), job.read("emission").table("object_gains.parquet")
    share = np.zeros(scene.n_objects, np.float32)
    share[table["object_id"]] = table["transmittance"]
    return replace(scene, transmittance=share), _read_light(job, len(scene.faces))


def read_gains(job: Job) -> CameraGains:
    """Read exposure, white balance and vignetting of every view as stage emission used them; the job needs emission upstream."""
    facts = job.read("emission").json("emission.json")
    gain = np.asarray(facts["gain"], np.float64)
    return CameraGains(gain, np.asarray(facts["vignetting"], np.float64), np.ones(len(gain), bool))


def pixel_gains(gains: CameraGains, number: int, view: View, index: np.ndarray) -> np.ndarray:
    """Compute the factors on the radiance of some pixels.

    Args:
        gains: of all views of the capture.
        number: position of the view in the capture.
        view: its camera.
        index: (n,) flattened indices of the pixels.

    Returns:
        (n, 3) factors: exposure, white balance and vignetting.
    """
    return gains.factor(number, radius_squared(index, view.width, view.height))


def read_radiance_cache(job: Job, scale: float = 1.0) -> RadianceCache:
    """Read the radiance cache, its radiance times `scale`, onto the device; voxels that only saturated pixels show are in it."""
    from iif_core.light.transport.cache import RadianceCache

    reader = job.read("emission")
    table, facts = reader.table("radiance_cache.parquet"), reader.json("emission.json")
    ijk = np.stack([table[c] for c in "ijk"], 1).astype(np.int32)
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float32) * np.float32(scale)
    return RadianceCache(facts["cache_edge_m"], np.asarray(facts["cache_origin"], np.float32), ijk, radiance)
