"""The linear problem of one scene, put together from pixels and two traces; solvers read nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.light.emission.environment import Sky
from iif_core.light.emission.gains import object_gains
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.pruning import WhiteSurface
from iif_core.light.emission.rows import EmissionRows, GlossRows, block_rows, scale_rows

ANCHOR_WEIGHT = 100.0
"""Weight of what is directly seen of a group relative to everything that its light does elsewhere: a face that is
looked at says what it emits; light it sends elsewhere also depends on albedos that the prior only guessed."""


Halves = list[tuple[np.ndarray, np.ndarray]]
"""Two independent estimates of (A (n, G, 3), h (n, 3))."""


@dataclass(frozen=True)
class EmissionProblem:
    """Averaged rows, m of them.

    Attributes:
        rows: the system. gloss: its specular part; None: the same gain holds for both lobes.
        observed: (m, 3) radiance.
        owner: (m,) object that reflects, -1 = an emitter's own pixels.
        anchor: (m,) bool, an emitter or the sky, seen directly.
        level_error: standard error of the logarithm of the level of all light, infinite where nothing tells it
            (`with_gains`). error_of_group: (G, 3) the same of each group's light, 0 where it is itself seen unsaturated.
        level_raised: as `ObjectGains.raised`. gain: as `ObjectGains.gain`.
    """

    rows: EmissionRows
    observed: np.ndarray
    owner: np.ndarray
    anchor: np.ndarray
    level_error: float = float("inf")
    level_raised: float = 0.0
    error_of_group: np.ndarray | None = None
    gain: np.ndarray | None = None
    gloss: GlossRows | None = None

    def with_gains(self, initial: np.ndarray, albedo: np.ndarray | None = None, n_objects: int = 0) -> EmissionProblem:
        """Rows scaled by the albedo gains of the objects that go with the light, weighed relative to what they should show.
        albedo: (n_objects, 3) mean base albedo, which no gain may make whiter than white.
        n_objects: as in `object_gains`."""
        # Cached radiance (h) is measured, so the light has a scale even where no emitter is seen unsaturated.
        pinned = bool(np.any(self.rows.target < self.observed)) or bool((self.anchor & ~self.rows.lower_bound.any(1)).any())
        # Without a scale the two lobes would fix one by how unlike they are, which the predicted gloss is not good for.
        gloss = self.gloss if pinned else None
        found = object_gains(
            self.rows, self.observed, self.owner, initial, pinned, albedo=albedo, n_objects=n_objects, gloss=gloss
        )
        of_row, gloss_of_row = np.ones(self.observed.shape), np.ones(len(self.observed))
        known = self.owner >= 0
        of_row[known], gloss_of_row[known] = found.gain[self.owner[known]], found.gloss_gain[self.owner[known]]
        rows = replace(self.rows, weight=found.weight)
        rows = scale_rows(rows, self.observed, of_row, gloss, gloss_of_row)
        return replace(
            self,
            rows=rows,
            level_error=found.level_error,
            level_raised=found.raised,
            error_of_group=found.error_of_group,
            gain=found.gain,
            gloss=None,
        )


def assemble(
    pixels: EmissionPixels,
    halves: Halves,
    n_groups: int,
    white: Halves | None = None,
    sky: Sky | None = None,
    gloss: Halves | None = None,
) -> EmissionProblem:
    """Averages over (view, tile, object) with their weights; directly seen emitters and sky as rows of their own.

    A row of radiance y weighs 1 / (mean y + floor)^2: noise of photographs and albedos is relative.

    What a pixel on an emitter shows is taken as its emission alone (kept emitters are black): an anchor that outweighs
    the rest. With `white`, while it is still open which groups shine, it may as well reflect, up to a white surface:
    y - (A_w E + h_w) <= E_g <= y, the upper end only where y is not saturated.

    Args:
        halves: two independent estimates of (A (n, G, 3), h (n, 3)) of the pixels.
        white: the same of the pixels on emitters (in their order) with a white material.
        sky: the last groups are its, each with one more row: the mean of the camera rays that see it.
        gloss: the part of the halves that the specular lobe reflects.
    """
    own = pixels.group >= 0
    direct = np.zeros((len(own), n_groups, 3), np.float32)
    direct[np.flatnonzero(own), pixels.group[own]] = 1.0
    matrices, targets = [], []
    for half in range(2):
        matrix, cached = np.array(halves[half][0]), np.array(halves[half][1])
        matrix[own], cached[own] = (0.0, 0.0) if white is None else white[half]
        matrices.append(matrix + direct)
        targets.append(pixels.radiance - cached)
    bound = pixels.bound if white is None else pixels.bound | own[:, None]
    radiance, rows = pixels.radiance, [matrices, targets]
    owner = np.where(own, -1, pixels.object_id)
    key = np.stack([owner, pixels.group, pixels.view, pixels.tile], 1)
    if white is not None:
        clear = own & ~pixels.bound.any(1)
        rows = [[np.concatenate([a, -direct[clear]]) for a in matrices], [np.r_[t, -radiance[clear]] for t in targets]]
        radiance, bound = np.r_[radiance, -radiance[clear]], np.r_[bound, np.ones((int(clear.sum()), 3), bool)]
        key = np.r_[key, key[clear] * [1, 1, 1, -1] - [0, 0, 0, 1]]
    specular = None
    if gloss is not None:
        parts = [[np.where(own.reshape(-1, *[1] * (x.ndim - 1)), 0.0, x) for x in pair] for pair in zip(*gloss, strict=True)]
        more = len(radiance) - len(own)  # what was added to tell emitters has no part in it
        specular = GlossRows(*(np.concatenate([x, np.zeros((more, *x.shape[1:]), x.dtype)]) for pair in parts for x in pair))
    problem = _blocks(EmissionRows(*rows[0], *rows[1], np.ones(radiance.shape), bound), radiance, key, specular)
    if sky is not None and sky.pixels.any():
        problem = _with_sky(problem, n_groups, sky)
    return problem if white is not None else replace(problem, rows=_strengthened(problem.rows, problem.anchor))


def _blocks(rows: EmissionRows, radiance: np.ndarray, key: np.ndarray, gloss: GlossRows | None) -> EmissionProblem:
    """Averages of rows with the same key (owner, group, view, tile), weighted for relative noise."""
    keys, block = np.unique(key, axis=0, return_inverse=True)
    block, ones, empty = block.ravel(), rows.weight, rows.first[:, :0]
    out = block_rows(rows, block)
    # The same blocks again for gloss, for y itself, and for the number of the block.
    if gloss is not None:
        mean = block_rows(
            EmissionRows(gloss.first, gloss.second, gloss.cached, gloss.cached_second, rows.weight, rows.lower_bound), block
        )
        gloss = GlossRows(mean.first, mean.second, mean.target, mean.target_second)
    seen = block_rows(EmissionRows(empty, empty, radiance, radiance, ones, rows.lower_bound), block)
    number = np.repeat(block.astype(np.float64)[:, None], 3, 1)
    label = block_rows(EmissionRows(empty, empty, number, number, ones, rows.lower_bound), block).target[:, 0]
    key = keys[np.round(label).astype(np.int64)] if len(keys) else keys.reshape(0, 4)
    brightness = np.abs(seen.target).mean(1, keepdims=True)
    for g in np.unique(key[key[:, 1] >= 0, 1]):  # one weight for all that is seen of a group, or its dark edges count most
        own = key[:, 1] == g
        brightness[own] = brightness[own].mean()
    floor = 0.05 * float(np.median(brightness)) if len(brightness) else 1.0
    scale = np.maximum(brightness + floor, 1e-12)
    weight = out.weight / scale**2
    owner = key[:, 0].astype(np.int64)
    # What an emitter shows itself has next to no noise.
    noise = np.where(owner >= 0, 1.0, 1e-3) * scale[:, 0]
    cluster = np.where(owner >= 0, owner * (int(key[:, 2].max(initial=0)) + 1) + key[:, 2], -1)
    rows = replace(out, weight=weight, cluster=cluster, noise=noise)
    return EmissionProblem(rows, seen.target, owner, key[:, 1] >= 0, gloss=gloss)


def _with_sky(problem: EmissionProblem, n_groups: int, sky: Sky) -> EmissionProblem:
    known = np.flatnonzero(sky.pixels > 0)
    count, old, seen = len(known), problem.rows, sky.radiance[known]
    row = np.zeros((count, n_groups, 3), np.float32)
    row[np.arange(count), n_groups - sky.size + known] = 1.0
    level = np.maximum(seen.mean(1), 1e-6)
    weight = np.repeat((sky.pixels[known] / level**2)[:, None], 3, 1)
    added = EmissionRows(
        np.concatenate([old.first, row]),
        np.concatenate([old.second, row]),
        np.concatenate([old.target, seen]),
        np.concatenate([old.target_second, seen]),
        np.concatenate([old.weight, weight]),
        np.concatenate([old.lower_bound, np.repeat(sky.bounded[known][:, None], 3, 1)]),
        np.r_[old.cluster, np.full(count, -1)],
        np.r_[old.noise, 1e-3 * level],
    )
    owner, anchor = np.r_[problem.owner, np.full(count, -1)], np.r_[problem.anchor, np.ones(count, bool)]
    gloss = problem.gloss
    if gloss is not None:
        gloss = GlossRows(
            *(np.concatenate([x, np.zeros((count, *x.shape[1:]), x.dtype)]) for x in (gloss.first, gloss.second)),
            *(np.concatenate([x, np.zeros((count, 3), x.dtype)]) for x in (gloss.cached, gloss.cached_second)),
        )
    return EmissionProblem(added, np.concatenate([problem.observed, seen]), owner, anchor, gloss=gloss)


def _strengthened(rows: EmissionRows, anchor: np.ndarray) -> EmissionRows:
    """Anchors outweigh the rest of their column by ANCHOR_WEIGHT."""
    if not anchor.any():
        return rows
    mean = 0.5 * (rows.first + rows.second)
    elsewhere = np.einsum("nc,ngc->gc", np.where(anchor[:, None], 0.0, rows.weight), mean.astype(np.float64) ** 2)
    group = mean[anchor].max(2).argmax(1)
    weight = rows.weight.copy()
    own = np.zeros(elsewhere.shape)
    # Bounds that are met carry nothing, so where a group is also seen unsaturated only that counts.
    known = np.where(rows.lower_bound[anchor], 0.0, weight[anchor])
    np.add.at(own, group, known)
    bounds = np.zeros(elsewhere.shape)
    np.add.at(bounds, group, weight[anchor])
    own = np.where(own > 0, own, bounds)
    factor = np.maximum(1.0, ANCHOR_WEIGHT * elsewhere / np.maximum(own, 1e-300))
    weight[anchor] *= factor[group]
    return replace(rows, weight=weight)


def initial_radiance(pixels: EmissionPixels, observed: np.ndarray, is_hdr: bool) -> np.ndarray:
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


def white_surface(pixels: EmissionPixels, seen: np.ndarray, white: Halves) -> WhiteSurface:
    """Means over the pixels of each group of what they would show if they were white.

    Args:
        seen: (G, 3) radiance seen on each group; white: as in `assemble`.
    """
    group = pixels.group[pixels.group >= 0]
    n_groups = len(seen)
    count = np.maximum(np.bincount(group, minlength=n_groups), 1)
    matrix, cached = np.zeros((n_groups, n_groups, 3)), np.zeros((n_groups, 3))
    np.add.at(matrix, group, 0.5 * (white[0][0] + white[1][0]))
    np.add.at(cached, group, 0.5 * (white[0][1] + white[1][1]))
    return WhiteSurface(np.where((count > 0)[:, None], seen, 0.0), matrix / count[:, None, None], cached / count[:, None])
