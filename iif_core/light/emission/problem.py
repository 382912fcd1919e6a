"""The linear problem of one scene, assembled from pixels and traced transport; solvers read nothing else
(docs/method/light.md#rows)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.environment import Sky
from iif_core.light.emission.gains import BaseAlbedo, GainOptions, ObjectGains, estimate_object_gains
from iif_core.light.emission.pixels import COVERAGE_ERROR, EmissionPixels
from iif_core.light.emission.pruning import WhiteSurface, without_groups
from iif_core.light.emission.rows import EmissionRows, TracedTransport, block_rows, light_of

ANCHOR_WEIGHT = 100.0
"""Weight of what is directly seen of a group relative to everything that its light does elsewhere (Eq. L.17)."""
ROW_FLOOR = 0.05
"""Error of a row that does not shrink with its radiance, relative to the median of all rows (Eq. L.15)."""


@dataclass(frozen=True)
class EmissionProblem:
    """Averaged rows, m of them.

    Attributes:
        rows: the system.
        owner: (m,) object that reflects, -1 = an emitter or the sky, seen directly.
        anchor: (m,) bool, an emitter or the sky, seen directly.
        pixels: (m,) how many were averaged.
    """

    rows: EmissionRows
    owner: np.ndarray
    anchor: np.ndarray
    pixels: np.ndarray

    @property
    def scale_is_identifiable(self) -> bool:
        """Photographed light (h) shares in what is reflected, or an emitter is seen unsaturated in all channels: the light then
        has a scale in the units of the photographs."""
        return bool((self.rows.cached > 0).any()) or bool((self.anchor & ~self.rows.lower_bound.any(1)).any())

    def misfit(self, radiance: np.ndarray) -> float:
        """Return how badly light `radiance` (G, 3) explains the pixels that look at no emitter (Eq. L.40): their mean squared
        relative error, without the noise of the two traces, which is independent; each error is at most 2."""
        used = ~self.anchor
        observed, bound = self.rows.observed[used], self.rows.lower_bound[used]
        predicted = [
            light_of(matrix[used], radiance) + cached[used]
            for matrix, cached in zip(self.rows.matrices, self.rows.cached.sum(1), strict=True)
        ]
        mean = 0.5 * (predicted[0] + predicted[1])
        floor = ROW_FLOOR * float(np.median(observed.mean(1))) if len(observed) else 1.0
        scale = np.maximum(0.5 * (observed + np.abs(mean)) + floor, 1e-300)
        # The two traces have independent noise, so it has no part in the expectation of the product.
        error = (observed - predicted[0]) / scale * ((observed - predicted[1]) / scale)
        # A bound that is met speaks neither for nor against the light.
        error = np.where(bound & (mean > observed), 0.0, error).mean(1)
        return float((self.pixels[used] * error).sum() / max(self.pixels[used].sum(), 1e-300))

    def is_bounded(self, groups: int) -> np.ndarray:
        """Return which of the first `groups` groups are seen, but never unsaturated: only bounds say how bright they look."""
        first, second = self.rows.matrices
        shown = 0.5 * np.abs(first + second)[self.anchor, :groups].max(2) > 0
        bound = self.rows.lower_bound[self.anchor].any(1)
        return shown.any(0) & ~shown[~bound].any(0)

    def take(self, keep: np.ndarray) -> EmissionProblem:
        """Return some of the rows."""
        return EmissionProblem(self.rows.take(keep), self.owner[keep], self.anchor[keep], self.pixels[keep])

    def beside(self, other: EmissionProblem) -> EmissionProblem:
        """These rows, followed by others of the same groups."""
        joined = (np.concatenate([getattr(part, name) for part in (self, other)]) for name in ("owner", "anchor", "pixels"))
        return EmissionProblem(self.rows.beside(other.rows), *joined)

    def columns(self, keep: np.ndarray, shown: np.ndarray) -> EmissionProblem:
        """The problem of a subset of the groups, a mask (G,); the others light the scene with the radiance `shown` (G, 3)."""
        return replace(self, rows=without_groups(self.rows, keep, shown))

    def solve_object_gains(
        self,
        prior: EmissionPrior,
        albedo: BaseAlbedo | None = None,
        n_objects: int = 0,
        options: GainOptions | None = None,
    ) -> tuple[EmissionProblem, ObjectGains]:
        """Estimate the albedo gains of objects together with the light (up to 15 solves; docs/method/light.md#object-gains).

        `prior` is the prior of the groups, `albedo` the albedo of the base, if known; options: None = defaults.
        Returns the problem with rows scaled by the gains, without lobes, and weights relative to what the rows should show; and
        the gains.
        """
        identifiable = self.scale_is_identifiable
        # Without a scale the two lobes would fix one by how much they differ, for which predicted gloss is not good enough.
        rows = self.rows if identifiable else self.rows.without_lobes()
        found = estimate_object_gains(rows, self.owner, prior, identifiable, albedo, n_objects, options)
        return replace(self, rows=replace(rows, weight=found.weight)).with_gains(found), found

    def with_gains(self, gains: ObjectGains) -> EmissionProblem:
        """The problem with rows scaled by the gains of their objects, lobes added up; weights stay."""
        known = self.owner >= 0
        of_row, gloss_of_row = np.ones(self.rows.observed.shape), np.ones(len(known))
        of_row[known], gloss_of_row[known] = gains.gain[self.owner[known]], gains.gloss_gain[self.owner[known]]
        return replace(self, rows=self.rows.scaled(of_row, gloss_of_row))


def assemble(
    pixels: EmissionPixels,
    transport: TracedTransport,
    n_groups: int,
    white: TracedTransport | None = None,
    sky: Sky | None = None,
) -> EmissionProblem:
    """Average pixels over (view, tile, object) with their weights (Eq. L.15), and add rows for the sky.

    A pixel on an emitter shows its emission alone (kept emitters are black): an anchor that outweighs the other rows. With
    `white`, while it is still open which groups emit, it may as well reflect, up to a white surface (Eq. L.18):
    y - (A_w E + h_w) <= E_g <= y, the upper end only where y is not saturated.

    Args:
        pixels: n pixels.
        transport: of the pixels.
        n_groups: G, groups of the sky included.
        white: transport of the pixels on emitters, in their order, with a white material; one lobe.
        sky: the last groups belong to it; each that camera rays see gets a row with their mean.

    Returns:
        The problem, rows of the sky last.
    """
    # -------- what a pixel on an emitter shows --------
    # It shows phi E, with phi the share of the pixel in which it sees each group (n, G, 3), and no traced light. In a trial it
    # may also show what a white surface would reflect.
    own = pixels.group >= 0
    direct = np.repeat(pixels.direct(n_groups)[:, :, None], 3, 2)
    matrix, cached = np.array(transport.matrix), np.array(transport.cached, np.float64)
    matrix[:, :, own], cached[:, :, own] = 0.0, 0.0
    observed = np.array(pixels.radiance, np.float64)
    if white is not None:
        matrix[:, :1, own], cached[:, :1, own] = white.matrix, white.cached

    # -------- pixels that only bound the emission (Eq. L.16, L.18) --------
    # In a trial every pixel on an emitter does; afterwards only one that the emitter fills in part.
    bounded = pixels.partial if white is None else own
    bound = pixels.bound | bounded[:, None]
    # Unsaturated ones have an upper end too, phi E <= y, which is the lower bound -phi E >= -y.
    clear = bounded & ~pixels.bound.any(1)
    top = -observed[clear]
    partial = pixels.partial
    # Shares are counted on few rays. Each end takes them with the error that makes the bound weaker.
    least = np.where(partial[:, None, None], np.maximum(direct - COVERAGE_ERROR, 0.0), direct)
    most = np.where((direct > 0) & partial[:, None, None], np.minimum(direct + COVERAGE_ERROR, 1.0), direct)
    matrix[:, 0] += most
    if white is None:  # what shares a pixel with an emitter is dimmer than `rest`
        observed -= np.where(partial, pixels.rest * (1.0 - least[:, :, 0].sum(1)), 0.0)[:, None]

    # -------- one row for each owner, group, view and tile --------
    key = np.stack([np.where(own, -1, pixels.object_id), pixels.group, pixels.view, pixels.tile], 1)
    if clear.any():  # the upper ends, as bounds of the negated rows
        upper = np.zeros((*matrix.shape[:2], int(clear.sum()), n_groups, 3), matrix.dtype)
        upper[:, 0] = -least[clear]
        none = np.zeros((*upper.shape[:3], 3), upper.dtype)
        matrix, cached = np.concatenate([matrix, upper], 2), np.concatenate([cached, none], 2)
        observed, bound = np.r_[observed, top], np.r_[bound, np.ones((int(clear.sum()), 3), bool)]
        # Negative tiles keep upper ends from being averaged with lower ends.
        key = np.r_[key, key[clear] * [1, 1, 1, -1] - [0, 0, 0, 1]]
    problem, _ = _averaged(EmissionRows(matrix, observed, cached, np.ones(observed.shape), bound), key)
    if sky is not None and sky.pixels.any():
        problem = _with_sky(problem, n_groups, sky)
    return problem if white is not None else replace(problem, rows=_strengthened(problem.rows, problem.anchor))


def reflecting_rows(pixels: EmissionPixels, transport: TracedTransport, n_groups: int) -> tuple[EmissionProblem, np.ndarray]:
    """Average pixels that look at groups (Eq. L.15) as if these only reflected.

    Returns the problem of its rows, and the group that each of them looks at.
    """
    shape = (len(pixels.group), 3)
    rows = EmissionRows(transport.matrix, pixels.radiance.astype(float), transport.cached, np.ones(shape), pixels.bound)
    tile = pixels.tile.astype(np.int64) * n_groups + pixels.group
    key = np.stack([pixels.object_id, np.full(shape[0], -1), pixels.view, tile], 1)
    averaged, first = _averaged(rows, key)
    return averaged, pixels.group[first]


def _averaged(rows: EmissionRows, key: np.ndarray) -> tuple[EmissionProblem, np.ndarray]:
    """Averages of rows with the same key (owner, group, view, tile), weighted for relative noise; and a row that each is of."""
    keys, block = np.unique(key, axis=0, return_inverse=True)
    rows, pixel = block_rows(rows, block.ravel())
    key, pixels = key[pixel], rows.weight[:, 0]  # all weights were 1, so their sum is a number of pixels
    brightness = np.abs(rows.observed).mean(1, keepdims=True)
    for g in np.unique(key[key[:, 1] >= 0, 1]):  # one weight for all that is seen of a group, or its dark edges count most
        own = key[:, 1] == g
        brightness[own] = brightness[own].mean()
    floor = ROW_FLOOR * float(np.median(brightness)) if len(brightness) else 1.0
    scale = np.maximum(brightness + floor, 1e-12)
    owner = key[:, 0].astype(np.int64)
    # What an emitter shows itself has next to no noise.
    noise = np.where(owner >= 0, 1.0, 1e-3) * scale[:, 0]
    # Rows of one object in one view share the error of its albedo. Anchors are independent of each other.
    cluster = np.where(owner >= 0, owner * (int(key[:, 2].max(initial=0)) + 1) + key[:, 2], -1)
    rows = replace(rows, weight=rows.weight / scale**2, cluster=cluster, noise=noise)
    return EmissionProblem(rows, owner, key[:, 1] >= 0, pixels), pixel


def _with_sky(problem: EmissionProblem, n_groups: int, sky: Sky) -> EmissionProblem:
    """A row for each group of the sky that camera rays see."""
    known = np.flatnonzero(sky.pixels > 0)
    count, old, seen = len(known), problem.rows, sky.radiance[known]
    matrix = np.zeros((*old.matrix.shape[:2], count, n_groups, 3), np.float32)
    # Camera rays see the group itself: A = 1 in its own column, and h = 0.
    matrix[:, 0, np.arange(count), n_groups - sky.size + known] = 1.0
    level = np.maximum(seen.mean(1), 1e-6)
    rows = EmissionRows(
        np.concatenate([old.matrix, matrix], 2),
        np.concatenate([old.observed, seen]),
        np.concatenate([old.cached, np.zeros((*old.cached.shape[:2], count, 3), old.cached.dtype)], 2),
        np.concatenate([old.weight, np.repeat((sky.pixels[known] / level**2)[:, None], 3, 1)]),
        np.concatenate([old.lower_bound, np.repeat(sky.bounded[known][:, None], 3, 1)]),
        np.r_[old.cluster, np.full(count, -1)],
        np.r_[old.noise, 1e-3 * level],
    )
    owner, anchor = np.r_[problem.owner, np.full(count, -1)], np.r_[problem.anchor, np.ones(count, bool)]
    return EmissionProblem(rows, owner, anchor, np.r_[problem.pixels, sky.pixels[known]])


def _strengthened(rows: EmissionRows, anchor: np.ndarray) -> EmissionRows:
    """Anchors outweigh the other rows of their column by ANCHOR_WEIGHT (Eq. L.17)."""
    if not anchor.any():
        return rows
    first, second = rows.matrices
    mean = 0.5 * (first + second)
    # Numerator of Eq. L.17 without the factor, (G, 3): what the light of each group does in rows that are no anchors.
    elsewhere = np.einsum("nc,ngc->gc", np.where(anchor[:, None], 0.0, rows.weight), mean.astype(np.float64) ** 2)
    # The group that an anchor looks at: its own column alone differs from 0, and is negative in rows of upper ends (Eq. L.16).
    group = np.abs(mean[anchor]).max(2).argmax(1)
    weight = rows.weight.copy()
    own = np.zeros(elsewhere.shape)
    # Bounds that are met carry nothing, so where a group is also seen unsaturated only that counts.
    known = np.where(rows.lower_bound[anchor], 0.0, weight[anchor])
    np.add.at(own, group, known)
    bounds = np.zeros(elsewhere.shape)
    np.add.at(bounds, group, weight[anchor])
    own = np.where(own > 0, own, bounds)
    # A group that no anchor looks at has nothing to strengthen.
    factor = np.maximum(1.0, np.divide(ANCHOR_WEIGHT * elsewhere, own, out=np.ones_like(own), where=own > 0))
    weight[anchor] *= factor[group]
    return replace(rows, weight=weight)


def initial_radiance(pixels: EmissionPixels, observed: np.ndarray, is_hdr: bool) -> np.ndarray:
    """Return (G, 3) mean radiance seen on each group, for 8-bit photographs the 0.9 quantile of what its pixels show.

    observed (G, 3): mean value of all photographs, for groups without a pixel.
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


def expected_radiance(pixels: EmissionPixels, seen: np.ndarray) -> np.ndarray:
    """Return (G, 3) what groups radiate that show `seen` (G, 3): the middle between that and seen / share of their pixels."""
    own = pixels.group >= 0
    count = np.bincount(pixels.group[own], minlength=len(seen))
    share = np.bincount(pixels.group[own], pixels.own_share[own], len(seen)) / np.maximum(count, 1)
    return seen / np.sqrt(np.where(share > 0, share, 1.0))[:, None]


def white_surface(pixels: EmissionPixels, seen: np.ndarray, white: TracedTransport) -> WhiteSurface:
    """Average over the pixels of each group what they would show if they were white.

    seen (G, 3): radiance seen on each group; white: as in `assemble`.
    """
    group = pixels.group[pixels.group >= 0]
    n_groups = len(seen)
    count = np.maximum(np.bincount(group, minlength=n_groups), 1)
    matrix, cached = np.zeros((n_groups, n_groups, 3)), np.zeros((n_groups, 3))
    np.add.at(matrix, group, 0.5 * (white.matrix[0, 0] + white.matrix[1, 0]))
    np.add.at(cached, group, 0.5 * (white.cached[0, 0] + white.cached[1, 0]))
    covered = np.zeros((n_groups, n_groups))
    np.add.at(covered, group, pixels.direct(n_groups)[pixels.group >= 0])
    seen = np.where((count > 0)[:, None], seen, 0.0)
    return WhiteSurface(seen, matrix / count[:, None, None], cached / count[:, None], covered / count[:, None])
