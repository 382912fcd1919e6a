"""The path tracer itself: one vertex, one loop. Everything here works on device types inside a kernel.

Directions are of unit length, `wo` points to where the light goes, `wi` to where it comes from. Surfaces are
double-sided. A vertex is lit twice, by a point drawn on an emitter and by the direction in which the path goes on, and the
two are weighted with the power heuristic, both densities per solid angle (METHOD 2.5; the measure mix-up named
there is avoided).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .. import brdf
from ..xp import DRJIT
from .cache import RadianceCache
from .emitters import Emitters
from .geometry import Geometry, nearest_hit, offset_from

ROULETTE_START = 4
ROULETTE_LIMIT = 0.95


class World:
    """What a path meets: not a Dr.Jit struct on purpose, so that loops do not carry its tables as state."""

    def __init__(self, geometry: Geometry, material: Any, emitters: Emitters, cache: RadianceCache | None, collector: Any):
        self.geometry, self.material, self.emitters = geometry, material, emitters
        self.cache, self.collector = cache, collector


class RadianceCollector:
    """Adds up radiance. A collector says what a path gains by reaching an emitter; kernels are otherwise the same."""

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        """Gain of reaching `face` of the given radiance with path weight `weight` (Color3f)."""
        return dr.select(active, weight * radiance, 0)

    def environment(self, radiance: Any, weight: Any, active: Any) -> Any:
        """Gain of leaving the scene."""
        return dr.select(active, weight * radiance, 0)


def power_weight(p: Any, q: Any) -> Any:
    """p^2 / (p^2 + q^2) as 1 / (1 + (q/p)^2): no overflow of the squares, p = inf gives 1, p = 0 gives 0 (METHOD H16, H56)."""
    ratio = q / p
    return dr.select(p > 0, 1 / dr.fma(ratio, ratio, 1), 0)


def uniform(rng: Any) -> Any:
    """Uniform in [0, 1 - 2^-24] (METHOD H55)."""
    return dr.minimum(rng.next_float32(), 1 - 2**-24)


def to_world(local: tuple[Any, Any, Any], normal: Any) -> Any:
    """Local vector (z = normal) in world axes; the frame is Duff et al.'s branch-free one."""
    tangent, bitangent = mi.coordinate_system(normal)
    return mi.Vector3f(tangent * local[0] + bitangent * local[1] + normal * local[2])


def evaluate(wi: Any, wo: Any, normal: Any, roughness: Any) -> tuple[Any, Any, Any, Any]:
    """(diffuse, spec, fc, mixture density) of one pair of directions."""
    NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, normal, wi, wo)
    diffuse, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, roughness)
    return diffuse, spec, fc, brdf.mixture_pdf(DRJIT, NoL, NoH, VoH, sin2_h, roughness)


def reflectance(kd: Any, ks: Any, diffuse: Any, spec: Any, fc: Any) -> Any:
    """f cos (Color3f) from the lobes of one direction."""
    return brdf.compose(kd, ks, diffuse, spec * (1 - fc), spec * fc)


def sample_lobe(choose_specular: Any, u1: Any, u2: Any, wo: Any, normal: Any, roughness: Any) -> Any:
    """Direction from the GGX lobe where asked, else from the cosine lobe; it may lie below the surface."""
    half = to_world(brdf.sample_ggx_half(DRJIT, u1, u2, roughness), normal)
    mirrored = dr.normalize(mi.Vector3f(*brdf.reflect(wo, half)))
    return dr.select(choose_specular, mirrored, to_world(brdf.sample_cosine(DRJIT, u1, u2), normal))


@dataclass
class LightSample:
    """A point drawn on an emitter: `valid` = visible and radiating this way; `pdf` per solid angle at the receiver."""

    valid: Any
    face: Any
    radiance: Any
    wi: Any
    pdf: Any


def sample_light(world: World, rng: Any, point: Any, normal: Any, active: Any) -> LightSample:
    """Next-event estimation from `point`, which already lies off the surface (see `offset_from`)."""
    emitters, geometry = world.emitters, world.geometry
    u0, u1, u2 = uniform(rng), uniform(rng), uniform(rng)
    face = emitters.sample_face(u0, active)
    root = dr.sqrt(u1)
    target = geometry.point_on_face(face, 1 - root, root * u2, active)
    light_normal, _ = geometry.normal_and_object(face, active)
    offset = mi.Vector3f(target - point)
    distance2 = dr.squared_norm(offset)
    distance = dr.sqrt(distance2)
    wi = offset / dr.maximum(distance, 1e-20)
    cos_front = -dr.dot(light_normal, wi)
    radiance, pdf_area, emits, _ = emitters.surface(face, cos_front, active)
    candidate = active & (pdf_area > 0) if world.collector_ignores_radiance else emits
    pdf = pdf_area * distance2 / dr.abs(cos_front)
    valid = candidate & (dr.abs(cos_front) > 1e-7) & (dr.dot(normal, wi) > 0) & (pdf > 0)
    # Up to 1e-3 of the distance in front of the emitter counts as the emitter (METHOD H23).
    valid &= ~geometry.occluded(point, wi, distance * (1 - 1e-3), valid)
    return LightSample(valid, face, radiance, wi, pdf)
