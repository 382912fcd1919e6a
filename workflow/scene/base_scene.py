"""Mesh, base materials and pixels as the light-transport stages (emission, shading, affines) need them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.response import SATURATION
from iif_core.light.base_scene import BaseScene, Light
from iif_core.reflectance.material import CHANNELS, NEUTRAL
from iif_core.surface.triangles import face_geometry
from workflow.artifacts.store import StageReader, rgb
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache

SECOND_LOOK = "second_look.json"
"""Says whether stage second_look made its own base."""


def read_base(job: Job) -> StageReader:
    """Return the base texture that a stage starts from: the texture of the second look, if one was made before the stage."""
    if "second_look" in job.stage.upstream:
        again = job.read("second_look")
        if again.json(SECOND_LOOK)["made"]:
            return again
    return job.read("base")


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
        made_up=made_up_objects(object_id, n_objects, int(capture.facts.get("added_faces", 0))),
        vertices=vertices,
        faces=faces,
        object_id=object_id,
        normals=normals,
        areas=areas,
        n_objects=n_objects,
        cell_edge=float(facts["cell_edge_m"]),
        cell_origin=np.asarray(facts["origin"], np.float32),
        cell_ijk=np.stack([cells[c] for c in "ijk"], 1).astype(np.int32),
        cell_object=cells["object_id"].astype(np.int32),
        cell_values=_rows(cells),
        object_values=object_values,
    )


def made_up_objects(object_id: np.ndarray, n_objects: int, added: int) -> np.ndarray:
    """Return (n_objects,) bool, the objects of which all faces are among the `added` last ones, which the capture built around a
    scan (`source.close`); `object_id`: (F,) of the faces."""
    made_up = np.zeros(n_objects + 1, bool)  # the last entry is for faces without an object, -1
    made_up[object_id[len(object_id) - added :]] = True
    made_up[object_id[: len(object_id) - added]] = False
    return made_up[:-1]


def _rows(table: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([table[name] for name in CHANNELS], 1).astype(np.float32)


def sensor_bounds(value: np.ndarray, is_hdr: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return sensor values limited to SATURATION, and a mask of those that are at it and thus only lower bounds.

    Radiance (`is_hdr`) has no upper limit and no bounds.
    """
    if is_hdr:
        return value, np.zeros(value.shape, bool)
    return np.minimum(value, SATURATION), value >= SATURATION


def base_maps(job: Job, view: View) -> np.ndarray:
    """Read the base albedo, roughness and metallic of a view, (H * W, 5) float32."""
    return base_channels(read_base(job).exr(f"maps/{view.name}.exr"))


def base_channels(maps: dict[str, np.ndarray]) -> np.ndarray:
    """Return albedo, roughness and metallic of maps of stage base, (H * W, 5) float32."""
    parts = [rgb(maps, "albedo"), maps["roughness"][..., None], maps["metallic"][..., None]]
    return np.concatenate(parts, -1).reshape(-1, 5).astype(np.float32)


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


def read_environment_seen(job: Job) -> np.ndarray | None:
    """Return (H, W) bool, the texels of the environment of which a photograph shows something; None where it has no texels. The
    job needs emission upstream."""
    reader = job.read("emission")
    if not reader.has("environment_texels.parquet"):
        return None
    texels, emitters = reader.table("environment_texels.parquet"), reader.table("emitters.parquet")
    seen = emitters["emitter_id"][(emitters["kind"] == "environment") & (emitters["observations"] > 0)]
    out = np.zeros([int(texels[c].max(initial=0)) + 1 for c in ("row", "column")], bool)
    out[texels["row"], texels["column"]] = np.isin(texels["emitter_id"], seen)
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


def read_radiance_cache(job: Job, scale: float = 1.0) -> RadianceCache:
    """Read the radiance cache, its radiance times `scale`, onto the device; voxels that only saturated pixels show are in it."""
    from iif_core.light.transport.cache import RadianceCache

    reader = job.read("emission")
    table, facts = reader.table("radiance_cache.parquet"), reader.json("emission.json")
    ijk = np.stack([table[c] for c in "ijk"], 1).astype(np.int32)
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float32) * np.float32(scale)
    return RadianceCache(facts["cache_edge_m"], np.asarray(facts["cache_origin"], np.float32), ijk, radiance)
