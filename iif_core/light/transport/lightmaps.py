"""Diffuse light that arrives at surface points from every lamp by itself, with all reflections, from one set of paths
(docs/method/light.md#light-maps)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.light.transport.arrays import batches, checked_points, on_device
from iif_core.light.transport.geometry import cosine_directions, nearest_hit, offset_from, trace
from iif_core.light.transport.kernels import (
    Vertex,
    World,
    incoming,
    light_by_lobe,
    power_weight,
    sample_light,
    scatter_by_lobe,
    to_world,
    uniform,
)
from iif_core.light.transport.lamp_cache import NEAR, LampCache
from iif_core.light.transport.lamps import LampCollector, checked_lamps
from iif_core.light.transport.scene import PathOptions, Scene
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf

Array = np.ndarray

DRAWS = 2
"""Emitters that are drawn at a point of the map for each direction."""
CELLS = 1 << 14
"""Squares of which the surface would consist if it were cut evenly. The voxels of known light have the same edge."""
LEARNED = 0.5
"""Rays for each point of a map that find the surface from which it gets reflected light."""


class _Given:
    """Random numbers of which the first is given."""

    def __init__(self, first: Any, rng: Any):
        self._first, self._rng = [first], rng

    def next_float32(self) -> Any:
        return self._first.pop() if self._first else self._rng.next_float32()

    def next_uint32(self) -> Any:
        return self._rng.next_uint32()


def _drawn_light(world: World, rng: Any, origin: Any, normal: Any, number: Any, count: Any) -> Any:
    """Collect the light of the emitter that draw `number` of `count` finds. Which emitter it is, is drawn once in each of `count`
    strata, so that every lamp has its share of the draws at every point. Returns the gain, 0."""
    if not world.emitters.can_be_sampled:
        return mi.Color3f(0)
    # `sample_light` draws the emitter first, so the given number picks the emitter and the rest stays random.
    light = sample_light(world, _Given((number + uniform(rng)) / count, rng), origin, normal, mi.Bool(True))
    cosine = dr.maximum(dr.dot(normal, light.wi), 0) * dr.inv_pi
    # DRAWS emitters stand against one direction, so their density counts DRAWS times (Eq. S.6).
    share = dr.select(light.valid, cosine * power_weight(DRAWS * light.pdf, cosine) / (DRAWS * light.pdf), 0)
    return light.gain(world, mi.Color3f(share))


@dr.syntax
def _trace_points(
    world: World,
    known: LampCache | None,
    rng: Any,
    point: Any,
    normal: Any,
    samples: Any,
    sample: Any,
    end: Any,
    max_bounces: Any,
) -> Any:
    """Follow the paths of every lane; the collector holds the result, and the returned gain is 0."""
    nothing = mi.Color3f(0)
    origin = offset_from(point, normal)
    while sample < end:
        # -------- emitters drawn at the point --------
        for draw in range(DRAWS):
            nothing += _drawn_light(world, rng, origin, normal, DRAWS * mi.Float(sample) + draw, DRAWS * mi.Float(samples))

        # -------- direction of density cos / pi --------
        # The first number of a direction is drawn once in each of as many strata as there are samples.
        u1 = dr.minimum((mi.Float(sample) + uniform(rng)) / mi.Float(samples), 1 - 2**-24)
        u2 = uniform(rng)
        wi = to_world(brdf.sample_cosine(DRJIT, u1, u2), normal)
        pdf = dr.dot(normal, wi) * dr.inv_pi
        # cos / pi over the density is 1, so the path starts with throughput 1.
        gain, rng = _arriving(world, known, rng, origin, wi, pdf, max_bounces)
        nothing += gain
        sample += 1
    return nothing


def _arriving(
    world: World, known: LampCache | None, rng: Any, origin: Any, direction: Any, pdf: Any, max_bounces: Any
) -> tuple[Any, Any]:
    """Collect what arrives along a ray that leaves a point of the map. Returns the gain, 0, and the random stream."""
    one = pdf / DRAWS  # against the density of one draw of an emitter, of which there are DRAWS for each direction
    if known is None:
        return incoming(world, rng, origin, direction, one, 1, max_bounces, pdf > 0)
    # With one interaction at most, the point itself, `incoming` collects emission and stops.
    emitted, rng = incoming(world, rng, origin, direction, one, 1, 1, pdf > 0)
    reflected, rng = _reflected(world, known, rng, origin, direction, max_bounces, (pdf > 0) & (max_bounces > 1))
    return emitted + reflected, rng


def _reflected(
    world: World, known: LampCache, rng: Any, origin: Any, direction: Any, max_bounces: Any, active: Any
) -> tuple[Any, Any]:
    """Collect what the surface that a ray meets reflects; return the gain, 0, and the random stream.

    Where the diffuse light of the surface is known, it is looked up, and the path continues for the gloss alone. Elsewhere the
    path continues for all of the light."""
    # -------- the surface that the ray meets --------
    hit = nearest_hit(world.geometry, origin, direction, active, world.geometry.draw_salt(rng))
    front = -dr.dot(hit.normal, direction)
    active &= hit.valid & (front != 0)
    normal = dr.select(front < 0, -hit.normal, hit.normal)
    base_color, roughness, metallic = world.material(hit.point, hit.face, hit.object_id, active)
    kd, ks = brdf.kd_ks(base_color, metallic)

    # -------- its diffuse light, where it is known --------
    found, row = known.find(hit.point, normal, hit.object_id, hit.t, active)
    gain = known.add(world.collector, row, kd, found)

    # -------- the rest: its gloss alone, or a whole path --------
    # Where the diffuse light is known, a path follows in the GGX lobe with the probability of this lobe. 1 / chance makes up for
    # the paths that do not.
    chance = brdf.specular_chance(DRJIT, dr.max(kd), dr.max(ks), dr.dot(normal, -direction))
    goes_on = active & (~found | (uniform(rng) < chance))
    over = dr.select(found, dr.rcp(chance), 1)
    # Known: k_d = 0, and the GGX lobe for certain. Not known: both lobes, as at any vertex.
    diffuse, lobe = dr.select(found, mi.Color3f(0), kd), dr.select(found, 1, chance)
    vertex = Vertex(offset_from(hit.point, normal), normal, -direction, diffuse, ks, roughness, lobe)
    if world.emitters.can_be_sampled:
        light, *shares = light_by_lobe(world, rng, vertex, goes_on)
        gain += light.gain(world, over * (shares[0] + shares[1]))
    goes_on, wi, *shares, pdf = scatter_by_lobe(rng, vertex, goes_on)
    # Two interactions so far: the point of the map, and this surface.
    more, rng = incoming(world, rng, vertex.point, wi, pdf, 2, max_bounces, goes_on, over * (shares[0] + shares[1]))
    return gain + more, rng


def light_maps(
    scene: Scene,
    points: ArrayLike,
    normals: ArrayLike,
    lamp_of_face: ArrayLike,
    lamps: int,
    paths: PathOptions,
    environment_lamp: int = -1,
    number: Array | None = None,
    known: LampCache | None = None,
) -> Array:
    """Integrate the diffuse light at points for every lamp by itself: D_l = 1/pi int L_l cos, of the light L_l that lamp l emits
    and that reaches the point directly or after any reflections (Eq. L.59).

    A diffuse surface of reflectance k_d then has the radiance k_d sum_l D_l, and the sum over all lamps is the diffuse integral
    of Eq. S.3, because every path adds what it meets to the lamp that emits it and nothing is counted twice or left out.

    Args:
        scene: what paths meet; of its cache nothing is used, because cached light belongs to no lamp.
        points: (n, 3) metres.
        normals: (n, 3) of any length above 0, on the side from which the light arrives.
        lamp_of_face: (m,) lamp of every face of the scene, -1 = its light is left out.
        lamps: number of lamps.
        paths: bounces include the point.
        environment_lamp: lamp of the environment, -1 = its light is left out.
        number: (n,) uint32, by which the points draw their random numbers; None = by their order.
        known: light of the surface that paths meet first, with which they end there except for the gloss; None = they go on.

    Returns:
        (n, lamps, 3) float32 radiance, linear.

    Raises:
        InputError: wrong shapes, non-finite numbers, lamps out of range.
        TransportError: light that is not finite.
    """
    points, normals, _ = checked_points(points, normals, normals)
    of_face = on_device(checked_lamps(scene, lamp_of_face, lamps, environment_lamp), mi.Int32)
    result = np.zeros((len(points), lamps, 3), np.float32)
    if paths.max_bounces == 0 or lamps == 0 or not len(points):
        return result
    scene = scene._replace(cache=None)
    for batch in batches(len(points), paths.samples, 3 * lamps, paths.chunk):
        rows = dr.zeros(mi.Float, batch.lanes * 3 * lamps)
        lane = dr.arange(mi.UInt32, batch.lanes)
        world = World(scene, LampCollector(rows, lane, lamps, of_face, environment_lamp))
        gain = _trace_points(
            world,
            known,
            batch.streams(paths.seed, number),
            batch.spread(mi.Point3f, points),
            batch.spread(mi.Vector3f, normals),
            dr.opaque(mi.UInt32, paths.samples),
            *batch.samples(paths.samples),
            dr.opaque(mi.UInt32, paths.max_bounces),
        )
        dr.eval(gain, rows)
        result[batch.part] = batch.collect_rows(rows, lamps, 3)
    return result / np.float32(paths.samples)


def known_light(
    scene: Scene,
    points: ArrayLike,
    normals: ArrayLike,
    lamp_of_face: ArrayLike,
    lamps: int,
    object_of_face: ArrayLike,
    paths: PathOptions,
    environment_lamp: int = -1,
) -> LampCache | None:
    """Trace the light of the surface that reflects it to the points of a light map, for `light_maps`.

    The light is traced where rays from some of the points meet surface, and averaged over cells. Each part of a cell thus counts
    as often as it is met. What all points get from a cell therefore has the same mean as with whole paths.

    Args:
        scene, lamp_of_face, lamps, environment_lamp: as in `light_maps`.
        points, normals: (n, 3) of the map: metres; unit vectors on the side from which light arrives.
        object_of_face: (m,) object of every face, -1 = none.
        paths: from each place; bounces include the place, and the seed differs from the seed of the map.

    Returns:
        The light; None where no surface is met or paths have no bounce.
    """
    geometry, rng = scene.geometry, np.random.default_rng(paths.seed)
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)

    # -------- places that reflect light to the map --------
    row = rng.choice(len(points), int(np.ceil(LEARNED * len(points))), replace=False)
    start, way = points[row] + 1e-4 * normals[row], cosine_directions(normals[row], rng)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    face, distance = trace(geometry, start, way)
    edge = float(np.sqrt(geometry.areas.sum() / CELLS))
    # Nearer surface is not asked, and it would make cells in corners darker than those who ask see them.
    met = np.flatnonzero((face >= 0) & (np.asarray(lamp_of_face)[face] < 0) & (distance > NEAR * edge))
    if not len(met) or paths.max_bounces == 0 or not lamps:
        return None

    # -------- their light --------
    face, way = face[met], way[met]
    place = start[met] + distance[met, None] * way
    normal = geometry.normals[face]
    # The side from which the ray came.
    normal = np.where(np.einsum("ij,ij->i", normal, way)[:, None] > 0, -normal, normal)
    light = light_maps(scene, place, normal, lamp_of_face, lamps, paths, environment_lamp)
    return LampCache(edge, place, normal, np.asarray(object_of_face)[face], light)
