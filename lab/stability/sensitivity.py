"""Which error of the input, and which setting, costs most accuracy: elementary effects after Morris.

Every factor has four levels from good to bad (input) or from dear to cheap (settings). Errors of cameras and mesh are errors of
what the stages are given: photographs stay, and depth and faces are traced anew through the wrong mesh from the wrong place.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.stability import chain
from lab.stability.accuracy import Accuracy, accuracy
from lab.stability.chain import Capture
from lab.studies.screening import elementary_effects, trajectories

TRAJECTORIES = 4
BULGES = 12
"""Waves of which bulges are made."""
SCORES = ("albedo", "albedo_as_is", "roughness", "light")
Change = Callable[[Capture, float, np.random.Generator], Capture]


@dataclass(frozen=True)
class Factor:
    """A factor and its four levels, the first of which changes nothing."""

    name: str
    levels: tuple[float, float, float, float]
    unit: str
    change: Change


class Effect(NamedTuple):
    """Effect of a factor from its first to its last level on one score: mean with sign, mean size, half of its 95 % interval."""

    room: str
    factor: str
    levels: str
    score: str
    mean: float
    size: float
    error: float


def _retraced(capture: Capture) -> Capture:
    """Depth and faces of the pixels through the present mesh and cameras."""
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry = build_geometry(capture.vertices, capture.faces, np.zeros(len(capture.faces), np.int32))
    depth, face = {}, {}
    for view in capture.views:
        ids, distance = trace(geometry, view.world_from_camera[:3, 3], view.directions().reshape(-1, 3))
        shape = (view.height, view.width)
        face[view.name] = ids.reshape(shape)
        depth[view.name] = np.where(ids >= 0, distance, 0).reshape(shape).astype(np.float32)
    return replace(capture, depth=depth, face=face)


def _poses(capture: Capture, pixels: float, rng: np.random.Generator) -> Capture:
    """Cameras turned so that the picture moves by so many pixels, and moved as far again by parallax at the median depth."""
    views = []
    for view in capture.views:
        depth = float(np.median(capture.depth[view.name][capture.face[view.name] >= 0]))
        way = rng.standard_normal(3) / np.sqrt(3) * pixels / view.fx
        cross = np.array([[0, -way[2], way[1]], [way[2], 0, -way[0]], [-way[1], way[0], 0]])
        pose = view.world_from_camera.copy()
        u, _, vt = np.linalg.svd(pose[:3, :3] @ (np.eye(3) + cross))
        pose[:3, :3] = u @ vt
        pose[:3, 3] += rng.standard_normal(3) / np.sqrt(3) * pixels / view.fx * depth
        views.append(replace(view, world_from_camera=pose))
    return replace(capture, views=tuple(views))


def _mesh_noise(capture: Capture, millimetres: float, rng: np.random.Generator) -> Capture:
    _, number = np.unique(capture.vertices, axis=0, return_inverse=True)
    number = number.reshape(-1)
    moved = 1e-3 * millimetres * rng.standard_normal((int(number.max()) + 1, 3))
    return replace(capture, vertices=(capture.vertices + moved[number]).astype(np.float32))


def _bulges(capture: Capture, millimetres: float, rng: np.random.Generator) -> Capture:
    """The mesh bulges smoothly by so much (standard deviation), over half a metre: a reconstruction from photographs does where
    surface has no texture, and the paper compares one with a laser scan."""
    moved = np.zeros(capture.vertices.shape)
    for _ in range(BULGES):
        wave = rng.standard_normal(3) * np.pi / 0.5
        moved += rng.standard_normal(3) * np.sin(capture.vertices @ wave + rng.uniform(0, 2 * np.pi))[:, None]
    moved *= 1e-3 * millimetres * np.sqrt(2 / BULGES)
    return replace(capture, vertices=(capture.vertices + moved).astype(np.float32))


def _decimated(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """So many of the faces are left, each with the object of the face that is nearest to it; lamps stay as they are."""
    if share >= 1:
        return capture
    import open3d as o3d

    lamp = capture.emission.any(1)
    kept = np.flatnonzero(~lamp)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(capture.vertices.astype(np.float64)), o3d.utility.Vector3iVector(capture.faces[kept])
    )
    mesh.remove_duplicated_vertices()
    fewer = mesh.simplify_quadric_decimation(max(int(share * len(kept)), 4))
    vertices, faces = np.asarray(fewer.vertices, np.float32), np.asarray(fewer.triangles, np.int32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(capture.vertices.astype(np.float32)), o3d.core.Tensor(capture.faces[kept].astype(np.uint32))
    )
    nearest = scene.compute_closest_points(o3d.core.Tensor(vertices[faces].mean(1)))["primitive_ids"].numpy()
    lamps = capture.faces[lamp] + len(vertices)
    return replace(
        capture,
        vertices=np.concatenate([vertices, capture.vertices]),
        faces=np.concatenate([faces, lamps]).astype(np.int32),
        instance=np.concatenate([capture.instance[kept][nearest], capture.instance[lamp]]),
        emission=np.concatenate([np.zeros((len(faces), 3)), capture.emission[lamp]]).astype(np.float32),
    )


def _holes(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """Faces missing at random; lamps stay, whose loss would be another question."""
    keep = (rng.random(len(capture.faces)) >= share) | capture.emission.any(1)
    return replace(capture, faces=capture.faces[keep], instance=capture.instance[keep], emission=capture.emission[keep])


def _parted(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """A share of the objects is cut in two by a plane through its middle."""
    middle = capture.vertices[capture.faces].mean(1)
    instance, names = capture.instance.copy(), list(capture.names)
    for number in range(len(capture.names)):
        own = np.flatnonzero(capture.instance == number)
        if rng.random() >= share or len(own) < 2 or capture.emission[own].any():
            continue
        side = (middle[own] - middle[own].mean(0)) @ rng.standard_normal(3) > 0
        instance[own[side]] = len(names)
        names.append(f"{capture.names[number]}, part")
    return replace(capture, instance=instance, names=tuple(names))


def _joined(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """A share of the objects is joined with the nearest other one; lamps stay alone."""
    count = len(capture.names)
    middle = capture.vertices[capture.faces].mean(1)
    owner = np.maximum(capture.instance, 0)
    size = np.maximum(np.bincount(owner, minlength=count), 1)
    centre = np.stack([np.bincount(owner, middle[:, axis], count) / size for axis in range(3)], 1)
    lamp = np.bincount(owner, capture.emission.any(1), count) > 0
    target = np.arange(count)
    for number in np.flatnonzero(~lamp):
        if rng.random() < share:
            away = np.where(lamp | (np.arange(count) == number), np.inf, np.linalg.norm(centre - centre[number], axis=1))
            target[number] = target[int(away.argmin())] if np.isfinite(away).any() else number
    return replace(capture, instance=np.where(capture.instance >= 0, target[owner], -1).astype(np.int32))


def _exposures(capture: Capture, spread: float, rng: np.random.Generator) -> Capture:
    views = tuple(replace(view, exposure=view.exposure * float(np.exp(spread * rng.standard_normal()))) for view in capture.views)
    return replace(capture, views=views)


def _of_photos(change: Callable[[NDArray, float, np.random.Generator], NDArray]) -> Change:
    def apply(capture: Capture, amount: float, rng: np.random.Generator) -> Capture:
        top = 1.0 if capture.facts["dynamic_range"] == "ldr" else np.inf
        photo = {name: np.clip(change(image, amount, rng), 0, top).astype(np.float32) for name, image in capture.photo.items()}
        return replace(capture, photo=photo)

    return apply


def _crossing(capture: Capture, pixels: float, rng: np.random.Generator) -> Capture:
    """Predictions moved against the photographs, so that they cross the borders of objects."""
    maps = {}
    for name, values in capture.maps.items():
        dx, dy = np.rint(pixels * rng.standard_normal(2)).astype(int)
        maps[name] = np.roll(values, (dy, dx), axis=(1, 2))
    return replace(capture, maps=maps)


def _setting(section: str, key: str) -> Change:
    def apply(capture: Capture, value: float, rng: np.random.Generator) -> Capture:
        kind = type(capture.document[section][key])
        return capture.with_settings(**{section: {key: kind(value)}})

    return apply


def _fit_pixels(capture: Capture, value: float, rng: np.random.Generator) -> Capture:
    """Specular light is traced at the pixels that the fit reads."""
    return capture.with_settings(affines={"pixels": int(value)}, shading={"pixels": int(value)})


def _fewer_predictions(capture: Capture, count: float, rng: np.random.Generator) -> Capture:
    return replace(capture, maps={name: maps[: int(count)] for name, maps in capture.maps.items()})


def _prior(capture: Capture, value: float, rng: np.random.Generator) -> Capture:
    raise AssertionError("predictions are made by `_predicted`")


PRIOR = "strength of the errors of the predictions"
SHARED = "errors of the predictions that all views of an object share"
FACTORS = (
    Factor("poses", (0.0, 0.3, 1.0, 3.0), "pixels", _poses),
    Factor("vertices of the mesh", (0.0, 1.0, 10.0, 30.0), "mm", _mesh_noise),
    Factor("bulges of the mesh", (0.0, 5.0, 15.0, 50.0), "mm over 0.5 m", _bulges),
    Factor("faces of the mesh", (1.0, 0.3, 0.1, 0.01), "of them", _decimated),
    Factor("holes in the mesh", (0.0, 0.01, 0.05, 0.2), "of the faces", _holes),
    Factor("objects parted", (0.0, 0.1, 0.3, 1.0), "of the objects", _parted),
    Factor("objects joined", (0.0, 0.1, 0.3, 0.6), "of the objects", _joined),
    Factor("exposures", (0.0, 0.05, 0.2, 0.5), "log, a view", _exposures),
    Factor("white balance", (0.0, 0.02, 0.05, 0.2), "log, a view and channel",
           _of_photos(lambda image, s, rng: image * np.exp(s * rng.standard_normal(3)))),
    Factor("noise of the photographs", (0.0, 0.01, 0.03, 0.1), "relative",
           _of_photos(lambda image, s, rng: image * (1 + s * rng.standard_normal(image.shape)))),
    Factor(PRIOR, (0.5, 1.0, 1.5, 2.0), "x", _prior),
    Factor(SHARED, (1.0, 1.5, 2.0, 3.0), "x", _prior),
    Factor("predictions across borders", (0.0, 1.0, 2.0, 4.0), "pixels", _crossing),
    Factor("number of predictions", (8.0, 4.0, 2.0, 1.0), "", _fewer_predictions),
    Factor("cells", (0.28, 0.4, 0.8, 1.6), "footprints", _setting("base", "cell_footprints")),
    Factor("ridge of the maps", (0.003, 0.01, 0.03, 0.1), "", _setting("base", "ridge")),
    Factor("emission.rows", (20000.0, 10000.0, 5000.0, 2000.0), "", _setting("emission", "rows")),
    Factor("emission.samples", (32.0, 16.0, 8.0, 4.0), "", _setting("emission", "samples")),
    Factor("emission.cache_edge", (0.03, 0.06, 0.12, 0.24), "m", _setting("emission", "cache_edge")),
    Factor("shading.samples", (64.0, 32.0, 16.0, 8.0), "", _setting("shading", "samples")),
    Factor("shading.cell_edge", (0.025, 0.05, 0.1, 0.2), "m", _setting("shading", "cell_edge")),
    Factor("shading.noise", (0.1, 0.2, 0.4, 1.0), "", _setting("shading", "noise")),
    Factor("affines.pixels", (100000.0, 50000.0, 20000.0, 5000.0), "", _fit_pixels),
)  # fmt: skip
GEOMETRY = ("poses", "vertices of the mesh", "bulges of the mesh", "faces of the mesh", "holes in the mesh")
ROOMS: dict[str, dict[str, Any]] = {
    **chain.ROOMS,
    "modern hall": {
        "source": {"kind": "mitsuba", "path": "data/modern-hall/scene.xml"},
        "capture": {"dynamic_range": "hdr", "views": 10, "width": 96, "height": 96, "samples": 256, "denoise": True},
        "prior": {"kind": "simulated", "samples": 4},
        "segmentation": {"kind": "given"},
        "emission": {"rows": 10000, "samples": 16},
        "shading": {"samples": 16, "levels": 8},
        "affines": {"pixels": 50000},
        "components": {"specular": "on", "environment": "off"},
    },
}
"""Rooms of the study: those of `chain`, and a scene with ground truth by somebody else, which has to be at its path."""


def rooms() -> list[str]:
    """Return the rooms that are there."""
    return [name for name, settings in ROOMS.items() if Path(settings["source"].get("path", ".")).exists()]


def changed(capture: Capture, predicted: Mapping[tuple[float, float], Capture], run: str, seed: int) -> Capture:
    """Return the capture of one run: a digit for each of `FACTORS`, its level."""
    level = {factor.name: factor.levels[int(digit)] for factor, digit in zip(FACTORS, run, strict=True)}
    out = replace(capture, maps=predicted[level[PRIOR], level[SHARED]].maps)
    for number, factor in enumerate(FACTORS):
        if factor.name not in (PRIOR, SHARED):
            out = factor.change(out, level[factor.name], np.random.default_rng([17, seed, number]))
    moved = any(level[name] != factor.levels[0] for name in GEOMETRY for factor in FACTORS if factor.name == name)
    return _retraced(out) if moved else out


def measure(room: str, count: int = TRAJECTORIES) -> Iterator[Effect]:
    """Run `count` trajectories of Morris on one of `ROOMS`, with eight predictions, and rank the factors."""
    names = [factor.name for factor in FACTORS]
    runs = trajectories(names, count, seed=0)
    log = logging.getLogger("stability")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        own = {"prior": {"kind": "simulated", "samples": 8}, "segmentation": {"kind": "given"}}
        settings: dict[str, Any] = {**ROOMS[room], **own}
        capture = chain.make_capture(folder / "capture", settings)
        strengths, shares = (factor.levels for factor in FACTORS if factor.name in (PRIOR, SHARED))
        predicted = {
            (strength, shared): chain.with_predictions(capture, folder / "capture", strength=strength, shared=shared)
            for strength in strengths
            for shared in shares
        }
        found: dict[str, Accuracy] = {}
        for number, run in enumerate(runs):
            if run not in found:
                found[run] = accuracy(chain.run(changed(capture, predicted, run, 0), folder / "run"), capture)
            log.info("sensitivity: %s: %d of %d runs", room, number + 1, len(runs))
    for score in SCORES:
        effects = elementary_effects(names, runs, [getattr(found[run], score) for run in runs])
        for factor in FACTORS:
            effect = effects[factor.name]
            span = f"{factor.levels[0]:g} to {factor.levels[-1]:g} {factor.unit}".strip()
            yield Effect(room, factor.name, span, score, effect.mean, effect.mean_size, effect.error)
