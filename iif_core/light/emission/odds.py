"""How likely an object is to be a lamp before its light is asked for: where it hangs, and how bright it looks
(docs/method/light.md#prior-odds-of-a-lamp)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.photographs import Photographs
from iif_core.light.tracer import Tracer

OVERHEAD = 0.94
"""Height in its room, 0 = floor and 1 = ceiling, from which an object hangs overhead."""
SATURATED = 0.85
"""Share of the pixels of an object that are saturated, from which the object as a whole is."""
LEAST_PIXELS = 4
"""Pixels that must show that."""
LIKELY, UNLIKELY = 9.0, 1.0 / 17.0
"""Odds that an object is a lamp, relative to what is usual: of one that hangs overhead and is saturated; of one that no camera
sees and that is not overhead."""
WORTH = 15.0
"""What a fall of the logarithm of the misfit by 1 is worth, as the logarithm of odds."""
PROBABILITY = (-3.5, 2.15, 2.65, 2.2, 4.3)
"""Logarithm of the odds that what was found to shine is a lamp: constant, and what counts that it is likely, saturated,
seen by no camera, and needed."""
DOUBTFUL = 0.5
"""Probability of a lamp below which it is more likely surface that light falls on or passes through."""
_NEEDED = (-0.05, 1.0)
"""Limits of the logarithm of the growth of the misfit without it."""
_STEP_OFF = 0.01
"""Metres below the highest and the lowest point of an object at which its vertical rays start. Many lamps are flush with a
ceiling, so the ray upwards starts inside the object, and passes it."""
_OWN_LAYERS = 8
"""Layers of an object that a ray passes."""


@dataclass(frozen=True)
class ObjectLooks:
    """What the photographs show of objects, the last entry surface of no object.

    Attributes:
        faces: (F,) bool, some pixel shows the face.
        pixels: (O + 1,) int, valid pixels; of these, inside: away from the border of the object, bright: as bright as an emitter
            may be, bounded: saturated in some channel.
    """

    faces: np.ndarray
    pixels: np.ndarray
    inside: np.ndarray
    bright: np.ndarray
    bounded: np.ndarray

    @classmethod
    def of(cls, photos: Photographs, threshold: float) -> ObjectLooks:
        """Count the pixels of each object; threshold: radiance from which surface may be an emitter."""
        scene = photos.scene
        faces, counts = np.zeros(len(scene.faces), bool), np.zeros((4, scene.n_objects + 1), int)
        for view in photos.views:
            record = photos.records[view]
            faces[record.pixels.face[record.pixels.valid] if record.seen is None else record.seen] = True
            pixels = record.pixels.take(np.flatnonzero(record.pixels.valid))
            radiance, bound = photos.radiance(view, pixels.value, pixels.index)
            bounded, owner = bound.any(1), np.where(pixels.object_id < 0, scene.n_objects, pixels.object_id)
            kinds = np.ones_like(bounded), pixels.interior, (radiance.max(1) >= threshold) | bounded, bounded
            for count, kind in zip(counts, kinds, strict=True):
                count += np.bincount(owner[kind], minlength=len(count))
        return cls(faces, *counts)

    @property
    def is_saturated(self) -> np.ndarray:
        """(O,) bool: most of what is seen of the object is saturated."""
        return (self.bounded >= np.maximum(SATURATED * self.pixels, LEAST_PIXELS))[:-1]

    def known(self, scene: BaseScene, least: int) -> np.ndarray:
        """Return (F,) bool: a pixel shows the face, or light passes through it, so that no lamp can hide in it.

        An object with fewer than `least` pixels away from its border counts as unseen if some pixel of it is bright: it may be a
        small lamp, whose pixels are mixed with what is around it.
        """
        hardly = (self.bright > 0) & (self.inside < least)
        hardly[-1] = False  # surface of no object
        return (self.faces & ~hardly[scene.object_id]) | (scene.passes > 0)


def heights(tracer: Tracer, scene: BaseScene, objects: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how high the middle of each of `objects` (k,) is between what is below it and what is above it, (k,) in [0, 1], and
    how far these are apart, (k,) metres.

    Where a ray meets nothing, the highest or the lowest point of the mesh stands for it. `up`: (3,) of any length above 0.
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    level = scene.vertices.astype(np.float64) @ up
    bottom, top = float(level.min()), float(level.max())
    number = np.full(scene.n_objects + 1, -1)
    number[objects] = np.arange(len(objects))
    face = np.flatnonzero(number[scene.object_id] >= 0)
    own, corner = number[scene.object_id[face]], level[scene.faces[face]]
    low, high = np.full(len(objects), np.inf), np.full(len(objects), -np.inf)
    np.minimum.at(low, own, corner.min(1))
    np.maximum.at(high, own, corner.max(1))
    area = np.maximum(np.bincount(own, scene.areas[face], len(objects)), 1e-300)
    middles = scene.vertices[scene.faces[face]].mean(1) * scene.areas[face][:, None]
    middle = np.stack([np.bincount(own, middles[:, c], len(objects)) for c in range(3)], 1) / area[:, None]

    def end(start: np.ndarray, sign: float, otherwise: float) -> np.ndarray:
        """Height (k,) of what is met above (+1) or below (-1) the heights `start` (k,), other than the object itself."""
        at, found = start.copy(), np.full(len(objects), np.nan)
        for _ in range(_OWN_LAYERS):
            points = middle + (at - middle @ up)[:, None] * up
            face, distance = tracer.meets(points, np.broadcast_to(sign * up, points.shape))
            at = np.where(face >= 0, at + sign * (distance + 1e-4), at)  # on, past what was met
            is_own = (face >= 0) & (scene.object_id[face] == objects)
            found = np.where(np.isnan(found) & ~is_own, np.where(face >= 0, at, otherwise), found)
        return np.where(np.isnan(found), otherwise, found)

    ceiling = np.maximum(end(high - _STEP_OFF, 1.0, top), high)
    floor = np.minimum(end(low - _STEP_OFF, -1.0, bottom), low)
    return np.clip((middle @ up - floor) / np.maximum(ceiling - floor, 1e-9), 0.0, 1.0), ceiling - floor


@dataclass(frozen=True)
class LampOdds:
    """How likely objects are to be lamps.

    Attributes:
        odds: (O,) relative to what is usual.
    """

    odds: np.ndarray

    @classmethod
    def of(cls, photos: Photographs, looks: ObjectLooks) -> LampOdds:
        """Judge all objects; those that cameras see are as likely as is usual, unless they are saturated and overhead. Sides that
        were built around a scan are as likely as those."""
        scene = photos.scene
        count = scene.n_objects
        known = looks.known(scene, photos.options.min_observations)
        seen, exists = (
            np.bincount(scene.object_id[faces & (scene.object_id >= 0)], minlength=count) > 0 for faces in (known, ~known)
        )
        asked = np.flatnonzero(looks.is_saturated | (exists & ~seen))
        overhead = np.zeros(count, bool)
        if len(asked):
            overhead[asked] = heights(photos.tracer, scene, asked, np.asarray(photos.up))[0] >= OVERHEAD
        likely = overhead & looks.is_saturated
        if scene.made_up is not None:  # what would come in through the openings that they close comes from them
            likely |= scene.made_up
        return cls(np.where(likely, LIKELY, np.where(seen | overhead, 1.0, UNLIKELY)))

    @property
    def is_likely(self) -> np.ndarray:
        """(O,) bool: the object hangs overhead, and what is seen of it is saturated; or it was built where light may come in."""
        return self.odds > 1.0

    @property
    def weight(self) -> np.ndarray:
        """(O,) factor on the misfit of light in which the object shines, odds^(-1 / WORTH)."""
        return self.odds ** (-1.0 / WORTH)


@dataclass(frozen=True)
class LampEvidence:
    """What speaks for each of G groups of emitters to be a lamp, and not surface that light falls on or passes through.

    Attributes:
        is_likely: (G,) bool, of an object that is likely (`LampOdds`); is_saturated: (G,) bool, most of what is seen of
            its family is; is_hidden: (G,) bool, no camera sees it.
        needed: (G,) logarithm by which the misfit (Eq. L.40) grows without all of its kind, in the first look at all candidates.
    """

    is_likely: np.ndarray
    is_saturated: np.ndarray
    is_hidden: np.ndarray
    needed: np.ndarray

    def select(self, keep: np.ndarray) -> LampEvidence:
        """Return the same of some groups."""
        return LampEvidence(*(getattr(self, field.name)[keep] for field in fields(self)))

    @property
    def columns(self) -> np.ndarray:
        """(G, 4) what `PROBABILITY` counts, after its constant."""
        seen = self.is_saturated & ~self.is_hidden
        return np.column_stack([self.is_likely, seen, self.is_hidden, np.clip(self.needed, *_NEEDED)]).astype(np.float64)

    @property
    def probability(self) -> np.ndarray:
        """(G,) that it is a lamp, as often as in rooms with truth (docs/method/light.md#probability-of-a-lamp)."""
        constant, *counts = PROBABILITY
        return 1.0 / (1.0 + np.exp(-(constant + self.columns @ np.array(counts))))

    @property
    def is_unlikely(self) -> np.ndarray:
        """(G,) bool: by its looks alone, without what it is needed for, it is more probably no lamp."""
        return replace(self, needed=np.zeros(len(self.needed))).probability < DOUBTFUL
