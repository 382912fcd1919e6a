"""Mitsuba's path tracer on the same rooms, with the reflectance of the method as a BSDF plug-in: the reference of renderings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workflow.exporters import mitsuba_bsdf
from workflow.runtime import device


@dataclass(frozen=True)
class Part:
    """One object of a room: quads and triangles of one material.

    Attributes:
        vertices: (n, 3) m; faces: (m, 3), normals to the lit side.
        material: base colour R, G, B, roughness, metallic; linear.
        radiance: (3,) of the front side.
    """

    vertices: NDArray
    faces: NDArray
    material: tuple[float, float, float, float, float]
    radiance: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Room:
    """Objects, constant radiance from outside, and rays that look at them.

    Attributes:
        parts: objects; sky: (3,) radiance.
        origin: (3,) m; directions: (n, 3) of the rays.
    """

    parts: Sequence[Part]
    sky: tuple[float, float, float]
    origin: NDArray
    directions: NDArray


def scene_of(room: Room) -> Any:
    """Return a room as a scene of Mitsuba."""
    mi = device.mitsuba()
    mitsuba_bsdf.register()
    document: dict[str, Any] = {"type": "scene"}
    for number, part in enumerate(room.parts):
        *base, roughness, metallic = (float(value) for value in part.material)
        bsdf = {
            "type": mitsuba_bsdf.NAME,
            "base_color": {"type": "rgb", "value": base},
            "roughness": roughness,
            "metallic": metallic,
        }
        props = mi.Properties()
        props["mesh_bsdf"] = mi.load_dict(bsdf)
        if any(part.radiance):
            radiance = {"type": "rgb", "value": [float(value) for value in part.radiance]}
            props["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
        mesh = mi.Mesh(f"part{number}", len(part.vertices), len(part.faces), props)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.asarray(part.vertices, np.float32).ravel()
        parameters["faces"] = np.asarray(part.faces, np.uint32).ravel()
        parameters.update()
        document[f"part{number}"] = mesh
    if any(room.sky):
        radiance = {"type": "rgb", "value": [float(value) for value in room.sky]}
        document["sky"] = {"type": "constant", "radiance": radiance}
    return mi.load_dict(document)


def reference(scene: Any, room: Room, samples: int, max_bounces: int, seed: int) -> NDArray:
    """Estimate the radiance along the rays of a room with Mitsuba's `path` integrator, (n, 3)."""
    import drjit as dr
    import mitsuba as mi

    integrator = mi.load_dict({"type": "path", "max_depth": max_bounces + 1, "rr_depth": 1000})
    count = len(room.directions)
    sampler = mi.load_dict({"type": "independent", "sample_count": samples})
    sampler.seed(seed, count * samples)
    ways = np.repeat(room.directions / np.linalg.norm(room.directions, axis=1, keepdims=True), samples, 0).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*(float(value) for value in room.origin)), mi.Vector3f(ways.T))
    radiance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
    summed = [dr.block_sum(channel, samples) for channel in (radiance.x, radiance.y, radiance.z)]
    return np.stack([np.array(channel) for channel in summed], 1) / samples


def ours(room: Room, samples: int, max_bounces: int, seed: int) -> NDArray:
    """Estimate the same with the path tracer of the project, (n, 3)."""
    device.mitsuba()
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.materials import CellMaterials
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    start = np.cumsum([0, *(len(part.vertices) for part in room.parts)])
    vertices = np.concatenate([part.vertices for part in room.parts])
    faces = np.concatenate([part.faces + first for part, first in zip(room.parts, start, strict=False)])
    owner = np.repeat(np.arange(len(room.parts)), [len(part.faces) for part in room.parts]).astype(np.int32)
    radiance = np.array([part.radiance for part in room.parts], np.float32)[owner]
    geometry = build_geometry(vertices, faces, owner)
    emitters = Emitters(geometry, radiance, np.where(radiance.any(1), 1, 0), environment=np.array(room.sky, np.float32))
    of_parts = np.array([part.material for part in room.parts], np.float32)
    material = CellMaterials(1.0, np.zeros(3), np.zeros((0, 3), np.int64), np.zeros(0, np.int32), np.zeros((0, 5)), of_parts)
    return render(Scene(geometry, material, emitters), room.origin, room.directions, PathOptions(samples, max_bounces, seed))
