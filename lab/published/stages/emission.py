"""Stage emission as published: every bright triangle is an emitter, and a descent on fresh paths finds its radiance
(lab/docs/published.md#emission).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.calibration.choice import calibration_facts, given_response
from iif_core.camera.gains import CameraGains
from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.response import Response, response, response_facts
from iif_core.errors import InputError
from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.cache import RadianceVoxels, VoxelPixels
from lab.published.light.descent import (
    THRESHOLD,
    PublishedOptions,
    PublishedState,
    bounding_cube,
    bright_triangles,
    clamped_loss,
    descend,
)
from lab.published.state import keep_state, kept_state
from workflow.decisions import light as decisions
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base_scene
from workflow.scene.decoded import DecodedViews
from workflow.scene.emission_views import gain_plan, view_exposures
from workflow.scene.light_files import emitter_columns, write_light
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from lab.published.light.single_bounce import BouncePaths

REPAIRED = "published_repaired"
SATURATED_SHARE = 0.5
"""With `published_repaired` a triangle is an emitter if more than this share of the pixels that show it are saturated."""
_SEEDS = 0x707562  # keeps the random streams of this stage apart from those of others
_SAVED_EVERY = 50
"""Steps after which the state is written, so that a job that is killed loses little."""


@dataclass(frozen=True)
class _Pool:
    """Pixels that the descent draws from: number of the view (n,), flattened index (n,), sensor values (n, 3) of all photographs,
    and cameras and exposures of the views."""

    view: np.ndarray
    index: np.ndarray
    value: np.ndarray
    views: list[View]
    exposure: np.ndarray

    def rays(self, rows: np.ndarray, normalise: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return origins, directions and their changes to the next pixel on the right and below, (n, 3) each.

        normalise: make the directions of unit length, and not the changes, as published."""
        of = self.view[rows]
        pose = np.stack([view.world_from_camera for view in self.views])[of]
        fx, fy, cx, cy = (np.array([getattr(view, name) for view in self.views])[of] for name in ("fx", "fy", "cx", "cy"))
        width = np.array([view.width for view in self.views])[of]
        column, row = self.index[rows] % width, self.index[rows] // width
        camera = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(len(rows))], 1)
        direction = np.einsum("nij,nj->ni", pose[:, :3, :3], camera)
        if normalise:
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        steps = [direction_derivatives(view.fx, view.fy, view.world_from_camera) for view in self.views]
        right, down = (np.stack([step[axis] for step in steps])[of] for axis in range(2))
        return pose[:, :3, 3], direction, right, down


def run(job: Job) -> None:
    """Write the files of stage emission.

    Raises:
        InputError: the photographs are linear, which the published loss does not know, or their exposures are not known.
    """
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    if capture.is_hdr:
        raise InputError(
            f"emission.solver: {job.settings.emission.solver}: the published loss is for 8-bit photographs, and these are"
            " linear; set `capture: {dynamic_range: ldr}` or another solver"
        )
    if capture.facts.get("exposure_estimated"):
        raise InputError(
            f"emission.solver: {job.settings.emission.solver}: the published method needs known exposures, and those of this"
            " capture were estimated; give them with the photographs, or set another solver"
        )
    notes: list[str] = []
    gains, curve = view_exposures(capture, notes), _mean_curve(job)
    number = {view.view_id: place for place, view in enumerate(capture.views)}
    exposure = gains.gain[[number[view.view_id] for view in capture.used], 0]
    pool, cache, shine, count = _read(job, capture, scene, exposure, curve)
    emitter_of_face = np.full(len(scene.faces), -1, np.int32)
    emitter_of_face[shine] = np.arange(shine.sum())
    job.log.info("%d of %d triangles are brighter than %.2f", shine.sum(), len(shine), THRESHOLD)
    state = _descended(job, scene, pool, cache, emitter_of_face, curve)
    _write(job, scene, state, cache, emitter_of_face, count)
    _write_facts(job, capture, state, cache, (gains, curve), notes)


def _mean_curve(job: Job) -> Response:
    """Return the curve that stands for the mean response of the published basis."""
    family = job.settings.affines.response
    return response("ggcm" if family == "auto" else family)


def _read(
    job: Job, capture: CaptureReader, scene: BaseScene, exposure: np.ndarray, curve: Response
) -> tuple[_Pool, RadianceVoxels, np.ndarray, np.ndarray]:
    """Read all photographs: the pixels of the descent, the radiance cache, which triangles are emitters (F,) bool, and how many
    pixels show each (F,)."""
    views, faces = capture.used, len(scene.faces)
    low, high = np.inf, -np.inf
    for view in views:
        points = DecodedViews(capture, job.read("segmentation"), 0).pixels(view, scene.normals).points
        low, high = min(low, float(points.min(initial=np.inf))), max(high, float(points.max(initial=-np.inf)))
    corner, edge = bounding_cube(low, high) if np.isfinite(low) else (0.0, 1.0)
    total, count = np.zeros((faces, 3)), np.zeros(faces)
    lit: list[tuple[np.ndarray, np.ndarray]] = []
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number, view in enumerate(views):
        pixels = DecodedViews(capture, job.read("segmentation"), 0).pixels(view, scene.normals)
        pixels = pixels.take(np.flatnonzero(pixels.valid))
        shown = np.clip(pixels.value, 0, 1)
        radiance = curve.inverse(shown) / exposure[number]
        finite = np.isfinite(radiance).all(1)
        lit.append((pixels.points[finite], radiance[finite]))
        tested = shown > THRESHOLD if job.settings.emission.solver == REPAIRED else radiance
        total += np.stack([np.bincount(pixels.face, tested[:, c], faces) for c in range(3)], 1)
        count += np.bincount(pixels.face, minlength=faces)
        parts.append((np.full(len(shown), number, np.int16), pixels.index.astype(np.int32), pixels.value.astype(np.float32)))
        job.progress(number + 1, len(views), "views read")
    joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
    pool = _Pool(joined[0], joined[1], joined[2], views, exposure)
    limit = SATURATED_SHARE if job.settings.emission.solver == REPAIRED else THRESHOLD
    points, radiance = (np.concatenate(part) for part in zip(*lit, strict=True))
    voxels = VoxelPixels.of(edge, np.full(3, corner, np.float32), points, radiance, np.zeros(len(points), bool))
    cache = voxels.cache(np.ones(len(points), bool))
    return pool, cache, bright_triangles(total / np.maximum(count, 1)[:, None], count, limit), count


def _descended(
    job: Job, scene: BaseScene, pool: _Pool, cache: RadianceVoxels, emitter_of_face: np.ndarray, curve: Response
) -> PublishedState:
    """Run the descent, from where an earlier run of the same job was killed."""
    count = int(emitter_of_face.max(initial=-1)) + 1
    options = PublishedOptions(steps=job.settings.emission.iterations, seed=job.seed)
    state, kept = PublishedState.start(count), kept_state(job.writer, "descent")
    if kept is not None:
        state = PublishedState(**kept[0], step=kept[1]["step"], loss=tuple(kept[1]["loss"]))
    steps = options.total(len(pool.index))
    if count:
        trace = _tracer(job, scene, pool, cache, emitter_of_face)

        def loss(rows: np.ndarray, radiance: np.ndarray) -> tuple[float, np.ndarray]:
            return clamped_loss(radiance, pool.exposure[pool.view[rows]], pool.value[rows], curve)

        for moved in descend(state, len(pool.index), trace, loss, options):
            state = moved
            job.progress(state.step, steps, "steps of the descent")
            if state.step % _SAVED_EVERY == 0 and state.step < steps:
                _save(job, state)
    return state


def _save(job: Job, state: PublishedState) -> None:
    arrays = {name: getattr(state, name) for name in ("stored", "keep", "sampling")}
    keep_state(job.writer, "descent", arrays, {"step": state.step, "loss": list(state.loss)})


def _tracer(
    job: Job, scene: BaseScene, pool: _Pool, cache: RadianceVoxels, emitter_of_face: np.ndarray
) -> Callable[[np.ndarray, PublishedState, int], BouncePaths]:
    """Return what traces the pixels of a step: emitters that are switched off are surface again."""
    device.mitsuba()
    geometry, material = scene.traceable()
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.scene import PathOptions, Scene
    from lab.published.light.single_bounce import trace_bounce

    voxels = RadianceCache(cache.edge, cache.origin, cache.ijk, cache.radiance)
    repaired, own = job.settings.emission.solver == REPAIRED, np.flatnonzero(emitter_of_face >= 0)
    worlds: dict[bytes, tuple[Scene, np.ndarray]] = {}

    def trace(rows: np.ndarray, state: PublishedState, step: int) -> BouncePaths:
        key = state.keep.tobytes() + state.sampling.tobytes()  # the table changes at two steps alone
        if key not in worlds:
            worlds.clear()
            weight, number = np.zeros(len(emitter_of_face)), emitter_of_face.copy()
            weight[own] = np.where(state.keep, state.sampling, 0.0)[emitter_of_face[own]]
            number[own] = np.where(state.keep[emitter_of_face[own]], emitter_of_face[own], -1)
            dark = np.zeros((len(weight), 3))
            worlds[key] = Scene(geometry, material, Emitters(geometry, dark, sampling_weight=weight), voxels), number
        world, number = worlds[key]
        origin, direction, right, down = pool.rays(rows, normalise=not repaired)
        paths = PathOptions(job.settings.emission.samples, 1, ((job.seed << 32) | _SEEDS) << 32 | step)
        return trace_bounce(world, number, origin, direction, (right, down), paths, mixed_measures=not repaired)

    return trace


def _write(
    job: Job, scene: BaseScene, state: PublishedState, cache: RadianceVoxels, emitter_of_face: np.ndarray, count: np.ndarray
) -> None:
    face, n = np.flatnonzero(emitter_of_face >= 0), len(state.keep)
    table = emitter_columns(
        faces=np.ones(n),
        area=scene.areas[face],
        radiance=state.radiance,
        error=np.zeros((n, 3)),
        observations=count[face],
        kept=state.keep,
        reason=["" if keep else "switched off by the schedule" for keep in state.keep],
    )
    gain, transmittance = np.ones((scene.n_objects, 3)), np.zeros(scene.n_objects)
    write_light(job, table, face, emitter_of_face[face], np.zeros(n), gain, transmittance, cache)


def _write_facts(
    job: Job,
    capture: CaptureReader,
    state: PublishedState,
    cache: RadianceVoxels,
    camera: tuple[CameraGains, Response],
    notes: list[str],
) -> None:
    gains, curve = camera
    found = given_response(_by_channel(curve), "published: the mean curve", gains.exposure)
    kept = int(state.keep.sum())
    if not kept:
        notes.append("no triangle is bright enough: light comes from the radiance cache alone, re-renderings will be dark")
    size = found.response.params.size
    calibration = {**calibration_facts(found), "covariance": np.eye(size).tolist()}
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": cache.edge,
            "cache_origin": [float(x) for x in cache.origin],
            "solver": job.settings.emission.solver,
            "steps": state.step,
            "loss": [float(np.mean(part)) for part in np.array_split(np.array(state.loss), 50) if len(part)],
            "level_error": 0.0,
            "level_raised": 0.0,
            "escape_share": {"primary": 0.0, "secondary": 0.0},
            "threshold": THRESHOLD,
            "exposure": gains.exposure.tolist(),
            "gain": gains.gain.tolist(),
            "vignetting": gains.vignetting.tolist(),
            "response": {**response_facts(found.response), "calibration": calibration},
            "plan": [*gain_plan(capture, gains), decisions.emitters(kept, len(state.keep) - kept, len(state.keep))],
            "notes": notes,
        },
    )


def _by_channel(curve: Response) -> Response:
    return curve.with_params(np.tile(curve.params, (3, 1))) if curve.names else curve
