"""Irradiance of surface, estimated from what the photographs show of everything that the surface sees
(docs/method/light.md#irradiance-from-photographs).

Radiance is taken as diffuse, and exposures and response as known; errors of either stay in the albedo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.numerics.frames import dominant_side, tangent_frame
from iif_core.numerics.graph import component_labels
from iif_core.numerics.xp import NUMPY
from iif_core.surface.cells import grid_origin, pack_keys, unpack_keys, voxel_indices

Trace = Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]
"""(origins (n, 3), directions (n, 3)) -> face (n,), -1 = none, and distance (n,) in lengths of the direction."""

MAX_CELLS = 30_000
"""More cells than this are merged, eight into one, so that memory does not grow with the scene."""
DARKEST = 4e-3
"""Linear sensor values below this are noise (docs/method/numerics.md#logarithm-of-zero)."""
RAYS, SHADOW_RAYS = 64, 12
"""Directions per cell, and points per lamp."""
RAYS_AT_ONCE = 8
"""Directions per cell that are traced in one call: on a GPU a call costs more than its rays."""
MAX_LAMPS, SKY_PATCHES = 16, 16  # unknown sources
WIDTH = 0.25
"""Cauchy width of log radiance inside a group; texture beyond it hardly counts."""
SWEEPS = 15  # Gauss-Newton steps
SPREAD = {"lamp": 1.5, "sky": 1.0, "unseen": 0.3, "albedo": 0.9}
"""Standard deviations of the priors of log radiance and log albedo. A lamp that is not saturated has 0.2."""
BRIGHT_TIMES = 10.0
"""Surface so many times brighter than the mean is a lamp, saturated or not: too small for rays in all directions."""
LAMP_ABOVE = 2.0
"""First guess of the radiance of a saturated lamp, relative to what its photographs show."""
CHROMA_SHARE = 0.5
"""Share of the slow change of chromaticity inside a group that counts as light; of luminance, all counts."""
_GROUPS = 10_000  # a key has 16 bits for group and side
_OUTSIDE = 65535


@dataclass(frozen=True)
class SurfaceCells:
    """Surface cells, n of them: a voxel, a group, and one of six sides.

    Attributes:
        edge: metres; origin: (3,).
        points, normals (unit): (n, 3) means; group: (n,) int; log_radiance: (n, 3) mean of log L over unsaturated pixels;
            pixels: (n,) of those; saturated: (n,) share of all pixels; voxel: (n,) row of the next three.
        voxel_key: (v,) uint64 sorted; voxel_radiance: (v, 3) mean.
    """

    edge: float
    origin: NDArray
    points: NDArray
    normals: NDArray
    group: NDArray
    log_radiance: NDArray
    pixels: NDArray
    saturated: NDArray
    voxel: NDArray
    voxel_key: NDArray
    voxel_radiance: NDArray

    def __len__(self) -> int:
        return len(self.points)


class SurfaceCellsBuilder:
    """Sums over the pixels of views, view by view; cells grow when there would be more than MAX_CELLS.

    Args:
        corners: (n, 3) points that span the scene, metres.
        edge: of a cell, metres.

    Raises:
        InputError: edge not positive.
    """

    def __init__(self, corners: NDArray, edge: float):
        if not edge > 0:
            raise InputError(f"surface cells of edge {edge}; a length in metres above 0 is needed")
        self.edge, self.origin = float(edge), grid_origin(corners, edge)
        self.keys, self.group = np.zeros(0, np.uint64), np.zeros(0, np.int64)
        # Columns: pixels, saturated pixels; then, 3 each: point, normal, log L of unsaturated pixels, L of all pixels.
        self.sums = np.zeros((0, 14))

    def add(
        self, points: NDArray, normals: NDArray, group: NDArray, radiance: NDArray, saturated: NDArray, exposure: float
    ) -> None:
        """Add the pixels of one view.

        Args:
            points, normals: (n, 3) metres, and unit vectors towards the camera.
            group: (n,) >= -1, object or piece of the mesh.
            radiance: (n, 3) linear, the exposure divided out.
            saturated, exposure: (n,) bool, and of the view.
        """
        group = np.asarray(group, np.int64)
        side = dominant_side(normals)
        keys = pack_keys(voxel_indices(points, self.edge, self.origin), ((group + 1) % _GROUPS) * 6 + side)
        clear = ~np.asarray(saturated, bool)
        log = np.log(np.maximum(radiance, DARKEST / exposure)) * clear[:, None]
        ones = np.ones((len(keys), 1))
        rows = np.concatenate([ones, ~clear[:, None], points, normals, log, radiance], 1)
        self._merge(np.r_[self.keys, keys], np.r_[self.group, group], np.concatenate([self.sums, rows]))
        while len(self.keys) > MAX_CELLS:
            # Voxels of twice the edge have half the index; group and side stay apart.
            ijk, object_id = unpack_keys(self.keys)
            self.edge *= 2
            self._merge(pack_keys(ijk >> 1, object_id), self.group, self.sums)

    def _merge(self, keys: NDArray, group: NDArray, sums: NDArray) -> None:
        self.keys, first, row = np.unique(keys, return_index=True, return_inverse=True)
        self.group = group[first]
        self.sums = _sums(row.ravel(), len(self.keys), sums)

    def finish(self) -> SurfaceCells:
        """Return the cells with means over their pixels."""
        count, shone, clear = self.sums[:, 0], self.sums[:, 1], self.sums[:, 0] - self.sums[:, 1]
        ijk, _ = unpack_keys(self.keys)
        # Rays meet voxels: their radiance is the mean over all groups and sides in them.
        voxel_key, voxel = np.unique(pack_keys(ijk, np.full(len(ijk), -1)), return_inverse=True)
        voxel = voxel.ravel()
        of_voxel = _sums(voxel, len(voxel_key), self.sums[:, [0, 11, 12, 13]])
        normals = self.sums[:, 5:8]
        seen = np.maximum(of_voxel[:, 0], 1)
        return SurfaceCells(
            self.edge,
            np.asarray(self.origin, np.float64),
            self.sums[:, 2:5] / np.maximum(count, 1)[:, None],
            normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
            self.group,
            self.sums[:, 8:11] / np.maximum(clear, 1)[:, None],
            clear,
            shone / np.maximum(count, 1),
            voxel,
            voxel_key,
            of_voxel[:, 1:] / seen[:, None],
        )


@dataclass(frozen=True)
class Gathered:
    """What each cell sees: `known` (n, 3) photographed radiance x its share; `share` (n, u) of unknown source j; its first
    guess `start` (u, 3) and `spread` (u,), log radiance."""

    known: NDArray
    share: NDArray
    start: NDArray
    spread: NDArray


def gather(cells: SurfaceCells, trace: Trace, seed: int = 0, rays: int | None = None) -> Gathered:
    """Estimate what each cell sees by cosine-distributed rays (stratified, turned at random in each cell) and, for lamps, rays to
    points on them.

    Args:
        cells: the cells.
        trace: intersects rays with the mesh.
        seed: of the random numbers.
        rays: per cell; None = RAYS.

    Returns:
        Known light and shares of the unknown sources: lamps, sky patches, unseen surface.
    """
    # -------- unknown sources: lamps, patches of sky, unseen surface --------
    # `shines` marks voxels of lamps, which the rays below pass over because lamps have form factors.
    rng, rays = np.random.default_rng(seed), rays or RAYS
    lamp_of_cell, guess, spread = _lamps(cells)
    lamps = len(guess)
    shines = np.zeros(len(cells.voxel_key), bool)
    shines[cells.voxel[lamp_of_cell >= 0]] = True
    sky = sphere_points(SKY_PATCHES)
    known, share = np.zeros((len(cells), 3)), np.zeros((len(cells), lamps + SKY_PATCHES + 1))

    # -------- what cosine-distributed rays meet --------
    # Origins lie off the surface; `turn` shifts the pattern at random, a cell by itself, so that neighbours do not share its
    # gaps.
    tangents = _tangents(cells.normals)
    start = cells.points + 0.02 * cells.edge * cells.normals
    turn = rng.random((len(cells), 2))
    for first in range(0, rays, RAYS_AT_ONCE):
        ways = []
        for i in range(first, min(first + RAYS_AT_ONCE, rays)):
            # Strata in the radius, golden ratio in the angle: the points of one cell fill the disc evenly. Lifted to the
            # hemisphere, a uniform disc has density cos / pi.
            u = (np.array([(i + 0.5) / rays, (0.6180339887 * i) % 1]) + turn) % 1
            radius, angle = np.sqrt(u[:, :1]), 2 * np.pi * u[:, 1:]
            ways.append(
                radius * (np.cos(angle) * tangents[0] + np.sin(angle) * tangents[1]) + np.sqrt(1 - u[:, :1]) * cells.normals
            )
        for way, (face, t) in zip(ways, _traced(trace, [start] * len(ways), ways), strict=True):
            hit = np.flatnonzero(face >= 0)
            # Photographed surface is known, other surface is the last source, and a miss is a patch of sky.
            row = find_voxel(cells, start[hit] + t[hit, None] * way[hit])
            seen = row >= 0
            plain = seen & ~shines[row]  # lamps have rays of their own
            known[hit[plain]] += cells.voxel_radiance[row[plain]]
            share[hit[~seen], -1] += 1
            out = np.flatnonzero(face < 0)
            share[out, lamps + (way[out] @ sky.T).argmax(1)] += 1

    # -------- shares of the hemisphere, and form factors of lamps --------
    known /= rays
    share /= rays
    for j in range(lamps):
        share[:, j] = _form_factor(cells, np.flatnonzero(lamp_of_cell == j), start, trace, rng)
    # First guess of sky and unseen surface: the mean of the photographs.
    ambient = np.log(np.maximum(np.average(np.exp(cells.log_radiance), axis=0, weights=np.maximum(cells.pixels, 1e-9)), 1e-6))
    return Gathered(
        known,
        share,
        np.concatenate([guess, np.tile(ambient, (SKY_PATCHES + 1, 1))]),
        np.r_[spread, np.full(SKY_PATCHES, SPREAD["sky"]), SPREAD["unseen"]],
    )


def _traced(trace: Trace, origins: list[NDArray], directions: list[NDArray]) -> list[tuple[NDArray, NDArray]]:
    """Faces and distances (float64) of several sets of rays, in one call."""
    face, t = trace(np.concatenate(origins), np.concatenate(directions))
    ends = np.cumsum([len(own) for own in directions])[:-1]
    return list(zip(np.split(np.asarray(face), ends), np.split(np.asarray(t, np.float64), ends), strict=True))


def _lamps(cells: SurfaceCells) -> tuple[NDArray, NDArray, NDArray]:
    """(n,) lamp of each cell or -1; first guess of log radiance (lamps, 3); its standard deviation (lamps,).

    Lamps are cells mostly saturated, or BRIGHT_TIMES brighter than the mean, joined where they are within two edges."""
    from scipy.spatial import cKDTree

    bright = cells.voxel_radiance.max(1)
    shines = (cells.saturated > 0.5) | (bright > BRIGHT_TIMES * max(float(bright.mean()), 1e-9))[cells.voxel]
    own = np.flatnonzero(shines)
    lamp = np.full(len(cells), -1)
    if not len(own):
        return lamp, np.zeros((0, 3)), np.zeros(0)
    pairs = cKDTree(cells.points[own]).query_pairs(2 * cells.edge, output_type="ndarray")
    label = component_labels(len(own), *pairs.T)
    # Largest lamps first.
    rank = np.argsort(np.argsort(-np.bincount(label), kind="stable"), kind="stable")
    lamp[own] = np.minimum(rank[label], MAX_LAMPS - 1)  # all small lamps are one
    count = int(lamp.max()) + 1
    size = np.maximum(np.bincount(lamp[own], minlength=count), 1)
    # What the photographs show of a lamp; where it is clipped, only a bound, hence the higher guess and the wider prior.
    radiance = _sums(lamp[own], count, cells.voxel_radiance[cells.voxel[own]]) / size[:, None]
    clipped = np.bincount(lamp[own], cells.saturated[own], count) / size > 0.25
    guess = np.log(np.maximum(radiance, 1e-6)) + np.where(clipped, np.log(LAMP_ABOVE), 0.0)[:, None]
    return lamp, guess, np.where(clipped, SPREAD["lamp"], 0.2)


def _form_factor(cells: SurfaceCells, lamp: NDArray, start: NDArray, trace: Trace, rng: np.random.Generator) -> NDArray:
    """(n,) cosine-weighted share of the hemisphere of every cell that the cells `lamp` cover, by points on them (Eq. L.56)."""
    total, n = np.zeros(len(cells)), len(cells)
    lit, ways, terms = [], [], []
    for _ in range(SHADOW_RAYS):
        # One random cell of the lamp for each receiver, and a random point in the plane of that cell.
        own = lamp[rng.integers(0, len(lamp), n)]
        jitter = (rng.random((n, 3)) - 0.5) * 0.5 * cells.edge * (1 - np.abs(cells.normals[own]))
        way = cells.points[own] + jitter - start
        square = np.maximum((way**2).sum(1), 1e-12)
        here, there = (way * cells.normals).sum(1), -(way * cells.normals[own]).sum(1)
        facing = np.flatnonzero((here > 0) & (there > 0))
        # r^2 cos cos' / r^4, because `way` has length r. The floor of half an edge keeps neighbours of a lamp finite (Eq. L.56).
        term = here * there / np.maximum(square, (0.5 * cells.edge) ** 2) ** 2
        lit.append(facing)
        ways.append(way[facing])
        terms.append((term[facing], 1 - 0.5 * cells.edge / np.sqrt(square[facing])))
    for cell, (term, nearest), (_, t) in zip(lit, terms, _traced(trace, [start[cell] for cell in lit], ways), strict=True):
        # Visible if the ray gets within half an edge of the point, in lengths of `way`.
        near = t > nearest
        total[cell[near]] += term[near]
    return np.minimum(total / SHADOW_RAYS * len(lamp) * cells.edge**2 / np.pi, 1.0)


def fit_light(
    cells: SurfaceCells, gathered: Gathered, albedo: float | NDArray, spread: float = SPREAD["albedo"]
) -> tuple[NDArray, NDArray]:
    """Fit log light on every cell and log albedo of its group, (n, 3) each; diffuse radiance is e^(their sum), up to texture
    (Eq. L.57).

    A group of m cells has the weight of sqrt(m).

    Args:
        cells: n cells; gathered: what they see.
        albedo: prior mean of the albedos of groups, one for all or (groups, 3) in the order of their ids; fixes the scale where
            no photographed surface lights anything.
        spread: standard deviation of that prior, in log albedo.
    """
    _, group = np.unique(cells.group, return_inverse=True)
    group = group.ravel()
    groups = int(group.max(initial=-1)) + 1
    use = cells.pixels >= 2
    # A group of N cells counts as sqrt(N), so that large walls do not decide alone.
    weight0 = use / np.sqrt(np.maximum(np.bincount(group[use], minlength=groups)[group], 1))
    prior_weight = WIDTH**2 / spread**2  # precision of the albedo's prior, in units of a cell's
    log_prior = np.log(np.broadcast_to(albedo, (groups, 3)))
    light, log_albedo = np.zeros((len(cells), 3)), np.zeros((len(cells), 3))
    # m_0 of Eq. L.55, so that the logarithm exists where a cell sees nothing.
    floor = 1e-3 * float(np.exp(gathered.start).mean()) if gathered.start.size else 1e-6
    # Sources that no cell sees leave the system.
    active = gathered.share.max(0, initial=0) > 2e-3
    share = gathered.share[:, active]
    for c in range(3):
        theta = first = gathered.start[active, c]
        precision = WIDTH**2 / gathered.spread[active] ** 2
        weight = weight0
        for _ in range(SWEEPS):
            # -------- levels of the groups under the present sources --------
            source = np.exp(theta)
            mean = gathered.known[:, c] + share @ source + floor
            difference = cells.log_radiance[:, c] - np.log(mean)
            total = np.bincount(group, weight, groups) + prior_weight
            level = (np.bincount(group, weight * difference, groups) + prior_weight * log_prior[:, c]) / total

            # -------- Cauchy weights --------
            residual = difference - level[group]
            weight = weight0 / (1 + (residual / WIDTH) ** 2)

            # -------- Gauss-Newton step in theta, at most 1 in each --------
            slope = share * source / mean[:, None]
            # The level of a group follows theta: subtract the group's mean of every column.
            total = np.bincount(group, weight, groups) + prior_weight
            centred = slope - (_sums(group, groups, weight[:, None] * slope) / total[:, None])[group]
            # einsum, not BLAS: the sums must not depend on the number of threads.
            matrix = np.einsum("ni,nj->ij", centred * weight[:, None], slope) + np.diag(precision)
            right = np.einsum("ni,n->i", centred, weight * residual) - precision * (theta - first)
            theta = theta + np.clip(np.linalg.solve(matrix, right), -1, 1) if len(theta) else theta
        light[:, c] = np.log(gathered.known[:, c] + share @ np.exp(theta) + floor)
        log_albedo[:, c] = level[group]
    return light, log_albedo


def residual_light(cells: SurfaceCells, residual: NDArray, reach: float) -> NDArray:
    """Extract what of the residual log radiance (n, 3) changes slowly inside a group: light that `fit_light` could not explain
    (Eq. L.58).

    Robust means over boxes of edge reach / 2 (same group and side), then a Gaussian over boxes of width `reach` metres in
    position and 1 in the normal. All of the luminance is used, and CHROMA_SHARE of the chromaticity.
    """
    from scipy.spatial import cKDTree

    low = cells.origin - reach
    side = dominant_side(cells.normals)
    # Robust mean in each box: texture is an outlier, slow light is not.
    keys = pack_keys(voxel_indices(cells.points, reach / 2, low), ((cells.group + 1) % _GROUPS) * 6 + side)
    _, box = np.unique(keys, return_inverse=True)
    box = box.ravel()
    boxes = int(box.max(initial=-1)) + 1
    if not boxes:
        return np.zeros_like(residual)
    start = weight = (cells.pixels >= 2).astype(np.float64)
    for _ in range(8):
        count = np.bincount(box, weight, boxes)
        mean = _sums(box, boxes, weight[:, None] * residual) / np.maximum(count, 1e-12)[:, None]
        weight = start / (1 + (np.abs(residual - mean[box]).mean(1) / WIDTH) ** 2)
    _, group = np.unique(cells.group, return_inverse=True)
    # A unit of distance is one reach, or a change of 1 in the normal. Other groups lie out of reach.
    place = np.concatenate([cells.points / reach, cells.normals, 1e3 * group.reshape(-1, 1)], 1)
    centre = _sums(box, boxes, place) / np.bincount(box, minlength=boxes)[:, None]
    distance, near = cKDTree(centre).query(place, k=min(32, boxes), distance_upper_bound=3.0)
    distance, near = distance.reshape(len(place), -1), near.reshape(len(place), -1)
    found = np.isfinite(distance)
    near = np.where(found, near, 0)
    # `query` pads with infinite distances where fewer boxes are near.
    kernel = np.where(found, np.exp(-0.5 * np.where(found, distance, 0) ** 2), 0) * count[near]
    smooth = (kernel[..., None] * mean[near]).sum(1) / np.maximum(kernel.sum(1), 1e-9)[:, None]
    luminance = smooth.mean(1, keepdims=True)
    return luminance + CHROMA_SHARE * (smooth - luminance)


class LightField:
    """Interpolates log light between the cells: a mean over the 8 nearest in position (in edges) and normal."""

    def __init__(self, cells: SurfaceCells):
        from scipy.spatial import cKDTree

        self.edge = cells.edge
        self.tree = cKDTree(self._place(cells.points, cells.normals))

    def _place(self, points: NDArray, normals: NDArray) -> NDArray:
        return np.concatenate([np.asarray(points, np.float64) / self.edge, 3.0 * np.asarray(normals, np.float64)], 1)

    def weights(self, points: NDArray, normals: NDArray) -> tuple[NDArray, NDArray]:
        """Return rows of the cells and their weights, (m, k) each, for points and unit normals (m, 3)."""
        count = min(8, self.tree.n)
        distance, near = self.tree.query(self._place(points, normals), k=count, eps=0.2)
        weight = 1 / (np.reshape(distance, (len(points), count)) + 0.3) ** 2
        return np.reshape(near, (len(points), count)), weight / weight.sum(1, keepdims=True)


def sphere_points(count: int) -> NDArray:
    """Return (count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)


def find_voxel(cells: SurfaceCells, points: NDArray) -> NDArray:
    """Row of the voxel around each point, -1 where no photograph shows it."""
    if not len(points) or not len(cells.voxel_key):
        return np.full(len(points), -1)
    ijk = np.floor((points - cells.origin) / cells.edge)
    # `pack_keys` refuses indices outside its range; such points ask for the last voxel of the range instead.
    ijk = np.where(((ijk >= 0) & (ijk < _OUTSIDE)).all(1)[:, None], ijk, _OUTSIDE).astype(np.int64)
    keys = pack_keys(ijk, np.full(len(ijk), -1))
    row = np.minimum(np.searchsorted(cells.voxel_key, keys), len(cells.voxel_key) - 1)
    return np.where(cells.voxel_key[row] == keys, row, -1)


def _tangents(n: NDArray) -> tuple[NDArray, NDArray]:
    """Two unit vectors (n, 3) that form a right-handed frame with each unit normal."""
    first, second = tangent_frame(NUMPY, *n.T)
    return np.stack(first, 1), np.stack(second, 1)


def _sums(row: NDArray, count: int, values: NDArray) -> NDArray:
    """(count, c) sums of the rows (n, c) by their number, in the order of the rows."""
    out = np.zeros((count, values.shape[1]))
    for c in range(values.shape[1]):
        out[:, c] = np.bincount(row, values[:, c], count)
    return out


def estimate_log_light(
    cells: SurfaceCells,
    gathered: Gathered,
    albedo: float | NDArray,
    reaches: tuple[float, ...],
    spread: float = SPREAD["albedo"],
) -> NDArray:
    """Estimate the light on the cells: what `gather` found, fitted, and completed by the residual light.

    Args:
        cells: n cells; gathered: what they see.
        albedo, spread: prior of the albedos of groups, as in `fit_light`.
        reaches: scales of the residual light, in edges of a cell.

    Returns:
        (len(reaches), n, 3) log light, one version for each reach.
    """
    if not len(cells):
        return np.zeros((len(reaches), 0, 3))
    light, log_albedo = fit_light(cells, gathered, albedo, spread)
    residual = np.where((cells.pixels >= 2)[:, None], cells.log_radiance - light - log_albedo, 0.0)
    return np.stack([light + residual_light(cells, residual, reach * cells.edge) for reach in reaches])
