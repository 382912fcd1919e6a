"""Inputs of the learned prior, from photographs, cameras, mesh and objects alone (docs/method/priors.md#learned).

Every input is relative, so that neither the exposure of a view nor a factor on all exposures changes it: the photograph divided
by the light that all photographs together imply, what other photographs show of the same surface, what the mirrored ray meets,
and shape. The light is the estimate of `iif_core.light.irradiance`; the network is there to remove its errors from the quotient.

Views are read one at a time. What other views look up is kept in 62 bytes a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from threading import Lock
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from iif_core.camera.pixels import ViewMaps
from iif_core.errors import InputError
from iif_core.light.irradiance import (
    DARKEST,
    Gathered,
    LightField,
    SurfaceCells,
    SurfaceCellsBuilder,
    Trace,
    estimate_log_light,
    find_voxel,
    gather,
)
from iif_core.numerics.parallel import map_in_order
from iif_core.priors.reprojection import NORMAL_STEPS, Camera, ViewTable, add_samples, as_steps, from_steps, quantiles
from iif_core.priors.retinex import albedo_level

CHANNELS = (
    *("y_r", "y_g", "y_b"),
    *("dy_r", "dy_g", "dy_b"),
    *("i_r", "i_g", "i_b"),
    *("low_r", "low_g", "low_b"),
    *("mid_r", "mid_g", "mid_b"),
    *("high", "top", "count"),
    *("m_r", "m_g", "m_b"),
    *("m_known", "m_far"),
    *("slope", "corr", "rest"),
    *("n_x", "n_y", "n_z"),
    *("nov", "depth", "border", "hit", "valid", "saturated"),
    *("g_r", "g_g", "g_b"),
    *("g_slope", "g_corr"),
)
"""Names of the inputs, natural logarithms of radiance where nothing else is said (table in docs/method/priors.md#learned):
y the photograph less the light, of the shorter reach; dy what the longer reach changes; i the photograph less the median of its
view; low, mid, high, top the 20, 50, 80 and 100 % quantiles over all views, less this view; count log(1 + views); m the radiance
that the mirrored ray meets, less the photograph, whether it is known, and log(1 + metres); slope, corr, rest the regression of
radiance on mirrored radiance over the views; n the normal in the camera, nov its cosine with the viewing direction; g medians and
pooled regression of the object."""

CELL_FOOTPRINTS = 6.0
"""Edge of a surface cell in median pixel footprints."""
REACHES = (3.0, 8.0)
"""Reaches of the residual light in edges of a cell (Eq. L.58)."""
MAX_VIEWS = 24
"""Views of a point that are compared, its own among them: as many as the captures have that the network is trained on."""
POOL_PIXELS = 40_000
"""Pixels of a view in the pooled regression of its objects. Of more pixels, every second, third, ... row and column counts."""
MEAN_ALBEDO = 0.4
"""Mean over the surface to which the light is scaled; the network corrects it."""
KNOWN_SPREAD = 0.3
"""Standard deviation of an object's log albedo as a first prediction states it."""
COMPUTED_SHARE = 0.7
"""Weight of the computed light in a second look; the gathered light has the rest (Eq. P.29)."""
# Range in which the quotient y is kept, natural logarithm.
QUOTIENT = (-5.5, 2.5)
FARTHEST, BRIGHTEST = 10.0, 30.0
"""Largest distance in metres, and radiance in means of the scene, of what a mirrored ray meets."""
# Bins of 1/64 of a natural logarithm; what lies outside falls into the first or the last one.
_MEDIAN_BINS, _MEDIAN_RANGE = 1024, (-10.0, 6.0)


class Views(Protocol):
    """A sequence of views, which may read them when they are asked for.

    Their `value` is radiance times the exposure of the camera, which is > 0, linear Rec. 709. Only pixels with surface are valid.
    `object_id` is the object or piece of the mesh. There are `saturated` and `normals`.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> ViewMaps: ...


@dataclass(frozen=True)
class ViewLight:
    """What only the view itself reads again, for the n pixels that show surface.

    Attributes:
        row: (n, 8) uint16 cells of the light around each pixel, and their weights, (n, 8) float16.
        mirrored: (n, 3) float16 log radiance, relative to the scene's mean, that the mirrored ray meets; distance: (n,) float16
            metres to it, NaN = it meets nothing.
    """

    row: NDArray
    weight: NDArray
    mirrored: NDArray
    distance: NDArray


@dataclass(frozen=True)
class Gathering:
    """What the inputs of a view need of all views.

    Attributes:
        light: on the surface.
        cameras, tables, lights: of each view.
        neighbours: for each view the views that see most of the same surface, itself first.
        group: (G,) sorted ids of objects, and for each: median (G, 3) of the quotient y; slope, correlation (G,) of radiance on
            mirrored radiance.
    """

    light: SceneLight
    cameras: list[Camera]
    tables: list[ViewTable]
    lights: list[ViewLight]
    neighbours: list[NDArray]
    group: NDArray
    median: NDArray
    slope: NDArray
    correlation: NDArray


Keep = Callable[[NDArray], NDArray]


@dataclass(frozen=True)
class SceneLight:
    """Light on the surface, estimated from all views.

    Attributes:
        cells: of the surface, and what they see; field: interpolates between them; log_light: (2, cells, 3) for the two REACHES.
        mean: radiance, mean over all used pixels.
        seen: for each view the coarse blocks of surface that it sees, sorted.
    """

    cells: SurfaceCells
    gathered: Gathered
    field: LightField
    log_light: NDArray
    mean: float
    seen: list[NDArray]

    def around(self, view: ViewMaps) -> tuple[NDArray, NDArray]:
        """Return rows of the cells around the n pixels of a view that show surface, and their weights, (n, k) each."""
        hit = view.hit
        return self.field.weights(view.points()[hit], view.normals[hit])

    def log_at(self, row: NDArray, weight: NDArray) -> NDArray:
        """Return the log light (2, n, 3) float32 from the cells around n pixels."""
        weight = weight.astype(np.float32)
        return np.stack([np.einsum("nk,nkc->nc", weight, own.astype(np.float32)[row]) for own in self.log_light])


def scene_light(views: Views, trace: Trace, mean_albedo: float, seed: int = 0) -> SceneLight:
    """Estimate the light from all views (Eq. L.55 to L.58), scaled to a mean albedo (Eq. P.16).

    Raises:
        InputError: no view shows any surface.
    """
    cells, mean, seen = _cells(views)
    gathered = gather(cells, trace, seed)
    log_light = _levelled(cells, estimate_log_light(cells, gathered, mean_albedo, REACHES), mean_albedo)
    return SceneLight(cells, gathered, LightField(cells), log_light, mean, seen)


def _levelled(cells: SurfaceCells, log_light: NDArray, mean_albedo: float) -> NDArray:
    """Scale each version of the light so that the albedos have the wanted mean (Eq. P.16)."""
    # Each reach leaves another mean albedo, so each is scaled by itself.
    levels = [albedo_level(np.exp(cells.log_radiance - own), cells.pixels, mean_albedo) for own in log_light]
    return log_light - np.log(levels)[:, None, None]


def gather_views(
    views: Views,
    trace: Trace,
    mean_albedo: float = MEAN_ALBEDO,
    seed: int = 0,
    keep: Keep = lambda array: array,
    threads: int = 1,
) -> Gathering:
    """Estimate the light from all views, and prepare what they look up in each other.

    Args:
        views: of one capture, at least one; each is read five times.
        trace: intersects rays with the mesh.
        mean_albedo: prior mean of the albedos of objects, to which the light is scaled.
        seed: of the rays.
        keep: returns an array that holds the same values, perhaps on disk; it is given all arrays that grow with the views.
        threads: views that are worked on at a time; the result does not depend on it.

    Raises:
        InputError: no view shows any surface.
    """
    # -------- the light, and what is looked up in each view --------
    light = scene_light(views, trace, mean_albedo, seed)
    tables, lights, cameras = [], [], []

    one_at_a_time = Lock()

    def locked(origins: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
        with one_at_a_time:  # it may use its own threads
            return trace(origins, directions)

    def prepared(i: int) -> tuple[ViewTable, ViewLight, Camera]:
        view = views[i]
        return *_prepared(view, light, locked), camera_of(view)

    for table, own, camera in map_in_order(prepared, len(views), threads):
        tables.append(ViewTable(*(keep(array) for array in table)))
        lights.append(ViewLight(keep(own.row), keep(own.weight), keep(own.mirrored), keep(own.distance)))
        cameras.append(camera)
    # -------- which views see the same surface; medians and pooled regression of the objects --------
    neighbours = _neighbours(light.seen)
    group, median = _medians(views, light, lights)
    pool = _Pool(group)

    def sums_of(i: int) -> tuple[NDArray, NDArray]:
        view = views[i]
        index = _spread(view.hit)
        return view.object_id.ravel()[index], _reprojected(view, index, tables, cameras, neighbours[i])[2]

    for objects, sums in map_in_order(sums_of, len(views), threads):
        pool.add(objects, sums)
    return Gathering(light, cameras, tables, lights, neighbours, group, median, *pool.regression())


def gather_again(gathering: Gathering, views: Views, log_albedo: NDArray, mean_albedo: float = MEAN_ALBEDO) -> Gathering:
    """Estimate the light again, now that the albedo of each object is roughly known; everything else stays.

    `mean_albedo`, with which the network was trained, still sets the level.

    Args:
        gathering: as `gather_views` returned it.
        views: the same.
        log_albedo: (G, 3) mean log albedo of each of `gathering.group`; NaN = not known.
        mean_albedo: as for `gather_views`.
    """
    light = gathering.light
    # Objects without a first prediction keep the prior mean.
    known = np.nan_to_num(log_albedo, nan=np.log(mean_albedo))
    # `estimate_log_light` wants one row for each group of the cells, in the order of their ids.
    albedo = np.exp(known[np.searchsorted(gathering.group, np.unique(light.cells.group))])
    found = estimate_log_light(light.cells, light.gathered, albedo, REACHES, KNOWN_SPREAD)
    light = replace(light, log_light=_levelled(light.cells, found, mean_albedo))
    _, median = _medians(views, light, gathering.lights)
    return replace(gathering, light=light, median=median)


def with_computed_light(gathering: Gathering, views: Views, irradiance: Iterable[NDArray]) -> Gathering:
    """Mix the gathered light with light that was computed from known emitters (Eq. P.29).

    Gathered light knows lamps, sky and unseen surface only roughly. Computed light has the errors of the emitters,
    so the gathered light keeps some weight. The level stays, and so does the difference between the two reaches.

    Args:
        gathering: from `gather_again`.
        views: the same as there.
        irradiance: for each view in turn, (H, W, 3) diffuse light of its pixels, up to one factor for each channel. A pixel
            without three positive values is unknown.

    Returns:
        A new gathering, or the same one if all of the light is unknown.
    """
    light = gathering.light
    cells = len(light.cells)
    # -------- mean log light of each cell, over the pixels that are nearest to it --------
    total, count = np.zeros((cells, 3)), np.zeros(cells)
    for i, (own, picture) in enumerate(zip(gathering.lights, irradiance, strict=True)):
        value = picture[views[i].hit].astype(np.float64)
        known = np.isfinite(value).all(1) & (value > 0).all(1)
        nearest = own.row[known, 0].astype(np.int64)  # rows are in the order of distance
        count += np.bincount(nearest, minlength=cells)
        for c in range(3):
            total[:, c] += np.bincount(nearest, np.log(value[known, c]), cells)
    known = count > 0
    if not known.any():
        return gathering
    # -------- mix (Eq. P.29) --------
    # The median of the change is the unknown factor; lamps, whose own light means nothing, hardly move a median.
    change = total[known] / count[known, None] - light.log_light[0][known]
    log_light = light.log_light.copy()
    # The same change for both reaches keeps their difference, which is input `dy`.
    log_light[:, known] += COMPUTED_SHARE * (change - np.median(change, 0))
    light = replace(light, log_light=log_light)
    _, median = _medians(views, light, gathering.lights)
    return replace(gathering, light=light, median=median)


def _medians(views: Views, light: SceneLight, lights: list[ViewLight]) -> tuple[NDArray, NDArray]:
    """Ids of objects (G,), and the medians of the quotient (G, 3)."""
    medians = _Medians()
    for i, own in enumerate(lights):
        view = views[i]
        hit = view.hit
        y = log_radiance(view)[hit] - light.log_at(own.row, own.weight)[0]
        medians.add(view.object_id[hit], y, (view.valid & ~view.saturated)[hit])
    return medians.group, medians.values()


def features(gathering: Gathering, views: Views, i: int) -> NDArray:
    """Compute the inputs of view `i`.

    Returns:
        (C, H, W) float32 in the order of CHANNELS, finite, 0 where there is no surface.
    """
    view = views[i]
    shape, n = view.depth.shape, view.depth.size
    hit = np.flatnonzero(view.hit.ravel())
    own_log = log_radiance(view).reshape(n, 3)
    samples, count, sums = _reprojected(view, hit, gathering.tables, gathering.cameras, gathering.neighbours[i])
    own = gathering.tables[i]
    out = np.zeros((len(CHANNELS), n), np.float32)
    put = _Writer(out, hit)
    # -------- the photograph, with and without the light --------
    light = gathering.light.log_at(gathering.lights[i].row, gathering.lights[i].weight)
    y = (own_log[hit] - light[0]).clip(*QUOTIENT)
    put("y_r", y)
    put("dy_r", (light[0] - light[1]).clip(-2, 2))
    grey = own_log.mean(-1)[view.valid.ravel()]  # one number for a pixel, so that the colour of the view stays in the input
    put("i_r", (own_log[hit] - (np.median(grey) if len(grey) else 0.0)).clip(-5, 4))
    # -------- over the views that see the same point, relative to this one --------
    # The view's own value is rounded to the same steps as the samples, so a point that no other view sees has exactly 0.
    relative = (quantiles(samples, count) - from_steps(own.log_radiance[hit])[:, None]).clip(-4, 4)
    put("low_r", relative[:, 0])
    put("mid_r", relative[:, 1])
    put("high", relative[:, 2].mean(-1))
    put("top", relative[:, 3].mean(-1))
    put("count", np.log1p(count).clip(0, 4))
    # -------- what the mirrored ray meets --------
    known = np.isfinite(own.mirrored[hit])
    distance = gathering.lights[i].distance.astype(np.float32)
    # The same unit and the same floor as in `_prepared`, so that their difference compares like with like.
    floored = np.log(np.maximum(radiance_of(view).reshape(n, 3)[hit] / gathering.light.mean, 1e-3))
    met = gathering.lights[i].mirrored.astype(np.float32)
    put("m_r", np.where(known[:, None], met - floored, 0).clip(-5, 5))
    put("m_known", known)
    put("m_far", np.log1p(np.nan_to_num(distance, nan=0.0)))
    for name, value in zip(("slope", "corr", "rest"), _regression(sums, own.luminance[hit].astype(np.float64)), strict=True):
        put(name, value.clip(-3, 3))
    # -------- shape --------
    normal = view.normals.reshape(n, 3)[hit]
    # Row vectors: n R is R' n, the normal in the axes of the camera.
    put("n_x", normal @ view.camera.world_from_camera[:3, :3].astype(np.float32))
    towards = -view.camera.directions().reshape(n, 3)[hit]
    put("nov", (normal * towards).sum(-1) / np.linalg.norm(towards, axis=-1))  # rays have length 1 in z, not unit length
    depth = np.log(np.maximum(view.depth.ravel()[hit], 0.05))
    put("depth", (depth - np.median(depth) if len(hit) else depth).clip(-2, 2))
    put("border", borders(view.object_id).ravel()[hit])
    put("hit", np.ones(len(hit)))
    put("valid", view.valid.ravel()[hit])
    put("saturated", view.saturated.ravel()[hit])
    # -------- the object as a whole --------
    # Every id that shows surface has a row, because the medians were taken over the same pixels.
    row = np.searchsorted(gathering.group, view.object_id.ravel()[hit])
    put("g_r", gathering.median[row] - y)
    put("g_slope", gathering.slope[row])
    put("g_corr", gathering.correlation[row])
    return out.reshape(len(CHANNELS), *shape)


def mirrored(inputs: NDArray) -> NDArray:
    """Return the inputs (C, H, W) of the same view seen in a mirror: left is right, and so is the normal's x."""
    out = inputs[:, :, ::-1].copy()
    out[CHANNELS.index("n_x")] *= -1
    return out


class _Writer:
    """Writes columns of values of the pixels `hit` into channels, by the name of the first."""

    def __init__(self, out: NDArray, hit: NDArray):
        self.out, self.hit = out, hit

    def __call__(self, name: str, values: NDArray) -> None:
        first = CHANNELS.index(name)
        values = np.asarray(values, np.float32)
        for c, column in enumerate(values.T if values.ndim == 2 else [values]):
            self.out[first + c, self.hit] = column


def camera_of(view: ViewMaps) -> Camera:
    """Return the camera of a view as the compiled loops read it."""
    own, pose = view.camera, np.asarray(view.camera.world_from_camera, np.float64)
    rotation = np.ascontiguousarray(pose[:3, :3].T)
    return Camera(rotation, pose[:3, 3].copy(), np.array([own.fx, own.fy, own.cx, own.cy], np.float64), own.width, own.height)


def _cells(views: Views) -> tuple[SurfaceCells, float, list[NDArray]]:
    """Surface cells of all views, their mean radiance, and for each view the coarse blocks of surface that it sees."""
    # -------- extent of the surface and size of a pixel; the cells need both before the first pixel --------
    footprints, low, high = [], np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(len(views)):
        view = views[i]
        hit = view.hit
        if hit.any():
            footprints.append(float(np.median(view.depth[hit])) / view.camera.fx)
            points = view.points()[hit]
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    if not footprints:
        raise InputError("prior: no photograph shows the mesh; compare poses and mesh (`alignment` in capture/capture.json)")
    # -------- sums over the pixels of each cell; blocks of surface of each view --------
    builder = SurfaceCellsBuilder(np.stack([low, high]), CELL_FOOTPRINTS * float(np.median(footprints)))
    total, count, seen = 0.0, 0, []
    # Fixed here: the builder doubles its edge when there are too many cells, and blocks of all views must agree.
    block = 4 * builder.edge
    for i in range(len(views)):
        view = views[i]
        use, points = view.valid, view.points()
        radiance = radiance_of(view)[use]
        builder.add(points[use], view.normals[use], view.object_id[use], radiance, view.saturated[use], view.camera.exposure)
        total, count = total + float(radiance.sum(dtype=np.float64)), count + radiance.size
        where = np.floor((points[view.hit] - low) / block).astype(np.int64)
        seen.append(np.unique((where[:, 0] << 42) | (where[:, 1] << 21) | where[:, 2]))  # three indices of 21 bits
    return builder.finish(), max(total / max(count, 1), 1e-6), seen


def radiance_of(view: ViewMaps) -> NDArray:
    """Return (H, W, 3) float32 radiance, 0 where it may not be used."""
    return np.where(view.valid[..., None], view.value, 0).astype(np.float32) / np.float32(view.camera.exposure)


def log_radiance(view: ViewMaps) -> NDArray:
    """Return (H, W, 3) float32 log radiance, floored at the noise of the view."""
    return np.log(np.maximum(radiance_of(view), np.float32(DARKEST / view.camera.exposure)))


def _prepared(view: ViewMaps, light: SceneLight, trace: Trace) -> tuple[ViewTable, ViewLight]:
    """What other views look up in a view, and what only the view itself reads again."""
    n, cells = view.depth.size, light.cells
    hit = np.flatnonzero(view.hit.ravel())
    points, normals = view.points().reshape(n, 3)[hit], view.normals.reshape(n, 3)[hit]
    # Mirrored rays, and the photographed radiance of the voxel that they meet.
    towards = -view.camera.directions().reshape(n, 3)[hit]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    # Mirror direction 2 (n . w) n - w of the unit vector w to the camera; of unit length, so t is in metres.
    way = (2 * (normals * towards).sum(-1, keepdims=True) * normals - towards).astype(np.float32)
    start = (points + 1e-3 * normals).astype(np.float32)  # off the face, which the ray would meet at once
    face, t = trace(start, way)
    met = np.flatnonzero(np.asarray(face) >= 0)
    t = np.asarray(t, np.float64)
    voxel = find_voxel(cells, start[met] + t[met, None] * way[met])
    seen = voxel >= 0
    radiance = cells.voxel_radiance[voxel[seen]] / light.mean
    # By pixel that shows surface, for the view itself; `luminance` by pixel of the picture, as other views look it up.
    distance, mirrored = np.full(len(hit), np.nan, np.float16), np.zeros((len(hit), 3), np.float16)
    luminance = np.full(n, np.nan, np.float32)
    distance[met] = np.minimum(t[met], FARTHEST)
    mirrored[met[seen]] = np.log(np.maximum(radiance, 1e-3))
    luminance[hit[met[seen]]] = np.minimum(radiance.mean(-1), BRIGHTEST)
    table = ViewTable(
        np.asarray(view.depth, np.float32).ravel(),
        np.rint(view.normals.reshape(n, 3) * NORMAL_STEPS).astype(np.int8),
        view.valid.ravel(),
        as_steps(log_radiance(view).reshape(n, 3)),
        (radiance_of(view).reshape(n, 3).mean(-1) / light.mean).astype(np.float32),
        luminance,
    )
    row, weight = light.around(view)
    # 16 bits hold the row of a cell, since there are at most MAX_CELLS = 30,000 of them.
    return table, ViewLight(row.astype(np.uint16), weight.astype(np.float16), mirrored, distance)


def _neighbours(seen: list[NDArray]) -> list[NDArray]:
    """For each view up to MAX_VIEWS views that share most blocks of surface with it, itself first."""
    from scipy.sparse import csr_matrix

    blocks, column = np.unique(np.concatenate(seen), return_inverse=True)
    starts = np.r_[0, np.cumsum([len(own) for own in seen])]
    # (views, blocks); the product of two rows counts the blocks that both views see.
    incidence = csr_matrix((np.ones(len(column), np.int32), column.ravel(), starts), (len(seen), len(blocks)))
    out = []
    for i in range(len(seen)):
        shared = (incidence @ incidence[i].T).toarray().ravel()
        shared[i] = np.iinfo(np.int32).max  # the view itself comes first, as `_reprojected` expects
        best = np.argsort(-shared, kind="stable")[:MAX_VIEWS]
        out.append(best[shared[best] > 0])
    return out


def _spread(hit: NDArray) -> NDArray:
    """Pixels that show surface, at most POOL_PIXELS or so: all, or every second, third, ... row and column."""
    step = int(np.ceil(np.sqrt(hit.size / POOL_PIXELS)))
    kept = np.zeros(hit.shape, bool)
    kept[::step, ::step] = True
    return np.flatnonzero(kept & hit)


def _reprojected(
    view: ViewMaps, index: NDArray, tables: list[ViewTable], cameras: list[Camera], neighbours: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Samples, their number and the sums of `add_samples` for the pixels `index` of a view, whose own number comes first."""
    point, normal = view.points().reshape(-1, 3)[index], view.normals.reshape(-1, 3)[index].astype(np.float32)
    samples = np.zeros((len(index), len(neighbours), 3), np.float32)
    count, sums = np.zeros(len(index), np.int32), np.zeros((len(index), 6))
    none = np.full(len(index), -1, np.int64)
    for number, u in enumerate(neighbours):
        # The first neighbour is the view itself: its pixels are known and need no projection.
        own = none if number else index.astype(np.int64)
        add_samples(point, normal, own, cameras[int(u)], tables[int(u)], samples, count, sums)
    return samples, count, sums


def _moments(sums: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Number, means of L and X, and sums of centred L X, X X and L L, from the sums of `add_samples`."""
    s = np.maximum(sums[:, 0], 1e-6)  # no sample: all sums are 0
    y, x = sums[:, 1] / s, sums[:, 2] / s
    # Centred sums are differences, which rounding can make negative.
    return s, y, x, sums[:, 5] - s * y * x, np.maximum(sums[:, 4] - s * x * x, 0), np.maximum(sums[:, 3] - s * y * y, 0)


def _regression(sums: NDArray, luminance: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Slope and correlation over the views of radiance L on mirrored radiance X, ridge-regularised, and what X does not explain:
    log of the mean of L - slope X, relative to this view."""
    s, y, x, cov, vx, vy = _moments(sums)
    slope = cov / (vx + 0.02 * s * (x**2 + 0.05))  # Eq. P.25
    # The addend stands for a standard deviation of 10 % of both means: radiance that hardly varies has a correlation near 0, not
    # a quotient of noise.
    correlation = cov / np.sqrt(vx * vy + 1e-4 * s * s * (y**2 + 1e-4) * (x**2 + 0.01) + 1e-12)
    # What X explains may exceed the mean; at least 5 % of it stays.
    rest = np.log(np.maximum(y - slope.clip(0, 1.5) * x, 0.05 * y) + 1e-4) - np.log(luminance + 1e-4)
    return slope.clip(-0.5, 1.5), correlation, rest


def borders(group: NDArray) -> NDArray:
    """Return (H, W) bool: a neighbour in the picture belongs to another object."""
    border = np.zeros(group.shape, bool)
    across, down = group[:, 1:] != group[:, :-1], group[1:] != group[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= down
    border[:-1] |= down
    return border


class _Pool:
    """Sums of the regression of objects over all pixels of all views; `group` (G,) are the sorted ids."""

    def __init__(self, group: NDArray):
        self.group, self.sums = group, np.zeros((len(group), 4))

    def add(self, group: NDArray, sums: NDArray) -> None:
        s, _, _, cov, vx, vl = _moments(sums)
        row = np.searchsorted(self.group, group)
        self.sums += np.stack([np.bincount(row, column, len(self.group)) for column in (cov, vx, vl, s)], 1)

    def regression(self) -> tuple[NDArray, NDArray]:
        """Return slope and correlation (G,)."""
        cov, vx, vl, s = self.sums.T
        slope = (cov / (vx + 1e-3 * s + 1e-9)).clip(-0.5, 1.5)
        return slope, cov / np.sqrt(vx * vl + 1e-12)


class _Medians:
    """Medians of the quotient of each object and channel, by histograms, so that memory does not grow with the pixels."""

    def __init__(self) -> None:
        self.group = np.zeros(0, np.int64)
        self.counts = np.zeros((0, 3, _MEDIAN_BINS), np.int32)

    def add(self, group: NDArray, values: NDArray, clear: NDArray) -> None:
        """Add pixels: group (n,), values (n, 3), and which of them count (n,) bool."""
        low, high = _MEDIAN_RANGE
        merged = np.union1d(self.group, group)
        if len(merged) > len(self.group):
            counts = np.zeros((len(merged), 3, _MEDIAN_BINS), np.int32)
            counts[np.searchsorted(merged, self.group)] = self.counts
            self.group, self.counts = merged, counts
        bins = ((values[clear] - low) * (_MEDIAN_BINS / (high - low))).clip(0, _MEDIAN_BINS - 1).astype(np.int64)
        row = np.searchsorted(self.group, group[clear])
        for c in range(3):
            np.add.at(self.counts, (row, c, bins[:, c]), 1)

    def values(self) -> NDArray:
        """Return the medians (G, 3), to a bin of 1/64; 0 for objects without a pixel that counts."""
        total = self.counts.sum(-1)
        # First bin at which the count passes half of the pixels.
        middle = (np.cumsum(self.counts, -1) > (total // 2)[..., None]).argmax(-1)
        low, high = _MEDIAN_RANGE
        return np.where(total > 0, low + (middle + 0.5) * (high - low) / _MEDIAN_BINS, 0.0)
