"""Materials of a room that was edited: parts of it moved, and objects with textures of their own put in
(docs/method/light.md#edits)."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from iif_core.errors import InputError
from iif_core.light.transport.arrays import on_device
from iif_core.light.transport.scene import Material
from iif_core.reflectance.brdf import R_MIN
from iif_core.reflectance.material import LOWEST

Array = np.ndarray


class Textures(NamedTuple):
    """Textures of inserted faces, k of them.

    texels (t, 5) float32 materials of all textures, row by row, one after the other; first, width, height (k,) the texture of
    each face: its first texel and its size; to_uv (k, 8) the affine map of points on the face, in metres, to u (first four
    numbers: gradient and offset) and v (last four), which repeat beyond [0, 1); v counts downwards.
    """

    texels: Array
    first: Array
    width: Array
    height: Array
    to_uv: Array


def uv_maps(corners: Array, uv: Array) -> Array:
    """Return the affine maps (k, 8) of points on triangles with corners (k, 3, 3) in metres to their texture coordinates
    (k, 3, 2); the gradient lies in the plane of the triangle, and is 0 for triangles without area."""
    corners, uv = np.asarray(corners, np.float64), np.asarray(uv, np.float64)
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], 2)
    steps = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], 2)
    # Two edges fix the gradient in the plane of the triangle. The pseudo-inverse adds no component along the normal, and is 0
    # for a triangle without area.
    gradient = steps @ np.linalg.pinv(edges, rcond=1e-9)
    offset = uv[:, 0] - np.einsum("kci,ki->kc", gradient, corners[:, 0])
    return np.concatenate([gradient, offset[..., None]], 2).reshape(-1, 8)


class EditedMaterials:
    """Materials of a room of which some faces were moved, and whose last faces were put in.

    Args:
        room: materials of the faces of the room.
        faces: m, of the room and of everything that was put in.
        shift: (m, 3) by which each face was moved, metres: its material is looked up where it came from. None = none was.
        textures: of the last faces; None = none was put in.

    Raises:
        InputError: textures that do not fit together.
    """

    def __init__(self, room: Material, faces: int, shift: Array | None = None, textures: Textures | None = None):
        self.room = room
        self._shift = None if shift is None else on_device(np.pad(shift, [(0, 0), (0, 1)]))
        self._first: Any = None
        if textures is None:
            return
        count = len(textures.first)
        sizes = np.asarray(textures.width, np.int64) * textures.height
        if textures.to_uv.shape != (count, 8) or count > faces or (textures.first + sizes).max(initial=0) > len(textures.texels):
            raise InputError(
                f"textures of {count} faces among {faces}: maps {textures.to_uv.shape}, {len(textures.texels)} texels"
            )
        self._first = dr.opaque(mi.UInt32, faces - count)
        self._to_uv = on_device(textures.to_uv)
        place = np.stack([textures.first, textures.width, textures.height, np.zeros(count)], 1)
        self._place = on_device(place.astype(np.uint32), mi.UInt32)
        # Eight floats a texel, of which two aligned reads fetch a material.
        self._texels = on_device(np.pad(np.clip(textures.texels, LOWEST, 1), [(0, 0), (0, 3)]))

    def __call__(self, point: Any, face: Any, object_id: Any, active: Any) -> tuple[Any, Any, Any]:
        place = point
        if self._shift is not None:
            away = dr.gather(mi.Vector4f, self._shift, face, active)
            place = mi.Point3f(point.x - away.x, point.y - away.y, point.z - away.z)
        if self._first is None:
            return self.room(place, face, object_id, active)
        # What was put in has the last face ids.
        inserted = active & (face >= self._first)
        colour, roughness, metallic = self.room(place, face, object_id, active & ~inserted)
        own_colour, own_roughness, own_metallic = self._textured(point, face - self._first, inserted)
        return (
            dr.select(inserted, own_colour, colour),
            dr.select(inserted, dr.maximum(own_roughness, R_MIN), roughness),
            dr.select(inserted, own_metallic, metallic),
        )

    def _textured(self, point: Any, number: Any, active: Any) -> tuple[Any, Any, Any]:
        """Interpolate the texture of inserted face `number` between the four texels around a point, bilinearly."""
        u_map = dr.gather(mi.Vector4f, self._to_uv, number * 2, active)
        v_map = dr.gather(mi.Vector4f, self._to_uv, number * 2 + 1, active)
        place = dr.gather(mi.Vector4u, self._place, number, active)
        # Lanes that are not active read a size of 0, by which no remainder can be taken.
        column, next_column, right = _around(point, u_map, dr.maximum(place.y, 1))
        row, next_row, below = _around(point, v_map, dr.maximum(place.z, 1))
        colour, roughness, metallic = mi.Color3f(0), mi.Float(0), mi.Float(0)
        for y, of_row in ((row, 1 - below), (next_row, below)):
            for x, of_column in ((column, 1 - right), (next_column, right)):
                weight, texel = of_row * of_column, place.x + y * place.y + x
                first = dr.gather(mi.Vector4f, self._texels, texel * 2, active)
                colour += weight * mi.Color3f(first.x, first.y, first.z)
                roughness += weight * first.w
                metallic += weight * dr.gather(mi.Float, self._texels, texel * 8 + 4, active)
        return colour, roughness, metallic


def _around(point: Any, to_coordinate: Any, size: Any) -> tuple[Any, Any, Any]:
    """(texel, next texel, share of the next) along one axis of a texture that repeats."""
    value = to_coordinate.w + point.x * to_coordinate.x + point.y * to_coordinate.y + point.z * to_coordinate.z
    # Repeat beyond [0, 1); centres of texels lie at + 0.5.
    value = (value - dr.floor(value)) * mi.Float(size) - 0.5
    low = dr.floor(value)
    # `low` is -1 before the first centre, whose neighbour is the last texel.
    first = mi.UInt32(mi.Int32(low) + mi.Int32(size)) % size
    return first, (first + 1) % size, value - low
