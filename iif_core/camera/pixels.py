"""The pixels of one photograph that show surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from iif_core.camera.gains import CameraGains, radius_squared
from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.view import View
from iif_core.surface.triangles import towards_viewer


class DecodedView(NamedTuple):
    """Photograph, G-buffer and segmentation of a view as they are stored, (H, W) and (H, W, 3) arrays."""

    photo: np.ndarray
    valid: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    object_id: np.ndarray
    interior: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ViewPixels:
    """The pixels of one view that hit the mesh, in reading order; n pixels.

    Attributes:
        index: (n,) into the flattened image.
        points, normals, wo: (n, 3) float32, metres and unit vectors; normals face the camera.
        face, object_id: (n,) int32; from_front: (n,) bool, the camera is on the side of the face normal.
        value: (n, 3) photograph; valid, interior: (n,) bool.
        number: (n,) uint32 of view and pixel, by which rays that start there draw their random numbers.
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

    def take(self, choice: np.ndarray) -> ViewPixels:
        """Return the chosen pixels."""
        return ViewPixels(**{name: array[choice] for name, array in self.__dict__.items()})


def pixels_of_view(view: View, decoded: DecodedView, normals: np.ndarray, among: np.ndarray | None = None) -> ViewPixels:
    """Collect the pixels of a view that hit the mesh.

    Args:
        view: the camera.
        decoded: photograph, G-buffer and segmentation of the view.
        normals: (m, 3) of the faces, 0 for degenerate ones.
        among: (H * W,) bool, pixels that may be collected; None = all.

    Returns:
        One row for each pixel that hits the mesh.
    """
    photo, valid, depth, face, object_id, interior = decoded
    hit = (face.ravel() >= 0) & (depth.ravel() > 0)
    hit = np.flatnonzero(hit if among is None else hit & among)
    directions = view.directions().reshape(-1, 3)[hit]
    points = (view.world_from_camera[:3, 3] + depth.reshape(-1, 1)[hit] * directions).astype(np.float32)
    wo = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    face = face.ravel()[hit]
    normals, front = towards_viewer(normals[face].astype(np.float32), wo)
    value = photo.reshape(-1, 3)[hit]
    return ViewPixels(
        index=hit,
        points=points,
        normals=normals.astype(np.float32),
        wo=wo.astype(np.float32),
        face=face,
        object_id=object_id.ravel()[hit],
        from_front=front,
        value=value,
        valid=valid.ravel()[hit] & np.isfinite(value).all(1),
        interior=interior.ravel()[hit],
        number=((hit + view.view_id * 0x9E3779B1) & 0xFFFFFFFF).astype(np.uint32),
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
