"""The pixels of one photograph: its maps, and the pixels that show surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from iif_core.camera.gains import CameraGains, radius_squared
from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.view import View
from iif_core.numerics.rows import Rows
from iif_core.surface.triangles import towards_viewer


@dataclass(frozen=True, kw_only=True)
class ViewMaps:
    """A view as images, H rows and W columns. A map that nobody asked for, or that the scene does not have yet, is None.

    Attributes:
        camera: of the photograph.
        value: (H, W, 3) the photograph: sensor values, or radiance. Whoever makes something else of it says so.
        valid: (H, W) bool, pixels whose value may be used.
        depth: (H, W) float32 z-depth in metres, 0 = no surface; face: (H, W) int32, -1 = no surface.
        object_id, segment_id: (H, W) int32, -1 = none; interior: (H, W) bool, away from the borders of objects.
        saturated: (H, W) bool, `value` is a lower bound.
        normals: (H, W, 3) float32 unit normals towards the camera, 0 = no surface.
    """

    camera: View
    value: np.ndarray
    valid: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    object_id: np.ndarray | None = None
    segment_id: np.ndarray | None = None
    interior: np.ndarray | None = None
    saturated: np.ndarray | None = None
    normals: np.ndarray | None = None

    @property
    def hit(self) -> np.ndarray:
        """(H, W) bool: the pixel hits the mesh."""
        return (self.face >= 0) & (self.depth > 0)

    def points(self, kind: DTypeLike = np.float32) -> np.ndarray:
        """Return (H, W, 3) surface points in metres; they mean nothing where no surface is hit."""
        return self.camera.points(self.depth, kind)


@dataclass(frozen=True, kw_only=True)
class ViewPixels(Rows):
    """The pixels of one view that hit the mesh, in reading order; n pixels.

    Attributes:
        index: (n,) into the flattened image.
        points, normals, wo: (n, 3) float32, metres and unit vectors; normals face the camera.
        face, object_id: (n,) int32; from_front: (n,) bool, the camera is on the side of the face normal.
        value: (n, 3) photograph; valid, interior: (n,) bool.
        number: (n,) uint32 of view and pixel, by which rays that start there draw their random numbers.
        base: (n, 5) float32 base albedo, roughness and metallic; None = nobody asked.
    """

    index: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    wo: np.ndarray
    face: np.ndarray
    object_id: np.ndarray
    from_front: np.ndarray
    value: np.ndarray
    valid: np.ndarray
    interior: np.ndarray
    number: np.ndarray
    base: np.ndarray | None = None

    @property
    def of_object(self) -> np.ndarray:
        """(n,) bool: the pixel shows an object."""
        return self.object_id >= 0


def pixels_of_view(
    maps: ViewMaps, normals: np.ndarray, among: np.ndarray | None = None, base: np.ndarray | None = None
) -> ViewPixels:
    """Collect the pixels of a view that hit the mesh.

    Args:
        maps: of the view, with objects and interior.
        normals: (m, 3) of the faces, 0 for degenerate ones.
        among: (H, W) bool, pixels that may be collected; None = all.
        base: (H * W, 5) base albedo, roughness and metallic; None = nobody asks.

    Returns:
        One row for each pixel that hits the mesh.
    """
    view, hit = maps.camera, maps.hit
    index = np.flatnonzero(hit if among is None else hit & among)
    directions = view.directions().reshape(-1, 3)[index]
    wo = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    face = maps.face.ravel()[index]
    normals, front = towards_viewer(normals[face].astype(np.float32), wo)
    value = maps.value.reshape(-1, 3)[index]
    return ViewPixels(
        index=index,
        points=(view.world_from_camera[:3, 3] + maps.depth.reshape(-1, 1)[index] * directions).astype(np.float32),
        normals=normals.astype(np.float32),
        wo=wo.astype(np.float32),
        face=face,
        object_id=maps.object_id.ravel()[index],
        from_front=front,
        value=value,
        valid=maps.valid.ravel()[index] & np.isfinite(value).all(1),
        interior=maps.interior.ravel()[index],
        number=((index + view.view_id * 0x9E3779B1) & 0xFFFFFFFF).astype(np.uint32),
        base=None if base is None else base[index],
    )


def pixel_steps(view: View, face: np.ndarray, holes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Compute how directions change from pixel to pixel, by which rays are spread over their pixels.

    Behind holes of the mesh lie the directions that light the room, not what the camera would see, so pixels next to a miss have
    step 0: their rays stay in the middle.

    Args:
        view: the camera.
        face: (H, W) face that each pixel shows, -1 = miss.
        holes: whether the mesh has large holes.

    Returns:
        Change of direction to the next pixel on the right and below, (3,) each; (H * W, 3) each with `holes`.
    """
    from scipy.ndimage import minimum_filter

    steps = direction_derivatives(view.fx, view.fy, view.world_from_camera)
    if not holes:
        return steps
    whole = minimum_filter(face >= 0, 3, mode="nearest").reshape(-1, 1)
    return steps[0] * whole, steps[1] * whole


def pixel_gains(gains: CameraGains, number: int, view: View, index: np.ndarray) -> np.ndarray:
    """Compute the factors on the radiance of some pixels.

    Args:
        gains: of all views of the capture.
        number: position of the view in the capture.
        view: its camera.
        index: (n,) flattened indices of the pixels.

    Returns:
        (n, 3) factors: exposure, white balance and vignetting.
    """
    return gains.factor(number, radius_squared(index, view.width, view.height))
