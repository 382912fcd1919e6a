"""One path: its vertices, the light that is drawn at them, and the loop that follows it (docs/method/shading.md#paths).

Everything here works on device types inside a kernel. Directions have unit length; `wo` points to where the light goes, `wi` to
where it comes from. The two ways to draw light are weighted with the power heuristic (Eq. S.6), both densities per solid angle
(docs/method/numerics.md#densities-in-two-measures).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from iif_core.light.transport.geometry import nearest_hit, offset_from
from iif_core.light.transport.scene import Scene
from iif_core.numerics.frames import tangent_frame
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf

ROULETTE_START = 4  # interactions after which a path may end by chance
ROULETTE_LIMIT = 0.95  # highest probability of survival


class World:
    """A scene and a collector for kernels; not a Dr.Jit struct on purpose, so that loops do not carry its tables as state."""

    def __init__(self, scene: Scene, collector: Any):
        self.geometry, self.material, self.emitters, self.cache = scene
        self.collector = collector


class RadianceCollector:
    """Adds up radiance. A collector says what a path gains by reaching an emitter; kernels are otherwise the same."""

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        """Return what a path gains on reaching an emitting face.

        Args:
            face: id of the face.
            radiance: its radiance towards the path.
            weight: Color3f, throughput of the path times the weight of multiple importance sampling.
            active: where the face is reached.

        Returns:
            Color3f, 0 where not active.
        """
        return dr.select(active, weight * radiance, 0)

    def environment(self, texel: Any, radiance: Any, weight: Any, active: Any) -> Any:
        """Return what a path gains on leaving the scene through `texel` (row x W + column).

        Args:
            texel, radiance, weight, active: as in `emitter`.

        Returns:
            Color3f, 0 where not active.
        """
        return dr.select(active, weight * radiance, 0)


@dataclass
class Vertex:
    """A shaded point of a path: `point` already lies off the surface (`offset_from`), `normal` is on the side of `wo`.

    `chance`: probability with which a path continues in the GGX lobe; None = by what the lobes reflect (Eq. R.12).
    """

    point: Any
    normal: Any
    wo: Any
    kd: Any
    ks: Any
    roughness: Any
    chance: Any = None


def power_weight(p: Any, q: Any) -> Any:
    """Return p^2 / (p^2 + q^2) as 1 / (1 + (q/p)^2), Eq. S.6; p = inf gives 1, p = 0 gives 0
    (docs/method/numerics.md#squared-densities)."""
    ratio = q / p
    return dr.select(p > 0, 1 / dr.fma(ratio, ratio, 1), 0)


def uniform(rng: Any) -> Any:
    """Draw uniformly from [0, 1 - 2^-24] (docs/method/numerics.md#random-numbers-equal-to-one)."""
    return dr.minimum(rng.next_float32(), 1 - 2**-24)


def to_world(local: tuple[Any, Any, Any], normal: Any) -> Any:
    """Turn a local vector (z = normal) into world axes."""
    tangent, bitangent = (mi.Vector3f(*axis) for axis in tangent_frame(DRJIT, normal.x, normal.y, normal.z))
    return mi.Vector3f(tangent * local[0] + bitangent * local[1] + normal * local[2])


def _specular_chance(vertex: Vertex) -> Any:
    """Probability with which a path continues in the GGX lobe."""
    if vertex.chance is not None:
        return vertex.chance
    return brdf.specular_chance(DRJIT, dr.max(vertex.kd), dr.max(vertex.ks), dr.dot(vertex.normal, vertex.wo))


def _evaluate(vertex: Vertex, wi: Any, chance: Any) -> tuple[Any, Any, Any]:
    """(diffuse f cos, specular f cos, mixture density) of light from `wi`."""
    NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, vertex.normal, wi, vertex.wo)
    diffuse, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, vertex.roughness)
    pdf = brdf.mixture_pdf(DRJIT, NoL, NoH, VoH, sin2_h, vertex.roughness, chance)
    # With k_d = 0 `compose` leaves the specular part of Eq. R.7.
    return vertex.kd * diffuse, brdf.compose(0, vertex.ks, 0, spec * (1 - fc), spec * fc), pdf


def sample_lobe(choose_specular: Any, u1: Any, u2: Any, wo: Any, normal: Any, roughness: Any) -> Any:
    """Draw a direction from the GGX lobe or from the cosine lobe.

    Args:
        choose_specular: where the GGX lobe is wanted.
        u1, u2: uniform in [0, 1).
        wo, normal: unit direction to the viewer, unit normal on its side.
        roughness: of the GGX lobe.

    Returns:
        Unit direction, possibly below the surface.
    """
    # Every lane evaluates both candidates and keeps one, so the two may share u1 and u2.
    half = to_world(brdf.sample_ggx_half(DRJIT, u1, u2, roughness), normal)
    mirrored = dr.normalize(mi.Vector3f(*brdf.reflect(wo, half)))
    return dr.select(choose_specular, mirrored, to_world(brdf.sample_cosine(DRJIT, u1, u2), normal))


@dataclass
class LightSample:
    """A point drawn on an emitter, or a direction to the environment (`on_sky`).

    `valid`: it is visible and radiates this way; `pdf`: density per solid angle at the receiver (Eq. S.5).
    """

    valid: Any
    face: Any
    on_sky: Any
    texel: Any
    radiance: Any
    wi: Any
    pdf: Any

    def gain(self, world: World, weight: Any) -> Any:
        """Return what a path of the given weight (Color3f) gains by it."""
        if not world.emitters.sky_is_sampled:
            return world.collector.emitter(self.face, self.radiance, weight, self.valid)
        gain = world.collector.emitter(self.face, self.radiance, weight, self.valid & ~self.on_sky)
        return gain + world.collector.environment(self.texel, self.radiance, weight, self.valid & self.on_sky)


def sample_light(world: World, rng: Any, point: Any, normal: Any, active: Any) -> LightSample:
    """Draw a point on an emitter or a direction to the environment and test whether it is visible.

    Args:
        world: what the shadow ray can meet.
        rng: random stream of the lane.
        point, normal: receiver, already off the surface (`offset_from`), and its unit normal on the side of the viewer.
        active: lanes that need a sample.

    Returns:
        The sample.
    """
    # u0 picks a face or a texel, (u1, u2) the point on the face or the direction in the texel.
    emitters, geometry = world.emitters, world.geometry
    u0, u1, u2 = uniform(rng), uniform(rng), uniform(rng)
    face, on_sky, texel = emitters.sample(u0, active)

    # -------- point on a face: density per area, then per solid angle (Eq. S.5) --------
    # The square root makes barycentric coordinates uniform over the triangle.
    root = dr.sqrt(u1)
    target = geometry.point_on_face(face, 1 - root, root * u2, active)
    light_normal, _ = geometry.normal_and_object(face, active)
    offset = mi.Vector3f(target - point)
    distance2 = dr.squared_norm(offset)
    distance = dr.sqrt(distance2)
    # A receiver on the drawn point itself has no direction to it. The tests of `valid` below sort such samples out.
    wi = offset / dr.maximum(distance, 1e-20)
    cos_front = -dr.dot(light_normal, wi)
    radiance, pdf_area, emits, _ = emitters.surface(face, cos_front, active)
    pdf = pdf_area * distance2 / dr.abs(cos_front)
    # A face that is seen edge-on has no finite density.
    valid = emits & (dr.abs(cos_front) > 1e-7)
    # Up to 1e-3 of the distance in front of the emitter counts as the emitter: numerics.md#visibility-of-a-light.
    reach = distance * (1 - 1e-3)

    # -------- or a direction to the environment, in lanes that drew a texel --------
    if emitters.sky_is_sampled:
        sky, sky_pdf = emitters.texel(texel, active & on_sky)
        radiance, pdf = dr.select(on_sky, sky, radiance), dr.select(on_sky, sky_pdf, pdf)
        # A lane uses (u1, u2) for the face or for the texel, never for both.
        wi = dr.select(on_sky, emitters.direction_to(texel, u1, u2), wi)
        # Whatever the ray meets hides the environment, however far away it is.
        valid, reach = (valid & ~on_sky) | (active & on_sky), dr.select(on_sky, dr.inf, reach)

    # -------- visibility --------
    # Only lanes whose sample can contribute trace a shadow ray.
    valid &= (dr.dot(normal, wi) > 0) & (pdf > 0)
    valid &= ~geometry.occluded(point, wi, reach, valid, geometry.draw_salt(rng))
    return LightSample(valid, face, on_sky, texel, radiance, wi, pdf)


def light_by_lobe(world: World, rng: Any, vertex: Vertex, active: Any) -> tuple[LightSample, Any, Any]:
    """Estimate direct light by drawing a point on an emitter.

    Args:
        world: what the shadow ray can meet.
        rng: random stream of the lane.
        vertex: the shaded point.
        active: lanes that need a sample.

    Returns:
        The sample and its weights f cos w / pdf (Color3f) in the diffuse and in the specular lobe.
    """
    light = sample_light(world, rng, vertex.point, vertex.normal, active)
    # `pdf` is p_b of Eq. S.6: the density with which the path itself would continue towards the light.
    diffuse, specular, pdf = _evaluate(vertex, light.wi, _specular_chance(vertex))
    share = dr.select(light.valid, power_weight(light.pdf, pdf) / light.pdf, 0)
    return light, diffuse * share, specular * share


def _direct_light(world: World, rng: Any, vertex: Vertex, weight: Any, active: Any) -> Any:
    """Gain of a point drawn on an emitter, at a vertex of a path with throughput `weight`."""
    if not world.emitters.can_be_sampled:
        return mi.Color3f(0)
    light, diffuse, specular = light_by_lobe(world, rng, vertex, active)
    return light.gain(world, weight * (diffuse + specular))


def scatter_by_lobe(rng: Any, vertex: Vertex, active: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Draw the direction in which a path continues: (goes_on, wi, diffuse f cos / pdf, specular f cos / pdf, pdf)."""
    choice, u1, u2 = uniform(rng), uniform(rng), uniform(rng)
    chance = _specular_chance(vertex)
    wi = sample_lobe(choice < chance, u1, u2, vertex.wo, vertex.normal, vertex.roughness)
    diffuse, specular, pdf = _evaluate(vertex, wi, chance)
    # A direction below the surface ends the path. A second draw in its place would not have the density `pdf`.
    goes_on = active & (dr.dot(vertex.normal, wi) > 0) & (pdf > 0)
    return goes_on, wi, *(dr.select(goes_on, lobe / pdf, 0) for lobe in (diffuse, specular)), pdf


def _roulette(rng: Any, bounce: Any, throughput: Any, active: Any) -> tuple[Any, Any]:
    """Russian roulette (Eq. S.11): (survives, 1 / survival probability); before `ROULETTE_START` every path survives."""
    chance = dr.minimum(dr.max(throughput), ROULETTE_LIMIT)
    # With a chance of 1 every path survives, because `uniform` never returns 1.
    chance = dr.select(bounce >= ROULETTE_START, chance, 1)
    survives = active & (uniform(rng) < chance) & (dr.max(throughput) > 0)
    return survives, dr.select(survives, 1 / chance, 0)


def _take_from_cache(world: World, point: Any, throughput: Any, active: Any) -> tuple[Any, Any]:
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
    """Follow a path and return what it gains (Eq. S.10): radiance times throughput where radiance is collected.

    The path ends at the environment, in the radiance cache (never on an emitting face), after `max_bounces` interactions, or
    by Russian roulette.

    Args:
        world: what the path can meet.
        rng: random stream of the lane.
        origin, direction: start, off the surface, and unit direction.
        pdf: density per solid angle with which the direction was drawn where emitters are drawn as well, inf elsewhere.
        bounce, max_bounces: surface interactions so far (at 0 the cache is not asked), and the most.
        active: lanes that have a path.
        throughput: of the path so far.

    Returns:
        Gain (Color3f) and the random stream.
    """
    # The loop carries these variables, so each has its device type before it starts.
    gain = mi.Color3f(0)
    throughput = mi.Color3f(throughput)
    origin = mi.Point3f(origin)
    direction = mi.Vector3f(direction)
    pdf = mi.Float(pdf)
    bounce = mi.UInt32(bounce)
    active = mi.Bool(active)
    while active:
        # -------- nearest surface along the ray --------
        hit = nearest_hit(world.geometry, origin, direction, active, world.geometry.draw_salt(rng))

        # -------- emission that the ray finds, first term of Eq. S.10 --------
        # `pdf` is the density with which the last vertex drew this direction; the other argument of `power_weight` is the
        # density with which `sample_light` would have drawn the same light. A texel that is never drawn has density 0, hence
        # weight 1.
        escapes = active & ~hit.valid
        texel = world.emitters.texel_along(direction)
        sky, sky_pdf = world.emitters.texel(texel, escapes)
        gain += world.collector.environment(texel, sky, throughput * power_weight(pdf, sky_pdf), escapes)
        cos_front = -dr.dot(hit.normal, direction)
        radiance, pdf_area, emits, is_emitter = world.emitters.surface(hit.face, cos_front, hit.valid)
        # Eq. S.5: `t` is the distance to the last vertex in metres, because the direction has length 1.
        weight = power_weight(pdf, pdf_area * hit.t * hit.t / dr.abs(cos_front))
        gain += world.collector.emitter(hit.face, radiance, throughput * weight, emits)

        # -------- end in the radiance cache --------
        # A voxel may hold a lamp and its housing, so emitting faces do not ask the cache. At bounce 0 a camera ray has met its
        # first surface, which is always shaded.
        found, cached = _take_from_cache(world, hit.point, throughput, hit.valid & ~is_emitter & (bounce >= 1))
        gain += cached

        # -------- the point becomes a vertex of the path --------
        # A surface that is met edge-on has no side on which it is seen and counts as a miss.
        active &= hit.valid & ~found & (bounce < max_bounces) & (cos_front != 0)
        normal = dr.select(cos_front < 0, -hit.normal, hit.normal)
        wo = -direction
        base_color, roughness, metallic = world.material(hit.point, hit.face, hit.object_id, active)
        origin = offset_from(hit.point, normal)
        vertex = Vertex(origin, normal, wo, *brdf.kd_ks(base_color, metallic), roughness)

        # -------- next-event estimation, second term of Eq. S.10 --------
        gain += _direct_light(world, rng, vertex, throughput, active)

        # -------- next direction --------
        # `pdf` stays with the direction: the next turn weighs the emission that it finds by it.
        active, direction, diffuse, specular, pdf = scatter_by_lobe(rng, vertex, active)
        throughput *= diffuse + specular
        bounce += 1

        # -------- Russian roulette (Eq. S.11) --------
        active, boost = _roulette(rng, bounce, throughput, active)
        throughput *= boost
    return gain, rng
