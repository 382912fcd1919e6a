"""The mesh of a room with the fused base texture, and the light that was found in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.reflectance.material import BLACK
from iif_core.surface.cells import grid_origin

if TYPE_CHECKING:
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials


@dataclass(frozen=True, kw_only=True)
class BaseScene:
    """The mesh with the base texture; ids are int32 with -1 = none, lengths metres, colours linear.

    Attributes:
        vertices (n, 3), faces (m, 3), object_id (m,) of the faces, normals (m, 3), areas (m,).
        n_objects: objects are 0 ... n_objects - 1.
        cell_edge, cell_origin, cell_ijk (c, 3), cell_object (c,), cell_values (c, 5): surface cells of the base
            texture.
        object_values: (n_objects, 5) means, for surface that no photograph shows.
        transmittance: (n_objects,) share of the light that passes straight through the surface of each object; None = none.
        made_up: (n_objects,) bool, objects that were built around a scan, where light may come in; None = none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    n_objects: int
    cell_edge: float
    cell_origin: np.ndarray
    cell_ijk: np.ndarray
    cell_object: np.ndarray
    cell_values: np.ndarray
    object_values: np.ndarray
    transmittance: np.ndarray | None = None
    made_up: np.ndarray | None = None

    @property
    def is_sheer(self) -> np.ndarray:
        """(m,) bool: light passes through the face, so that pixels on it show what lies behind as well."""
        return self.passes > 0

    @property
    def passes(self) -> np.ndarray:
        """(m,) float32 share of the light that passes straight through each face."""
        share = np.zeros(self.n_objects, np.float32) if self.transmittance is None else self.transmittance
        return np.append(share, np.float32(0.0))[self.object_id]  # the last for surface of no object, -1

    def facing(self, eye: np.ndarray) -> np.ndarray:
        """Return the side of each face (m,) on which `eye` (3,) is: +1 that of its normal, -1 behind it, 0 in its plane."""
        first = self.vertices[self.faces[:, 0]].astype(np.float64)
        return np.sign(np.einsum("ij,ij->i", self.normals, np.asarray(eye, np.float64) - first))

    def seen_normals(self, face_id: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """Return the normals (H, W, 3) float32 of the faces `face_id` (H, W) on the side of `eye` (3,); 0 where that is -1."""
        normals = self.normals * self.facing(eye)[:, None]
        return np.where((face_id >= 0)[..., None], normals[face_id], 0).astype(np.float32)

    def with_gains(self, gain: np.ndarray) -> BaseScene:
        """Return the scene with the albedos of its objects multiplied by `gain` (n_objects, 3) and limited to 1."""
        cells, objects = self.cell_values.copy(), self.object_values.copy()
        objects[:, :3] = np.minimum(objects[:, :3] * gain, 1.0)
        cells[:, :3] = np.minimum(cells[:, :3] * gain[self.cell_object], 1.0)
        return replace(self, cell_values=cells, object_values=objects)

    def traceable(self, black: np.ndarray | None = None) -> tuple[Geometry, CellMaterials]:
        """Build geometry and materials on the device, which has been chosen; faces of `black` reflect nothing."""
        material = self.materials()
        from iif_core.light.transport.geometry import build_geometry

        object_id = self.object_id if black is None else np.where(black, self.n_objects, self.object_id)
        return build_geometry(self.vertices, self.faces, object_id, self.passes), material

    def materials(self) -> CellMaterials:
        """Build the materials on the device, which has been chosen; an object of id `n_objects` is black."""
        from iif_core.light.transport.materials import CellMaterials

        grid = self.cell_edge, self.cell_origin, self.cell_ijk, self.cell_object
        return CellMaterials(*grid, self.cell_values, self._values_of_objects)

    def repainted(self, materials: CellMaterials) -> CellMaterials:
        """Return a copy of `materials`, which must be of the same cells, with the values of this scene."""
        return materials.repainted(self.cell_values, self._values_of_objects)

    @property
    def _values_of_objects(self) -> np.ndarray:
        return np.concatenate([self.object_values, np.float32([BLACK])])


def cache_origin(scene: BaseScene, edge: float) -> np.ndarray:
    """Return the corner (3,) of the radiance-cache grid, in metres."""
    return grid_origin(scene.vertices[scene.faces.ravel()], edge)


@dataclass(frozen=True)
class Light:
    """The light that stage emission estimated, per face.

    Attributes:
        radiance: (m, 3) linear.
        side: (m,) int8, side of the face that emits: +1 front, -1 back, 0 both.
        emits: (m,) bool.
        environment: (3,), or (H, W, 3) as in `iif_core.light.environment`.
    """

    radiance: np.ndarray
    side: np.ndarray
    emits: np.ndarray
    environment: np.ndarray

    def emitters(self, geometry: Geometry) -> Emitters:
        """Build the emitters on the device."""
        from iif_core.light.transport.emitters import Emitters

        return Emitters(geometry, self.radiance, self.side, self.environment)
