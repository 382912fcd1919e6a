"""Alignment of photographs with each other on surface points, and with the edges of the mesh (Eq. C.30): features, the points
that several photographs show, and Gauss-Newton steps with Cauchy's weights, on images blurred less and less. The texture values
of the points are eliminated. Which cameras may move, and how, is for `registration` to say (`Unknowns`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

SIGMA_ROTATION, SIGMA_TRANSLATION = 0.02, 0.03
"""Standard deviation of the correction that all views share, and of that of a free view: radians, metres."""
SIGMA_PRINCIPAL, SIGMA_FOCAL = 0.02, 0.02
"""Standard deviation of the common corrections, relative to the focal length."""
_PRIOR = np.repeat([SIGMA_ROTATION, SIGMA_TRANSLATION], 3), np.array([SIGMA_PRINCIPAL, SIGMA_PRINCIPAL, SIGMA_FOCAL])
DARK = 0.06
"""Luminance relative to the median below which texture counts as noise; an 8-bit photograph has some five levels there."""
BLURS = (2.5, 1.2, 0.7)
"""Standard deviations of the successive blurs of the feature images, in pixels."""
STEPS_PER_BLUR = 6
MIN_COSINE = 0.25
"""Smallest cosine between normal and viewing direction at which surface is compared."""
HELD_OUT_BLOCK = 0.3
"""Edge in metres of the blocks of surface that are held out together."""
EDGE_WEIGHT = 0.15
"""Weight of an edge point relative to a row of texture; the errors of neighbouring edge points are correlated."""
HELD_OUT_EVERY = 3
"""One of so many blocks is held out."""


@dataclass(frozen=True)
class Photo:
    """One photograph and the mesh as its camera sees it.

    Attributes:
        image: (H, W, 3) sensor values or radiance; usable: (H, W) bool.
        depth: (H, W) z-depth of the mesh in metres, 0 = miss; normal: (H, W, 3) unit, 0 = miss.
        focal: (fx, fy), principal: (cx, cy) in pixels, pixel centres at u + 0.5.
        pose: (4, 4) world_from_camera, OpenCV axes.
        held: whether the photograph is kept for testing: it is aligned with the others, and changes nothing but its own pose.
    """

    image: np.ndarray
    usable: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    focal: tuple[float, float]
    principal: tuple[float, float]
    pose: np.ndarray
    held: bool = False


def feature_image(image: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Compute the log of the mean channel less its surroundings (6 % of the width), in units of 0.35, clipped to +-3 (Eq. C.29).

    The mean is relative to its median over pixels that are not black, and `DARK` is added before the logarithm. The result,
    (H, W) float64, does not depend on exposure, white balance, vignetting and slow shading; it is 0 if all pixels are black.
    """
    from scipy.ndimage import gaussian_filter

    grey = np.where(usable, np.nan_to_num(np.asarray(image, np.float64)).clip(0).mean(-1), 0.0)
    lit = grey[grey > 0]
    if not len(lit):
        return np.zeros(grey.shape)
    grey = np.log(DARK + grey / np.median(lit))
    weight = usable.astype(np.float64)
    sigma = max(2.0, 0.06 * image.shape[1])
    # Blurred values over blurred weights: the mean over usable pixels around each pixel.
    around = gaussian_filter(grey * weight, sigma) / np.maximum(gaussian_filter(weight, sigma), 1e-6)
    out = np.where(usable, grey - around, 0.0)
    return np.clip(out / 0.35, -3.0, 3.0)


def mesh_edges(depth: np.ndarray, normal: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find edges of the mesh as a camera sees it: silhouettes (depth ratio above 5 %) and creases (more than 30 degrees).

    Returns:
        Pixel coordinates (n, 2) half way between the two pixels that differ, and the z-depth (n,) of the nearer pixel.
    """
    coordinates, near = [], []
    for axis in (0, 1):
        for step in (1, -1):
            other, turned = np.roll(depth, step, axis), np.roll(normal, step, axis)
            both = (depth > 0) & (other > 0) & usable
            # `roll` wraps around, so border pixels have no neighbour on one side.
            both[[0, -1]], both[:, [0, -1]] = False, False
            # A silhouette belongs to its nearer side, which is this pixel. At a crease the depth is continuous and the normal
            # turns.
            jump = both & (other > 1.05 * depth)
            bend = both & (np.abs(other / np.maximum(depth, 1e-9) - 1) < 0.05) & ((normal * turned).sum(-1) < 0.87)
            found = np.argwhere(jump | bend)
            # (row, column) becomes (u, v) of the pixel centre, then half a pixel towards the neighbour.
            at = found[:, ::-1] + 0.5
            at[:, 1 - axis] -= 0.5 * step
            coordinates.append(at)
            near.append(depth[found[:, 0], found[:, 1]])
    return np.concatenate(coordinates), np.concatenate(near)


def photo_edges(feature: np.ndarray, blur: float) -> np.ndarray:
    """Compute the blurred gradient magnitude over its 95 % quantile: (H, W) float64 in [0, 1]."""
    from scipy.ndimage import gaussian_filter

    dv, du = np.gradient(gaussian_filter(feature, 0.7))
    size = gaussian_filter(np.minimum(np.hypot(du, dv), 1.0), blur)
    return np.clip(size / max(float(np.quantile(size, 0.95)), 1e-9), 0.0, 1.0)


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a descent: cameras move along some directions.

    Attributes:
        directions: (6 V + 3, n) orthogonal columns: twists of the views, principal point, log focal length.
        sigma: (n,) standard deviation of the prior of the coordinate along each.
    """

    directions: np.ndarray
    sigma: np.ndarray


def together(views: int, poses: bool, intrinsics: bool) -> Unknowns:
    """Return the unknowns with which all cameras move alike: one twist in their own frames, and the intrinsics."""
    directions = np.zeros((6 * views + 3, 9))
    directions[: 6 * views, :6] = np.tile(np.eye(6), (views, 1))
    directions[6 * views :, 6:] = np.eye(3)
    chosen = np.r_[np.repeat(poses, 6), np.repeat(intrinsics, 3)].astype(bool)
    return Unknowns(directions[:, chosen], np.concatenate(_PRIOR)[chosen])


def apart(moving: np.ndarray, width: float) -> Unknowns:
    """Return the unknowns with which cameras move beside each other: a twist of each, of which those that are not held have mean
    zero in the cameras' own frames, because errors of the mesh hide their mean.

    Args:
        moving: (V,) bool, which views are not held; one that is held moves for itself.
        width: standard deviation of the prior, in units of SIGMA_ROTATION and SIGMA_TRANSLATION.
    """
    from scipy.linalg import block_diag, helmert

    count = int(moving.sum())
    # Rows of Helmert's matrix are orthonormal contrasts: each camera against the mean of those before it.
    contrasts = block_diag(helmert(count).T if count else np.zeros((0, 0)), np.eye(len(moving) - count))
    of_views = np.zeros_like(contrasts)
    of_views[np.r_[np.flatnonzero(moving), np.flatnonzero(~moving)]] = contrasts
    directions = np.kron(of_views, np.eye(6))
    sigma = width * np.tile(_PRIOR[0], of_views.shape[1])
    return Unknowns(np.concatenate([directions, np.zeros((3, directions.shape[1]))]), sigma)


def free(views: int, intrinsics: bool) -> Unknowns:
    """Return the unknowns with which every camera moves for itself: a twist of each, and the common intrinsics."""
    chosen = np.r_[np.repeat(True, 6 * views), np.repeat(intrinsics, 3)]
    return Unknowns(np.eye(len(chosen))[:, chosen], np.r_[np.tile(_PRIOR[0], views), _PRIOR[1]][chosen])


def descend(
    photos: Sequence[Photo],
    features: Sequence[np.ndarray],
    blurs: Sequence[float],
    start: Cameras,
    rows: Rows,
    edges: Sequence[np.ndarray],
    unknowns: Unknowns,
) -> Cameras:
    """Move cameras by Gauss-Newton, from blurred to sharp images."""
    # The prior pulls each view towards where this descent starts, and the intrinsics towards the given ones.
    state = replace(start, twist=np.zeros_like(start.twist))
    # Limits of a step in rad, m, and units of the focal length, within which an image is about linear.
    limit = np.r_[np.tile(np.repeat([0.02, 0.03], 3), len(photos)), [0.02, 0.02, 0.02]]
    # A linear model of an image holds within its blur: wide blurs bring cameras close, narrow ones make them precise.
    for blur in blurs if len(unknowns.sigma) else ():
        maps = [Maps.of(f, blur) for f in features]
        for _ in range(STEPS_PER_BLUR):
            normal, right = normal_equations(photos, maps, state, rows, edges, unknowns)
            step = unknowns.directions @ np.linalg.solve(normal, right)
            state = state.moved(np.clip(step, -limit, limit))
    return state


@dataclass(frozen=True)
class Cameras:
    """Corrected cameras: poses (V, 4, 4), shift of the principal point (2,) in focal lengths, and factor of the focal length."""

    pose: np.ndarray
    principal: np.ndarray
    focal: float
    twist: np.ndarray  # (V, 6) sum of the steps, for the prior

    @classmethod
    def of(cls, photos: Sequence[Photo]) -> Cameras:
        return cls(np.array([p.pose for p in photos], np.float64), np.zeros(2), 1.0, np.zeros((len(photos), 6)))

    def moved(self, step: np.ndarray) -> Cameras:
        views = len(self.pose)
        twist = step[: 6 * views].reshape(views, 6)
        # A twist acts in the camera's frame: X' = X - omega x X - tau to first order.
        pose = np.array([a @ _exponential(x) for a, x in zip(self.pose, twist, strict=True)])
        common = step[6 * views :]
        return replace(
            self,
            pose=pose,
            principal=self.principal + common[:2],
            focal=self.focal * float(np.exp(common[2])),
            twist=self.twist + twist,
        )


def _exponential(twist: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    # The translation is taken as it stands, which differs from the exponential map in second order only.
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return out


@dataclass(frozen=True)
class Rows:
    """Pairs of a surface point and a view that shows it."""

    point: np.ndarray  # (n,) number of the surface point
    view: np.ndarray  # (n,)
    world: np.ndarray  # (n, 3)
    held_out: np.ndarray  # (n,) bool

    def take(self, choice: np.ndarray) -> Rows:
        """Select rows and renumber the points."""
        point = np.unique(self.point[choice], return_inverse=True)[1]
        return Rows(point, self.view[choice], self.world[choice], self.held_out[choice])


@dataclass(frozen=True)
class Maps:
    """Blurred features and edges of a photograph with their derivatives by the pixel, (H, W) each."""

    value: np.ndarray
    du: np.ndarray
    dv: np.ndarray
    edge: np.ndarray
    edge_du: np.ndarray
    edge_dv: np.ndarray

    @classmethod
    def of(cls, feature: np.ndarray, blur: float) -> Maps:
        from scipy.ndimage import gaussian_filter

        value, edge = gaussian_filter(feature, blur), photo_edges(feature, blur)
        dv, du = np.gradient(value)
        ev, eu = np.gradient(edge)
        return cls(value, du, dv, edge, eu, ev)

    def at(self, names: Sequence[str], uv: np.ndarray) -> list[np.ndarray]:
        """Interpolate bilinearly at pixel coordinates (n, 2)."""
        h, w = self.value.shape
        # Pixel centres lie at + 0.5. The limits keep all four neighbours inside.
        x, y = np.clip(uv[:, 0] - 0.5, 0, w - 1.001), np.clip(uv[:, 1] - 0.5, 0, h - 1.001)
        i, j = x.astype(int), y.astype(int)
        a, b = x - i, y - j
        out = []
        for name in names:
            m = getattr(self, name)
            top, low = m[j, i] * (1 - a) + m[j, i + 1] * a, m[j + 1, i] * (1 - a) + m[j + 1, i + 1] * a
            out.append(top * (1 - b) + low * b)
        return out


def camera_points(state: Cameras, v: int, world: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of the world in the frame of camera v, metres."""
    pose = state.pose[v]
    return (world - pose[:3, 3]) @ pose[:3, :3]


def project(photo: Photo, state: Cameras, local: np.ndarray) -> np.ndarray:
    """Return pixel coordinates (n, 2) of points (n, 3) in the frame of a corrected camera."""
    z = np.maximum(local[:, 2], 1e-6)
    fx, fy = photo.focal[0] * state.focal, photo.focal[1] * state.focal
    u = photo.principal[0] + fx * (local[:, 0] / z + state.principal[0])
    return np.stack([u, photo.principal[1] + fy * (local[:, 1] / z + state.principal[1])], -1)


def _jacobian(photo: Photo, state: Cameras, local: np.ndarray, du: np.ndarray, dv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of an image value by the twist (n, 6) and by principal point and log focal length (n, 3) (Eq. C.31)."""
    x, y, z = local[:, 0], local[:, 1], np.maximum(local[:, 2], 1e-6)
    fx, fy = photo.focal[0] * state.focal, photo.focal[1] * state.focal
    # G of Eq. C.31: gradient of the image value by the camera coordinates.
    gx, gy = du * fx / z, dv * fy / z
    gz = -(gx * x + gy * y) / z
    # x' = x - omega x x - t, so d x' / d omega = [x]_x and d x' / d t = -1.
    turn = np.stack([gy * z - gz * y, gz * x - gx * z, gx * y - gy * x], -1)  # G x X
    shift = -np.stack([gx, gy, gz], -1)
    scale = du * fx * (x / z + state.principal[0]) + dv * fy * (y / z + state.principal[1])
    return np.concatenate([turn, shift], -1), np.stack([du * fx, dv * fy, scale], -1)


def overlap(photos: Sequence[Photo], features: Sequence[np.ndarray], points: int) -> Rows:
    """Find textured surface points and the views that show them."""
    from scipy.ndimage import minimum_filter

    state = Cameras.of(photos)
    flat = [_inner(p) for p in photos]
    each = -(-points // len(photos))
    world = []
    for p, f, inside in zip(photos, features, flat, strict=True):
        index = np.flatnonzero(inside)
        if p.held or not len(index):
            continue
        dv, du = np.gradient(f)
        strong = np.hypot(du, dv).ravel()[index]
        # The half with the strongest gradients, thinned evenly over the picture.
        index = index[strong >= np.median(strong)]
        world.append(surface_points(p, index[:: max(1, len(index) // each)]))
    everything = np.concatenate(world) if world else np.zeros((0, 3))
    point, view = [], []
    for v, (p, inside) in enumerate(zip(photos, flat, strict=True)):
        local = camera_points(state, v, everything)
        uv = project(p, state, local)
        h, w = p.depth.shape
        i, j = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        ok = (local[:, 2] > 0.05) & (i >= 2) & (j >= 2) & (i < w - 2) & (j < h - 2)
        # A projection falls between pixels, so its neighbours must be such surface too.
        safe = minimum_filter(inside, 3)
        found = np.flatnonzero(ok)
        found = found[safe[j[found], i[found]]]
        # Surface in front hides a point whose depth differs from the depth seen there.
        near = np.abs(p.depth[j[found], i[found]] - local[found, 2]) < 0.02 * local[found, 2]
        point.append(found[near])
        view.append(np.full(int(near.sum()), v))
    number, view = np.concatenate(point), np.concatenate(view)
    # A held-out view sets no level, so two others must show the point.
    moving = np.array([not p.held for p in photos])
    count = np.bincount(number[moving[view]], minlength=len(everything))
    keep = count[number] >= 2
    number, view = number[keep], view[keep]
    return Rows(np.unique(number, return_inverse=True)[1], view, everything[number], held_out_blocks(everything[number]))


def held_out_blocks(world: np.ndarray) -> np.ndarray:
    """Which of the points (n, 3) are held out, (n,) bool: whole blocks of surface."""
    block = np.floor(world / HELD_OUT_BLOCK).astype(np.int64)
    # A hash spreads the held-out blocks over the scene; a block falls on one side with all of its points.
    return (block * np.array([73856093, 19349663, 83492791])).sum(1) % 1_000_003 % HELD_OUT_EVERY == 0


def _inner(photo: Photo) -> np.ndarray:
    """(H, W) bool: usable smooth surface away from silhouettes and borders, not seen at a grazing angle."""
    from scipy.ndimage import maximum_filter, minimum_filter

    depth = photo.depth
    # Similar depth in a window of 5 x 5 pixels: no silhouette within two pixels.
    low, high = minimum_filter(depth, 5), maximum_filter(depth, 5)
    rays = _rays(photo)
    facing = np.abs((photo.normal * (rays @ photo.pose[:3, :3].T)).sum(-1)) / np.linalg.norm(rays, axis=-1)
    out = photo.usable & (low > 0) & (high < 1.1 * low) & (facing > MIN_COSINE)
    out[:3], out[-3:], out[:, :3], out[:, -3:] = False, False, False, False
    return out


def _rays(photo: Photo) -> np.ndarray:
    h, w = photo.depth.shape
    v, u = np.mgrid[:h, :w] + 0.5
    x, y = (u - photo.principal[0]) / photo.focal[0], (v - photo.principal[1]) / photo.focal[1]
    return np.stack([x, y, np.ones_like(x)], -1)


def surface_points(photo: Photo, index: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) of the world that pixels, flat indices (n,), show on the mesh."""
    local = (_rays(photo) * photo.depth[..., None]).reshape(-1, 3)[index]
    return local @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def edge_points(photo: Photo) -> np.ndarray:
    """Return the points (n, 3) of the world on edges of the mesh (`mesh_edges`)."""
    at, z = mesh_edges(photo.depth, photo.normal, photo.usable)
    x, y = (at[:, 0] - photo.principal[0]) / photo.focal[0], (at[:, 1] - photo.principal[1]) / photo.focal[1]
    return np.stack([x * z, y * z, z], -1) @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _level(value: np.ndarray, weight: np.ndarray, point: np.ndarray) -> np.ndarray:
    total = np.bincount(point, weight)
    return (np.bincount(point, weight * value) / np.maximum(total, 1e-12))[point]


def feature_values(
    photos: Sequence[Photo], maps: Sequence[Maps], state: Cameras, rows: Rows, names: Sequence[str]
) -> list[np.ndarray]:
    """Return maps by name (`Maps`), each interpolated where rows (n,) are seen, (n,)."""
    out = [np.zeros(len(rows.view)) for _ in names]
    for v, (photo, m) in enumerate(zip(photos, maps, strict=True)):
        own = np.flatnonzero(rows.view == v)
        uv = project(photo, state, camera_points(state, v, rows.world[own]))
        for k, values in enumerate(m.at(names, uv)):
            out[k][own] = values
    return out


def residuals(photos: Sequence[Photo], maps: Sequence[Maps], state: Cameras, rows: Rows) -> np.ndarray:
    """(n,) feature value minus the level of its point: the mean over the views that are not held out."""
    value = feature_values(photos, maps, state, rows, ("value",))[0]
    moving = np.array([not p.held for p in photos], np.float64)[rows.view]
    return value - _level(value, moving, rows.point)


def normal_equations(
    photos: Sequence[Photo],
    maps: Sequence[Maps],
    state: Cameras,
    rows: Rows,
    edges: Sequence[np.ndarray],
    unknowns: Unknowns,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix (n, n) and the right-hand side of a step along n directions: texture values eliminated, prior added."""
    from scipy.sparse import coo_matrix

    views = len(photos)
    size = 6 * views + 3

    # -------- residuals and derivatives, a row for each (point, view) --------
    value, du, dv = feature_values(photos, maps, state, rows, ("value", "du", "dv"))
    moving = np.array([not p.held for p in photos], np.float64)[rows.view]
    jacobian, common = np.zeros((len(value), 6)), np.zeros((len(value), 3))
    for v, photo in enumerate(photos):
        own = np.flatnonzero(rows.view == v)
        local = camera_points(state, v, rows.world[own])
        jacobian[own], common[own] = _jacobian(photo, state, local, du[own], dv[own])

    # -------- weights of Cauchy's loss, in units of 1 / scale^2 --------
    residual = value - _level(value, moving, rows.point)
    own = np.abs(residual[moving > 0])
    scale = max(1.4826 * float(np.median(own)) if len(own) else 1.0, 1e-3)
    weight = 1.0 / (1.0 + (residual / (2.385 * scale)) ** 2) / scale**2

    # -------- sparse Jacobian (rows, 6 V + 3) --------
    # A held-out photograph changes its own twist only, not the intrinsics and not the levels.
    common *= moving[:, None]
    mean = _level(value, (weight + 1e-9) * moving, rows.point)
    # Each row has nine entries: the twist of its view, and the three common unknowns.
    number = np.arange(len(value))
    at = 6 * rows.view[:, None] + np.arange(6)
    columns = np.concatenate([at, np.tile(6 * views + np.arange(3), (len(value), 1))], 1)
    entries = np.concatenate([jacobian, common], 1)
    matrix = coo_matrix((entries.ravel(), (np.repeat(number, 9), columns.ravel())), (len(value), size)).tocsr()

    # -------- levels of the points eliminated --------
    # For fixed cameras C_s is the weighted mean of its rows, so its derivative is the weighted mean of theirs: what a level
    # explains is taken from the matrix. Levels are constants for a held-out photograph, so that its rows move no other camera.
    level = weight * moving
    total = np.maximum(np.bincount(rows.point, level), 1e-9)
    pooled = coo_matrix((level, (rows.point, number)), (len(total), len(value))).tocsr() @ matrix
    normal = (matrix.T @ matrix.multiply(weight[:, None]) - pooled.T @ pooled.multiply(1.0 / total[:, None])).toarray()
    # Residuals from their level have no weighted mean over a point, so the level's derivative drops out here.
    right = -(matrix.T @ (weight * (value - mean)))

    # -------- edges and priors, second to fourth sum of Eq. C.30 --------
    _add_edges(photos, maps, state, edges, normal, right)
    # What a held-out photograph shows moves its own camera, and no direction that others share.
    directions, own = unknowns.directions, np.repeat([not p.held for p in photos], 6)
    shared = (directions[: 6 * views] != 0).sum(0) > 1
    used = directions.copy()
    used[: 6 * views, shared] *= own[:, None]
    normal, right = used.T @ normal @ used, used.T @ right
    # All steps so far, along each direction.
    steps = np.r_[state.twist.ravel(), state.principal, np.log(state.focal)]
    so_far = (directions.T @ steps) / (directions**2).sum(0)
    rows_of_view = moving.sum() / max(sum(not p.held for p in photos), 1)
    precision = max(rows_of_view / 200.0, 1.0) / unknowns.sigma**2  # the errors of neighbouring rows are correlated
    # The prior pulls towards the start, hence towards the negative sum of all steps so far.
    return normal + np.diag(precision), right - precision * so_far


def _add_edges(
    photos: Sequence[Photo],
    maps: Sequence[Maps],
    state: Cameras,
    edges: Sequence[np.ndarray],
    normal: np.ndarray,
    right: np.ndarray,
) -> None:
    last = 6 * len(photos) + np.arange(3)
    for v, (photo, m, world) in enumerate(zip(photos, maps, edges, strict=True)):
        if not len(world):
            continue
        local = camera_points(state, v, world)
        value, du, dv = m.at(("edge", "edge_du", "edge_dv"), project(photo, state, local))
        own, common = _jacobian(photo, state, local, du, dv)
        whole = np.concatenate([own, common * (not photo.held)], 1)
        at = np.r_[6 * v + np.arange(6), last]
        # 1 / sigma_E^2 of Eq. C.30, from the residuals of the view.
        weight = EDGE_WEIGHT / max(float(np.var(1 - value)), 1e-3)
        normal[np.ix_(at, at)] += weight * whole.T @ whole
        # The residual is 1 - E; its derivative is minus the Jacobian of E, hence the sign.
        right[at] += weight * whole.T @ (1 - value)
