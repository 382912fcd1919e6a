"""Stage relit_truth: the source of a scene with truth, rendered under new light (lab/docs/evaluation.md#relighting)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.light.relighting import frame_times
from lab.relit.lamps import Lamp
from lab.relit.measures import exposure_of
from lab.relit.new_light import Ball, NewLight, source_lamps
from lab.relit.sources import open_room
from workflow.artifacts.store import split_rgb
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

_SEEDS = 0x72656C74  # keeps the random streams of this stage apart from those of others
SPHERE_RADIANCE = (53.0, 50.0, 45.0)
"""Of the glowing sphere, the default of relightings."""
SPHERE_SIZE = 0.05
"""Its radius, as a share of the median distance of the surface that the views see."""
CLEARANCE = 5.0
"""Radii that its path keeps away from the cameras of the pictures."""
MOVE = 0.5
"""Metres by which the strongest lamp is moved, towards the middle of the cameras."""
OPEN = 1e-3
"""Mean radiance in the room, as a share of that outside, below which the room has no opening: what comes in are cracks."""


@dataclass(frozen=True)
class _Setup:
    """What decides which lights there are."""

    lamps: list[Lamp]
    views: list[View]
    others: list[View]
    distance: float


def run(job: Job) -> None:
    """Write lights.json and <light>/<view>.exr: radiance R G B, the same with other random numbers (`again`), `valid`."""
    capture, wanted = CaptureReader(job.read("capture")), job.settings.relit
    if not capture.has_truth:
        raise InputError(f"scene {job.scene}: no ground truth, so nothing to compare a relighting with")
    if wanted.denoise:
        require_denoiser()
    setup = _setup(capture, wanted.views)
    room = open_room(job, capture)
    lights, left_out = _lights(job, capture, setup)
    normals = _normals(capture)
    done, kept = 0, []
    for number, light in enumerate(lights):
        pictures = []
        for view in setup.views:
            job.progress(done, len(lights) * len(setup.views), "pictures of the source under new light")
            done += 1
            truth = capture.truth(view)
            face_id = capture.gbuffer(view)[1]
            images = []
            for again in (0, 1):
                seed = np.random.SeedSequence([job.seed, _SEEDS, number, view.view_id, again]).generate_state(1)[0]
                image, valid = room.relit(light, view, wanted.samples, wanted.max_bounces, int(seed))
                if wanted.denoise and image.any():  # the denoiser makes a faint haze of black
                    image = denoise(image, truth.albedo, _seen_normals(normals, face_id, view))
                images.append(image.astype(np.float32))
            mask = valid & truth.valid & (face_id >= 0)
            if light.shift is not None:  # what the lamp hid has no truth: the denoiser's guides show the lamp there
                mask &= ~np.isin(face_id, next(lamp.faces for lamp in setup.lamps if lamp.lamp == light.lamp))
            pictures.append((view, images, mask))
        reason = _useless(light, setup, [(images[0], mask) for _, images, mask in pictures])
        if reason:
            left_out.append({"light": light.name, "reason": reason})
            job.log.info("%s: %s", light.name, reason)
            continue
        exposure = exposure_of([images[0] for _, images, _ in pictures], [mask for _, _, mask in pictures])
        for view, images, mask in pictures:
            channels = {**split_rgb(images[0]), **split_rgb(images[1], "again"), "valid": mask}
            job.writer.exr(f"{light.name}/{view.name}.exr", channels, "relative")
        kept.append({**light.document(), "exposure": exposure})
    job.progress(done, done, "pictures of the source under new light")
    total = sum(lamp.power for lamp in setup.lamps)
    job.writer.json(
        "lights.json",
        {
            "lights": kept,
            "left_out": left_out,
            "views": [view.name for view in setup.views],
            "lamps": [
                {
                    "lamp": lamp.lamp,
                    "name": lamp.name,
                    "faces": len(lamp.faces),
                    "area_m2": lamp.area,
                    "centre": lamp.centre.tolist(),
                    "share_of_power": lamp.power / total if total else 0.0,
                }
                for lamp in setup.lamps
            ],
        },
    )


def _setup(capture: CaptureReader, count: int) -> _Setup:
    places = np.unique(np.linspace(0, len(capture.views) - 1, min(count, len(capture.views))).round().astype(int))
    views = [capture.views[place] for place in places]
    depths = [depth[depth > 0] for depth in (capture.gbuffer(view)[0] for view in views)]
    seen = np.concatenate(depths)
    others = [view for view in capture.views if view not in views]
    return _Setup(source_lamps(capture), views, others, float(np.median(seen)) if len(seen) else 1.0)


def _lights(job: Job, capture: CaptureReader, setup: _Setup) -> tuple[list[NewLight], list[dict[str, str]]]:
    """Return the lights that are asked for, and those that cannot be had with the reason."""
    wanted, lights, left_out = job.settings.relit, [], []
    for place, lamp in enumerate(setup.lamps):
        if place < wanted.lamps:
            lights.append(NewLight(f"lamp{lamp.lamp}", "lamp", lamp.lamp))
        else:
            left_out.append({"light": f"lamp{lamp.lamp}", "reason": f"only the {wanted.lamps} strongest shine alone"})
    if not setup.lamps:
        left_out.append({"light": "lamps", "reason": "the source has none on its mesh"})
    if wanted.moved and setup.lamps:
        strongest = setup.lamps[0]
        way = np.mean([view.world_from_camera[:3, 3] for view in capture.views], 0) - strongest.centre
        way *= MOVE / max(float(np.linalg.norm(way)), 1e-9)
        lights.append(NewLight(f"moved{strongest.lamp}", "moved", strongest.lamp, shift=tuple(way.tolist())))
    if wanted.environment is not None:
        lights.append(NewLight("environment", "environment", environment=tuple(wanted.environment)))
    path = _path(capture, setup) if wanted.spheres else None
    if wanted.spheres and path is None:
        left_out.append({"light": "sphere", "reason": "no free path between cameras that keeps away from those of the pictures"})
    if path is not None:
        for frame, time in enumerate(frame_times(wanted.spheres)):
            centre = path[0] + time * (path[1] - path[0])
            ball = Ball(tuple(centre.tolist()), SPHERE_SIZE * setup.distance, SPHERE_RADIANCE)
            lights.append(NewLight(f"sphere{frame}", "sphere", ball=ball))
    return lights, left_out


def _path(capture: CaptureReader, setup: _Setup) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the two farthest camera positions between which nothing stands and no camera of the pictures is near."""
    from iif_core.light.transport.geometry import build_geometry, trace

    vertices, faces = capture.mesh()
    geometry = build_geometry(vertices, faces, np.zeros(len(faces), np.int32))
    spots = np.array([view.world_from_camera[:3, 3] for view in setup.others]).reshape(-1, 3)
    eyes = np.array([view.world_from_camera[:3, 3] for view in setup.views])
    if len(spots) < 2:
        return None
    first, second = np.triu_indices(len(spots), 1)
    start, way = spots[first], spots[second] - spots[first]
    length = np.linalg.norm(way, axis=1)
    along = np.clip(((eyes[None] - start[:, None]) * way[:, None]).sum(-1) / np.maximum(length**2, 1e-12)[:, None], 0, 1)
    nearest = np.linalg.norm(start[:, None] + along[..., None] * way[:, None] - eyes[None], axis=-1).min(1)
    usable = (nearest > CLEARANCE * SPHERE_SIZE * setup.distance) & (length > 0)
    if not usable.any():
        return None
    first, second, way, length = first[usable], second[usable], way[usable], length[usable]
    hit, t = trace(geometry, spots[first], way / length[:, None])
    free = (hit < 0) | (t > length)
    if not free.any():
        return None
    best = int(np.argmax(np.where(free, length, -1)))
    return spots[first[best]], spots[second[best]]


def _useless(light: NewLight, setup: _Setup, pictures: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """Return why the pictures under a light say nothing; empty if they do."""
    seen = [image[mask] for image, mask in pictures if mask.any()]
    mean = float(np.concatenate(seen).mean()) if seen else 0.0
    if light.kind == "environment":
        own = max(light.environment or (0.0,))
        return "the room has no opening that lets it in" if mean < OPEN * own else ""
    return "no light of it reaches what the views see" if mean <= 0 else ""


def _normals(capture: CaptureReader) -> np.ndarray:
    from iif_core.surface.triangles import face_geometry

    return face_geometry(*capture.mesh())[0]


def _seen_normals(normals: np.ndarray, face_id: np.ndarray, view: View) -> np.ndarray:
    """Normals towards the camera (H, W, 3), 0 where nothing is hit."""
    normal = np.where((face_id >= 0)[..., None], normals[np.maximum(face_id, 0)], 0)
    away = (normal * view.directions()).sum(-1, keepdims=True) > 0
    return np.where(away, -normal, normal).astype(np.float32)
