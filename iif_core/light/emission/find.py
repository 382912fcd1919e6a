"""All light of a scene: what shines, what comes from outside, and what is reflected (docs/method/light.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.light.emission.candidates import emitter_candidates, fading_surface
from iif_core.light.emission.direct import EmissionSolution
from iif_core.light.emission.emitters import (
    Traced,
    in_doubt,
    lamp_names,
    object_called,
    reliable,
    search_emitters,
    solve_with_saturated_surface,
    traced,
    trial,
)
from iif_core.light.emission.environment import Sky, SkySums
from iif_core.light.emission.groups import EmitterGroups, GroupingOptions, group_emitters
from iif_core.light.emission.odds import LampEvidence, LampOdds, ObjectLooks
from iif_core.light.emission.photographs import (
    Photographs,
    escaping_light,
    radiance_cache,
    rays_from_surface,
    statistics_of_faces,
)
from iif_core.light.emission.pruning import CERTAIN_EXCESS, CERTAIN_EXCESS_OPEN, SIGNIFICANT
from iif_core.light.emission.sun import SunEvidence
from iif_core.light.emission.sun_search import find_sun


@dataclass(frozen=True, kw_only=True)
class FirstLook:
    """What may shine, and what rays meet that leave the surface.

    Attributes:
        groups: candidates for emitters; threshold: radiance of candidates; glowing: (F,) pieces of surface that glow as a whole.
        sky: sums of what camera rays see that miss the mesh.
        met: (n,) faces that rays from surface meet, -1 = they leave the mesh.
        primary, secondary: share of camera rays and of rays from surface that leave the mesh.
        brightness: of the camera rays that leave it, relative to the others; None = none does.
    """

    groups: EmitterGroups
    threshold: float
    glowing: np.ndarray
    sky: SkySums
    met: np.ndarray
    primary: float
    secondary: float
    brightness: float | None


@dataclass(frozen=True, kw_only=True)
class FoundLight:
    """All light of a scene under one assumption about which surface lets light through.

    Attributes:
        photos: with that assumption; look: the first look at them.
        found: the problem; solution: of it.
        evidence: what speaks for each of its groups; None = photographs without a largest value, of which no room told the odds.
        names: of the groups, by where they are; left_out, reasons, left_on: candidate groups that turned out to reflect, why, and
            the objects that most of them are on.
        gain: (n_objects, 3) of the albedos.
        outside: the sky, None = none; sun: what speaks for one in it.
        hidden: number of groups that no camera sees and that were thought to shine.
        notes: what a person should know.
    """

    photos: Photographs
    look: FirstLook
    found: Traced
    evidence: LampEvidence | None
    solution: EmissionSolution
    names: list[str]
    left_out: EmitterGroups
    reasons: list[str]
    left_on: list[str]
    gain: np.ndarray
    outside: Sky | None
    sun: SunEvidence | None
    hidden: int
    notes: list[str]

    @property
    def is_open(self) -> bool:
        """So much of the surface faces holes of the mesh that light from outside is twelve directions (`SkySums.directions`)."""
        return self.outside is not None and self.outside.direction is None

    @property
    def candidates(self) -> int:
        """Number of groups that were looked at."""
        groups = self.look.groups
        return groups.size + len(groups.dropped) + self.hidden

    @property
    def transmittance(self) -> np.ndarray:
        """(n_objects,) share of the light that passes straight through each object."""
        scene = self.photos.scene
        return np.zeros(scene.n_objects, np.float32) if scene.transmittance is None else scene.transmittance

    def misfit(self, without: np.ndarray) -> float:
        """Return the misfit (Eq. L.40) over the rows of other objects than `without`, (n_objects,) bool; inf without rows."""
        problem = self.found.problem
        rows = problem.take(~np.append(without, False)[problem.owner])
        return rows.misfit(self.solution.radiance) if (~rows.anchor).any() else np.inf


def look_around(photos: Photographs, adjacency: np.ndarray) -> FirstLook:
    """Find candidates for emitters, and how much light may come from outside; `adjacency`: (E, 2) pairs of neighbouring faces."""
    scene, least = photos.scene, photos.options.min_observations
    statistics, threshold, glowing = statistics_of_faces(photos, adjacency)
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least, glowing)
    fades = fading_surface(candidate, statistics, adjacency, scene.normals, scene.areas, glowing)
    if fades.any():
        photos.log.say(
            f"{fades.sum()} bright faces ({scene.areas[fades].sum():.1f} m^2) fade into their surroundings: they are lit"
        )
    candidate, glowing = candidate & ~fades, np.where(fades, -1, glowing).astype(glowing.dtype)
    options = GroupingOptions(min_observations=least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, options, glowing)
    photos.log.say(f"{candidate.sum()} candidate faces in {groups.size} groups ({len(groups.dropped)} left out)")
    sky, primary, brightness = escaping_light(photos)
    met = rays_from_surface(photos)
    return FirstLook(
        groups=groups,
        threshold=threshold,
        glowing=glowing,
        sky=sky,
        met=met,
        primary=primary,
        secondary=float((met < 0).mean()),
        brightness=brightness,
    )


def find_light(photos: Photographs, look: FirstLook, environment: bool, is_open: bool) -> FoundLight:
    """Find which groups of faces shine and how brightly, and the light from outside.

    Args:
        photos: with response and gains.
        look: the first look at them.
        environment: light comes from outside the mesh.
        is_open: the mesh is a part of a room: that light is from twelve directions instead of a map of what the cameras see.
    """
    scene, groups, threshold = photos.scene, look.groups, look.threshold
    cache = radiance_cache(photos, groups)
    outside = (look.sky.directions() if is_open else look.sky.groups()) if environment else None
    notes: list[str] = []
    sun = None
    if outside is not None and not is_open:
        outside, sun = find_sun(photos, outside, threshold)
    elif outside is not None:
        share = f"{look.secondary:.0%} of the rays from the surface leave the mesh"
        notes.append(f"{share}: light from twelve directions, as the room shows it")
    certain = CERTAIN_EXCESS_OPEN if outside is not None and outside.is_unseen else CERTAIN_EXCESS
    looks = ObjectLooks.of(photos, threshold)
    odds = LampOdds.of(photos, looks)
    photos.log.say(f"{odds.is_likely.sum()} objects hang overhead and are saturated: they are likely lamps")
    pruned, gain = trial(photos, groups, cache, outside, certain, threshold, odds)
    unseen = photos.tracer.repainted(scene.with_gains(gain))
    reasons = np.array(pruned.reason[: groups.size], dtype=object)
    hits = np.bincount(look.met[look.met >= 0], minlength=len(scene.faces))
    search = photos, unseen, groups, pruned, certain, outside, threshold, hits, looks, odds
    found, shines, changes, evidence = search_emitters(*search)
    for change in changes:
        photos.log.say(f"emitters: {change}")
    notes.extend(changes)
    reasons[pruned.kept[: groups.size] & ~shines] = "the photographs are explained better without it"
    reasons[shines] = ""
    hidden = int(found.groups.is_hidden.sum())
    found, solution = solve_with_saturated_surface(photos, unseen, found, outside, threshold)
    weak = in_doubt(photos, found, solution)
    if weak.any() and (outside is not None or not weak.all()):  # without light from outside something in the room has to shine
        photos.log.say(f"{weak.sum()} groups radiate no more than their error allows, and are taken out")
        visible = np.flatnonzero(shines)
        reasons[visible[weak[: len(visible)]]] = f"its radiance is within {SIGNIFICANT:.0f} standard errors of zero"
        found, evidence = traced(photos, unseen, found.groups.select(~weak), outside, threshold), evidence.select(~weak)
        found, solution = solve_with_saturated_surface(photos, unseen, found, outside, threshold)
    gain = reliable(found.gains) if len(found.prior.initial) else gain  # without emitters those of the trial stay
    left_out = groups.select(reasons != "")
    return FoundLight(
        photos=photos,
        look=look,
        found=found,
        evidence=None if photos.sensor.is_hdr else evidence,
        solution=solution,
        names=lamp_names(photos, found.groups, solution.radiance[: found.groups.size]),
        left_out=left_out,
        reasons=[reason for reason in reasons if reason],
        left_on=object_called(photos, left_out),
        gain=gain,
        outside=outside,
        sun=sun,
        hidden=hidden,
        notes=notes,
    )
