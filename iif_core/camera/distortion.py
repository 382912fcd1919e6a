"""Lens distortion: resampling of a distorted photograph to a pinhole camera (docs/method/camera.md#lens-distortion).

Points are normalised camera coordinates (x, y) = (X/Z, Y/Z) with OpenCV axes; both models are OpenCV's (Eq. C.4, C.5).
Directions beyond the first turning point count as not visible (docs/method/numerics.md#lens-that-folds-back).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

MAX_ANGLE = math.radians(60.0)
"""Largest half-angle of the pinhole picture in radians; at 60 degrees perspective stretches radially by 1 / cos^2 = 4."""

BAND_PIXELS = 1 << 19
"""Number of target pixels that are resampled at a time."""


@dataclass(frozen=True)
class Distortion:
    """A lens: `kind`, radial k1 ... k4 (radial_tangential: k4 = 0), tangential p1, p2 (fisheye: 0).

    Raises:
        InputError: a coefficient that is not finite or that the model does not have.
    """

    kind: Literal["radial_tangential", "fisheye"]
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    p: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.kind not in ("radial_tangential", "fisheye"):
            raise InputError(f"distortion {self.kind!r}: unknown; allowed: radial_tangential, fisheye")
        if not np.isfinite([*self.k, *self.p]).all():
            raise InputError(f"distortion coefficients k={self.k}, p={self.p}: must be finite numbers")
        if self.kind == "radial_tangential" and self.k[3] != 0:
            raise InputError(f"k4 = {self.k[3]}: the radial_tangential model has k1, k2, k3, p1, p2 only")
        if self.kind == "fisheye" and any(self.p):
            raise InputError(f"p1, p2 = {self.p}: the fisheye model has k1 ... k4 only")

    @property
    def is_identity(self) -> bool:
        """Whether the lens is a pinhole already; a fisheye never is, because t_d = atan r."""
        return self.kind == "radial_tangential" and not any(self.k) and not any(self.p)

    @property
    def turning_radius(self) -> float:
        """Smallest r from which r_d falls, inf if there is none (Eq. C.6); tangential terms are ignored."""
        k1, k2, k3, k4 = self.k
        # d/dr of r c(r^2) (or of t c(t^2)) as a polynomial in s = r^2 (t^2), highest power first.
        slope = np.array([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
        slope[np.abs(slope) < 1e-12] = 0.0  # no effect below r = 100, and roots would divide by it
        roots = np.roots(slope)
        real = roots[np.abs(roots.imag) <= 1e-9 * np.maximum(np.abs(roots.real), 1e-300)].real
        first = math.sqrt(real[real > 0].min()) if (real > 0).any() else math.inf
        if self.kind == "radial_tangential":
            return first
        return math.tan(first) if first < math.pi / 2 else math.inf


@dataclass(frozen=True)
class Pinhole:
    """Focal lengths and principal point in pixels (pixel centres at +0.5), and the size of the picture."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def _radial(lens: Distortion, r: Array) -> Array:
    """r_d as a function of r."""
    t = np.arctan(r) if lens.kind == "fisheye" else r
    return t * _factor(lens, t)


def _factor(lens: Distortion, t: Array) -> Array:
    """r_d / t, where t is the angle of a fisheye lens and the radius of another."""
    k1, k2, k3, k4 = lens.k
    s = t * t
    return 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))


def distort(lens: Distortion, points: ArrayLike) -> tuple[Array, Array]:
    """Distort pinhole points (..., 2); returns (..., 2) float64 and whether the map is one-to-one there, (...) bool.

    Example:
        >>> distort(Distortion("radial_tangential", (0.1, 0, 0, 0)), [[1.0, 0.0]])[0].tolist()
        [[1.1, 0.0]]
    """
    points = np.asarray(points, np.float64)
    x, y = points[..., 0], points[..., 1]
    r = np.hypot(x, y)
    # On the axis r_d / r is 0 / 0; both models have scale 1 there.
    safe = np.where(r > 0, r, 1.0)
    scale = np.where(r > 0, _radial(lens, r) / safe, 1.0)
    p1, p2 = lens.p
    x_d = x * scale + 2 * p1 * x * y + p2 * (r * r + 2 * x * x)
    y_d = y * scale + p1 * (r * r + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x_d, y_d], -1), np.isfinite(r) & (r < lens.turning_radius)


def undistort(lens: Distortion, points: ArrayLike) -> tuple[Array, Array]:
    """Find the pinhole position (..., 2) float64 of distorted points (..., 2), and whether there is one, (...) bool.

    The radius comes from bisection below the turning point, which always converges; Newton steps in (x, y) follow if p1 or p2
    is set. Points without a solution (beyond the turning point, or 90 degrees and more off the axis) become (0, 0).
    """
    points = np.asarray(points, np.float64)
    r_d = np.hypot(points[..., 0], points[..., 1])
    r = _invert_radial(lens, r_d)
    safe = np.where(r_d > 0, r_d, 1.0)
    gain = np.where(np.isfinite(r), np.where(r_d > 0, r / safe, 1.0), 0.0)
    q = points * gain[..., None]
    if any(lens.p):
        for _ in range(20):
            q = _newton_step(lens, q, points)
    # Whatever the steps did, a point counts only if distorting it leads back.
    again, unique = distort(lens, q)
    found = np.isfinite(r) & unique & (np.abs(again - points).max(-1, initial=0) <= 1e-9 * (1 + r_d))
    return np.where(found[..., None], q, 0.0), found


def _invert_radial(lens: Distortion, r_d: Array) -> Array:
    """r with _radial(r) = r_d below the turning point; NaN where there is none."""
    # The angle is bounded where r is not.
    top = math.atan(lens.turning_radius)
    low, high = np.zeros_like(r_d), np.full_like(r_d, top)
    # r_d at the turning point, beyond which no radius is reached.
    limit = float(_radial(lens, np.array(math.tan(min(top, math.pi / 2 - 1e-9)))))
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = _radial(lens, np.tan(middle)) < r_d
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    middle = 0.5 * (low + high)
    # Bisection leaves an absolute error; r_d / factor, which hardly depends on it, has all digits close to the axis too.
    fisheye = lens.kind == "fisheye"
    t = r_d / _factor(lens, middle if fisheye else np.tan(middle))
    return np.where(r_d < limit, np.tan(t) if fisheye else t, np.nan)


def _newton_step(lens: Distortion, q: Array, target: Array) -> Array:
    """One step towards distort(q) = target, radial_tangential; q stays where the Jacobian is singular."""
    k1, k2, k3, _ = lens.k
    p1, p2 = lens.p
    x, y = q[..., 0], q[..., 1]
    s = x * x + y * y
    c = 1 + s * (k1 + s * (k2 + s * k3))
    slope = k1 + s * (2 * k2 + s * 3 * k3)  # dc/ds
    xx = c + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = c + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    determinant = xx * yy - xy * xy
    regular = np.abs(determinant) > 1e-9
    by = np.where(regular, determinant, 1.0)
    error = distort(lens, q)[0] - target
    step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], -1)
    step = step / by[..., None]
    # Large steps occur near a turning point, where there is no solution; squares must not overflow.
    small = regular & (np.abs(step).max(-1) <= 1 + np.sqrt(s))
    return np.where(small[..., None], q - step, q)


def pinhole_inside(lens: Distortion, source: Pinhole) -> Pinhole:
    """Find the pinhole camera of the same focal length for the largest upright rectangle that the photograph covers.

    The rectangle lies inside the undistorted border of the picture (OpenCV: `alpha = 0`) and within MAX_ANGLE of the axis. Its
    size in pixels follows from the focal length, so the centre keeps its resolution. A pinhole picture is unchanged.

    Raises:
        InputError: nothing is left.
    """
    steps = np.linspace(0.0, 1.0, 129)
    left, right = (source.width * edge - source.cx for edge in (0.0, 1.0))
    top, bottom = (source.height * edge - source.cy for edge in (0.0, 1.0))
    along_x, along_y = left + (right - left) * steps, top + (bottom - top) * steps
    reach = min(lens.turning_radius, 1e9)

    def border(u: Array | float, v: Array | float) -> Array:
        at = np.stack(np.broadcast_arrays(u / source.fx, v / source.fy), -1).astype(np.float64)
        point, found = undistort(lens, at)
        # A border point without a solution is put at the turning radius, in the same direction.
        beyond = at / np.maximum(np.linalg.norm(at, axis=-1, keepdims=True), 1e-12) * reach
        return np.where(found[:, None], point, beyond)

    widest = math.tan(MAX_ANGLE)
    # Each side of the rectangle touches the innermost point of the undistorted border on that side.
    x0 = max(border(left, along_y)[:, 0].max(), -widest)
    x1 = min(border(right, along_y)[:, 0].min(), widest)
    y0 = max(border(along_x, top)[:, 1].max(), -widest)
    y1 = min(border(along_x, bottom)[:, 1].min(), widest)
    width, height = (int(math.floor(v + 1e-6)) for v in ((x1 - x0) * source.fx, (y1 - y0) * source.fy))
    if width < 1 or height < 1:
        raise InputError(
            f"lens {lens.kind} with k={lens.k}, p={lens.p}: no upright picture fits inside the undistorted"
            " photograph; the coefficients do not belong to this camera"
        )
    # Less than a pixel is left over on either axis; half of it falls on each side.
    spare_x, spare_y = (x1 - x0) * source.fx - width, (y1 - y0) * source.fy - height
    cx, cy = float(-x0 * source.fx - spare_x / 2), float(-y0 * source.fy - spare_y / 2)
    return Pinhole(source.fx, source.fy, cx, cy, width, height)


def undistort_image(
    image: ArrayLike,
    lens: Distortion,
    source: Pinhole,
    target: Pinhole,
    valid: ArrayLike | None = None,
    nearest: bool = False,
) -> tuple[Array, Array]:
    """Resample a photograph to the `target` camera at the same place.

    Args:
        image: (H, W) or (H, W, C), any dtype.
        lens, source: the camera that took it; source.width, source.height must be W, H.
        target: for example `pinhole_inside(lens, source)`.
        valid: (H, W) bool; a target pixel that touches an invalid pixel is invalid. All are valid if None.
        nearest: use the nearest pixel (for ids) instead of bilinear interpolation.

    Returns:
        (h, w[, C]) image of the same dtype, 0 where nothing is seen, and (h, w) bool, which pixels the photograph covers.
    """
    image = np.asarray(image)
    if image.shape[:2] != (source.height, source.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(f"image of {size} pixels, its camera has {source.width}x{source.height}")
    known = np.ones(image.shape[:2], bool) if valid is None else np.asarray(valid, bool)
    out = np.zeros((target.height, target.width, *image.shape[2:]), image.dtype)
    seen = np.zeros((target.height, target.width), bool)
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx
    band = max(1, BAND_PIXELS // target.width)
    for first in range(0, target.height, band):
        rows = slice(first, min(first + band, target.height))
        y = (np.arange(rows.start, rows.stop) + 0.5 - target.cy) / target.fy
        at, unique = distort(lens, np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1))
        u, v = at[..., 0] * source.fx + source.cx, at[..., 1] * source.fy + source.cy
        out[rows], seen[rows] = _sample(image, known, u, v, nearest)
        seen[rows] &= unique
        out[rows][~seen[rows]] = 0
    return out, seen


def _sample(image: Array, known: Array, u: Array, v: Array, nearest: bool) -> tuple[Array, Array]:
    """Image at pixel positions (u, v), and whether all pixels that contribute there are known."""
    height, width = known.shape
    inside = (u > -1e-6) & (u < width + 1e-6) & (v > -1e-6) & (v < height + 1e-6)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    if nearest:
        i, j = np.clip(np.floor(u).astype(int), 0, width - 1), np.clip(np.floor(v).astype(int), 0, height - 1)
        return image[j, i], inside & known[j, i]
    # Pixel centres lie at + 0.5. Half a pixel beyond the outer centres the border pixel is repeated.
    a, b = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    i, j = np.minimum(a.astype(int), max(width - 2, 0)), np.minimum(b.astype(int), max(height - 2, 0))
    a, b = a - i, b - j
    i1, j1 = np.minimum(i + 1, width - 1), np.minimum(j + 1, height - 1)
    value, complete = 0.0, inside
    corners = (((1 - a) * (1 - b), j, i), (a * (1 - b), j, i1), ((1 - a) * b, j1, i), (a * b, j1, i1))
    for weight, row, column in corners:
        shaped = weight.astype(np.float32).reshape(weight.shape + (1,) * (image.ndim - 2))
        # A pixel of weight 0 may be NaN and must not enter.
        value = value + np.where(shaped > 0, image[row, column] * shaped, 0)
        complete = complete & (known[row, column] | (weight <= 1e-6))
    return value, complete
