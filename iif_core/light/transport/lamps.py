"""Radiance along rays from every lamp by itself, from one set of paths (docs/method/light.md#recombination)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import batches, on_device, rows_of
from iif_core.light.transport.kernels import World
from iif_core.light.transport.render import radiance_sum
from iif_core.light.transport.scene import PathOptions, Scene

Array = np.ndarray


class LampCollector:
    """Adds emitted radiance times the weight of the path to the row of the lane, in the column of the lamp that emits it.

    Nothing is returned to the path. A lane writes to its own row alone, so plain additions are safe and their order is fixed.
    """

    def __init__(self, rows: Any, lane: Any, lamps: int, lamp_of_face: Any, environment_lamp: int):
        self.rows, self.lane, self.lamps = rows, lane, dr.opaque(mi.UInt32, lamps)
        self.lamp_of_face = lamp_of_face
        self.environment_lamp = None if environment_lamp < 0 else dr.opaque(mi.UInt32, environment_lamp)

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        lamp = dr.gather(mi.Int32, self.lamp_of_face, face, active)
        return self.add(mi.UInt32(lamp), weight * radiance, active & (lamp >= 0))

    def environment(self, texel: Any, radiance: Any, weight: Any, active: Any) -> Any:
        if self.environment_lamp is None:
            return mi.Color3f(0)
        return self.add(self.environment_lamp, weight * radiance, active)

    def add(self, lamp: Any, value: Any, active: Any) -> Any:
        """Add `value` (Color3f) to the radiance of `lamp` in the row of the lane; return what the path gains, 0."""
        entry = (self.lane * self.lamps + lamp) * 3
        for channel in range(3):
            mode = dr.ReduceMode.NoConflicts
            dr.scatter_reduce(dr.ReduceOp.Add, self.rows, value[channel], entry + channel, active, mode=mode)
        return mi.Color3f(0)


def checked_lamps(scene: Scene, lamp_of_face: ArrayLike, lamps: int, environment_lamp: int) -> Array:
    """Return the lamp of every face as (m,) int32.

    Raises:
        InputError: another number of faces, or lamps out of range.
    """
    of_face, faces = np.ascontiguousarray(lamp_of_face, np.int32), len(scene.geometry.faces)
    if of_face.shape != (faces,) or max(of_face.max(initial=-1), environment_lamp) >= lamps:
        raise InputError(
            f"lamp_of_face has shape {of_face.shape} and values up to {of_face.max(initial=-1)}, the environment is lamp"
            f" {environment_lamp}; expected ({faces},) and lamps 0 ... {lamps - 1}, -1 = none"
        )
    return of_face


def render_lamps(
    scene: Scene,
    lamp_of_face: ArrayLike,
    lamps: int,
    origins: ArrayLike,
    directions: ArrayLike,
    paths: PathOptions,
    jitter: tuple[ArrayLike, ArrayLike],
    environment_lamp: int = -1,
) -> Array:
    """Estimate the radiance that arrives along rays from every lamp by itself, seen directly or after any reflections (Eq. L.63).

    The paths are those of `render.render`, and each adds what it meets to the lamp that emits it, so that the sum over the lamps
    is an estimate of the same radiance. A picture under other light is the sum with other weights.

    Args:
        scene: what paths meet; of its cache nothing is used, because cached light belongs to no lamp.
        lamp_of_face: (m,) lamp of every face, -1 = its light is left out.
        lamps: number of lamps L.
        origins: (n, 3) or (3,) metres.
        directions: (n, 3) of any length above 0.
        paths: as in `render.render`.
        jitter: (3,) or (n, 3) each: change of the direction to the next pixel on the right and below.
        environment_lamp: lamp of the environment, -1 = its light is left out.

    Returns:
        (n, L, 3) float32 radiance, linear.

    Raises:
        InputError: wrong shapes, non-finite numbers, lamps out of range.
        TransportError: light that is not finite.
    """
    count = len(np.asarray(directions))
    shape = (count, 3)
    rows = [
        rows_of(np.broadcast_to(np.asarray(value, np.float32), shape), count, 3, name)
        for value, name in ((origins, "origins"), (directions, "directions"), (jitter[0], "jitter"), (jitter[1], "jitter"))
    ]
    of_face = on_device(checked_lamps(scene, lamp_of_face, lamps, environment_lamp), mi.Int32)
    result = np.zeros((count, lamps, 3), np.float32)
    if not lamps:
        return result
    scene, kinds = scene._replace(cache=None), (mi.Point3f, mi.Vector3f, mi.Vector3f, mi.Vector3f)
    for batch in batches(count, paths.samples, 3 * lamps, paths.chunk):
        sums = dr.zeros(mi.Float, batch.lanes * 3 * lamps)
        lane = dr.arange(mi.UInt32, batch.lanes)
        world = World(scene, LampCollector(sums, lane, lamps, of_face, environment_lamp))
        gain = radiance_sum(
            world,
            batch.streams(paths.seed),
            *(batch.spread(kind, part) for kind, part in zip(kinds, rows, strict=True)),
            *batch.samples(paths.samples),
            dr.opaque(mi.UInt32, paths.max_bounces),
        )
        dr.eval(gain, sums)
        result[batch.part] = batch.collect_rows(sums, lamps, 3)
    return result / np.float32(paths.samples)
