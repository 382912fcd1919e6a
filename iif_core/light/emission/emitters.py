"""Which groups of faces emit light and how much: pixels are traced, and the linear problems of `iif_core.light.emission` solved
(docs/method/light.md#least-squares)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.colours import likely_colours
from iif_core.light.emission.direct import (
    FAMILY_WIDTH,
    HIDDEN_WIDTH,
    OUTSIDE_WIDTH,
    SINGLE_WIDTH,
    EmissionPrior,
    EmissionSolution,
    solve_families,
)
from iif_core.light.emission.environment import Sky, sky_prior
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR, BaseAlbedo, GainOptions, ObjectGains
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.hidden import with_hidden_surface
from iif_core.light.emission.kinds import Piece, of_one_kind, place_names
from iif_core.light.emission.odds import OVERHEAD, LampEvidence, LampOdds, ObjectLooks, heights
from iif_core.light.emission.photographs import SEEDS, Photographs, choose_rows, radiance_cache
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import (
    EmissionProblem,
    assemble,
    expected_radiance,
    initial_radiance,
    reflecting_rows,
    white_surface,
)
from iif_core.light.emission.pruning import PrunedEmission, WhiteSurface, insignificant, prune_groups
from iif_core.light.emission.rows import TracedTransport, light_of
from iif_core.light.emission.search import HIDDEN_EXCESS, QUICK, Candidates, Families, Proposal, search
from iif_core.light.tracer import Tracer
from iif_core.surface.cells import pack_keys, voxel_indices

WHITE = (1.0, 1.0, 1.0, 1.0, 0.0)
"""Material of the brightest surface that only reflects."""
METAL = 0.9
"""Predicted metalness above which a surface counts as metal in the solve."""
FIRST_LOOK_ROWS = 20_000
"""Pixels that are traced with all groups as columns, to see which other emitters are worth a trace of their own."""
SATURATED_SHARE = 0.01
"""Share of the cached light by which saturated surface must be brighter than was thought before the light is solved again."""
SATURATED_ROUNDS = 3
SATURATED_PIXELS = 20_000
"""Pixels of saturated surface that are traced."""
SATURATED_SHARE_COMPARED = 0.1
"""The same share while emitters are compared."""
SUSPECTS = 2
"""Families that stayed although white surface would be about as bright, of which it is traced what could take their place."""
HIDDEN_POINTS = 32
"""Points of each hidden surface at which the light that falls on it is estimated."""
OF_A_ROOM = 1.8
"""Metres between what is below and above a lamp from which it hangs from a ceiling, and not from a cupboard over a worktop."""
COMPARED_TILES_ACROSS = 8
"""Tiles across a picture whose pixels are averaged while emitters are compared: light changes slowly."""


class SurfacePoints(NamedTuple):
    """Points of surface that no pixel shows, n of them, as `ViewPixels` has those of pixels: `points`, `normals`, `wo` (n, 3),
    `base` (n, 5) and `number` (n,)."""

    points: np.ndarray
    normals: np.ndarray
    wo: np.ndarray
    base: np.ndarray
    number: np.ndarray


@dataclass(frozen=True)
class Traced:
    """Groups that emit light, the cache of everything else, and the problem that they pose, with its gains.

    Attributes:
        groups, cache: of faces.
        prior: of the groups, then of the sky.
        problem: with rows scaled by the gains; gains: of the objects.
    """

    groups: EmitterGroups
    cache: RadianceVoxels
    prior: EmissionPrior
    problem: EmissionProblem
    gains: ObjectGains

    @property
    def level_error(self) -> np.ndarray:
        """(G, 3) error of the logarithm of the light of each group that comes from the level, no larger than the prior's."""
        return np.minimum(self.gains.error_of_group, PRIOR_LEVEL_ERROR)

    @cached_property
    def radiance(self) -> np.ndarray:
        """(G, 3) the solution with this prior."""
        return self.prior.radiance(self.problem.rows)

    @cached_property
    def misfit(self) -> float:
        """Misfit of that solution (Eq. L.40)."""
        return self.problem.misfit(self.radiance)


def trial(
    photos: Photographs,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    sky: Sky | None,
    certain: float,
    threshold: float,
    odds: LampOdds,
) -> tuple[PrunedEmission, np.ndarray]:
    """Find which groups emit light, and the albedo gains of objects (n_objects, 3), from half of the rows. Groups of objects that
    are likely lamps stay."""
    pixels, rows = choose_rows(photos, groups, threshold, 2)
    own = rows.group >= 0
    transport = trace_rows(photos, pixels, groups, voxels, sky, 0).without_lobes()
    paint = np.tile(np.float32(WHITE), (int(own.sum()), 1))
    white = trace_rows(photos, replace(pixels.take(own), base=paint), groups, voxels, sky, 1).without_lobes()
    seen, prior = light_prior(photos, groups, rows, sky)
    n_groups = len(prior.initial)
    problem = assemble(rows, transport, n_groups, white, sky)
    tried, gains = problem.solve_object_gains(prior, base_albedo(photos, sky), photos.scene.n_objects)
    family, protected = _families(photos, groups, n_groups), np.ones(n_groups, bool)
    protected[: groups.size] = np.append(odds.is_likely, False)[_objects(photos, groups)]
    evidence = white_surface(rows, np.concatenate([seen, np.zeros((n_groups - groups.size, 3))]), white)
    share = photos.options.prune
    return prune_groups(tried.rows, prior, family, evidence, ~tried.anchor, protected, share, certain), reliable(gains)


def traced(
    photos: Photographs,
    unseen: Tracer,
    groups: EmitterGroups,
    sky: Sky | None,
    threshold: float,
    tile_edge: int | None = None,
    options: GainOptions | None = None,
    voxels: RadianceVoxels | None = None,
    left_out: np.ndarray | None = None,
) -> Traced:
    """Trace the rows of groups that emit light, and estimate the gains of objects under it.

    unseen: paints what paths meet and no photograph shows, with the gains of the trial; `tile_edge` and `options`
    as in `choose_rows` and `solve_object_gains`; voxels: None = of the photographs; left_out: (F,) bool, faces whose pixels are
    no rows unless they shine.
    """
    cache = radiance_cache(photos, groups) if voxels is None else voxels
    pixels, rows = choose_rows(photos, groups, threshold, 1, tile_edge)
    if left_out is not None:
        use = (rows.group >= 0) | ~left_out[pixels.face]
        pixels, rows = pixels.take(use), rows.take(use)
    transport = trace_rows(photos, pixels, groups, cache, sky, 3, unseen)
    prior = light_prior(photos, groups, rows, sky)[1]
    problem = assemble(rows, transport, len(prior.initial), None, sky)
    problem, found = problem.solve_object_gains(prior, base_albedo(photos, sky), photos.scene.n_objects, options)
    return Traced(groups, cache, prior, problem, found)


def search_emitters(
    photos: Photographs,
    unseen: Tracer,
    groups: EmitterGroups,
    pruned: PrunedEmission,
    certain: float,
    sky: Sky | None,
    threshold: float,
    hits: np.ndarray,
    looks: ObjectLooks,
    odds: LampOdds,
) -> tuple[Traced, np.ndarray, list[str], LampEvidence]:
    """Find whether other emitters explain the photographs better than those that the trial kept: with objects that no camera
    sees, with groups that were dropped although they may shine, or without some.

    pruned: of the trial, for all `groups`; certain: brightness relative to a white surface from which a group shines for certain;
    hits: (F,) rays from visible surface that meet each face; looks, odds: of the objects.
    Returns the problem of the emitters, which of `groups` are among them, a description of what was changed, and what speaks for
    each of the emitters.
    """
    # Groups were dropped one after the other; of some the light was given to others, and they may be needed after all.
    offered = np.flatnonzero(pruned.may_shine(certain, photos.options.prune)[: groups.size])
    lit, excess, power = (of_group[offered] for of_group in (pruned.kept, pruned.excess, pruned.power))
    scene, all_groups = photos.scene, groups.size
    # A candidate that was left out does not come back as unseen.
    known = looks.known(scene, photos.options.min_observations) | (groups.of_face >= 0)
    groups = groups.select(np.isin(np.arange(groups.size), offered))
    every = with_hidden_surface(groups, known, scene.object_id, scene.areas, hits)
    family = _families(photos, every, every.size)
    family[: groups.size][~lit] += 2 * scene.n_objects + 1  # surface of no object, -1, has a number of its own
    family = np.unique(family, return_inverse=True)[1]
    # A lamp that comes back must be needed by other surface than its own.
    weak = np.isin(every.of_face, np.flatnonzero(~lit))
    misfits: dict[Families, float] = {}

    def misfit(chosen: Families) -> float:
        if not chosen and start and sky is None:
            return np.inf
        if chosen not in misfits:
            some = every.select(np.isin(family, [*chosen]))
            found = traced(photos, unseen, some, sky, threshold, comparison_tile(photos), QUICK, left_out=weak)
            # Saturated surface may be much brighter under these emitters than under others.
            cache = _raised(photos, unseen, found, found.cache, found.radiance, sky)
            if _differs(cache, found.cache, SATURATED_SHARE_COMPARED):
                found = traced(photos, unseen, some, sky, threshold, comparison_tile(photos), QUICK, cache, weak)
            misfits[chosen] = found.misfit
        return misfits[chosen]

    owner = _objects(photos, every)
    weights = np.ones(int(family.max(initial=-1)) + 1)
    of_group = np.append(odds.weight, 1.0)[owner]
    weights[family] = np.where(every.is_hidden, of_group, np.minimum(of_group, 1.0))  # what is seen is not unlikely
    shown = frozenset(family[: groups.size][lit].tolist())
    start = shown | frozenset(family[every.is_hidden & np.append(odds.is_likely, False)[owner]].tolist())
    look = _first_look(photos, unseen, every, lit, family, sky, threshold, certain, weights)
    brightest = {f: float(excess[family[: groups.size] == f].max()) for f in shown}
    given = {f: float(power[family[: groups.size] == f].max()) for f in shown}
    suspects = sorted((f for f, value in brightest.items() if value < certain), key=lambda f: -given[f])[:SUSPECTS]
    # Without light from outside something in the room has to shine.
    outside = sky is not None or (scene.made_up is not None and bool(scene.made_up.any()))
    doubtful = frozenset(f for f, value in brightest.items() if outside and value < HIDDEN_EXCESS and weights[f] >= 1.0)
    evidence = LampEvidence(
        is_likely=np.append(odds.is_likely, False)[owner],
        is_saturated=np.array([look.is_saturated(f) for f in family.tolist()], bool),
        is_hidden=every.is_hidden,
        needed=np.zeros(every.size),
    )
    # Without a largest value of the photographs nothing tells what is likely.
    unlikely = frozenset() if photos.sensor.is_hdr else frozenset(family[evidence.is_unlikely].tolist())

    def proposals(present: Families) -> list[Proposal]:
        return look.proposals(present, doubtful, frozenset(suspects), unlikely)

    chosen, changes = search(start, proposals, misfit, look.weight)
    told, before = [], start
    for after, old, new in changes:
        parts = [(after - before, "added"), (before - after, "taken out")]
        what = [f"{_names(photos, every, family, f)} {word}" for families, word in parts for f in sorted(families)]
        turn = "falls" if new < old else "grows, less than what is known of lamps and of white surface outweighs,"
        told.append(f"{' and '.join(what)}: the misfit of the light {turn} from {old:.4f} to {new:.4f}")
        before = after
    is_chosen, shines = np.isin(family, [*chosen]), np.zeros(all_groups, bool)
    shines[offered] = is_chosen[: groups.size]
    evidence = evidence.select(is_chosen)
    found, own = traced(photos, unseen, every.select(is_chosen), sky, threshold), family[is_chosen]
    kind = _kinds(photos, found.groups, own, evidence.is_saturated | evidence.is_hidden)
    needed = look.needed(chosen, lambda f: frozenset(own[kind == kind[own == f][0]].tolist()))
    return found, shines, told, replace(evidence, needed=np.array([needed[f] for f in own.tolist()], np.float64))


def solve_with_saturated_surface(
    photos: Photographs, unseen: Tracer, found: Traced, sky: Sky | None, threshold: float
) -> tuple[Traced, EmissionSolution]:
    """Solve, and solve once more if saturated surface that only reflects turns out to be much brighter than its bound.

    The bounds of the cache are raised to what the surface reflects of the light that was found (Eq. L.42), up to three times.
    Returns the problem, with the cache that goes with it, and its solution.
    """
    solution = solve(photos, found, sky)
    bounds = found.cache
    for _ in range(SATURATED_ROUNDS):
        cache = _raised(photos, unseen, found, bounds, solution.radiance, sky)
        if not _differs(cache, found.cache, SATURATED_SHARE):
            break
        more = float(cache.radiance.sum()) / max(float(bounds.radiance.sum()), 1e-300) - 1.0
        photos.log.say(f"saturated surface adds {100 * more:.0f} % to the cached light")
        found = traced(photos, unseen, found.groups, sky, threshold, voxels=cache)
        solution = solve(photos, found, sky)
    return found, solution


def in_doubt(photos: Photographs, found: Traced, solution: EmissionSolution) -> np.ndarray:
    """Return the groups of faces that radiate too little to be emitters, (G,) bool (`insignificant`)."""
    n = found.groups.size
    family = _families(photos, found.groups, n)
    return insignificant(solution.radiance[:n], solution.error[:n], found.level_error[:n], found.groups.area, family)


def lamp_names(photos: Photographs, groups: EmitterGroups, radiance: np.ndarray) -> list[str]:
    """Call groups that radiate (G, 3) by where they are (`place_names`)."""
    scene, owner = photos.scene, _objects(photos, groups)
    up = np.asarray(photos.up, np.float64)
    things = np.unique(owner[owner >= 0])
    overhead = np.zeros(scene.n_objects + 1, bool)  # the last for surface of no object
    height, room = heights(photos.tracer, scene, things, up)
    overhead[things] = (height >= OVERHEAD) & (room >= OF_A_ROOM)
    pieces = [Piece.of(scene.vertices, scene.faces[groups.of_face == g]) for g in range(groups.size)]
    power = np.where(groups.sides == 0, 2.0, 1.0) * groups.area * np.maximum(radiance, 0.0).sum(1)
    return place_names(pieces, up / np.linalg.norm(up), overhead[owner], groups.is_hidden, power)


def object_called(photos: Photographs, groups: EmitterGroups) -> list[str]:
    """Return the name of the object to which most of the surface of each group belongs."""
    return [photos.names[o] if o >= 0 else "surface of no object" for o in _objects(photos, groups)]


def _differs(cache: RadianceVoxels, before: RadianceVoxels, share: float) -> bool:
    """The light of two caches differs by at least a share."""
    old, new = (float(voxels.radiance.sum()) for voxels in (before, cache))
    return abs(new - old) > 0 and abs(new - old) >= share * old


def _raised(
    photos: Photographs, unseen: Tracer, found: Traced, cache: RadianceVoxels, radiance: np.ndarray, sky: Sky | None
) -> RadianceVoxels:
    """The cache of the photographs, with its bounds raised to what surface reflects of the light `radiance` (G, 3)."""
    bounds = pack_keys(cache.ijk[cache.censored])
    if not len(bounds):
        return cache
    parts = []
    for view in photos.views:
        pixels = photos.records[view].pixels
        drawn = np.random.default_rng([photos.options.seed, SEEDS, 2, view.view_id]).random(len(pixels.index))
        use = np.flatnonzero(pixels.valid & pixels.interior & (found.groups.of_face[pixels.face] < 0))
        keys = pack_keys(voxel_indices(pixels.points[use], cache.edge, cache.origin))
        inside = np.flatnonzero(np.isin(keys, bounds))
        inside = inside[np.argsort(drawn[use[inside]], kind="stable")]
        first = use[np.sort(inside[np.unique(keys[inside], return_index=True)[1]])]  # one pixel a voxel and view
        first = first[np.argsort(drawn[first], kind="stable")[: -(-SATURATED_PIXELS // len(photos.views))]]
        parts.append(pixels.take(first))
    pixels = ViewPixels.joined(parts)
    if not len(pixels.index):
        return cache
    transport = trace_rows(photos, pixels, found.groups, found.cache, sky, 2, unseen)
    matrix, cached = transport.matrix[:, 0].mean(0), transport.cached[:, 0].mean(0)
    light = light_of(matrix, radiance) + cached
    of_object = np.concatenate([found.gains.gain, np.ones((1, 3))])  # the last for surface of no object, -1
    possible = 1.0 / np.maximum(pixels.base[:, :3], 1e-3)  # no surface reflects more than it receives
    return cache.raised(pixels.points, np.minimum(of_object[pixels.object_id], possible) * light)


def _first_look(
    photos: Photographs,
    unseen: Tracer,
    every: EmitterGroups,
    lit: np.ndarray,
    family: np.ndarray,
    sky: Sky | None,
    threshold: float,
    certain: float,
    weights: np.ndarray,
) -> Candidates:
    """Trace all groups as columns of one problem, on some of the rows; of the first groups some are `lit`; `weights`: of the
    families."""
    thin = -(-photos.options.rows // FIRST_LOOK_ROWS)
    cache = radiance_cache(photos, every)
    pixels, rows = choose_rows(photos, every, threshold, thin, comparison_tile(photos))
    transport = trace_rows(photos, pixels, every, cache, sky, 2, unseen)
    white = _white_hidden_surface(photos, every, cache, sky, unseen)
    seen, prior = light_prior(photos, every, rows, sky)
    outside = len(prior.initial) - every.size
    problem = assemble(rows, transport, len(prior.initial), None, sky)
    own = np.flatnonzero(np.isin(rows.group, np.flatnonzero(lit)))
    reflecting, of_group = reflecting_rows(rows.take(own), transport.take(own), len(prior.initial))
    hidden = np.r_[every.is_hidden, np.zeros(outside, bool)]
    shown = np.concatenate([seen, np.zeros((outside, 3))])
    of_all = np.r_[family, np.full(outside, -1)]
    albedo = base_albedo(photos, sky)
    return Candidates(problem, reflecting, of_group, prior, of_all, hidden, shown, white, albedo, certain, weights)


def _white_hidden_surface(
    photos: Photographs, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky | None, unseen: Tracer
) -> WhiteSurface:
    """What both sides together of each hidden group would show if they were white; nothing for the other groups."""
    scene, rng = photos.scene, np.random.default_rng([photos.options.seed, SEEDS, 3])
    number = groups.size + (sky.size if sky else 0)
    matrix, cached = np.zeros((number, number, 3)), np.zeros((number, 3))
    own = np.flatnonzero(groups.is_hidden)
    if len(own):
        faces = [np.flatnonzero(groups.of_face == g) for g in own]
        drawn = [rng.choice(f, HIDDEN_POINTS, p=scene.areas[f] / scene.areas[f].sum()) for f in faces]
        face, group = np.concatenate(drawn), np.repeat(own, HIDDEN_POINTS)
        normal = scene.normals[face] * np.where(np.arange(len(face)) % 2, -1.0, 1.0)[:, None]
        middle = scene.vertices[scene.faces[face]].mean(1) + 1e-3 * normal
        points = SurfacePoints(
            points=middle.astype(np.float32),
            normals=normal.astype(np.float32),
            wo=normal.astype(np.float32),
            base=np.tile(np.float32(WHITE), (len(face), 1)),
            number=np.arange(len(face), dtype=np.uint32),
        )
        white = trace_rows(photos, points, groups, voxels, sky, 1, unseen).without_lobes()
        np.add.at(matrix, group, white.matrix[:, 0].mean(0) / (0.5 * HIDDEN_POINTS))
        np.add.at(cached, group, white.cached[:, 0].mean(0) / (0.5 * HIDDEN_POINTS))
    return WhiteSurface(np.zeros((number, 3)), matrix, cached)


def comparison_tile(photos: Photographs) -> int:
    return max(1, int(np.median([max(view.width, view.height) for view in photos.views])) // COMPARED_TILES_ACROSS)


def _names(photos: Photographs, groups: EmitterGroups, family: np.ndarray, number: int) -> str:
    """Describe a family: its object, and whether a camera sees it."""
    own = np.flatnonzero(family == number)
    thing = int(photos.scene.object_id[np.flatnonzero(groups.of_face == own[0])[0]])
    name = photos.names[thing] if thing >= 0 else "surface of no object"
    unseen = "unseen " if groups.is_hidden[own[0]] and not name.startswith("unseen ") else ""
    return f"{unseen}{name} ({groups.area[own].sum():.2g} m^2)"


def solve(photos: Photographs, found: Traced, sky: Sky | None) -> EmissionSolution:
    """Solve for the groups that shine, which are black from here on, and for the environment."""
    problem, prior = found.problem, found.prior
    initial = prior.initial
    family = _families(photos, found.groups, len(initial))
    # Where nothing but its light tells how bright a lamp is, lamps of one kind are alike.
    groups = found.groups
    alike = problem.is_bounded(groups.size) | groups.is_hidden
    family[: groups.size] = _kinds(photos, groups, family[: groups.size], alike)
    width = np.full(len(initial), FAMILY_WIDTH)
    if sky is not None and sky.is_unseen:
        together = groups.size + sky.no_sun
        family[together], width[together] = -1 - len(initial), OUTSIDE_WIDTH
    solution = solve_families(problem.rows, prior, family, width)
    radiance = likely_radiance(solution.radiance, solution.error, groups.area, sky)
    return replace(solution, radiance=radiance).with_level_error(found.level_error)


def likely_radiance(radiance: np.ndarray, error: np.ndarray, area: np.ndarray, sky: Sky | None) -> np.ndarray:
    """Return the radiance (n, 3) of the groups with likely colours (`likely_colours`): of the lamps among themselves, and of what
    comes from outside where no camera looks; what cameras see there has the colour that they see.

    Args:
        radiance, error: (n, 3) of the groups of `area` (G,) m^2, followed by those of the sky.
    """
    out, lamps = radiance.copy(), slice(len(area))
    out[lamps] = likely_colours(radiance[lamps], error[lamps], area)
    if sky is not None and sky.is_unseen:
        outside = len(area) + sky.no_sun
        out[outside] = likely_colours(radiance[outside], error[outside], sky.solid_angle[sky.no_sun])
    return out


def _families(photos: Photographs, groups: EmitterGroups, n_groups: int) -> np.ndarray:
    """(n_groups,) int: parts of one object shine alike, more or less, and so does its unseen surface; each group of the
    environment is alone."""
    family = -1 - np.arange(n_groups)
    family[: groups.size] = _objects(photos, groups)
    family[: groups.size][groups.is_hidden] += photos.scene.n_objects
    return family


def _kinds(photos: Photographs, groups: EmitterGroups, family: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """(G,) int: families (G,) of lamps of one kind, of those that look `alike`."""
    return of_one_kind(groups, photos.scene.vertices, photos.scene.faces, family, alike)


def _objects(photos: Photographs, groups: EmitterGroups) -> np.ndarray:
    """(G,) int object to which most of the surface of each group belongs, -1 = surface of no object."""
    face, scene = np.flatnonzero(groups.of_face >= 0), photos.scene
    pair, at = np.unique(np.stack([groups.of_face[face], scene.object_id[face]], 1), axis=0, return_inverse=True)
    area = np.bincount(at.ravel(), scene.areas[face], len(pair))
    order, owner = np.argsort(area, kind="stable"), np.full(groups.size, -1)
    owner[pair[order, 0]] = pair[order, 1]  # the largest part of each group comes last
    return owner


def reliable(gains: ObjectGains) -> np.ndarray:
    """Return (n_objects, 3) gains, 1 where the level of the light, and so theirs, is no better known than from the prior."""
    return gains.gain if gains.level_error < PRIOR_LEVEL_ERROR else np.ones_like(gains.gain)


def base_albedo(photos: Photographs, sky: Sky | None) -> BaseAlbedo:
    """Mean base albedo of the objects, which no gain may bring above 1 where light comes from where no camera looks: its level is
    the least certain. In a closed room the gains of single objects are less certain than the light."""
    return BaseAlbedo(photos.scene.object_values[:, :3], sky is not None and sky.is_unseen, photos.base_level_error)


def light_prior(
    photos: Photographs, groups: EmitterGroups, rows: EmissionPixels, sky: Sky | None
) -> tuple[np.ndarray, EmissionPrior]:
    """Return the radiance seen on the groups; and the prior of the groups, followed by those of the environment."""
    seen = initial_radiance(rows, groups.observed, photos.sensor.is_hdr)
    seen[groups.is_hidden] = 0.0
    initial, width = expected_radiance(rows, seen), np.where(groups.is_hidden, HIDDEN_WIDTH, SINGLE_WIDTH)
    if groups.is_hidden.any():
        initial[groups.is_hidden] = np.median(rows.radiance[rows.group < 0].mean(1))
    prior = EmissionPrior(initial, width)
    if sky is None:
        return seen, prior
    return seen, prior.beside(sky_prior(sky) if sky.direction is not None else EmissionPrior.independent(sky.radiance))


def trace_rows(
    photos: Photographs,
    pixels: ViewPixels | SurfacePoints,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    sky: Sky | None,
    stream: int,
    unseen: Tracer | None = None,
) -> TracedTransport:
    """Return two independent estimates of (A, h), by lobe.

    unseen: paints what paths meet and no photograph shows; None = the base texture."""
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.scene import EmitterColumns, PathOptions, ShadingPoints

    options = photos.options
    cache = RadianceCache(voxels.edge, voxels.origin, voxels.ijk, voxels.radiance)
    base, metallic = pixels.base, believed_metallic(pixels.base)
    points = ShadingPoints(pixels.points, pixels.normals, pixels.wo, base[:, :3], base[:, 3], metallic)
    side = np.where(groups.of_face >= 0, groups.side, 0).astype(np.int8)
    texels = sky.columns + groups.size if sky else None
    weight = _drawn(groups, photos.scene.areas)
    columns = EmitterColumns(groups.of_face, groups.size + (sky.size if sky else 0), side, texels, weight)
    drawn = sky.texel_weight if sky else None
    samples, seed = max(1, options.samples // 2), ((options.seed << 32) | SEEDS) * 8 + 2 * stream
    traces = [PathOptions(samples, options.max_bounces, seed + half) for half in range(2)]
    halves = []
    photos.log.progress(0, 2, "halves of the transport matrix traced")
    for found in (unseen or photos.tracer).transport(points, columns, cache, traces, drawn, pixels.number):
        halves.append([_albedo_and_gloss(values, metallic == 0) for values in found])
        photos.log.progress(len(halves), 2, "halves of the transport matrix traced")
    return TracedTransport(*(np.stack(part) for part in zip(*halves, strict=True)))


def believed_metallic(base: np.ndarray) -> np.ndarray:
    """Return the metalness (n,) of base materials (n, 5), 0 unless it is high: a wrongly predicted metal would remove the diffuse
    light of a whole surface."""
    return np.where(base[:, 4] > METAL, base[:, 4], 0.0)


def _drawn(groups: EmitterGroups, areas: np.ndarray) -> np.ndarray | None:
    """(F,) how often faces are drawn where some groups are hidden: half of the draws go to what cameras see, however many objects
    may hide a lamp, and all groups of either kind get the same. None = as usual."""
    hidden = groups.is_hidden
    if not hidden.any() or hidden.all():
        return None
    share = np.where(hidden, 0.5 / hidden.sum(), 0.5 / (~hidden).sum()) / np.maximum(groups.area, 1e-12)
    return np.where(groups.of_face >= 0, areas * np.append(share, 0.0)[groups.of_face], 0.0)


def _albedo_and_gloss(values: np.ndarray, dielectric: np.ndarray) -> np.ndarray:
    """(2, n, ...) of (n, 2, ...) values by diffuse and specular lobe: what is proportional to the albedo, the specular lobe of
    metals included, and the gloss of dielectrics."""
    gloss = np.where(dielectric.reshape(-1, *[1] * (values.ndim - 2)), values[:, 1], 0.0)
    return np.stack([values[:, 0] + (values[:, 1] - gloss), gloss])
