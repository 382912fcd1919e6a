"""What paths meet, which points they start from, and how many of them are traced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.cache import RadianceCache
from iif_core.light.transport.emitters import Emitters
from iif_core.light.transport.geometry import Geometry

Material = Callable[[Any, Any, Any, Any], tuple[Any, Any, Any]]
"""(point, face, object id, active) -> (base colour, roughness, metallic), all on the device; see `materials`."""


class Scene(NamedTuple):
    """Everything that a path can meet.

    A path that reaches a voxel of `cache` at its second surface or later ends there with the cached radiance.
    """

    geometry: Geometry
    material: Material
    emitters: Emitters | None
    cache: RadianceCache | None = None


@dataclass(frozen=True)
class PathOptions:
    """How many paths are traced and how long they are.

    Attributes:
        samples: paths for each ray or point, at least 1.
        max_bounces: surface interactions of a path, the first point included; 0 = emission that is seen directly.
        seed: any integer >= 0. Traces with different seeds are independent.
        chunk: lanes on the device at once, where a lane traces up to 8 samples of one point; None = 2^18, fewer where the
            results would take more than 256 MiB. The result does not depend on it.

    Raises:
        InputError: fewer than 1 sample or 0 bounces.
    """

    samples: int
    max_bounces: int
    seed: int
    chunk: int | None = None

    def __post_init__(self) -> None:
        if self.samples < 1 or self.max_bounces < 0:
            raise InputError(f"samples={self.samples}, max_bounces={self.max_bounces}: at least 1 sample and 0 bounces")


class ShadingPoints(NamedTuple):
    """Surface points with materials of their own, n rows.

    points (n, 3) metres; normals (n, 3), flipped to the viewer; wo (n, 3) towards the viewer; base_color (n, 3) linear in
    [0, 1]; roughness (n,) perceptual in [0.02, 1]; metallic (n,) in [0, 1].
    """

    points: ArrayLike
    normals: ArrayLike
    wo: ArrayLike
    base_color: ArrayLike
    roughness: ArrayLike
    metallic: ArrayLike


class EmitterColumns(NamedTuple):
    """Which unknown radiance faces and texels emit: the columns of the transport matrix, G of them.

    of_face (m,) int32 column of every face, -1 = dark; count = G; side (m,) as in `Emitters`, None = both sides; of_texel
    (H, W) int32 column of every texel of the environment map, -1 = dark, None = no environment; sampling_weight (m,) how
    often faces are drawn, None = half by area and half the same for every column.
    """

    of_face: ArrayLike
    count: int
    side: ArrayLike | None = None
    of_texel: ArrayLike | None = None
    sampling_weight: ArrayLike | None = None
