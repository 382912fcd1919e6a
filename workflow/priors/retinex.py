"""Prior `retinex`: a baseline without learned weights (docs/method/priors.md#retinex).

It divides the photograph by the irradiance that the other photographs imply, then applies colour retinex.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace

import numpy as np

from iif_core.light.irradiance import LightField, SurfaceCellsBuilder, Trace, estimate_log_light
from iif_core.priors.retinex import albedo_level, retinex_predictions
from iif_core.surface.triangles import face_geometry
from workflow.runtime import device
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.photograph import GAMMA
from workflow.segmentations.geometry import pieces
from workflow.segmentations.surface import Surface

SATURATED = 0.99  # sensor value
CELL_FOOTPRINTS = 6.0  # edge of a surface cell in median pixel footprints
REACHES = (3.0, 8.0)
"""Reach of the residual light in edges of a cell (Eq. L.58); each makes one version of the light."""
PIECES = SimpleNamespace(scale=0.05, min_faces=100, min_area=0.01, colour=0.1)
"""Pieces of the mesh take the place of objects where the capture names none (the defaults of segmentation `geometry`)."""


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """Make K predictions of a view; the light is estimated once, from all views that are not held out.

    Args:
        view: of the capture.
        settings: what stage `prior` may read (sections `prior` and `source`).
        capture: the normal form.
        seed: of the random numbers.

    Returns:
        (K, H, W, 5) float32, linear albedo, perceptual roughness, metallic.
    """
    scene = _scene(capture, settings.prior.mean_albedo, seed)
    pixels = _pixels(view, capture, scene.normals, scene.group)
    log_light = np.zeros((len(REACHES), view.height * view.width, 3))
    hit = pixels.hit.ravel()
    if hit.any() and scene.field is not None:
        row, weight = scene.field.weights(pixels.points.reshape(-1, 3)[hit], pixels.normals.reshape(-1, 3)[hit])
        for number, light in enumerate(scene.log_light):
            log_light[number, hit] = (weight[..., None] * light[row]).sum(1) + np.log(pixels.exposure)
            log_light[number, ~hit] = log_light[number, hit].mean(0)
    log_light = log_light.reshape(len(REACHES), view.height, view.width, 3)
    return retinex_predictions(
        pixels.linear,
        settings.prior.samples,
        settings.prior.mean_albedo,
        pixels.group,
        pixels.normals,
        pixels.valid & ~pixels.saturated,
        log_light if scene.field is not None else None,
        seed,
    )


@dataclass(frozen=True)
class _Scene:
    """Faces and light.

    Attributes:
        normals: (m, 3) of the faces.
        group: (m,) object of each face.
        field: interpolates between the cells; None without cells.
        log_light: (len(REACHES), cells, 3) versions of the log-irradiance, scaled to the mean albedo.
    """

    normals: np.ndarray
    group: np.ndarray
    field: LightField | None
    log_light: np.ndarray


@dataclass(frozen=True)
class _Pixels:
    """One view, (H, W) each: the photograph as radiance x exposure, and points, normals and objects of the mesh."""

    linear: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    hit: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    group: np.ndarray
    exposure: float


def _pixels(view: View, capture: CaptureReader, face_normals: np.ndarray, face_group: np.ndarray) -> _Pixels:
    photo, valid = capture.photo(view)
    saturated = np.zeros(photo.shape[:2], bool)
    if not capture.is_hdr:
        saturated = photo.max(-1) >= SATURATED
        photo = np.clip(photo, 0, 1) ** GAMMA
    depth, face = capture.gbuffer(view)
    hit = (face >= 0) & (depth > 0)
    normals = np.where(hit[..., None], face_normals[face], 0)
    directions = view.directions()
    # A face without area has no normal; the unit vector towards the camera takes its place.
    towards = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    normals = np.where(((normals**2).sum(-1, keepdims=True) < 0.5) & hit[..., None], towards, normals)
    normals = np.where((normals * towards).sum(-1, keepdims=True) < 0, -normals, normals)
    group = capture.given_instances(view)
    if group is None:
        group = np.where(hit, face_group[face], -1)
    exposure = 1.0 if capture.is_hdr or not view.exposure > 1e-6 else float(view.exposure)
    return _Pixels(photo, valid, saturated, hit, capture.points(view, depth), normals, group, exposure)


@lru_cache(1)
def _scene(capture: CaptureReader, mean_albedo: float, seed: int) -> _Scene:
    """Estimate the light on the surface cells from every view that is not held out."""
    vertices, faces = capture.mesh()
    normals, _ = face_geometry(vertices, faces)
    group = _groups(capture)
    views = capture.used
    footprints = []
    for view in views:
        depth, face = capture.gbuffer(view)
        seen = (face >= 0) & (depth > 0)
        if seen.any():
            footprints.append(float(np.median(depth[seen])) / view.fx)
    if not footprints:
        return _Scene(normals, group, None, np.zeros((len(REACHES), 0, 3)))
    builder = SurfaceCellsBuilder(vertices[faces.ravel()], CELL_FOOTPRINTS * float(np.median(footprints)))
    for view in views:
        pixels = _pixels(view, capture, normals, group)
        use = pixels.hit & pixels.valid & np.isfinite(pixels.linear).all(-1)
        value = pixels.linear[use] / pixels.exposure
        builder.add(pixels.points[use], pixels.normals[use], pixels.group[use], value, pixels.saturated[use], pixels.exposure)
    cells = builder.finish()
    if not len(cells):
        return _Scene(normals, group, None, np.zeros((len(REACHES), 0, 3)))
    light = estimate_log_light(cells, _tracer(vertices, faces), mean_albedo, REACHES, seed)
    levels = [albedo_level(np.exp(cells.log_radiance - own), cells.pixels, mean_albedo) for own in light]
    return _Scene(normals, group, LightField(cells), light - np.log(levels)[:, None, None])


def _groups(capture: CaptureReader) -> np.ndarray:
    """Return the object (m,) of each face as the capture gives it, else pieces of the mesh."""
    given = capture.faces()["instance_id"].astype(np.int64)
    if (given >= 0).any():
        return given
    return pieces(Surface(capture), PIECES).astype(np.int64)


def _tracer(vertices: np.ndarray, faces: np.ndarray) -> Trace:
    device.mitsuba()
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry = build_geometry(vertices, faces, np.full(len(faces), -1, np.int32))
    return lambda origins, directions: trace(geometry, origins, directions)
