"""Registration of photographs with a mesh: small corrections of poses and common intrinsics, and the sharpness of each view.

The photographs have to agree with each other on surface points, and with the edges of the mesh (Eq. C.30). The texture values of
the points are eliminated; steps are Gauss-Newton with Cauchy's weights, on images blurred less and less. First comes what all
cameras share, then each camera beside the others, tightly first, at last each freely; what held-out surface does not confirm is
undone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, stdtrit

from iif_core.camera.exposure import estimate_gains
from iif_core.errors import InputError

SIGMA_ROTATION, SIGMA_TRANSLATION = 0.02, 0.03
"""Standard deviation of the correction that all views share, and of that of a free view: radians, metres."""
WIDTHS = 0.03, 0.1, 0.3
"""Standard deviations, in units of those two, of the steps by which views may move beside each other, one after the other. Views
are known to about a pixel, so a prior much wider than their errors adds noise to good poses, and a narrow one cannot mend bad
ones."""
SIGMA_PRINCIPAL, SIGMA_FOCAL = 0.02, 0.02
"""Standard deviation of the common corrections, relative to the focal length."""
_PRIOR = np.repeat([SIGMA_ROTATION, SIGMA_TRANSLATION], 3), np.array([SIGMA_PRINCIPAL, SIGMA_PRINCIPAL, SIGMA_FOCAL])
DARK = 0.06
"""Luminance relative to the median below which texture counts as noise; an 8-bit photograph has some five levels there."""
BLURS = (2.5, 1.2, 0.7)
"""Standard deviations of the successive blurs of the feature images, in pixels."""
SURE, SURE_ALIKE = 4.0, 5.0
"""Standard errors of both measures together by which held-out surface must be better: with corrections of single views, and with
what all share. The errors of the mesh, which all views share, are not in them. Of right poses, the first reach 4.3, which moves
two rooms of sixteen by a tenth of a pixel and is allowed to, and the second 4.8, which would move them by half a pixel."""
BETTER = 2.0
"""Standard errors by which views that move less tightly must be better than the tighter ones that were accepted."""
WORSE = 3.0
"""Standard errors of its own by which neither measure may be worse."""
STEPS_PER_BLUR = 6
SHARED_EVERY = 4
"""What all cameras share, nine numbers, is found from one in so many points."""
MIN_COSINE = 0.25
"""Smallest cosine between normal and viewing direction at which surface is compared."""
HELD_OUT_BLOCK = 0.3
"""Edge in metres of the blocks of surface that are held out together."""
EDGE_WEIGHT = 0.15
"""Weight of an edge point relative to a row of texture; the errors of neighbouring edge points are correlated."""
MIN_VIEWS = 6
MIN_ROWS = 40
"""Number of points that a view must share with others before its quality is judged."""
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


@dataclass(frozen=True)
class Registration:
    """Result of `register`.

    Attributes:
        pose: (V, 4, 4); principal: (2,) shift of the principal point in units of the focal length; focal: factor.
        moved: (V,) median motion of the pixels of a view, in pixels of the given photographs.
        held_out: (before, after) robust spread of feature values on held-out surface.
        gain, error: mean decrease of the held-out loss per row and its standard error over views.
        edges: (before, after) mean photograph edge at held-out edges of the mesh.
        edge_gain, edge_error: its increase and the standard error over views.
        rows: (point, view) pairs compared.
        evidence: what held-out surface says, in standard errors (`combined`), for the correction of single views against what all
            share, or for what all share against the given cameras if single views stay.
        needed: what it has to exceed.
        accepted: whether a correction satisfies Eq. C.32; if none does, the other numbers are of the one with most evidence.
        each: whether the poses of single views are corrected beside those of the others, and not only all alike.
        sharpness: (V,) gradient of the texture relative to the other views; 1 = typical, 0 = not compared, as all that are held.
        agreement: (V,) correlation of features with the mean of the other views, after registration; 0 = not compared.
        shift: (V,) remaining translation against the texture of the other views, in pixels (Eq. C.33).

    All but `pose` and `moved` is of the photographs that are not held.
    """

    pose: np.ndarray
    principal: np.ndarray
    focal: float
    moved: np.ndarray
    held_out: tuple[float, float]
    gain: float
    error: float
    edges: tuple[float, float]
    edge_gain: float
    edge_error: float
    rows: int
    evidence: float
    needed: float
    accepted: bool
    each: bool
    sharpness: np.ndarray
    agreement: np.ndarray
    shift: np.ndarray


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


def register(photos: Sequence[Photo], points: int = 12_000, intrinsics: bool = True, poses: bool = True) -> Registration:
    """Correct poses and common intrinsics so that the photographs fit the mesh and each other.

    Args:
        photos: at least one.
        points: number of surface points that are compared, over all views.
        intrinsics: correct focal length and principal point, by the same relative amount in all views.
        poses: correct each pose.

    Returns:
        Corrected cameras, whether they are accepted, and the quality of each view.

    Raises:
        InputError: no photograph.
    """
    if not photos:
        raise InputError("registration: no photograph given; at least one is needed")

    # -------- features, shared surface points, edges of the mesh --------
    # Blocks of surface are held out from both kinds of rows, for the decision at the end.
    start = _Cameras.of(photos)
    features = [feature_image(p.image, p.usable) for p in photos]
    rows = _overlap(photos, features, points)
    edges = [_edge_points(p) for p in photos]
    held = [_held_out(world) for world in edges]
    fit = rows.take(~rows.held_out)
    seen = [world[~h] for world, h in zip(edges, held, strict=True)]

    # -------- judges: held-out surface, in what photographs show that are not held --------
    moving = np.array([not p.held for p in photos])
    rows = rows.take(moving[rows.view])
    judged = rows.take(rows.held_out), [world[h & own] for world, h, own in zip(edges, held, moving, strict=True)]
    maps = [_Maps.of(f, BLURS[-1]) for f in features]

    # -------- Gauss-Newton: all cameras alike, then each beside the others, less and less tightly, then each freely --------
    few = fit.take(fit.point % SHARED_EVERY == 0), [world[::SHARED_EVERY] for world in seen]
    stages = [(BLURS, few, together(len(photos), poses, intrinsics), SURE_ALIKE, SURE_ALIKE)]
    if poses:
        stages += [(BLURS[1:], (fit, seen), apart(moving, width), SURE, BETTER) for width in WIDTHS]
        # Free views come from so far away that a wide blur is needed; they bring back the mean motion, which takes more evidence.
        stages += [(BLURS, (fit, seen), free(len(photos), intrinsics), SURE, SURE)]
    alike = final = shown = start  # what all share, with single views moved, and what the numbers are of
    evidence, needed = 0.0, SURE_ALIKE
    for number, (blurs, data, unknowns, sure, better) in enumerate(stages):
        state = _descend(photos, features, blurs, final, *data, unknowns)
        against = _compare(photos, maps, (alike, state), *judged)
        # Single views must surely beat what all share, and what was accepted of them.
        pays = against.pays(sure) and (final is alike or _compare(photos, maps, (final, state), *judged).pays(better))
        if pays:
            final, alike = state, alike if number else state
        if pays or (final is start and (shown is start or against.evidence / sure > evidence / needed)):
            shown, evidence, needed = state, against.evidence, sure
    found = _compare(photos, maps, (start, shown), *judged)
    return Registration(
        shown.pose,
        shown.principal,
        shown.focal,
        np.array([_motion(photos, start, shown, v) for v in range(len(photos))]),
        found.spread,
        found.texture.mean,
        found.texture.error,
        found.edges,
        found.edge.mean,
        found.edge.error,
        len(rows.view),
        evidence,
        needed,
        final is not start,
        final is not alike,
        *_quality(photos, maps, final, rows),
    )


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


def _descend(
    photos: Sequence[Photo],
    features: Sequence[np.ndarray],
    blurs: Sequence[float],
    start: _Cameras,
    rows: _Rows,
    edges: Sequence[np.ndarray],
    unknowns: Unknowns,
) -> _Cameras:
    """Move cameras by Gauss-Newton, from blurred to sharp images."""
    # The prior pulls each view towards where this descent starts, and the intrinsics towards the given ones.
    state = replace(start, twist=np.zeros_like(start.twist))
    # A linear model of an image holds within its blur: wide blurs bring cameras close, narrow ones make them precise.
    for blur in blurs if len(unknowns.sigma) else ():
        maps = [_Maps.of(f, blur) for f in features]
        for _ in range(STEPS_PER_BLUR):
            state = state.moved(_step(photos, maps, state, rows, edges, unknowns))
    return state


@dataclass(frozen=True)
class _Cameras:
    """The unknowns of the registration."""

    pose: np.ndarray
    principal: np.ndarray
    focal: float
    twist: np.ndarray  # (V, 6) sum of the steps, for the prior

    @classmethod
    def of(cls, photos: Sequence[Photo]) -> _Cameras:
        return cls(np.array([p.pose for p in photos], np.float64), np.zeros(2), 1.0, np.zeros((len(photos), 6)))

    def moved(self, step: np.ndarray) -> _Cameras:
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
class _Rows:
    point: np.ndarray  # (n,) number of the surface point
    view: np.ndarray  # (n,)
    world: np.ndarray  # (n, 3)
    held_out: np.ndarray  # (n,) bool

    def take(self, choice: np.ndarray) -> _Rows:
        """Select rows and renumber the points."""
        point = np.unique(self.point[choice], return_inverse=True)[1]
        return _Rows(point, self.view[choice], self.world[choice], self.held_out[choice])


@dataclass(frozen=True)
class _Maps:
    value: np.ndarray
    du: np.ndarray
    dv: np.ndarray
    edge: np.ndarray
    edge_du: np.ndarray
    edge_dv: np.ndarray

    @classmethod
    def of(cls, feature: np.ndarray, blur: float) -> _Maps:
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


def _camera_points(state: _Cameras, v: int, world: np.ndarray) -> np.ndarray:
    pose = state.pose[v]
    return (world - pose[:3, 3]) @ pose[:3, :3]


def _project(photo: Photo, state: _Cameras, local: np.ndarray) -> np.ndarray:
    z = np.maximum(local[:, 2], 1e-6)
    fx, fy = photo.focal[0] * state.focal, photo.focal[1] * state.focal
    u = photo.principal[0] + fx * (local[:, 0] / z + state.principal[0])
    return np.stack([u, photo.principal[1] + fy * (local[:, 1] / z + state.principal[1])], -1)


def _jacobian(photo: Photo, state: _Cameras, local: np.ndarray, du: np.ndarray, dv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def _overlap(photos: Sequence[Photo], features: Sequence[np.ndarray], points: int) -> _Rows:
    """Find textured surface points and the views that show them."""
    from scipy.ndimage import minimum_filter

    state = _Cameras.of(photos)
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
        world.append(_world(p, index[:: max(1, len(index) // each)]))
    everything = np.concatenate(world) if world else np.zeros((0, 3))
    point, view = [], []
    for v, (p, inside) in enumerate(zip(photos, flat, strict=True)):
        local = _camera_points(state, v, everything)
        uv = _project(p, state, local)
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
    return _Rows(np.unique(number, return_inverse=True)[1], view, everything[number], _held_out(everything[number]))


def _held_out(world: np.ndarray) -> np.ndarray:
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


def _world(photo: Photo, index: np.ndarray) -> np.ndarray:
    local = (_rays(photo) * photo.depth[..., None]).reshape(-1, 3)[index]
    return local @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _edge_points(photo: Photo) -> np.ndarray:
    at, z = mesh_edges(photo.depth, photo.normal, photo.usable)
    x, y = (at[:, 0] - photo.principal[0]) / photo.focal[0], (at[:, 1] - photo.principal[1]) / photo.focal[1]
    return np.stack([x * z, y * z, z], -1) @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _level(value: np.ndarray, weight: np.ndarray, point: np.ndarray) -> np.ndarray:
    total = np.bincount(point, weight)
    return (np.bincount(point, weight * value) / np.maximum(total, 1e-12))[point]


def _values(
    photos: Sequence[Photo], maps: Sequence[_Maps], state: _Cameras, rows: _Rows, names: Sequence[str]
) -> list[np.ndarray]:
    out = [np.zeros(len(rows.view)) for _ in names]
    for v, (photo, m) in enumerate(zip(photos, maps, strict=True)):
        own = np.flatnonzero(rows.view == v)
        uv = _project(photo, state, _camera_points(state, v, rows.world[own]))
        for k, values in enumerate(m.at(names, uv)):
            out[k][own] = values
    return out


def _residuals(photos: Sequence[Photo], maps: Sequence[_Maps], state: _Cameras, rows: _Rows) -> np.ndarray:
    """(n,) feature value minus the level of its point: the mean over the views that are not held out."""
    value = _values(photos, maps, state, rows, ("value",))[0]
    moving = np.array([not p.held for p in photos], np.float64)[rows.view]
    return value - _level(value, moving, rows.point)


def _step(
    photos: Sequence[Photo],
    maps: Sequence[_Maps],
    state: _Cameras,
    rows: _Rows,
    edges: Sequence[np.ndarray],
    unknowns: Unknowns,
) -> np.ndarray:
    """Compute one Gauss-Newton step (6 V + 3,): twists, principal point, log focal length."""
    normal, right = normal_equations(photos, maps, state, rows, edges, unknowns)
    step = unknowns.directions @ np.linalg.solve(normal, right)
    # rad, m, and units of the focal length. The step takes images for linear, which holds over short distances only.
    limit = np.r_[np.tile(np.repeat([0.02, 0.03], 3), len(photos)), [0.02, 0.02, 0.02]]
    return np.clip(step, -limit, limit)


def normal_equations(
    photos: Sequence[Photo],
    maps: Sequence[_Maps],
    state: _Cameras,
    rows: _Rows,
    edges: Sequence[np.ndarray],
    unknowns: Unknowns,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix (n, n) and the right-hand side of a step along n directions: texture values eliminated, prior added."""
    from scipy.sparse import coo_matrix

    views = len(photos)
    size = 6 * views + 3

    # -------- residuals and derivatives, a row for each (point, view) --------
    value, du, dv = _values(photos, maps, state, rows, ("value", "du", "dv"))
    moving = np.array([not p.held for p in photos], np.float64)[rows.view]
    jacobian, common = np.zeros((len(value), 6)), np.zeros((len(value), 3))
    for v, photo in enumerate(photos):
        own = np.flatnonzero(rows.view == v)
        local = _camera_points(state, v, rows.world[own])
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
    maps: Sequence[_Maps],
    state: _Cameras,
    edges: Sequence[np.ndarray],
    normal: np.ndarray,
    right: np.ndarray,
) -> None:
    last = 6 * len(photos) + np.arange(3)
    for v, (photo, m, world) in enumerate(zip(photos, maps, edges, strict=True)):
        if not len(world):
            continue
        local = _camera_points(state, v, world)
        value, du, dv = m.at(("edge", "edge_du", "edge_dv"), _project(photo, state, local))
        own, common = _jacobian(photo, state, local, du, dv)
        whole = np.concatenate([own, common * (not photo.held)], 1)
        at = np.r_[6 * v + np.arange(6), last]
        # 1 / sigma_E^2 of Eq. C.30, from the residuals of the view.
        weight = EDGE_WEIGHT / max(float(np.var(1 - value)), 1e-3)
        normal[np.ix_(at, at)] += weight * whole.T @ whole
        # The residual is 1 - E; its derivative is minus the Jacobian of E, hence the sign.
        right[at] += weight * whole.T @ (1 - value)


@dataclass(frozen=True)
class Gain:
    """The mean gain of many rows, and how well it is known if the rows of a view are correlated.

    Attributes:
        mean: over the rows; error: its standard error, infinite if fewer than MIN_VIEWS views have rows.
        away: (V,) what each view adds to the error: the root of the sum of its squares is the error.
        views: number of views that have rows.
    """

    mean: float
    error: float
    away: np.ndarray
    views: int

    @classmethod
    def of(cls, gain: np.ndarray, view: np.ndarray, views: int) -> Gain:
        """Return the mean of the gains (n,) of rows, which belong to views (n,) of so many."""
        total, count = np.bincount(view, gain, views), np.bincount(view, minlength=views)
        seen = int((count > 0).sum())
        if seen < MIN_VIEWS:
            return cls(float(gain.mean()) if len(gain) else 0.0, np.inf, np.zeros(views), seen)
        # Deviations of the sums over views, with the correction for a small number of views.
        mean = total.sum() / count.sum()
        away = (total - mean * count) * np.sqrt(seen / (seen - 1)) / count.sum()
        return cls(float(mean), float(np.linalg.norm(away)), away, seen)


def combined(gains: Sequence[Gain]) -> float:
    """Combine gains into one number of standard errors: the sum of each in its own, over the standard error of that sum, which
    contains how the gains go together over views. A gain of infinite error counts for nothing.

    Where Student's t exceeds SURE as often as a normal variable exceeds 3, with ten views or fewer, it is less by that ratio.
    """
    known = [gain for gain in gains if gain.error < np.inf]
    if not known:
        return 0.0
    sizes = [max(gain.error, 1e-12) for gain in known]
    error = np.linalg.norm(sum(gain.away / size for gain, size in zip(known, sizes, strict=True)))
    z = sum(gain.mean / size for gain, size in zip(known, sizes, strict=True)) / max(error, 1e-6)
    return float(z * min(1.0, SURE / stdtrit(min(gain.views for gain in known) - 1, ndtr(3.0))))


@dataclass(frozen=True)
class _Comparison:
    """Two states of the cameras on held-out surface: (before, after) spread of features and photograph edge at mesh edges, and
    what the second gains in each."""

    spread: tuple[float, float]
    texture: Gain
    edges: tuple[float, float]
    edge: Gain

    @property
    def evidence(self) -> float:
        return combined([self.texture, self.edge])

    def pays(self, sure: float) -> bool:
        """The second is better by both measures together, by more than `sure`, and much worse by neither (Eq. C.32)."""
        return self.evidence > sure and all(gain.mean >= -WORSE * gain.error for gain in (self.texture, self.edge))


def _compare(
    photos: Sequence[Photo],
    maps: Sequence[_Maps],
    states: tuple[_Cameras, _Cameras],
    rows: _Rows,
    edges: Sequence[np.ndarray],
) -> _Comparison:
    return _Comparison(*_compare_features(photos, maps, states, rows), *_compare_edges(photos, maps, states, edges))


def _compare_features(
    photos: Sequence[Photo], maps: Sequence[_Maps], states: Sequence[_Cameras], rows: _Rows
) -> tuple[tuple[float, float], Gain]:
    """Robust spread of the features under two states; decrease of Cauchy's loss."""
    residual = [_residuals(photos, maps, state, rows) for state in states]
    if not len(rows.view):
        return (0.0, 0.0), Gain.of(np.zeros(0), rows.view, len(photos))
    spread = [float(1.4826 * np.median(np.abs(r))) for r in residual]
    # One width for both states, or the better one would be judged by a narrower loss.
    width = max(2.385 * spread[0], 1e-6)
    loss = np.log1p((residual[0] / width) ** 2) - np.log1p((residual[1] / width) ** 2)
    return (spread[0], spread[1]), Gain.of(loss, rows.view, len(photos))


def _compare_edges(
    photos: Sequence[Photo], maps: Sequence[_Maps], states: Sequence[_Cameras], edges: Sequence[np.ndarray]
) -> tuple[tuple[float, float], Gain]:
    """Mean photograph edge at mesh edges under two states; its increase."""
    view = np.repeat(np.arange(len(photos)), [len(world) for world in edges])
    if not len(view):
        return (0.0, 0.0), Gain.of(np.zeros(0), view, len(photos))
    value = [
        np.concatenate(
            [
                m.at(("edge",), _project(photo, state, _camera_points(state, v, world)))[0]
                for v, (photo, m, world) in enumerate(zip(photos, maps, edges, strict=True))
            ]
        )
        for state in states
    ]
    return (float(value[0].mean()), float(value[1].mean())), Gain.of(value[1] - value[0], view, len(photos))


def _quality(
    photos: Sequence[Photo], maps: Sequence[_Maps], state: _Cameras, rows: _Rows
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sharpness, agreement and remaining shift of each view, relative to the other views of the same surface."""
    views = len(photos)
    agreement, shift = np.zeros(views), np.zeros(views)
    value, du, dv = _values(photos, maps, state, rows, ("value", "du", "dv"))
    # Mean of the other views: a view must not agree with itself.
    total, count = np.bincount(rows.point, value), np.bincount(rows.point)
    others = (total[rows.point] - value) / np.maximum(count[rows.point] - 1, 1)
    metres = np.zeros(len(value))
    for v, photo in enumerate(photos):
        own = np.flatnonzero(rows.view == v)
        if len(own) < MIN_ROWS:
            continue
        # Footprint of a pixel, in metres across the line of sight.
        metres[own] = np.maximum(_camera_points(state, v, rows.world[own])[:, 2], 1e-6) / photo.focal[0]
        a, b = value[own] - value[own].mean(), others[own] - others[own].mean()
        agreement[v] = float((a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-12))
        slope, gap = np.stack([du[own], dv[own]], -1), value[own] - others[own]
        robust = 1.0 / (1.0 + (gap / max(3.5 * np.median(np.abs(gap)), 1e-6)) ** 2)
        # Two unknowns, the shift in u and v (Eq. C.33). The ridge serves views without any gradient.
        normal = slope.T @ (robust[:, None] * slope) + 1e-9 * np.eye(2)
        shift[v] = float(np.hypot(*np.linalg.solve(normal, slope.T @ (robust * gap))))
    seen = metres > 0
    # Gradients are per metre of surface, because a distant view shows the same texture steeper per pixel.
    steep = np.hypot(du[seen], dv[seen]) / metres[seen]
    gains = estimate_gains(rows.point[seen], rows.view[seen], steep, views)
    typical = np.median(gains.gain[gains.estimated]) if gains.estimated.any() else 1.0
    return np.where(gains.estimated, gains.gain / typical, 0.0), agreement, shift


def _motion(photos: Sequence[Photo], before: _Cameras, after: _Cameras, v: int) -> float:
    index = np.flatnonzero(photos[v].depth > 0)[::97]
    if not len(index):
        return 0.0
    world = _world(photos[v], index)
    a, b = (_project(photos[v], s, _camera_points(s, v, world)) for s in (before, after))
    return float(np.median(np.hypot(*(b - a).T)))
