"""Rays through one scene, for computations that ask what rays meet and how light arrives, and not how that is found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from iif_core.light.base_scene import BaseScene

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials
    from iif_core.light.transport.scene import EmitterColumns, PathOptions, ShadingPoints


class Tracer:
    """Rays through a scene on the device, which has been chosen.

    Geometry and materials are as large as the scene. They are built when a ray asks for them, and kept until `forget`.
    """

    def __init__(self, scene: BaseScene):
        self.scene = scene

    @cached_property
    def _world(self) -> tuple[Geometry, CellMaterials]:
        return self.scene.traceable()

    def forget(self) -> None:
        """Let go of what is on the device, which is built again when it is asked for."""
        self.__dict__.pop("_world", None)

    def of(self, scene: BaseScene) -> Tracer:
        """Return a tracer of another scene."""
        return Tracer(scene)

    def repainted(self, scene: BaseScene) -> Tracer:
        """Return a tracer of the same mesh with the base texture of `scene`, whose cells must be the same."""
        geometry, material = self._world
        other = Tracer(scene)
        other.__dict__["_world"] = geometry, scene.repainted(material)
        return other

    def meets(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest face along rays (`iif_core.light.transport.geometry.trace`).

        Args:
            origins, directions: (n, 3) or (3,) metres, and (n, 3) of any length above 0.

        Returns:
            Face (n,) int32, -1 = miss, and distance (n,) float32 in lengths of the direction, inf = miss.
        """
        from iif_core.light.transport.geometry import trace

        return trace(self._world[0], origins, directions)

    def transport(
        self,
        points: ShadingPoints,
        columns: EmitterColumns,
        cache: RadianceCache,
        traces: Sequence[PathOptions],
        texel_weight: np.ndarray | None,
        number: np.ndarray,
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Trace the transport matrix (Eq. L.14) of surface points once for each of `traces`.

        Yields:
            A (n, 2, G, 3) and h (n, 2, 3) by lobe, as `iif_core.light.transport.matrix.transport_matrix` returns them.
        """
        from iif_core.light.transport.matrix import transport_matrix
        from iif_core.light.transport.scene import Scene

        geometry, material = self._world
        scene = Scene(geometry, material, None, cache)
        for paths in traces:
            yield transport_matrix(scene, points, columns, paths, texel_weight, number)

    def behind(self, sheer: np.ndarray) -> Behind:
        """Return what lies behind the faces `sheer`, (m,) bool."""
        return Behind(self.scene, sheer)


class Behind:
    """What camera rays meet behind the faces `sheer`, (m,) bool, of a scene."""

    def __init__(self, scene: BaseScene, sheer: np.ndarray):
        from iif_core.light.transport.geometry import build_geometry

        self.sheer = sheer
        self._rest, self._sheets = (
            build_geometry(scene.vertices, scene.faces[part], scene.object_id[part]) for part in (~sheer, sheer)
        )

    def is_open(self, eye: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """(n,) bool: no other surface lies on the rays from the camera at `eye` (3,), of directions (n, 3)."""
        from iif_core.light.transport.geometry import trace

        return trace(self._rest, eye, towards)[0] < 0

    def sheets(self, eye: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """(n,) how often each ray meets `sheer` surface, at least once."""
        from iif_core.light.transport.sheets import count_sheets

        return np.maximum(count_sheets(self._sheets, eye, towards), 1)
