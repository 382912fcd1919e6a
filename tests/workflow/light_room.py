"""A closed room with known light and materials, as the stages before `emission` would have left it on disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from iif_core.camera.pinhole import look_at, pixel_directions
from iif_core.requirements.evidence import NOTHING
from iif_core.surface.cells import grid_origin, pack_keys, unpack_keys, voxel_indices
from lab.loose import Loose, changed, document_of
from lab.simulated.photographs import response_curve
from workflow.artifacts import StageReader
from workflow.artifacts.store import ids_to_disk, split_rgb
from workflow.decisions import plan as decisions
from workflow.scene.normal_form import CaptureWriter, Truth, View

SIZE = (4.0, 3.0, 2.4)
LAMP, BULB = 8.0, 20.0
CELL = 0.06


def _quad(origin, u, v, n):
    """An n x n grid of quads; normal u x v."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    vertices = np.array(origin) + s[..., None] * np.array(u) + t[..., None] * np.array(v)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    b = a + n + 1
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    return vertices.reshape(-1, 3), faces


def _box(low, high, n):
    """The six sides of a box, normals outwards."""
    low, high = np.array(low, float), np.array(high, float)
    dx, dy, dz = np.diag(high - low)
    sides = [(low, dy, dx), (low, dx, dz), (low, dz, dy), (high, -dx, -dy), (high, -dz, -dx), (high, -dy, -dz)]
    return _join([_quad(o, u, v, n) for o, u, v in sides])


def _join(parts):
    offset, vertices, faces = 0, [], []
    for v, f in parts:
        vertices.append(v)
        faces.append(f + offset)
        offset += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def _ball(centre, radius):
    import trimesh

    ball = trimesh.creation.icosphere(2, radius)
    return np.asarray(ball.vertices) + centre, np.asarray(ball.faces)


class Room:
    """Geometry, true materials per face and true emission per face.

    `parts`: name -> (vertices, faces); `looks`: name -> (albedo, roughness, metallic); `lights`: name -> radiance, on the side
    of the normal. Each default is replaced or, where the part is None, taken away.
    """

    def __init__(
        self, seed: int = 0, parts: dict | None = None, looks: dict | None = None, lights: dict | None = None, n: int = 14
    ):
        x, y, z = SIZE
        rng = np.random.default_rng(seed)
        usual = {
            "floor": _quad((0, 0, 0), (x, 0, 0), (0, y, 0), n),
            "ceiling": _quad((0, 0, z), (0, y, 0), (x, 0, 0), n),
            "wall_a": _quad((0, 0, 0), (0, y, 0), (0, 0, z), n),
            "wall_b": _quad((x, 0, 0), (0, 0, z), (0, y, 0), n),
            "wall_c": _quad((0, 0, 0), (0, 0, z), (x, 0, 0), n),
            "wall_d": _quad((0, y, 0), (x, 0, 0), (0, 0, z), n),
            "table": _box((1.2, 1.0, 0.0), (2.2, 1.8, 0.7), 8),
            "metal": _box((2.8, 0.6, 0.0), (3.4, 1.2, 1.0), 8),
            "glossy": _box((0.6, 2.2, 0.0), (1.2, 2.7, 0.9), 8),
            "lamp": _quad((1.6, 1.2, z - 0.05), (0, 0.6, 0), (0.8, 0, 0), 2),
            "bulb": _ball((1.9, 2.3, 1.4), 0.12),
        }
        parts = {name: part for name, part in {**usual, **(parts or {})}.items() if part is not None}
        self.names = list(parts)
        self.vertices, self.faces = _join(list(parts.values()))
        self.object_id = np.repeat(np.arange(len(parts)), [len(f) for _, f in parts.values()]).astype(np.int32)
        looks = {
            **dict.fromkeys(parts, ((0.5, 0.5, 0.5), 0.8, 0)),
            "floor": ((0.45, 0.3, 0.2), 0.5, 0),
            "ceiling": ((0.75, 0.75, 0.72), 0.9, 0),
            "wall_a": ((0.6, 0.62, 0.55), 0.8, 0),
            "wall_b": ((0.6, 0.3, 0.3), 0.8, 0),
            "wall_c": ((0.3, 0.45, 0.6), 0.8, 0),
            "wall_d": ((0.65, 0.6, 0.5), 0.8, 0),
            "table": ((0.5, 0.35, 0.2), 0.4, 0),
            "metal": ((0.85, 0.7, 0.4), 0.3, 1),
            "glossy": ((0.1, 0.2, 0.4), 0.2, 0),
            "lamp": ((0, 0, 0), 1, 0),
            "bulb": ((0, 0, 0), 1, 0),
            **(looks or {}),
        }
        colour = np.array([looks[name][0] for name in self.names])[self.object_id]
        texture = rng.uniform(0.6, 1.25, (len(self.faces), 1)) * rng.uniform(0.95, 1.05, (len(self.faces), 3))
        rest = np.array([looks[name][1:] for name in self.names])[self.object_id]
        self.material = np.concatenate([np.clip(colour * texture, 0, 1), rest], 1).astype(np.float32)
        self.emission = np.zeros((len(self.faces), 3), np.float32)
        lamps = {"lamp": LAMP * np.array([1, 0.95, 0.85]), "bulb": BULB * np.array([1, 0.8, 0.6])}
        for name, radiance in (lamps if lights is None else lights).items():
            self.emission[self.object_id == self.names.index(name)] = radiance
        self.side = np.where(self.emission.any(1), 1, 0).astype(np.int8)
        self.transmittance = np.zeros(len(self.faces), np.float32)

    def views(self, count: int, size: int, exposures: np.ndarray) -> list[View]:
        """Cameras on a ring that look across the room."""
        out = []
        focal = 0.5 * size / np.tan(np.radians(80) / 2)
        for i in range(count):
            angle = 2 * np.pi * i / count
            eye = np.array([2 + 1.5 * np.cos(angle), 1.5 + 1.1 * np.sin(angle), 1.5 + 0.3 * np.sin(3 * angle)])
            target = np.array([2 - np.cos(angle + 0.3), 1.5 - np.sin(angle + 0.3), 1.1 + 0.4 * np.cos(2 * angle)])
            pose = look_at(eye, target, (0, 0, 1))
            out.append(View(i, f"v{i:03d}", size, size, focal, focal, size / 2, size / 2, pose, float(exposures[i])))
        return out


def of(folder: Path, **sections: dict[str, Any]) -> Loose:
    """The stages in a folder, with the usual settings and some changed."""
    return Loose(folder, changed(_usual(), sections), "room")


@lru_cache(None)
def _usual() -> dict[str, Any]:
    document = document_of({"source": {"kind": "builtin", "scene": "tiny"}, "device": os.environ.get("IIF_TEST_DEVICE", "cpu")})
    return changed(document, {"prior": {"kind": "simulated"}, "segmentation": {"kind": "given"}})


def run(folder: Path, stages: dict[str, ModuleType], **sections: dict[str, Any]) -> None:
    """Run stages one after the other with the usual settings and some changed."""
    for name, module in stages.items():
        job = of(folder, **sections).job(name, 2)
        module.run(job)
        job.writer.finish()


def opened(folder: Path, stage: str) -> StageReader:
    """The reader of a finished stage."""
    return of(folder).open(stage)


def build(
    folder: Path,
    views: int = 8,
    size: int = 48,
    samples: int = 128,
    dynamic_range: str = "hdr",
    spoil: float = 0.2,
    seed: int = 0,
    curve: str | None = None,
    exposures: np.ndarray | None = None,
    brightness: float = 1.0,
    room: Room | None = None,
    sky: float | np.ndarray = 0.0,
    bounces: int = 10,
    retouch: Callable[[int, np.ndarray], np.ndarray] | None = None,
    truth: bool = False,
    held_out: tuple[int, ...] = (),
) -> Room:
    """Write capture, segmentation and base; `spoil` is the size of the affine errors of the base texture.

    `sky`: radiance of what is outside the mesh, one number or a map (H, W, 3); `retouch(view, image)`: the photograph
    as it is stored; `held_out`: numbers of views that nothing is fitted to.
    """
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry, trace
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from tests.oracles.face_materials import FaceMaterials

    room = room or Room(seed)
    room.emission *= brightness
    rng = np.random.default_rng(seed + 1)
    exposures = np.ones(views) if exposures is None else exposures
    cameras = room.views(views, size, exposures)
    cameras = [replace(view, split="test") if i in held_out else view for i, view in enumerate(cameras)]
    geometry = build_geometry(room.vertices, room.faces, room.object_id, room.transmittance)
    scanned = build_geometry(room.vertices, room.faces, room.object_id)
    material = FaceMaterials(room.material)
    emitters = Emitters(geometry, room.emission, room.side, environment=np.full(3, sky) if np.ndim(sky) == 0 else sky)
    sensor = response_curve(curve) if curve else None
    capture = of(folder).plant("capture")
    segmentation = of(folder).plant("segmentation")
    form = CaptureWriter(capture)
    form.cameras(cameras)
    form.mesh(room.vertices, room.faces, room.object_id, room.names, room.emission)
    spoiled, pixels = _spoil(room, spoil, rng), []
    for view in cameras:
        directions = pixel_directions(view.fx, view.fy, view.cx, view.cy, size, size, view.world_from_camera).reshape(-1, 3)
        origin = view.world_from_camera[:3, 3]
        face, depth = trace(scanned, origin, directions)
        radiance = render(
            Scene(geometry, material, emitters), origin, directions, PathOptions(samples, bounces, 1000 + view.view_id)
        )
        depth = np.where(face >= 0, depth, 0)
        image = radiance.reshape(size, size, 3)
        if sensor is not None:
            image = np.round(255 * sensor(np.clip(view.exposure * image, 0, 1))) / 255
        if retouch is not None:
            image = retouch(view.view_id, image)
        form.photo(view.name, image.astype(np.float32), encoded=sensor is not None)
        if truth:
            maps, shine = (values[face].reshape(size, size, -1) for values in (room.material, room.emission))
            hit = (face >= 0).reshape(size, size)
            maps, shine = maps * hit[..., None], shine * hit[..., None]
            form.truth(view.name, Truth(maps[..., :3], maps[..., 3], maps[..., 4], shine, radiance.reshape(size, size, 3), hit))
        form.gbuffer(view.name, depth.reshape(size, size), face.reshape(size, size))
        objects = np.where(face >= 0, room.object_id[face], -1).reshape(size, size).astype(np.int32)
        inner = np.ones((size, size), bool)
        for axis in (0, 1):
            for shift in (1, -1):
                inner &= np.roll(objects, shift, axis) == objects
        segmentation.exr(
            f"maps/{view.name}.exr",
            {"object.id": ids_to_disk(objects), "segment.id": ids_to_disk(_segments(view, objects, room)), "interior": inner},
        )
        pixels.append(
            (
                view,
                origin + depth[:, None] * directions,
                objects.ravel(),
                np.where((face >= 0)[:, None], spoiled[face], 0),
            )
        )
    form.finish("test", dynamic_range, truth, [])
    capture_facts = {"object_id": np.arange(len(room.names), dtype=np.int32), "name": np.array(room.names)}
    segmentation.table("objects.parquet", capture_facts)
    faces = {"face_id": np.arange(len(room.faces), dtype=np.int32), "object_id": room.object_id}
    segmentation.table("faces.parquet", faces)
    ids = np.arange(views * len(room.names), dtype=np.int32)
    segmentation.table("segments.parquet", {"segment_id": ids, "object_id": ids % len(room.names)})
    segmentation.finish()
    capture.finish()
    _write_base(folder, room, pixels, size)
    write_plan(folder)
    return room


def _segments(view: View, objects: np.ndarray, room: Room) -> np.ndarray:
    """One segment for each object in each view."""
    return np.where(objects >= 0, objects + view.view_id * len(room.names), -1).astype(np.int32)


def write_plan(folder: Path, specular: str = "on", environment: str = "auto") -> None:
    """Write a plan that leaves the light to stage emission; `specular: auto` leaves the lobes to the predictions."""
    plan = of(folder).plant("plan")
    components = [
        decisions.environment(environment, 0.1, 0.1, 1.0, NOTHING),
        decisions.specular(specular, NOTHING),
    ]
    plan.json("plan.json", {"plan": components})
    plan.finish()


def _spoil(room: Room, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Per-object affine errors of the true materials."""
    out = room.material.astype(np.float64).copy()
    for o in range(len(room.names)):
        own = room.object_id == o
        gain = np.exp(strength * rng.normal(0, 1, 3))
        out[own, :3] = np.clip(out[own, :3] * gain + 0.1 * strength * rng.normal(0, 1, 3), 0, 1)
        out[own, 3] = np.clip(out[own, 3] + strength * rng.normal(0, 0.5), 0.05, 1)
        out[own, 4] = np.clip(out[own, 4] * (1 - strength) + strength * rng.uniform(0, 0.5), 0, 1)
    return out


def _write_base(folder: Path, room: Room, pixels: list, size: int) -> None:
    base, prior = of(folder).plant("base"), of(folder).plant("prior")
    points = np.concatenate([p for _, p, _, _ in pixels])
    origin = grid_origin(room.vertices, CELL)
    objects = np.concatenate([o for _, _, o, _ in pixels])
    values = np.concatenate([v for _, _, _, v in pixels])
    seen = objects >= 0
    keys = pack_keys(voxel_indices(points[seen], CELL, origin), objects[seen])
    unique, inverse = np.unique(keys, return_inverse=True)
    count = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, values[seen, c]) / count for c in range(5)], 1)
    ijk, owner = unpack_keys(unique)
    centre = origin + (ijk + 0.5) * CELL
    names = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
    table = {"cell_id": np.arange(len(unique), dtype=np.int32), **{c: ijk[:, i] for i, c in enumerate("ijk")}}
    table |= {"object_id": owner, **{c: centre[:, i].astype(np.float32) for i, c in enumerate("xyz")}}
    table |= {name: mean[:, i].astype(np.float32) for i, name in enumerate(names)}
    table |= {f"{claim}_{name}": np.full(len(unique), 0.02, np.float32) for claim in ("scale", "uncertainty") for name in names}
    base.table("cells.parquet", table)
    cells = np.bincount(owner, minlength=len(room.names))
    sums = [np.bincount(owner, mean[:, i], len(room.names)) / np.maximum(cells, 1) for i in range(5)]
    rows = {"object_id": np.arange(len(room.names), dtype=np.int32), "cells": cells}
    base.table("objects.parquet", {**rows, **{name: s.astype(np.float32) for name, s in zip(names, sums, strict=True)}})
    cell_of = np.full(len(objects), -1, np.int32)
    cell_of[seen] = inverse
    for number, (view, _, _, _) in enumerate(pixels):
        part = slice(number * size * size, (number + 1) * size * size)
        ids = cell_of[part]
        maps = np.where((ids >= 0)[:, None], mean[ids], 0).reshape(size, size, 5).astype(np.float32)
        flat = np.full((size, size), 0.02, np.float32)
        base.exr(
            f"maps/{view.name}.exr",
            {
                "cell.id": ids_to_disk(ids.reshape(size, size)),
                "coverage": np.ones((size, size), np.float32),
                **split_rgb(maps[..., :3], "albedo"),
                "roughness": maps[..., 3],
                "metallic": maps[..., 4],
                **{f"{claim}.{name}": flat for claim in ("scale", "uncertainty") for name in ("albedo", "roughness", "metallic")},
            },
        )
    for view, _, _, values in pixels:
        maps = values.reshape(size, size, 5).astype(np.float16)
        names = [f"prior.000.{name}" for name in ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic")]
        prior.exr(f"maps/{view.name}.exr", {name: maps[..., i] for i, name in enumerate(names)})
    prior.finish()
    n = len(room.names)
    identity = np.tile(np.eye(3, 4, dtype=np.float32).ravel(), (n, 1))
    chosen = {"segment_id": np.arange(n), "k": np.zeros(n, int), "weight_albedo": np.ones(n), "affine_albedo": identity}
    base.table("selection.parquet", chosen)
    base.table("segments.parquet", {"segment_id": np.arange(n), "object_id": np.arange(n, dtype=np.int32)})
    facts = {"predictions": 1, "plan": [], "seen_once_share": 0.0}
    base.json("base.json", {**facts, "cell_edge_m": CELL, "origin": [float(v) for v in origin]})
    base.finish()
    second_look = of(folder).plant("second_look")
    second_look.json("second_look.json", {"made": False, "reason": "planted"})
    second_look.finish()


EMISSION = {"rows": 12000, "samples": 16, "environment": "auto"}
SHADING = {"pixels": "all", "samples": 32, "levels": 10, "cell_edge": 0.05, "noise": 0.15, "indirect": "auto"}
AFFINES = {"response": "auto", "pixels": 200000, "scale": "found", "textured": False}
