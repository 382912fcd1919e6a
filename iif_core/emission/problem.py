"""The linear problem of one scene, put together from pixels and two traces; solvers read nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .gains import object_gains
from .rows import EmissionRows, block_rows, scale_rows

ANCHOR_WEIGHT = 100.0
"""Weight of what is directly seen of a group relative to everything that its light does elsewhere: a face that is
looked at says what it emits; light it sends elsewhere also depends on albedos that the prior only guessed."""


@dataclass(frozen=True)
class PixelRows:
    """The pixels whose transport is traced, n rows.

    Attributes:
        radiance: (n, 3) linear; bound: (n, 3) bool, `radiance` is a lower bound.
        object_id, view, tile: (n,) int; pixels that agree in all three are averaged.
        group: (n,) emitter group that the pixel looks at, -1 = none.
    """

    radiance: np.ndarray
    bound: np.ndarray
    object_id: np.ndarray
    view: np.ndarray
    tile: np.ndarray
    group: np.ndarray


@dataclass(frozen=True)
class Sky:
    """Camera rays that leave the mesh: their number, mean radiance (3,), and whether most of them are saturated."""

    pixels: int
    radiance: np.ndarray
    bounded: bool


@dataclass(frozen=True)
class EmissionProblem:
    """Averaged rows, m of them.

    Attributes:
        rows: the system.
        observed: (m, 3) radiance.
        owner: (m,) object that reflects, -1 = an emitter's own pixels.
        anchor: (m,) bool, an emitter or the sky, seen directly.
    """

    rows: EmissionRows
    observed: np.ndarray
    owner: np.ndarray
    anchor: np.ndarray

    def with_gains(self, initial: np.ndarray) -> EmissionProblem:
        """Rows scaled by the albedo gains of the objects that go with the light."""
        # Cached radiance (h) is measured, so the light has a scale even where no emitter is seen unsaturated.
        pinned = bool(np.any(self.rows.target < self.observed)) or bool((self.anchor & ~self.rows.lower_bound.any(1)).any())
        gain = object_gains(self.rows, self.observed, self.owner, initial, pinned)
        of_row = np.ones(self.observed.shape)
        known = self.owner >= 0
        of_row[known] = gain[self.owner[known]]
        return replace(self, rows=scale_rows(self.rows, self.observed, of_row))


def assemble(
    pixels: PixelRows, halves: list[tuple[np.ndarray, np.ndarray]], n_groups: int, reflecting: bool, sky: Sky | None = None
) -> EmissionProblem:
    """Averages over (view, tile, object) with their weights; directly seen emitters and sky as rows of their own.

    A row of radiance y weighs 1 / (mean y + floor)^2: noise of photographs and albedos is relative.

    Args:
        halves: two independent estimates of (A (n, G, 3), h (n, 3)) of the pixels.
        reflecting: emitters also reflect, and are not trusted more than other rows; otherwise they are black anchors.
        sky: mean of the camera rays that leave the mesh, as one more row of the last group.
    """
    on_emitter = pixels.group >= 0
    direct = np.zeros((len(pixels.group), n_groups, 3), np.float32)
    direct[np.flatnonzero(on_emitter), pixels.group[on_emitter]] = 1.0
    reflects = np.ones(len(pixels.group), np.float32) if reflecting else np.where(on_emitter, 0.0, 1.0).astype(np.float32)
    first, second = (direct + a * reflects[:, None, None] for a, _ in halves)
    targets = [pixels.radiance - h * reflects[:, None] for _, h in halves]
    ones = np.ones((len(pixels.group), 3))
    owner = np.where(on_emitter, -1, pixels.object_id)
    keys, block = np.unique(np.stack([owner, pixels.group, pixels.view, pixels.tile], 1), axis=0, return_inverse=True)
    rows = block_rows(EmissionRows(first, second, *targets, ones, pixels.bound), block.ravel())
    empty = direct[:, :0]
    # The same blocks again for y itself, and for the number of the block.
    seen = block_rows(EmissionRows(empty, empty, pixels.radiance, pixels.radiance, ones, pixels.bound), block.ravel())
    number = np.repeat(block.ravel().astype(np.float64)[:, None], 3, 1)
    label = block_rows(EmissionRows(empty, empty, number, number, ones, pixels.bound), block.ravel()).target[:, 0]
    key = keys[np.round(label).astype(np.int64)] if len(keys) else keys.reshape(0, 4)
    brightness = seen.target.mean(1, keepdims=True)
    floor = 0.05 * float(np.median(brightness)) if len(brightness) else 1.0
    weight = rows.weight / np.maximum(brightness + floor, 1e-12) ** 2
    out = EmissionProblem(replace(rows, weight=weight), seen.target, key[:, 0].astype(np.int64), key[:, 1] >= 0)
    if sky is not None and sky.pixels:
        out = _with_sky(out, n_groups, sky)
    return out if reflecting else replace(out, rows=_strengthened(out.rows, out.anchor))


def _with_sky(problem: EmissionProblem, n_groups: int, sky: Sky) -> EmissionProblem:
    row = np.zeros((1, n_groups, 3), np.float32)
    row[0, n_groups - 1] = 1.0
    seen = sky.radiance[None]
    weight = np.full((1, 3), sky.pixels / max(float(seen.mean()), 1e-6) ** 2)
    old = problem.rows
    added = EmissionRows(
        np.concatenate([old.first, row]),
        np.concatenate([old.second, row]),
        np.concatenate([old.target, seen]),
        np.concatenate([old.target_second, seen]),
        np.concatenate([old.weight, weight]),
        np.concatenate([old.lower_bound, np.full((1, 3), sky.bounded)]),
    )
    return EmissionProblem(added, np.concatenate([problem.observed, seen]), np.r_[problem.owner, -1], np.r_[problem.anchor, True])


def _strengthened(rows: EmissionRows, anchor: np.ndarray) -> EmissionRows:
    """Anchors outweigh the rest of their column by ANCHOR_WEIGHT."""
    if not anchor.any():
        return rows
    mean = 0.5 * (rows.first + rows.second)
    elsewhere = np.einsum("nc,ngc->gc", np.where(anchor[:, None], 0.0, rows.weight), mean.astype(np.float64) ** 2)
    group = mean[anchor].max(2).argmax(1)
    weight = rows.weight.copy()
    own = np.zeros(elsewhere.shape)
    np.add.at(own, group, weight[anchor])
    factor = np.maximum(1.0, ANCHOR_WEIGHT * elsewhere / np.maximum(own, 1e-300))
    weight[anchor] *= factor[group]
    return replace(rows, weight=weight)


def initial_radiance(pixels: PixelRows, observed: np.ndarray, is_hdr: bool) -> np.ndarray:
    """(G, 3) mean radiance seen on each group, a high quantile of the bounds where saturated.

    Args:
        observed: (G, 3) mean value of all photographs, for groups without a row.
    """
    out = np.zeros(observed.shape)
    for g in range(len(observed)):
        own = pixels.group == g
        if not own.any():
            out[g] = observed[g] if is_hdr else 1.0
        else:
            # Of bounds at different exposures the high ones say most.
            out[g] = pixels.radiance[own].mean(0) if is_hdr else np.quantile(pixels.radiance[own], 0.9, axis=0)
    return out


def seen_radiance(pixels: PixelRows, n_groups: int) -> np.ndarray:
    """(G, 3) mean radiance of the pixels on each group that were not saturated; 0 without any."""
    out = np.zeros((n_groups, 3))
    clear = (pixels.group >= 0) & ~pixels.bound.any(1)
    count = np.bincount(pixels.group[clear], minlength=n_groups)
    for c in range(3):
        out[:, c] = np.bincount(pixels.group[clear], pixels.radiance[clear, c], n_groups) / np.maximum(count, 1)
    return out
