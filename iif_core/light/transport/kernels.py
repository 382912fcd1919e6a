"""The path tracer itself: one vertex, one loop. Everything here works on device types inside a kernel.

Directions are of unit length, `wo` points to where the light goes, `wi` to where it comes from. Surfaces are
double-sided. A vertex is lit twice, by a point drawn on an emitter and by the direction in which the path
goes on, and the two are weighted with the power heuristic, both densities per solid angle (METHOD 2.5; the
measure mix-up named there is avoided).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from iif_core.light.transport.cache import RadianceCache
from iif_core.light.transport.emitters import Emitters
from iif_core.light.transport.geometry import Geometry, nearest_hit, offset_from
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf

ROULETTE_START = 4
ROULETTE_LIMIT = 0.95


class World:
    """What a path meets: not a Dr.Jit struct on purpose, so that loops do not carry its tables as state."""

    def __init__(
        self,
        geometry: Geometry,
        material: Any,
        emitters: Emitters,
        cache: RadianceCache | None,
        collector: Any,
    ):
        self.geometry, self.material, self.emitters = geometry, material, emitters
        self.cache, self.collector = cache, collector


class RadianceCollector:
    """Adds up radiance. A collector says what a path gains by reaching an emitter; kernels are otherwise the
    same."""

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        """Gain of reaching `face` of the given radiance with path weight `weight` (Color3f)."""
        return dr.select(active, weight * radiance, 0)

    def environment(self, texel: Any, radiance: Any, weight: Any, active: Any) -> Any:
        """Gain of leaving the scene through `texel` of the environment."""
        return dr.select(active, weight * radiance, 0)


def power_weight(p: Any, q: Any) -> Any:
    """p^2 / (p^2 + q^2) as 1 / (1 + (q/p)^2): no overflow of the squares, p = inf gives 1, p = 0 gives 0
    (METHOD H16, H56)."""
    ratio = q / p
    return dr.select(p > 0, 1 / dr.fma(ratio, ratio, 1), 0)


def uniform(rng: Any) -> Any:
    """Uniform in [0, 1 - 2^-24] (METHOD H55)."""
    return dr.minimum(rng.next_float32(), 1 - 2**-24)


def to_world(local: tuple[Any, Any, Any], normal: Any) -> Any:
    """Local vector (z = normal) in world axes; the frame is Duff et al.'s branch-free one."""
    tangent, bitangent = mi.coordinate_system(normal)
    return mi.Vector3f(tangent * local[0] + bitangent * local[1] + normal * local[2])


def specular_chance(kd: Any, ks: Any, normal: Any, wo: Any) -> Any:
    """Probability with which a path at this vertex goes on in the GGX lobe."""
    return brdf.specular_chance(DRJIT, dr.max(kd), dr.max(ks), dr.dot(normal, wo))


def evaluate(wi: Any, wo: Any, normal: Any, roughness: Any, chance: Any) -> tuple[Any, Any, Any, Any]:
    """(diffuse, spec, fc, mixture density) of one pair of directions."""
    NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, normal, wi, wo)
    diffuse, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, roughness)
    return diffuse, spec, fc, brdf.mixture_pdf(DRJIT, NoL, NoH, VoH, sin2_h, roughness, chance)


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
    """A point drawn on an emitter, or a direction to the environment (`on_sky`): `valid` = visible and radiating this
    way; `pdf` per solid angle at the receiver."""

    valid: Any
    face: Any
    on_sky: Any
    texel: Any
    radiance: Any
    wi: Any
    pdf: Any

    def gain(self, world: World, weight: Any) -> Any:
        """What the collector makes of it, for a path of the given weight (Color3f)."""
        if not world.emitters.sky_is_sampled:
            return world.collector.emitter(self.face, self.radiance, weight, self.valid)
        gain = world.collector.emitter(self.face, self.radiance, weight, self.valid & ~self.on_sky)
        return gain + world.collector.environment(self.texel, self.radiance, weight, self.valid & self.on_sky)


def sample_light(world: World, rng: Any, point: Any, normal: Any, active: Any) -> LightSample:
    """Next-event estimation from `point`, which already lies off the surface (see `offset_from`)."""
    emitters, geometry = world.emitters, world.geometry
    u0, u1, u2 = uniform(rng), uniform(rng), uniform(rng)
    face, on_sky, texel = emitters.sample(u0, active)
    root = dr.sqrt(u1)
    target = geometry.point_on_face(face, 1 - root, root * u2, active)
    light_normal, _ = geometry.normal_and_object(face, active)
    offset = mi.Vector3f(target - point)
    distance2 = dr.squared_norm(offset)
    distance = dr.sqrt(distance2)
    wi = offset / dr.maximum(distance, 1e-20)
    cos_front = -dr.dot(light_normal, wi)
    radiance, pdf_area, emits, _ = emitters.surface(face, cos_front, active)
    pdf = pdf_area * distance2 / dr.abs(cos_front)
    valid = emits & (dr.abs(cos_front) > 1e-7)
    # Up to 1e-3 of the distance in front of the emitter counts as the emitter (METHOD H23).
    reach = distance * (1 - 1e-3)
    if emitters.sky_is_sampled:
        sky, sky_pdf = emitters.texel(texel, active & on_sky)
        radiance, pdf = dr.select(on_sky, sky, radiance), dr.select(on_sky, sky_pdf, pdf)
        wi = dr.select(on_sky, emitters.direction_to(texel, u1, u2), wi)
        valid, reach = (valid & ~on_sky) | (active & on_sky), dr.select(on_sky, dr.inf, reach)
    valid &= (dr.dot(normal, wi) > 0) & (pdf > 0)
    valid &= ~geometry.occluded(point, wi, reach, valid)
    return LightSample(valid, face, on_sky, texel, radiance, wi, pdf)


def light_by_lobe(
    world: World, rng: Any, point: Any, normal: Any, wo: Any, kd: Any, ks: Any, roughness: Any, active: Any
) -> tuple[LightSample, Any, Any]:
    """(sample, diffuse weight, specular weight) of next-event estimation at a vertex."""
    light = sample_light(world, rng, point, normal, active)
    diffuse, spec, fc, pdf = evaluate(light.wi, wo, normal, roughness, specular_chance(kd, ks, normal, wo))
    share = dr.select(light.valid, power_weight(light.pdf, pdf) / light.pdf, 0)
    return light, kd * diffuse * share, reflectance(0, ks, 0, spec, fc) * share


def direct_light(
    world: World,
    rng: Any,
    point: Any,
    normal: Any,
    wo: Any,
    kd: Any,
    ks: Any,
    roughness: Any,
    weight: Any,
    active: Any,
) -> Any:
    """Gain of next-event estimation at a vertex whose path weight so far is `weight`."""
    if not world.emitters.can_be_sampled:
        return mi.Color3f(0)
    light, diffuse, specular = light_by_lobe(world, rng, point, normal, wo, kd, ks, roughness, active)
    return light.gain(world, weight * (diffuse + specular))


def scatter_by_lobe(
    rng: Any, normal: Any, wo: Any, kd: Any, ks: Any, roughness: Any, active: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """(goes_on, wi, diffuse f cos / pdf, specular f cos / pdf, pdf): the direction in which a path continues."""
    choice, u1, u2 = uniform(rng), uniform(rng), uniform(rng)
    chance = specular_chance(kd, ks, normal, wo)
    wi = sample_lobe(choice < chance, u1, u2, wo, normal, roughness)
    diffuse, spec, fc, pdf = evaluate(wi, wo, normal, roughness, chance)
    goes_on = active & (dr.dot(normal, wi) > 0) & (pdf > 0)
    lobes = kd * diffuse / pdf, reflectance(0, ks, 0, spec, fc) / pdf
    return goes_on, wi, *(dr.select(goes_on, lobe, 0) for lobe in lobes), pdf


def scatter(rng: Any, normal: Any, wo: Any, kd: Any, ks: Any, roughness: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """(goes_on, wi, f cos / pdf, pdf): the direction in which a path continues."""
    goes_on, wi, diffuse, specular, pdf = scatter_by_lobe(rng, normal, wo, kd, ks, roughness, active)
    return goes_on, wi, diffuse + specular, pdf


def roulette(rng: Any, bounce: Any, throughput: Any, active: Any) -> tuple[Any, Any]:
    """(survives, 1 / survival probability) from the fourth bounce on; before that everyone survives."""
    chance = dr.minimum(dr.max(throughput), ROULETTE_LIMIT)
    chance = dr.select(bounce >= ROULETTE_START, chance, 1)
    survives = active & (uniform(rng) < chance) & (dr.max(throughput) > 0)
    return survives, dr.select(survives, 1 / chance, 0)


def take_from_cache(world: World, point: Any, throughput: Any, active: Any) -> tuple[Any, Any]:
    """(found, gain) of ending the path with the cached radiance."""
    if world.cache is None or world.cache.count == 0:
        return mi.Bool(False), mi.Color3f(0)
    found, radiance = world.cache.radiance(point, active)
    return found, dr.select(found, throughput * radiance, 0)


@dr.syntax
def incoming(
    world: World,
    rng: Any,
    origin: Any,
    direction: Any,
    pdf: Any,
    bounce: Any,
    max_bounces: Any,
    active: Any,
    throughput: Any = 1.0,
) -> tuple[Any, Any]:
    """(gain, rng) along `direction` from `origin`: radiance times `throughput`, when the collector collects
    radiance.

    `pdf` is the density with which the direction was drawn where emitters were sampled as well, inf where
    they were not; `bounce` counts the surface interactions so far. The path ends at the environment, in the
    radiance cache (only for bounce >= 1 and never on an emitting face), after `max_bounces` interactions, or
    by Russian roulette.
    """
    gain = mi.Color3f(0)
    throughput = mi.Color3f(throughput)
    origin = mi.Point3f(origin)
    direction = mi.Vector3f(direction)
    pdf = mi.Float(pdf)
    bounce = mi.UInt32(bounce)
    active = mi.Bool(active)
    while active:
        hit = nearest_hit(world.geometry, origin, direction, active)
        escapes = active & ~hit.valid
        texel = world.emitters.texel_along(direction)
        sky, sky_pdf = world.emitters.texel(texel, escapes)
        gain += world.collector.environment(texel, sky, throughput * power_weight(pdf, sky_pdf), escapes)
        cos_front = -dr.dot(hit.normal, direction)
        radiance, pdf_area, emits, is_emitter = world.emitters.surface(hit.face, cos_front, hit.valid)
        weight = power_weight(pdf, pdf_area * hit.t * hit.t / dr.abs(cos_front))
        gain += world.collector.emitter(hit.face, radiance, throughput * weight, emits)
        found, cached = take_from_cache(world, hit.point, throughput, hit.valid & ~is_emitter & (bounce >= 1))
        gain += cached

        active &= hit.valid & ~found & (bounce < max_bounces) & (cos_front != 0)
        normal = dr.select(cos_front < 0, -hit.normal, hit.normal)
        wo = -direction
        base_color, roughness, metallic = world.material(hit.point, hit.face, hit.object_id, active)
        kd, ks = brdf.kd_ks(base_color, metallic)
        origin = offset_from(hit.point, normal)
        gain += direct_light(world, rng, origin, normal, wo, kd, ks, roughness, throughput, active)
        active, direction, factor, pdf = scatter(rng, normal, wo, kd, ks, roughness, active)
        throughput *= factor
        bounce += 1
        active, boost = roulette(rng, bounce, throughput, active)
        throughput *= boost
    return gain, rng
