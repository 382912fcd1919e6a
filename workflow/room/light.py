"""The lamps of a room, and the light map of each (docs/method/light.md#light-maps)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iif_core.light.base_scene import BaseScene
from iif_core.light.environment import as_map, solid_angles
from iif_core.light.light_maps import MOST_LAMPS, NORMAL_REACH, group_lamps, smooth, with_mean_of
from iif_core.numerics.color import id_colours, luminance
from iif_core.surface.atlas import nearest_covered
from iif_core.surface.triangles import face_geometry
from workflow.exporters.atlas import TexturedPart, joined, texels_beside, texels_of
from workflow.models.denoise import denoise
from workflow.runtime import device
from workflow.scene.named import OUTSIDE

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.scene import Scene

Array = np.ndarray

FAINTEST = 1e-3
"""Least channel of the colour of a lamp, over its largest."""
BESIDE = 2.0
"""A texel next to a chart takes the light of the nearest texel of its part up to this distance, in texels. A difference of the
normals of `NORMAL_REACH` counts as one texel."""
EQUAL_SHARE = 0.5
"""Share of the draws that all lamps have alike; the rest is by power."""
CHUNK = 1 << 16
"""Points that are traced between two lines of progress."""
REACH = 1.5
"""Standard deviation of the smoothing over distance, in texels."""
PROBES = 16
"""Rays from each texel that find out whether it is inside of a solid."""
INSIDE = 0.25
"""Share of the rays that meet surface from behind, above which it is."""
LEARNED_SAMPLES = 16
"""Paths from each place at which the light of surface is found that reflects it to the texels."""


@dataclass(frozen=True)
class Lamp:
    """What one slider moves: an emitter, the environment, or all weak emitters that share a light map.

    Attributes:
        name: for people.
        emitters: ids of its emitters; empty = the environment.
        color: (3,) linear, largest 1: factor on the light of the map, the mean colour of its emitters. White for an environment
            that differs from texel to texel.
        radiance: (3,) mean radiance of its surface, or of the environment over all directions.
        power: of all its light, in m^2 sr of radiance; of the environment, as much as enters through surface that is missing is
            not known, so that it is 0.
    """

    name: str
    emitters: tuple[int, ...]
    color: Array
    radiance: Array
    power: float


@dataclass(frozen=True)
class Lamps:
    """All lamps, and the light of every emitter while its map is traced.

    Attributes:
        lamps: at most `MOST_LAMPS`.
        of_emitter: (E,) int32 lamp of each emitter, -1 = none.
        radiance: (E, 3) float32 radiance of each emitter divided by the colour of its lamp.
        environment: number of the lamp of the environment, -1 = dark.
        surroundings: (H, W, 3) float32 radiance of the environment divided by the colour of its lamp.
    """

    lamps: list[Lamp]
    of_emitter: Array
    radiance: Array
    environment: int
    surroundings: Array


def find_lamps(parts: Sequence[TexturedPart], radiance: Array, environment: Array, names: Sequence[str]) -> Lamps:
    """List the lamps of a scene: one for all emitters of one name, such as the panes of a window; the weakest together beyond
    `MOST_LAMPS`; the environment last.

    Args:
        parts: of the surface; the areas of emitters come from them.
        radiance: (E, 3) of each emitter id.
        environment: (3,), or (H, W, 3) as in `iif_core.light.environment`.
        names: (E,) of the emitters.
    """
    area = np.zeros(len(radiance))
    for part in parts:
        if part.emitter_id >= 0:
            sides = 2 if part.double_sided else 1
            area[part.emitter_id] += sides * face_geometry(part.vertices, part.faces)[1].sum()
    radiance = np.asarray(radiance, np.float64).reshape(-1, 3)
    power = np.pi * area * radiance.mean(1)
    outside = as_map(environment)
    shines = bool(outside.any())
    called = [names[e] if power[e] > 0 else f"{e} is dark" for e in range(len(power))]
    first, named = np.unique(called, return_index=True, return_inverse=True)[1:]
    of_name, count = group_lamps(np.bincount(first[named.ravel()], power, len(power)), MOST_LAMPS - shines)
    of_emitter = np.where(power > 0, of_name[first[named.ravel()]], -1).astype(np.int32)
    lamps, traced = [], np.zeros_like(radiance)
    for number in range(count):
        own = np.flatnonzero(of_emitter == number)
        total = power[own].sum()
        mean = (power[own, None] * radiance[own]).sum(0) / total
        color = np.maximum(_color(mean), FAINTEST)
        traced[own] = radiance[own] / color
        own_names = {names[e] for e in own}
        name = own_names.pop() if len(own_names) == 1 else f"{len(own)} weak emitters together"
        lamps.append(Lamp(name, tuple(int(e) for e in own), color, mean, float(total)))
    if shines:
        even = outside.shape[:2] == (1, 1)
        mean = np.average(outside.reshape(-1, 3), 0, solid_angles(*outside.shape[:2]).ravel()).astype(np.float64)
        lamps.append(Lamp(OUTSIDE, (), _color(mean) if even else np.ones(3), mean, 0.0))
        outside = np.full_like(outside, outside.max()) if even else outside
    return Lamps(lamps, of_emitter, traced.astype(np.float32), len(lamps) - 1 if shines else -1, outside)


def backdrop(radiance: Array, seen: Array | None) -> Array:
    """Return what is drawn behind the room: an environment (H, W, 3), grey with the mean luminance of those texels that no
    photograph shows. Their colours light the room, but as a picture they would be patches of nothing.

    seen: (H, W) bool; None = all.
    """
    if seen is None or seen.shape != radiance.shape[:2] or seen.all():
        return radiance
    mean = np.average(luminance(radiance[~seen]), weights=solid_angles(*seen.shape)[~seen])
    return np.where(seen[..., None], radiance, np.float32(mean))


def _color(radiance: Array) -> Array:
    """(3,) float64 with the largest channel 1."""
    return np.asarray(radiance, np.float64) / max(float(np.max(radiance)), 1e-30)


@dataclass(frozen=True)
class LitTexels:
    """The surface under the texels of a light map: n at which light is traced, and t that are stored.

    Light is traced at the centre of a texel or, if there is no surface at its centre, at the nearest point of the texel that has
    surface. Interpolation also reads the texels next to each chart. Such a texel takes the light of a texel with surface that is
    near and alike. If there is none, as with charts narrower than a texel, its light is traced at the nearest point of the chart.

    Attributes:
        size: S, of the map.
        index: (n,) int64 row x S + column, increasing.
        points, normals: (n, 3) float64 metres, and unit normals of the faces, on the side of the photographs.
        part: (n,) int64 part of the surface.
        edge: size of a texel on each part, (parts,) float64 metres, in the mean over the part.
        stored: (t,) int64 row x S + column, increasing: all of `index`, and others.
        source: (t,) int64 row of the traced texels whose light each has.
    """

    size: int
    index: Array
    points: Array
    normals: Array
    part: Array
    edge: Array
    stored: Array
    source: Array


def lit_texels(parts: Sequence[TexturedPart], size: int) -> LitTexels:
    """Find the surface under each texel of a light map of S x S, and under those that interpolation reads besides.

    Normals are those of the faces, because a path that starts under the shading normal may start inside of the surface.
    """
    from scipy.spatial import cKDTree

    centres = texels_of(parts, size)
    beside, inside = texels_beside(parts, centres)
    all_ = joined(centres, beside)
    own = np.concatenate([np.ones(len(centres.index), bool), inside])  # the texel has surface
    points, part = all_.points.astype(np.float64), all_.part
    geometry = [face_geometry(one.vertices.astype(np.float64), one.faces) for one in parts]
    normals = np.concatenate([normal for normal, _ in geometry])[all_.face]
    behind = np.einsum("ij,ij->i", normals, all_.normals) < 0
    normals = np.where(behind[:, None], -normals, normals)
    edge = np.empty(len(parts))
    for number, (one, (_, area)) in enumerate(zip(parts, geometry, strict=True)):
        corner = one.uv[one.faces].astype(np.float64) * size
        across, down = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        in_map = 0.5 * np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]).sum()
        edge[number] = np.sqrt(area.sum() / max(in_map, 1e-12))

    source = np.arange(len(part))
    if own.any() and not own.all():
        place = np.column_stack([points / edge[part, None], normals / NORMAL_REACH, part * 1e3])
        distance, nearest = cKDTree(place[own]).query(place[~own])
        alike = distance < BESIDE
        source[np.flatnonzero(~own)[alike]] = np.flatnonzero(own)[nearest[alike]]
    traced = np.flatnonzero(source == np.arange(len(part)))
    traced = traced[np.argsort(all_.index[traced])]
    row = np.empty(len(part), np.int64)
    row[traced] = np.arange(len(traced))
    order = np.argsort(all_.index)
    kept = (array[traced] for array in (all_.index, points, normals, part))
    return LitTexels(size, *kept, edge, all_.index[order], row[source[order]])


def trace_lamps(
    parts: Sequence[TexturedPart],
    texels: LitTexels,
    surface: BaseScene,
    lamps: Lamps,
    samples: int,
    max_bounces: int,
    seed: int,
    denoised: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Array:
    """Trace the light maps of all lamps, (n, lamps, 3) float32 radiance of a white diffuse surface.

    Paths meet the parts as they are shown, with the materials of the surface cells. A part that is shown from both sides has the
    light of the side that gets more of it. A texel inside of a solid has the light of the nearest texel of its part that is not.

    Args:
        parts: of the surface.
        texels: where the light is wanted.
        surface: with the fitted materials.
        lamps: of the parts.
        samples: paths for each texel.
        max_bounces: longest path, in bounces.
        seed: of the random numbers.
        denoised: denoise the map of each lamp by itself, and keep its mean (`with_mean_of`).
        progress: called with numbers of points.
    """
    if not lamps.lamps or not len(texels.index):
        return np.zeros((len(texels.index), len(lamps.lamps), 3), np.float32)
    lit = lit_scene(parts, surface, lamps)
    two_sided = np.array([part.double_sided for part in parts], bool)
    inside = inside_solids(lit.scene.geometry, texels, two_sided[lit.part_of_face], seed)
    inside &= ~two_sided[texels.part]
    open_ = np.flatnonzero(~inside)
    back = np.flatnonzero(two_sided[texels.part])
    points = np.concatenate([texels.points[open_], texels.points[back]])
    normals = np.concatenate([texels.normals[open_], -texels.normals[back]])
    number = np.concatenate([open_, len(texels.index) + back]).astype(np.uint32)
    traced = _trace(lit, points, normals, number, lamps, PathCount(samples, max_bounces, seed), progress)
    light = np.zeros((len(texels.index), len(lamps.lamps), 3), np.float32)
    light[open_] = traced[: len(open_)]
    if len(back):
        of, behind = texels.part[back], traced[len(open_) :]
        front_sum, back_sum = (np.bincount(of, side.sum((1, 2)), len(parts)) for side in (light[back], behind))
        turned = (back_sum > front_sum)[of]
        light[back[turned]] = behind[turned]
    if denoised and not inside.all():
        light = _denoised(light, texels, inside, len(parts))
    return light[_nearest_open(texels, inside)]


class PathCount(NamedTuple):
    """How many paths start at each point, how long they are, and the seed of their random numbers."""

    samples: int
    max_bounces: int
    seed: int


def _trace(
    lit: LitScene,
    points: Array,
    normals: Array,
    number: Array,
    lamps: Lamps,
    count: PathCount,
    progress: Callable[[int, int], None],
) -> Array:
    """(n, lamps, 3) float32."""
    from iif_core.light.transport.lightmaps import known_light, light_maps
    from iif_core.light.transport.scene import PathOptions

    of, paths, total = (lit.lamp_of_face, len(lamps.lamps)), PathOptions(*count), len(points)
    out = np.zeros((total, len(lamps.lamps), 3), np.float32)
    if not total:
        return out
    progress(0, total)
    learning = LEARNED_SAMPLES, count.max_bounces - 1, count.seed + 1
    known = known_light(lit.scene, points, normals, *of, lit.object_of_face, PathOptions(*learning), lamps.environment)
    for first in range(0, total, CHUNK):
        progress(first, total)
        some = slice(first, first + CHUNK)
        out[some] = light_maps(lit.scene, points[some], normals[some], *of, paths, lamps.environment, number[some], known)
    progress(total, total)
    return out


def inside_solids(geometry: Geometry, texels: LitTexels, two_sided: Array, seed: int) -> Array:
    """(n,) bool: more than INSIDE of the rays from a texel meet a face, which is not shown from both sides, from behind."""
    from iif_core.light.transport.geometry import cosine_directions, trace

    rng = np.random.default_rng(seed)
    behind = np.zeros(len(texels.index))
    start = texels.points + 1e-4 * texels.normals
    for _ in range(PROBES):
        way = cosine_directions(texels.normals, rng)
        face, _ = trace(geometry, start, way)
        hit = np.flatnonzero((face >= 0) & ~two_sided[face])
        behind[hit] += np.einsum("ij,ij->i", geometry.normals[face[hit]], way[hit]) > 0
    return behind > INSIDE * PROBES


def _nearest_open(texels: LitTexels, inside: Array) -> Array:
    """(n,) row of the nearest texel of the same part that is not inside; its own where the part has none."""
    from scipy.spatial import cKDTree

    row = np.arange(len(texels.index))
    for part in np.unique(texels.part[inside]):
        own = np.flatnonzero(texels.part == part)
        hidden, free = own[inside[own]], own[~inside[own]]
        if len(free):
            place = np.concatenate([texels.points, texels.edge[part] * texels.normals], 1)
            row[hidden] = free[cKDTree(place[free]).query(place[hidden])[1]]
    return row


def _denoised(light: Array, texels: LitTexels, inside: Array, parts: int) -> Array:
    """Denoise the picture of each lamp by itself, smooth over the borders of charts, and keep the mean light of each part.

    Guides are the normals, and a colour for each part in place of the albedo,
    which the light does not contain. What lies between charts or inside of solids is filled from the nearest texel that does
    not, so that charts have no dark rims."""
    size = texels.size
    row = np.zeros(size * size, np.int64)
    row[texels.index] = np.arange(len(texels.index))
    has = np.zeros(size * size, bool)
    has[texels.index[~inside]] = True
    source = row[nearest_covered(has.reshape(size, size))]
    colour = id_colours(np.arange(parts))[texels.part].astype(np.float32)
    guides = colour[source], texels.normals.astype(np.float32)[source]
    out = np.empty_like(light)
    for lamp in range(light.shape[1]):
        out[:, lamp] = denoise(light[:, lamp][source], *guides).reshape(-1, 3)[texels.index]
    for part in range(parts):
        own = np.flatnonzero((texels.part == part) & ~inside)
        out[own] = smooth(texels.points[own], texels.normals[own], out[own], REACH * texels.edge[part])
    return with_mean_of(light, out, texels.part, np.where(inside, 0, texels.edge[texels.part] ** 2))


class LitScene(NamedTuple):
    """The parts on the device with their lamps; of each face: lamp, object (m,) int32, -1 = none, and part (m,) int64."""

    scene: Scene
    lamp_of_face: Array
    object_of_face: Array
    part_of_face: Array


def lit_scene(parts: Sequence[TexturedPart], surface: BaseScene, lamps: Lamps) -> LitScene:
    """Build the parts on the device with their lamps."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.scene import Scene

    device.mitsuba()
    material = surface.materials()
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, start[:-1], strict=True)])
    part_of_face = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])

    def of_face(values: list) -> Array:
        return np.asarray(values)[part_of_face]

    emitter = of_face([part.emitter_id for part in parts])
    black = surface.n_objects  # of `BaseScene.materials`
    object_id = np.where(emitter >= 0, black, of_face([part.object_id for part in parts])).astype(np.int32)
    passes = of_face([1.0 - part.opacity for part in parts]).astype(np.float32)
    geometry = build_geometry(vertices, faces, object_id, passes)
    radiance = np.concatenate([lamps.radiance, np.zeros((1, 3), np.float32)])[emitter]  # the last for -1
    side = np.where(of_face([part.double_sided for part in parts]), 0, 1).astype(np.int8)
    lamp = np.append(lamps.of_emitter, np.int32(-1))[emitter].astype(np.int32)
    weight = _draws(geometry.areas * radiance.mean(1), lamp, len(lamps.lamps))
    environment = lamps.surroundings if lamps.environment >= 0 else np.zeros(3, np.float32)
    emitters = Emitters(geometry, radiance, side, environment, sampling_weight=weight)
    return LitScene(Scene(geometry, material, emitters), lamp, object_id, part_of_face)


def _draws(power: Array, lamp: Array, lamps: int) -> Array:
    """(m,) how often each face is drawn. `EQUAL_SHARE` of the draws is the same for all lamps, so that the light of weak lamps is
    not noisier than the light of strong ones; the rest goes by power."""
    own = lamp >= 0
    total = np.bincount(lamp[own], power[own], lamps)
    lit = int((total > 0).sum())
    if not lit:
        return power
    share = np.zeros_like(power)
    share[own] = power[own] / np.maximum(total, 1e-300)[lamp[own]] / lit
    return EQUAL_SHARE * share + (1 - EQUAL_SHARE) * power / power.sum()
