"""Rows of the probes of stage plan, from the photographs of a capture alone (docs/method/plan.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pinhole import project
from iif_core.camera.pixels import ViewMaps
from iif_core.camera.response import SATURATION
from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from iif_core.numerics.frames import dominant_side
from iif_core.numerics.xp import NUMPY
from iif_core.reflectance import brdf
from iif_core.requirements.probes import MAX_POINTS, GlossRows, LightRows
from iif_core.surface.triangles import towards_viewer
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry

_SEEDS = 0x706C6E  # keeps the random streams of this stage apart from those of others
MAX_VIEWS = 32
"""Photographs that are read, spread evenly."""
CACHE_PIXELS = 12_500
"""Pixels of a photograph that enter the table of photographed radiance."""
RAYS = 32
"""Cosine-distributed rays from a point."""
LOBES = (0.1, 0.3, 0.6)
"""Roughnesses of the lobes that gloss is looked for with."""
LOBE_RAYS = 16
PAIRS = 6
"""Further photographs of a point that are compared with its own."""
VOXELS_IN_DEPTH = 25
"""Voxels of the table in the median depth of the photographs."""
BLOCK_VOXELS, GROUP_VOXELS = 5, 25
"""Edges, in voxels, of the blocks of surface that err together, and of what counts as one object where nothing tells objects."""
LEAST_SEEN = 0.25
"""Share of the rays from a point that must meet photographed surface, among those that meet any."""
LEAST_COSINE = 0.05
"""Cosine between normal and viewer below which a photograph does not show a point: it may show the back of a thin sheet."""
DEPTH_TOLERANCE = 0.01
DEPTH_RANGE, BRIGHTNESS_RANGE = 1.1, 2.0
"""Largest over smallest depth and radiance within BORDER pixels of a point."""
BORDER = 2
"""Pixels around a point that must show nothing else."""


def as_radiance(maps: ViewMaps, is_hdr: bool) -> ViewMaps:
    """Return a view whose values are radiance, with its `saturated`; 8-bit values become radiance by the sRGB curve and the
    exposure, which no probe improves on."""
    exposure = maps.camera.exposure
    exposure = exposure if 0 < exposure < np.inf else 1.0  # docs/method/numerics.md#exposure-at-zero
    if is_hdr:
        return replace(maps, value=maps.value / exposure, saturated=np.zeros(maps.valid.shape, bool))
    radiance = linear_from_srgb(np.clip(maps.value, 0, 1)).astype(np.float32) / exposure
    return replace(maps, value=radiance, saturated=maps.valid & (maps.value.max(-1) >= SATURATION))


@dataclass(frozen=True)
class RadianceTable:
    """Mean photographed radiance of voxels: sorted keys (c,), radiance (c, 3), and whether all pixels were saturated (c,)."""

    edge: float
    low: np.ndarray
    keys: np.ndarray
    radiance: np.ndarray
    saturated: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, radiance: np.ndarray, saturated: np.ndarray, edge: float) -> RadianceTable:
        """Average pixels: points and radiance (n, 3), saturated (n,); saturated ones count where there are no others."""
        low = points.min(0)
        keys, row = np.unique(_keys(points, low, edge), return_inverse=True)
        clean = np.bincount(row, ~saturated, len(keys)) > 0
        weight = np.where(clean[row], ~saturated, True).astype(float)
        total = np.maximum(np.bincount(row, weight, len(keys)), 1e-9)
        mean = np.stack([np.bincount(row, weight * radiance[:, c], len(keys)) for c in range(3)], 1) / total[:, None]
        return cls(edge, low, keys, mean, ~clean)

    def find(self, points: np.ndarray) -> np.ndarray:
        """Return the row of the voxel around each point (n, 3), -1 = nothing was photographed there."""
        keys = _keys(points, self.low, self.edge)
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[row] == keys, row, -1)


def _keys(points: np.ndarray, low: np.ndarray, edge: float) -> np.ndarray:
    i, j, k = np.clip(np.floor((points - low) / edge), -1, 2**20 - 2).astype(np.int64).T + 1
    return (i << 42) | (j << 21) | k


@dataclass(frozen=True, kw_only=True)
class Points:
    """Surface points of a probe: position and unit normal towards the viewer (n, 3), radiance (n, 3), number of the view in the
    probe (n,), whether its neighbourhood is of one brightness (n,), `group` of surface and `block` (n,)."""

    position: np.ndarray
    normal: np.ndarray
    radiance: np.ndarray
    view: np.ndarray
    even: np.ndarray
    group: np.ndarray
    block: np.ndarray


@dataclass(frozen=True)
class ProbeRows:
    """What the probes read: rows for the light and for gloss; shares of camera rays and of rays from surface that leave the mesh,
    of the others that meet photographed surface; brightness of escaping camera rays relative to the photographs, None = none."""

    light: LightRows
    gloss: GlossRows
    escape_primary: float
    escape_secondary: float
    photographed: float
    outside: float | None


def probe_rows(job: Job, capture: CaptureReader, geometry: Geometry) -> ProbeRows:
    """Draw the points and trace their rays.

    Raises:
        InputError: no photograph shows the mesh.
    """
    rng = np.random.default_rng([job.seed, _SEEDS])
    views = capture.used[:: max(1, -(-len(capture.used) // MAX_VIEWS))]
    decoded = DecodedViews(capture, memory_mb=0)  # each file is read once, and all photographs stay in memory as radiance
    photos = [as_radiance(decoded.maps(view), capture.is_hdr) for view in views]
    depth = np.concatenate([photo.depth[photo.valid & photo.hit] for photo in photos])
    if not len(depth):
        raise InputError(
            "plan: no usable pixel of any photograph shows the mesh; compare poses and mesh (`alignment` in"
            " capture/capture.json), and look at the masks"
        )
    edge = float(np.median(depth)) / VOXELS_IN_DEPTH
    table = _table(photos, edge, rng)
    points = _draw(photos, geometry, _given_objects(job, capture), table, rng)
    light, secondary, photographed = _light_rows(points, geometry, table, rng)
    missed = np.array([np.count_nonzero(p.valid & ~p.hit) for p in photos])
    counted = sum(np.count_nonzero(p.valid) for p in photos)
    sky, inside = (_mean_radiance(photos, hit) for hit in (False, True))
    gloss = _gloss_rows(points, photos, geometry, table, sky, rng)
    outside = sky / max(inside, 1e-12) if missed.any() else None
    return ProbeRows(light, gloss, float(missed.sum() / max(counted, 1)), secondary, photographed, outside)


def _given_objects(job: Job, capture: CaptureReader) -> np.ndarray:
    """(m,) object of each face where the scene says that objects are given, else -1."""
    if job.settings.segmentation.kind == "given":
        return capture.faces()["instance_id"]
    return np.full(len(capture.faces()["face_id"]), -1, np.int32)


def _mean_radiance(photos: list[ViewMaps], hit: bool) -> float:
    """Return the mean radiance of what camera rays meet, or of where they miss; 0 without such pixels."""
    found = [photo.value[photo.valid & (photo.hit == hit)].mean(-1) for photo in photos]
    every = np.concatenate(found)
    return float(every.mean()) if len(every) else 0.0


def _table(photos: list[ViewMaps], edge: float, rng: np.random.Generator) -> RadianceTable:
    points, radiance, saturated = [], [], []
    for photo in photos:
        index = np.flatnonzero(photo.valid & photo.hit)
        index = rng.choice(index, min(len(index), CACHE_PIXELS), replace=False)
        points.append(photo.points(np.float64).reshape(-1, 3)[index])
        radiance.append(photo.value.reshape(-1, 3)[index])
        saturated.append(photo.saturated.ravel()[index])
    return RadianceTable.of(np.concatenate(points), np.concatenate(radiance), np.concatenate(saturated), edge)


def _draw(
    photos: list[ViewMaps], geometry: Geometry, instance: np.ndarray, table: RadianceTable, rng: np.random.Generator
) -> Points:
    """Draw points evenly over the photographs, away from edges of the mesh and from what is saturated or black."""
    each = MAX_POINTS // len(photos)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("position", "normal", "radiance", "view", "even", "face")}
    for number, photo in enumerate(photos):
        good = photo.valid & ~photo.saturated & photo.hit & (photo.value.mean(-1) > 0) & _even(photo, False)
        index = np.flatnonzero(good.ravel())
        index = rng.choice(index, min(len(index), each), replace=False)
        towards = -photo.camera.directions().reshape(-1, 3)[index]
        face = photo.face.ravel()[index]
        parts["position"].append(photo.points(np.float64).reshape(-1, 3)[index])
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        parts["normal"].append(towards_viewer(geometry.normals[face], towards)[0])
        parts["radiance"].append(photo.value.reshape(-1, 3)[index])
        parts["view"].append(np.full(len(index), number))
        parts["even"].append(_even(photo, True).ravel()[index])
        parts["face"].append(face)
    joined = {name: np.concatenate(part) for name, part in parts.items()}
    block = _keys(joined["position"], table.low, BLOCK_VOXELS * table.edge)
    side = dominant_side(joined["normal"])
    owner = instance[joined.pop("face")].astype(np.int64)
    # Where nothing tells objects apart, a large block of surface with one orientation is one.
    piece = np.unique(_keys(joined["position"], table.low, GROUP_VOXELS * table.edge), return_inverse=True)[1]
    group = np.where(owner >= 0, owner, -2 - (piece * 6 + side))
    return Points(**joined, group=np.unique(group, return_inverse=True)[1], block=block)


def _even(photo: ViewMaps, light: bool) -> np.ndarray:
    """(H, W) bool: the neighbourhood is at one depth, and not at the border; with `light` also of one brightness. What is
    photographed is then the surface in the middle of the pixel alone."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * BORDER + 1
    images = [(np.where(photo.hit, photo.depth, 0), DEPTH_RANGE)]
    if light:
        images.append((np.where(photo.valid & ~photo.saturated, photo.value.mean(-1), 0), BRIGHTNESS_RANGE))
    even = np.ones(photo.depth.shape, bool)
    for image, ratio in images:
        low, high = minimum_filter(image, size, mode="constant"), maximum_filter(image, size, mode="constant")
        even &= (low > 0) & (high < ratio * low)
    return even


def _light_rows(
    points: Points, geometry: Geometry, table: RadianceTable, rng: np.random.Generator
) -> tuple[LightRows, float, float]:
    """Return the rows, the share of rays that leave the mesh, and of the others the share that meets photographed surface."""
    from iif_core.light.transport.geometry import cosine_directions, trace

    normal = np.repeat(points.normal.astype(np.float64), RAYS, 0)
    way = cosine_directions(normal, rng)
    start = np.repeat(points.position, RAYS, 0) + 1e-3 * normal
    face, t = trace(geometry, start, way)
    hit = face >= 0
    row = np.full(len(face), -1)
    row[hit] = table.find(start[hit] + t[hit, None] * way[hit])
    saturated = (row >= 0) & table.saturated[row]
    known = np.where((row >= 0) & ~saturated, table.radiance[row].mean(1), 0.0)
    seen = (row >= 0).reshape(-1, RAYS).sum(1)
    # Rays that meet surface which nobody photographed are taken to bring what the others bring.
    share = hit.reshape(-1, RAYS).sum(1) / np.maximum(seen, 1) / RAYS
    hits = hit.reshape(-1, RAYS).sum(1)
    use = seen >= LEAST_SEEN * hits
    rows = LightRows(
        radiance=points.radiance.mean(1)[use],
        known=(known.reshape(-1, RAYS).sum(1) * share)[use],
        saturated=(saturated.reshape(-1, RAYS).sum(1) * share)[use],
        escaping=1.0 - hits[use] / RAYS,
        group=points.group[use],
        block=points.block[use],
    )
    return rows, float((~hit).mean()) if len(hit) else 0.0, float((row[hit] >= 0).mean()) if hit.any() else 0.0


def _gloss_rows(
    points: Points,
    photos: list[ViewMaps],
    geometry: Geometry,
    table: RadianceTable,
    sky: float,
    rng: np.random.Generator,
) -> GlossRows:
    """Compare each point with at most PAIRS other photographs of it."""
    found = [_seen_in(points, number, photo) for number, photo in enumerate(photos)]
    point, value, view = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((rng.random(len(point)), point))
    point, value, view = point[order], value[order], view[order]
    rank = np.arange(len(point)) - np.searchsorted(point, point)
    keep = rank < PAIRS
    point, value, view = point[keep], value[keep], view[keep]
    eyes = np.stack([photo.camera.world_from_camera[:3, 3] for photo in photos])
    each = np.arange(len(points.view))
    uniform = rng.random((2, LOBE_RAYS))  # the same for all points, so that differences between views keep little noise
    own = _lobes(points, each, eyes[points.view], geometry, table, sky, uniform)
    other = _lobes(points, point, eyes[view], geometry, table, sky, uniform)
    pair = np.stack([points.radiance.mean(1)[point], value], 1)
    mean = pair.mean(1)
    return GlossRows(
        radiance=pair / mean[:, None],
        lobes=np.stack([own[point], other], 1) / mean[:, None, None],
        view=np.stack([points.view[point], view], 1),
        point=point,
        group=points.group[point],
        block=points.block[point],
    )


def _seen_in(points: Points, number: int, photo: ViewMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of other photographs that this one shows: their rows, what it shows (mean of the channels), and its
    number."""
    from scipy.ndimage import map_coordinates

    v = photo.camera
    u, w, z = project(points.position, v.fx, v.fy, v.cx, v.cy, v.world_from_camera)
    x, y = np.floor(u), np.floor(w)
    towards = v.world_from_camera[:3, 3] - points.position
    facing = (towards * points.normal).sum(1) > LEAST_COSINE * np.linalg.norm(towards, axis=1)
    inside = facing & (z > 0) & (x >= 0) & (y >= 0) & (x < v.width) & (y < v.height) & (points.view != number) & points.even
    row = np.flatnonzero(inside)
    at = (y[row].astype(int), x[row].astype(int))
    good = photo.valid[at] & ~photo.saturated[at] & _even(photo, True)[at]
    good &= np.abs(photo.depth[at] - z[row]) < DEPTH_TOLERANCE * z[row]
    value = map_coordinates(photo.value.mean(-1), [w[row] - 0.5, u[row] - 0.5], order=1, mode="nearest")
    good &= value > 0
    return row[good], value[good], np.full(int(good.sum()), number)


def _lobes(
    points: Points, row: np.ndarray, eye: np.ndarray, geometry: Geometry, table: RadianceTable, sky: float, uniform: np.ndarray
) -> np.ndarray:
    """Return (n, J) what dielectric lobes of the roughnesses LOBES reflect from the points `row` towards `eye` (n, 3)."""
    from iif_core.light.transport.geometry import trace

    position, normal = points.position[row], points.normal[row].astype(np.float64)
    wo = eye - position
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    helper = np.where(np.abs(normal[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(normal, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], 1)
    out = np.zeros((len(row), len(LOBES)))
    for j, roughness in enumerate(LOBES):
        local = np.stack(brdf.sample_ggx_half(NUMPY, *uniform, roughness), -1)
        h = np.einsum("ra,nax->nrx", local, frame)
        wi = np.stack(brdf.reflect(wo[:, None].transpose(2, 0, 1), h.transpose(2, 0, 1)), -1)
        n, o = normal[:, None].transpose(2, 0, 1), wo[:, None].transpose(2, 0, 1)
        NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(NUMPY, n, wi.transpose(2, 0, 1), o)
        _, spec, fc = brdf.lobes(NUMPY, NoL, NoV, NoH, VoH, sin2_h, roughness)
        fresnel = brdf.F0_DIELECTRIC + (1 - brdf.F0_DIELECTRIC) * fc
        weight = spec * fresnel / np.maximum(brdf.specular_pdf(NUMPY, NoH, VoH, sin2_h, roughness), 1e-12)
        start = np.broadcast_to((position + 1e-3 * normal)[:, None], wi.shape).reshape(-1, 3)
        face, t = trace(geometry, start, wi.reshape(-1, 3))
        hit = face >= 0
        light = np.where(hit, 0.0, sky)
        found = table.find(start[hit] + t[hit, None] * wi.reshape(-1, 3)[hit])
        light[hit] = np.where(found >= 0, table.radiance[found].mean(1), 0.0)
        out[:, j] = (weight * light.reshape(weight.shape)).mean(1)
    return out
