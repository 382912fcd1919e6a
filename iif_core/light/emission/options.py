"""Options of the search for the light of a scene, and its log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class EmissionOptions:
    """How the light of a scene is looked for.

    Attributes:
        seed: of the random streams.
        min_observations: pixels that must show a face or a group of faces before it can be an emitter.
        cache_edge: edge of a voxel of the radiance cache, metres.
        pixels: of all photographs together that are looked at. Where there are more, a random choice of each photograph stands
            for it, and `min_observations` counts pixels of that choice.
        rows: pixels whose light transport is traced; samples: paths for each, over two halves; max_bounces: their longest, where
            the radiance cache holds no value.
        prune: share of the photographed light below which an emitter is dropped, unless it is missed.
    """

    seed: int
    min_observations: int = 8
    cache_edge: float = 0.06
    pixels: int = 4_000_000
    rows: int = 40_000
    samples: int = 16
    max_bounces: int = 6
    prune: float = 0.01


@dataclass(frozen=True)
class Log:
    """Where a long computation says what it finds: `say(text)`, and how far it is: `progress(done, total, what)`."""

    say: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, what: None
