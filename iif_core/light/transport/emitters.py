"""Emitters: radiance of faces and of the environment, and points or directions drawn with an exactly known density
(docs/method/light.md#drawing-emitters)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.environment import as_map, direction_in, solid_angles, texel_of, texel_weights
from iif_core.light.transport.arrays import on_device, rows_of
from iif_core.light.transport.geometry import Geometry, cosine_directions, trace
from iif_core.numerics.xp import DRJIT

Array = np.ndarray

MIN_SLOTS = 4096  # entries of the table from which emitters are drawn, at least

REMAINDER_STEP = 1 / 16
"""Remainders of slots closer than this count as equal, so that rounding does not decide between faces of equal area: one slot
more or less moves those of all faces after it."""

SHARE_LIMITS = (0.1, 0.5)
"""Bounds of the environment's share of the draws, next to emitting faces: a wrong guess of its power then starves neither."""


class Emitters:
    """Emitting faces of one geometry and the light around it. Emitting faces reflect too, with whatever the material says.

    A face or texel of weight 0 is never drawn and still found by directions that hit it; one of positive weight and radiance 0
    is drawn as well, for a radiance that is not known yet.

    Args:
        geometry: mesh of m faces.
        radiance: (m, 3) linear, >= 0.
        side: (m,) int8: +1 the side of the right-hand normal emits, -1 the other, 0 both; None = 0.
        environment: radiance of escaping rays, (3,) or a map (H, W, 3) as in `iif_core.light.environment`.
        sampling_weight: (m,) >= 0, how often a face is drawn; None = area x mean radiance.
        environment_weight: (H, W) >= 0, how often a texel is drawn; None = solid angle x mean radiance. A map of one texel is
            never drawn, since directions of the BRDF find it as well.
        environment_share: of all draws, where faces and texels are drawn; None = by power (Eq. L.11).

    Raises:
        InputError: wrong shapes, negative radiance or weights, unknown sides.
    """

    def __init__(
        self,
        geometry: Geometry,
        radiance: ArrayLike,
        side: ArrayLike | None = None,
        environment: ArrayLike = (0.0, 0.0, 0.0),
        sampling_weight: ArrayLike | None = None,
        environment_weight: ArrayLike | None = None,
        environment_share: float | None = None,
    ):
        # -------- radiance and sides --------
        faces = len(geometry.faces)
        radiance = rows_of(radiance, faces, 3, "emitter radiance")
        side = np.zeros(faces, np.int8) if side is None else np.asarray(side)
        if side.shape != (faces,) or not np.isin(side, (-1, 0, 1)).all():
            raise InputError(f"emitter side has shape {side.shape}; expected ({faces},) of -1, 0 or +1")
        if radiance.min() < 0:
            raise InputError(f"emitter radiance is {radiance.min():g} somewhere; radiance is never negative")

        # -------- how often each face and texel is drawn --------
        # Area x mean radiance is the power of a face up to the factor pi.
        power = geometry.areas * radiance.mean(axis=1, dtype=np.float64)
        weight = power if sampling_weight is None else rows_of(sampling_weight, faces, None, "sampling_weight")
        if weight.min() < 0:
            raise InputError("sampling_weight is negative somewhere")
        self.radiance, self.side, self.environment = radiance, side.astype(np.int8), as_map(environment)
        # A density per area is infinite on a face without area, and no ray meets it.
        weight = np.where(geometry.areas > 0, weight, 0.0)
        sky = _sky_weight(self.environment, environment_weight)
        if sky.any():
            if environment_share is None:
                environment_share = share_of_environment(
                    geometry, power.sum(), texel_weights(self.environment).sum() / (4 * np.pi)
                )
            # Faces and texels share the draws. Without a face to draw, the environment has all of them.
            weight = np.concatenate(
                [_scaled(weight, 1 - environment_share), _scaled(sky.ravel(), environment_share if weight.any() else 1.0)]
            )

        # -------- coincident faces --------
        # The first face is drawn for all of its copies. A ray may meet a copy, which therefore reports the same density: the two
        # weights of Eq. S.6 must agree on it.
        first, copies = _coincident(geometry, np.flatnonzero(weight[:faces] > 0), side)
        weight[first] += weight[copies]
        weight[copies] = 0

        # -------- table of slots (Eq. L.10) --------
        # m^2 of each face, then sr of each texel.
        measure = np.concatenate([geometry.areas, solid_angles(*sky.shape).ravel()])[: len(weight)]
        self.slots, pdf = _slots(weight, measure)
        self.pdf_area = pdf[:faces]
        self.pdf_area[copies] = self.pdf_area[first]
        self.pdf_sky = pdf[faces:].reshape(sky.shape) if sky.any() else np.zeros(sky.shape, np.float32)
        self.can_be_sampled = len(self.slots) > 0
        self.sky_is_sampled = bool(self.pdf_sky.any())

        # -------- copies on the device --------
        # Numbers that differ between scenes are opaque, so that scenes share compiled kernels.
        self._slots = on_device(self.slots, mi.UInt32) if self.can_be_sampled else None
        self._faces, self._last_slot = (dr.opaque(mi.UInt32, value) for value in (faces, max(len(self.slots), 1) - 1))
        # R, G, B and density of a face in one read. Where all faces shine to both sides, kernels do not read sides at all.
        self._radiance_pdf = on_device(np.column_stack([radiance, self.pdf_area]))
        self._side = on_device(self.side) if np.any(self.side) else None
        self._constant = [dr.opaque(mi.Float, float(value)) for value in self.environment[0, 0]]
        self._texels = on_device(np.concatenate([self.environment, self.pdf_sky[..., None]], -1))

    def texel(self, texel: Any, active: Any) -> tuple[Any, Any]:
        """Return (radiance, density per steradian) of a texel, row x W + column; density 0 where it is never drawn."""
        if self.environment.shape[:2] == (1, 1):
            return mi.Color3f(*self._constant), mi.Float(0)
        record = dr.gather(mi.Vector4f, self._texels, texel, active)
        return mi.Color3f(record.x, record.y, record.z), record.w

    def texel_along(self, direction: Any) -> Any:
        """Return the texel that a unit direction escapes into."""
        height, width = self.environment.shape[:2]
        if height * width == 1:
            return mi.UInt32(0)
        row, column = texel_of(DRJIT, direction, height, width)
        return mi.UInt32(row) * width + mi.UInt32(column)

    def direction_to(self, texel: Any, u1: Any, u2: Any) -> Any:
        """Draw a unit direction in a texel with the density that `texel` reports."""
        height, width = self.environment.shape[:2]
        return mi.Vector3f(*direction_in(DRJIT, mi.Float(texel // width), mi.Float(texel % width), u1, u2, height, width))

    def surface(self, face: Any, cos_front: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Return (radiance, area density, emits, is_emitter) of a face seen under `cos_front`, the cosine to its normal.

        `emits`: the side that is seen radiates; `is_emitter`: some side does.
        """
        record = dr.gather(mi.Vector4f, self._radiance_pdf, face, active)
        is_emitter = active & ((record.w > 0) | (dr.maximum(dr.maximum(record.x, record.y), record.z) > 0))
        emits = is_emitter & (cos_front != 0)
        if self._side is not None:
            side = dr.gather(mi.Float, self._side, face, is_emitter)
            emits &= (side == 0) | (side * cos_front > 0)
        return mi.Color3f(record.x, record.y, record.z), record.w, emits, is_emitter

    def sample(self, u: Any, active: Any) -> tuple[Any, Any, Any]:
        """Draw (face, on_sky, texel) with the densities that `surface` and `texel` report, from a uniform u in [0, 1)."""
        # The number of slots is a power of two, so the product has no rounding. The limit guards against u = 1.
        slot = dr.minimum(mi.UInt32(u * mi.Float(self._last_slot + 1)), self._last_slot)
        drawn = dr.gather(mi.UInt32, self._slots, slot, active)
        if not self.sky_is_sampled:
            return drawn, mi.Bool(False), mi.UInt32(0)
        # Numbers from `faces` on are texels.
        on_sky = drawn >= self._faces
        return dr.select(on_sky, 0, drawn), on_sky, dr.select(on_sky, drawn - self._faces, 0)


def share_of_environment(geometry: Geometry, power: float, sky: float) -> float:
    """Divide the draws between the environment and the emitting faces; return the environment's share (Eq. L.11).

    The shares follow the light that each gives to surfaces.

    power: sum of area x mean radiance of the faces; sky: mean radiance over all directions. Clipped to SHARE_LIMITS.
    """
    outside = geometry.areas.sum() * _escape_share(geometry) * sky
    total = outside + power
    return float(np.clip(outside / total if total > 0 else 1.0, *SHARE_LIMITS))


def _escape_share(geometry: Geometry, rays: int = 4096) -> float:
    """Share of cosine-distributed rays from random points of both sides of the surface that leave the mesh."""
    rng = np.random.default_rng(0)  # fixed: a mesh has one share, whatever the seed of a trace
    face = rng.choice(len(geometry.areas), rays, p=geometry.areas / geometry.areas.sum())
    root, u2 = np.sqrt(rng.random(rays)), rng.random(rays)
    corners = geometry.vertices[geometry.faces[face]].astype(np.float64)
    weights = np.stack([1 - root, root * (1 - u2), root * u2], 1)
    normal = geometry.normals[face] * rng.choice([-1.0, 1.0], rays)[:, None]
    start = np.einsum("ij,ijk->ik", weights, corners) + 1e-3 * normal
    hit, _ = trace(geometry, start, cosine_directions(normal, rng))
    return float((hit < 0).mean())


def _coincident(geometry: Geometry, drawn: Array, side: Array) -> tuple[Array, Array]:
    """(first, copy): faces out of `drawn` with the same corners that radiate to the same side, each copy with the first.

    A ray meets one of them only, so drawing a point on each would count its light twice.
    """
    # Faces that list the same corners in another order get the same key once their corners are sorted.
    corners = geometry.vertices[geometry.faces[drawn]]
    order = np.lexsort((corners[..., 2], corners[..., 1], corners[..., 0]), axis=1)
    key = np.take_along_axis(corners, order[..., None], 1).reshape(-1, 9)
    # 9 i + 3 j + k numbers the permutation that sorts the corners. An odd one turns the normal over, and the side with it.
    turned = np.where(np.isin(order @ np.array([9, 3, 1]), (5, 15, 19)), 1, -1)  # even permutations of 0 1 2
    key = np.column_stack([key, turned * side[drawn]])
    _, group, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    if len(count) == len(drawn):
        return drawn[:0], drawn[:0]
    by_group = np.argsort(group, kind="stable")
    # Place in `by_group` of the first member of each face's set; every later member is a copy.
    start = np.repeat(np.cumsum(count) - count, count)
    is_copy = np.arange(len(drawn)) > start
    return drawn[by_group[start[is_copy]]], drawn[by_group[is_copy]]


def _sky_weight(environment: Array, weight: ArrayLike | None) -> Array:
    shape = environment.shape[:2]
    if shape == (1, 1):
        return np.zeros(shape)
    if weight is None:
        return texel_weights(environment)
    weight = np.asarray(weight, np.float64)
    if weight.shape != shape or not (np.isfinite(weight).all() and weight.min() >= 0):
        raise InputError(f"environment_weight has shape {weight.shape}; expected {shape}, finite and not negative")
    return weight


def _scaled(weight: Array, total: float) -> Array:
    return weight * (total / weight.sum()) if weight.any() else weight


def _slots(weight: Array, measure: Array) -> tuple[Array, Array]:
    """(slots uint32, pdf (m,) float32): item of every slot and count / slots / measure, the density of one draw.

    Each item of positive weight owns at least one slot; the rest follow the weights by largest remainder in steps of
    REMAINDER_STEP, ties to the lower id (Eq. L.10; docs/method/numerics.md#searching-a-cumulative-sum).
    """
    pdf = np.zeros(len(weight), np.float32)
    items = np.flatnonzero(weight > 0)
    if not len(items):
        return np.zeros(0, np.uint32), pdf
    # A power of two, which `Emitters.sample` relies on.
    count = max(MIN_SLOTS, 1 << int(4 * len(items) - 1).bit_length())
    share = weight[items] / weight[items].max()
    share *= (count - len(items)) / share.sum()
    counts = 1 + np.floor(share).astype(np.int64)
    rest = count - counts.sum()
    # The slots that rounding down left over go to the largest remainders; the stable sort settles ties by id.
    counts[np.argsort(-np.round((share - np.floor(share)) / REMAINDER_STEP), kind="stable")[:rest]] += 1
    pdf[items] = counts / count / measure[items]
    return np.repeat(items, counts).astype(np.uint32), pdf
