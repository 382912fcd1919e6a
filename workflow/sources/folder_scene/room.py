"""The mesh of a scene on the device, and what rays of its cameras meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from iif_core.surface.triangles import face_geometry
from workflow.runtime import device, native
from workflow.scene.normal_form import View
from workflow.sources.folder_scene.mesh import Mesh

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry


@dataclass(frozen=True)
class Room:
    """A mesh that rays can meet; normals (m, 3) float32 of its faces, 0 for degenerate ones; its size, metres."""

    geometry: Geometry
    normals: np.ndarray
    size: float

    @classmethod
    def of(cls, mesh: Mesh, threads: int) -> Room:
        """Build the mesh on the device."""
        native.prepare()
        device.mitsuba()
        native.limit_threads(threads)
        from iif_core.light.transport.geometry import build_geometry

        geometry = build_geometry(mesh.vertices, mesh.faces, np.full(len(mesh.faces), -1, np.int32))
        size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        return cls(geometry, face_geometry(mesh.vertices, mesh.faces)[0].astype(np.float32), size)

    def seen(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) float32 with 0 = miss, and face ids (H, W) with -1 = miss, of a view."""
        from iif_core.light.transport.geometry import trace

        rays = view.directions()
        face, t = trace(self.geometry, view.world_from_camera[:3, 3], rays.reshape(-1, 3))
        shape = rays.shape[:2]
        return np.where(face >= 0, t, 0).reshape(shape).astype(np.float32), face.reshape(shape)

    def normals_of(self, face: np.ndarray) -> np.ndarray:
        """Return the normals (H, W, 3) of faces (H, W), 0 for -1."""
        return np.where(face[..., None] >= 0, self.normals[face], 0)

    def along(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (h, w) with 0 = miss, and normals (h, w, 3), along rays (h, w, 3)."""
        from iif_core.light.transport.geometry import trace

        face, t = trace(self.geometry, origin, rays.reshape(-1, 3))
        normal = np.where(face[:, None] >= 0, self.normals[face], 0)
        return np.where(face >= 0, t, 0).reshape(rays.shape[:2]), normal.reshape(*rays.shape[:2], 3)

    def depth_along(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return the z-depth (h, w) alone."""
        return self.along(origin, rays)[0]
