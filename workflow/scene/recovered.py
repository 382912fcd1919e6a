"""The recovered scene, assembled from the artefacts of several stages; render, export and report start from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response, response, sampled_response
from iif_core.errors import InputError
from iif_core.light.base_scene import BaseScene, Light
from iif_core.reflectance.material import CHANNELS, IDENTITY, apply_affines
from workflow.artifacts.store import StageReader
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base, read_lit_scene
from workflow.scene.named import shown_names


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """Geometry, fitted materials and light; ids are int32 with -1 = none, lengths metres, colours linear.

    Attributes:
        surface: mesh and cells with the *fitted* materials.
        object_names: one per object id.
        cell_centres: (c, 3) float32.
        light: per face, with the light scale.
        emitter_id: (m,) kept emitter of each face.
        emitter_radiance: (emitters, 3) per emitter id, with the light scale; 0 for dropped ones and environments.
        emitter_names: per emitter id, for people.
        light_scale: factor on the radiance of stage emission that makes it consistent with the fitted albedo.
    """

    surface: BaseScene
    object_names: list[str]
    cell_centres: np.ndarray
    light: Light
    emitter_id: np.ndarray
    emitter_radiance: np.ndarray
    emitter_names: list[str]
    light_scale: float

    def emission_map(self, face_id: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """Return the radiance (H, W, 3) float32 that the faces `face_id` (H, W), -1 = miss, emit towards `eye` (3,)."""
        emits = (self.light.side == 0) | (self.light.side == self.surface.facing(eye))
        radiance = np.where(emits[:, None], self.light.radiance, 0)
        return np.where((face_id >= 0)[..., None], radiance[face_id], 0).astype(np.float32)


def read_recovered(job: Job) -> Recovered:
    """Read the scene that stage affines wrote; the job needs capture, segmentation, base, emission and affines upstream.

    Raises:
        InputError: the cells of affines are not those of base.
    """
    base, light = read_lit_scene(job)
    affines, emission = job.read("affines"), job.read("emission")
    names = shown_names(job, base.n_objects)
    cells = read_base(job).table("cells.parquet", ("cell_id", *"xyz"))
    fitted = affines.table("cells.parquet", ("cell_id", *CHANNELS))
    if not np.array_equal(cells["cell_id"], fitted["cell_id"]):
        raise InputError(
            f"{affines.directory / 'cells.parquet'}: {len(fitted['cell_id'])} cells that are not the"
            f" {len(cells['cell_id'])} of base/cells.parquet; rebuild with --forcerun affines"
        )
    object_values = base.object_values
    if base.n_objects:
        each = np.arange(base.n_objects)
        object_values = apply_affines(read_affines(affines, base.n_objects), each, object_values).astype(np.float32)
    cell_values = np.stack([fitted[name] for name in CHANNELS], 1).astype(np.float32)
    scale = float(affines.json("affines.json").get("light_scale", 1.0)) if affines.has("affines.json") else 1.0
    light = replace(light, radiance=light.radiance * np.float32(scale), environment=light.environment * np.float32(scale))
    emitters, emitter_id = emission.table("emitters.parquet"), emitter_of_faces(job, light)
    radiance = np.zeros((int(emitters["emitter_id"].max(initial=-1)) + 1, 3), np.float32)
    radiance[emitter_id[light.emits]] = light.radiance[light.emits]
    return Recovered(
        surface=replace(base, cell_values=cell_values, object_values=object_values),
        object_names=names,
        cell_centres=np.stack([cells[c] for c in "xyz"], 1).astype(np.float32),
        light=light,
        emitter_id=emitter_id,
        emitter_radiance=radiance,
        emitter_names=emitters["name"].tolist(),
        light_scale=scale,
    )


def emitter_of_faces(job: Job, light: Light) -> np.ndarray:
    """Return the kept emitter of every face, (m,) int32, -1 = none; the job needs emission upstream."""
    faces = job.read("emission").table("emitter_faces.parquet")
    shines = light.emits[faces["face_id"]]
    emitter_id = np.full(len(light.emits), -1, np.int32)
    emitter_id[faces["face_id"][shines]] = faces["emitter_id"][shines]
    return emitter_id


def read_affines(reader: StageReader, n_objects: int) -> np.ndarray:
    """Read (objects, 16) float64 [T_albedo row by row, T_roughness, T_metallic]; identity where the table has no row."""
    table = reader.table("objects.parquet")
    out = np.tile(IDENTITY, (n_objects, 1))
    out[table["object_id"]] = np.concatenate([table[name] for name in ("T_albedo", "T_roughness", "T_metallic")], 1)
    return out


RESPONSE_SAMPLES = 101


def write_response(job: Job, curve: Response) -> None:
    """Write camera_response.parquet: parameters (x = 0) and samples of f on [0, 1] for each channel."""
    x = np.linspace(0.0, 1.0, RESPONSE_SAMPLES)
    rows: list[tuple[str, str, str, float, float]] = []
    for number, channel in enumerate("RGB"):
        own = curve.channel(number)
        rows += [(channel, "parameter", name, 0.0, float(v)) for name, v in zip(own.names, own.params, strict=True)]
        rows += [(channel, "sample", "", float(at), float(v)) for at, v in zip(x, own(x), strict=True)]
    names = ("channel", "kind", "name", "x", "value")
    job.writer.table("camera_response.parquet", {name: list(c) for name, c in zip(names, zip(*rows, strict=True), strict=True)})


def read_response(reader: StageReader) -> Response:
    """Read the camera response that stage affines estimated, from its samples; identity when it wrote none (HDR)."""
    name = "camera_response.parquet"
    if not reader.has(name):
        return response("identity")
    x, curves = response_samples(reader.table(name))
    return sampled_response(x, curves) if len(x) else response("identity")


def response_samples(table: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return x (S,) and f(x) (3, S), channels R G B, of a camera_response table; empty when it holds parameters only.

    Raises:
        InputError: the channels are sampled at different x.
    """
    rows = np.flatnonzero((table["kind"] == "sample") & (table["x"] >= 0) & (table["x"] <= 1))
    if not len(rows):
        return np.zeros(0), np.zeros((3, 0))
    channel, x, value = (table[c][rows] for c in ("channel", "x", "value"))
    channel = np.char.lower(channel.astype(str))
    curves = []
    for c in "rgb":
        own = np.flatnonzero(channel == c)
        own = own[np.argsort(x[own])]
        curves.append((x[own], value[own]))
    grid = curves[0][0]
    if not len(grid) or not all(np.array_equal(other, grid) for other, _ in curves):
        raise InputError(
            "camera_response.parquet: channels r, g, b must be sampled at the same x; rebuild with --forcerun affines"
        )
    return grid, np.stack([y for _, y in curves])
