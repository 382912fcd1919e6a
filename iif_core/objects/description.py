"""Names for objects that nobody has named: what colour they have and what part of a room they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.numerics.color import lab_from_linear
from iif_core.surface.triangles import face_geometry

LEVEL, UPRIGHT = 0.8, 0.35  # cosines with the vertical from which, and up to which, a face is level or upright
MOST = 0.6  # share of its area that makes an object level or upright
WIDE, WALL = 0.5, 1.5  # m^2 from which level surface is a floor or a ceiling, upright surface a wall
NEAR, HIGH = 0.12, 0.4  # of the height of the room: distance from its ends of floors and ceilings; height of a wall
FRONT = 0.05  # m^2 from which flat upright surface is a front
FLAT = 0.9  # share of the normals of a flat object that its mean normal keeps
PARALLEL, PLANE = 0.97, 0.06  # cosine between normals, and metres, up to which pieces lie in one plane
BEYOND, CLEAR = 0.15, 0.04  # metres behind a side of the room, and the share of all surface that may lie there
ALIKE = 20.0  # distance in CIELAB up to which a piece in the plane of a wall is part of it
GREY = 10.0  # chroma below which a colour is grey
_GREYS = ((25.0, "black"), (45.0, "dark grey"), (62.0, "grey"), (78.0, "light grey"), (101.0, "white"))
_HUES = (
    (42.0, "red"), (72.0, "orange"), (105.0, "yellow"), (195.0, "green"), (309.0, "blue"), (345.0, "purple"), (361.0, "red")
)  # fmt: skip


def colour_name(albedo: ArrayLike) -> str:
    """Return an everyday name of a colour.

    By lightness, chroma and hue of CIELAB (D65): greys by lightness below a chroma of 10, other colours by hue; dull orange is
    brown or, if it is light, beige, and dull light red is pink.

    Args:
        albedo: (3,) linear Rec.709, in [0, 1].

    >>> colour_name([0.8, 0.8, 0.8]), colour_name([0.2, 0.1, 0.05]), colour_name([0.05, 0.1, 0.4])
    ('white', 'brown', 'blue')
    """
    lightness, a, b = (float(v) for v in lab_from_linear(np.clip(np.asarray(albedo, np.float64), 0, 1)))
    chroma, hue = float(np.hypot(a, b)), float(np.degrees(np.arctan2(b, a)) % 360)
    if chroma < GREY:
        return next(name for most, name in _GREYS if lightness < most)
    name = next(name for most, name in _HUES if hue < most)
    if 25 <= hue < 105 and lightness < 62 and chroma < 50:
        return "brown"
    if 42 <= hue < 105 and chroma < 30:
        return "beige"
    return "pink" if name == "red" and lightness > 62 and chroma < 50 else name


def described(
    object_of_face: ArrayLike,
    vertices: ArrayLike,
    faces: ArrayLike,
    albedo: ArrayLike,
    seen: ArrayLike,
    up: ArrayLike,
    built: Sequence[bool] | None = None,
) -> list[str]:
    """Return a name for each object, such as `white wall 2`, each once.

    Of objects with the same name the largest has the number 1. Parts of a room are told by where faces look and lie: level
    surface at the bottom and at the top of the room is floor and ceiling, between them a `top` (of a table, a shelf); large and
    high upright surface is a wall, and so are flat pieces that make up such a surface together, of like colour and with hardly
    anything behind them; other flat upright pieces are a `front` (of a cupboard, a door, a picture); the rest are pieces. Which
    side of a face is its front does not count.

    Args:
        object_of_face: (m,) from 0 without gaps.
        vertices, faces: (n, 3), metres, and (m, 3).
        albedo: (objects, 3) linear Rec.709.
        seen: (objects,) bool, the albedo is known.
        up: (3,) about upward.
        built: (objects,) bool, they were added to the mesh; None = none was.
    """
    label, vertices = np.asarray(object_of_face, np.int64), np.asarray(vertices, np.float64)
    faces, count = np.asarray(faces, np.int64), len(np.asarray(albedo))
    normal, area = face_geometry(vertices, faces)
    size = np.bincount(label, area, count)
    up = _vertical(normal, area, np.asarray(up, np.float64))
    height, middle = vertices @ up, vertices[faces].mean(1) @ up

    # -------- where each object looks, and how high it reaches --------
    slope = np.abs(normal @ up)
    level = (np.bincount(label, area * (slope >= LEVEL), count) >= MOST * size) & (size > 0)
    upright = np.bincount(label, area * (slope <= UPRIGHT), count) >= MOST * size
    place = np.bincount(label, area * middle, count) / np.maximum(size, 1e-300)
    corner = height[faces]
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, label, corner.min(1))
    np.maximum.at(high, label, corner.max(1))

    # -------- the height of the room, without the few things that stick out of a scan --------
    order = np.argsort(middle)
    share = np.cumsum(area[order]) / max(float(area.sum()), 1e-300)
    bottom, top = (middle[order][min(np.searchsorted(share, at), len(order) - 1)] for at in (0.01, 0.99))
    tall = max(float(top - bottom), 1e-12)

    known = np.asarray(seen, bool) & np.isfinite(np.asarray(albedo, np.float64)).all(1)
    wall = upright & (size >= WALL) & (high - low >= HIGH * tall)
    sides = _Sides(label, normal, area, vertices[faces].mean(1), upright, low, high)
    kinds = []
    for i in range(count):
        if level[i]:
            at_end = size[i] >= WIDE
            floor = at_end and place[i] <= bottom + NEAR * tall
            ceiling = at_end and place[i] >= top - NEAR * tall
            kinds.append("floor" if floor else "ceiling" if ceiling else "top")
        else:
            kinds.append("wall" if wall[i] else "front" if sides.flat[i] and size[i] >= FRONT else "piece")
    for i in sides.walls(np.asarray(albedo, np.float64), known & ~wall, HIGH * tall):
        kinds[i] = "wall"
    added = np.zeros(count, bool) if built is None else np.asarray(built, bool)
    colours = ["added" if a else colour_name(c) if s else "unseen" for a, c, s in zip(added, albedo, known, strict=True)]
    names = [f"{colour} {kind}" for colour, kind in zip(colours, kinds, strict=True)]

    # -------- numbers by size, where a name is not the only one --------
    total, number = Counter(names), Counter()
    out = list(names)
    for i in np.argsort(-size, kind="stable"):
        number[names[i]] += 1
        if total[names[i]] > 1:
            out[i] = f"{names[i]} {number[names[i]]}"
    return out


def _vertical(normal: NDArray, area: NDArray, up: NDArray) -> NDArray:
    """Return the axis (3,) of the normals that look up or down, which is nearer to the vertical than what cameras say."""
    up = up / np.linalg.norm(up)
    own = np.abs(normal @ up) >= LEVEL
    if not area[own].sum() > 0:
        return up
    axis = np.linalg.eigh((normal[own] * area[own, None]).T @ normal[own])[1][:, -1]
    return axis if axis @ up > 0 else -axis


class _Sides:
    """The planes of flat upright objects: which of them make up a wall together.

    Attributes:
        flat: (objects,) bool, they are upright and their normals are alike.
    """

    def __init__(
        self, label: NDArray, normal: NDArray, area: NDArray, middle: NDArray, upright: NDArray, low: NDArray, high: NDArray
    ):
        count = len(upright)
        self.size, self.low, self.high = np.bincount(label, area, count), low, high
        self.middle, self.area = middle, area
        total = np.maximum(self.size, 1e-300)
        # The axis along which most of an object's normals lie, whatever their signs.
        moment = np.stack([np.bincount(label, area * normal[:, i] * normal[:, j], count) for i in range(3) for j in range(3)], 1)
        values, vectors = np.linalg.eigh(moment.reshape(count, 3, 3) / total[:, None, None])
        self.axis = vectors[:, :, -1]
        self.flat = upright & (values[:, -1] >= FLAT)
        self.centre = np.stack([np.bincount(label, area * middle[:, i], count) for i in range(3)], 1) / total[:, None]

    def walls(self, albedo: NDArray, asked: NDArray, high: float) -> list[int]:
        """Return the objects that make up walls together: in one plane, of one colour, with hardly anything behind them.

        Args:
            albedo: (objects, 3) linear Rec.709.
            asked: (objects,) bool, which may join: of known colour, and no wall by themselves. Such a wall needs no others, and
                panels of a door in its plane are none.
            high: metres that a wall reaches over.
        """
        lab = lab_from_linear(np.clip(np.where(asked[:, None], albedo, 0), 0, 1))
        left, out = self.flat & asked, []
        for seed in np.argsort(-self.size, kind="stable"):
            if not left[seed]:
                continue
            axis, at = self.axis[seed], self.axis[seed] @ self.centre[seed]
            near = left & (np.abs(self.axis @ axis) >= PARALLEL) & (np.abs(self.centre @ axis - at) <= PLANE)
            alike = near & (np.linalg.norm(lab - lab[seed], axis=1) <= ALIKE)
            offset = self.middle @ axis - at
            behind = min(self.area[offset > BEYOND].sum(), self.area[offset < -BEYOND].sum())
            reach = self.high[alike].max() - self.low[alike].min()
            if self.size[alike].sum() >= WALL and reach >= high and behind <= CLEAR * self.area.sum():
                out += np.flatnonzero(alike).tolist()
                left &= ~alike
            left[seed] = False
        return out
