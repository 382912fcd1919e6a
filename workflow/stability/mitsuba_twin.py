"""Mitsuba's path tracer on the same rooms, with the reflectance of the method as a BSDF plug-in: the reference of renderings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf


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


def plugin() -> type:
    """Return the BSDF class: Cook-Torrance of Eq. R.1 to R.13 on both sides, with a constant material."""
    import drjit as dr
    import mitsuba as mi

    class CookTorrance(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any):
            super().__init__(props)
            base = mi.Color3f(*(props[name] for name in ("red", "green", "blue")))
            self.kd, self.ks = brdf.kd_ks(base, mi.Float(props["metallic"]))
            self.roughness = mi.Float(props["roughness"])
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_flags, self.m_components = flags, [flags]

        def _viewer(self, si: Any) -> tuple[Any, Any]:
            """Direction to the viewer above the surface, and the sign that puts it there."""
            side = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -1.0, mi.Float(1))
            return mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * side), side

        def _evaluate(self, viewer: Any, light: Any) -> tuple[Any, Any]:
            """f cos and the density of a direction."""
            normal = (mi.Float(0), mi.Float(0), mi.Float(1))
            NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, normal, light, viewer)
            diffuse, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, self.roughness)
            chance = brdf.specular_chance(DRJIT, dr.max(self.kd), dr.max(self.ks), viewer.z)
            pdf = brdf.mixture_pdf(DRJIT, NoL, NoH, VoH, sin2_h, self.roughness, chance)
            value = brdf.compose(self.kd, self.ks, diffuse, spec * (1 - fc), spec * fc)
            above = (viewer.z > 0) & (light.z > 0)
            return dr.select(above, value, 0), dr.select(above, pdf, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            viewer, side = self._viewer(si)
            chance = brdf.specular_chance(DRJIT, dr.max(self.kd), dr.max(self.ks), viewer.z)
            half = brdf.sample_ggx_half(DRJIT, sample2.x, sample2.y, self.roughness)
            mirrored = dr.normalize(mi.Vector3f(*brdf.reflect(viewer, half)))
            light = dr.select(sample1 < chance, mirrored, mi.Vector3f(*brdf.sample_cosine(DRJIT, sample2.x, sample2.y)))
            value, pdf = self._evaluate(viewer, light)
            found = mi.BSDFSample3f()
            found.wo = mi.Vector3f(light.x, light.y, light.z * side)
            found.pdf, found.eta = pdf, mi.Float(1)
            found.sampled_type, found.sampled_component = mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(0)
            return found, dr.select(active & (pdf > 0), value / pdf, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            viewer, side = self._viewer(si)
            return self._evaluate(viewer, mi.Vector3f(wo.x, wo.y, wo.z * side))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def traverse(self, callback: Any) -> None:
            pass

    return CookTorrance


NAME = "iif_cook_torrance"
_REGISTERED: set[str] = set()


def scene_of(room: Room) -> Any:
    """Return a room as a scene of Mitsuba (variant `llvm_ad_rgb`)."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    if NAME not in _REGISTERED:
        mi.register_bsdf(NAME, plugin())
        _REGISTERED.add(NAME)
    document: dict[str, Any] = {"type": "scene"}
    for number, part in enumerate(room.parts):
        names = ("red", "green", "blue", "roughness", "metallic")
        bsdf = {"type": NAME, **{name: float(value) for name, value in zip(names, part.material, strict=True)}}
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
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
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
