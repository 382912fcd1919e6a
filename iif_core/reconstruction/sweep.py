"""Depth of a photograph by plane sweep: which of many planes in front of it makes others look like it, smoothly over the picture.

Cost by zero-mean normalised cross-correlation, which exposures do not change; aggregation after Hirschmueller (2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from iif_core.numerics.compiled import njit

UNKNOWN = 255
"""Cost of a plane on which too few other photographs show a pixel."""
REACH = 4
"""Steps to either side of what was found, in each of the finer searches."""


class Picture(NamedTuple):
    """A photograph without distortion.

    Attributes:
        grey: (H, W) float32.
        intrinsics: (3, 3), pixel centres at half-integers.
        camera_from_world: (3, 4) rotation and translation, OpenCV axes.
    """

    grey: NDArray
    intrinsics: NDArray
    camera_from_world: NDArray

    @property
    def centre(self) -> NDArray:
        rotation, translation = self.camera_from_world[:, :3], self.camera_from_world[:, 3]
        return -rotation.T @ translation

    def pixels(self, points: NDArray, shape: tuple[int, int]) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return row and column (...) int64 of the pixel of a picture of a shape (H, W) that shows each point (..., 3) of the
        world, 0 where none does, its z-depth (...), and (...) bool whether one does."""
        local = points @ self.camera_from_world[:, :3].T + self.camera_from_world[:, 3]
        depth, shown = local[..., 2], local @ self.intrinsics.T
        with np.errstate(invalid="ignore", divide="ignore"):
            x, y = shown[..., 0] / depth, shown[..., 1] / depth
            inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
        row, column = (np.where(inside, at, 0).astype(np.int64) for at in (y, x))
        return row, column, depth, inside


@dataclass(frozen=True)
class SweepOptions:
    """How depth is searched.

    Attributes:
        planes: number of depths, evenly spread in inverse depth.
        radius: of the windows that are compared, pixels.
        least: how many of the other photographs must show a pixel; the mean of the best `least` costs counts, so that one in
            which it is hidden does not.
        step, jump: costs of a change of depth by one plane and by more between neighbours, in levels of cost (127 =
            uncorrelated).
        edge: difference of grey between neighbours that halves `jump`.
        finer: steps of the searches that follow, about what was found, over that between planes.
        keeps: by how much the correlation must be larger at the end of such a search: plain surface stays where its neighbours
            put it.
    """

    planes: int = 96
    radius: int = 3
    least: int = 2
    step: float = 12.0
    jump: float = 120.0
    edge: float = 0.2
    finer: tuple[float, ...] = (0.25, 0.08)
    keeps: float = 0.1


def swept_depth(
    reference: Picture, others: Sequence[Picture], near: float, far: float, options: SweepOptions = SweepOptions()
) -> NDArray:
    """Return the z-depth (H, W) float32 of a photograph, NaN where fewer than `least` others show a pixel, in the world's unit.

    Args:
        reference: whose depth it is.
        others: to compare it with.
        near, far: least and largest depth.
    """
    inverse = np.linspace(1.0 / far, 1.0 / near, options.planes)
    compared = _Compared.of(reference, others, options.radius)
    grey = compared.grey
    cost = _costs(compared, inverse, options.least)
    total = np.zeros(cost.shape, np.uint16)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        _add_path(cost, grey, dy, dx, options.step, options.jump, options.edge, total)
    place = _best(total, cost)
    found = np.interp(place, np.arange(options.planes), inverse)
    for part in options.finer if len(others) >= options.least else ():
        found = _refined(compared, found, part * (inverse[1] - inverse[0]), options.least, options.keeps)
    return (1.0 / found).astype(np.float32)


class _Compared(NamedTuple):
    """A photograph and those that it is compared with.

    Attributes:
        grey: (H, W) float32; mean, deviation: (H, W) of its windows, whose radius is `radius`.
        others: of each other photograph grey, and K' R K^-1 (3, 3) and K' t (3,) of Eq. D.1.
    """

    grey: NDArray
    mean: NDArray
    deviation: NDArray
    radius: int
    others: list[tuple[NDArray, NDArray, NDArray]]

    @classmethod
    def of(cls, reference: Picture, others: Sequence[Picture], radius: int) -> _Compared:
        grey = np.ascontiguousarray(reference.grey, np.float32)
        mean = _means(grey, radius)
        deviation = np.sqrt(np.maximum(_means(grey.astype(np.float64) ** 2, radius) - mean**2, 0.0))
        rotation, translation = reference.camera_from_world[:, :3], reference.camera_from_world[:, 3]
        seen = []
        for other in others:
            turn = other.camera_from_world[:, :3] @ rotation.T
            move = other.camera_from_world[:, 3] - turn @ translation
            far = other.intrinsics @ turn @ np.linalg.inv(reference.intrinsics)
            seen.append((np.ascontiguousarray(other.grey, np.float32), far, other.intrinsics @ move))
        return cls(grey, mean, deviation, radius, seen)

    def scores(self, inverse: NDArray, out: NDArray) -> None:
        """Correlate with each other photograph, (others, H, W), at inverse depths (H, W)."""
        for (other, turn, move), score in zip(self.others, out, strict=True):
            _correlate(self.grey, self.mean, self.deviation, other, turn, move, inverse, self.radius, score)


def _costs(compared: _Compared, inverse: NDArray, least: int) -> NDArray:
    """(H, W, planes) uint8 costs."""
    shape = compared.grey.shape
    cost = np.full((*shape, len(inverse)), UNKNOWN, np.uint8)
    scores = np.empty((len(compared.others), *shape), np.float32)
    for plane, value in enumerate(inverse):
        compared.scores(np.full(shape, value), scores)
        _merge(scores, least, plane, cost)
    return cost


def _refined(compared: _Compared, found: NDArray, step: float, least: int, keeps: float) -> NDArray:
    """Search inverse depths (H, W) again, by `step`, about those that were found (Eq. D.3).

    Windows lie on the surface that was found, and not on planes in front of the photograph, so that it may be slanted.
    """
    base = _smooth(found, REACH * step)
    offsets = np.arange(-REACH, REACH + 1)
    scores = np.empty((len(compared.others), *base.shape), np.float32)
    alike = np.empty((len(offsets), *base.shape), np.float32)
    for k, offset in enumerate(offsets):
        compared.scores(base + offset * step, scores)
        alike[k] = np.partition(scores, -least, 0)[-least:].mean(0) - keeps * (offset / REACH) ** 2
    best = np.clip(alike.argmax(0), 1, len(offsets) - 2)
    before, here, after = (np.take_along_axis(alike, (best + i)[None], 0)[0] for i in (-1, 0, 1))
    bend = before - 2 * here + after
    between = np.divide(before - after, 2 * bend, out=np.zeros(bend.shape, np.float32), where=bend < 0)
    return base + (offsets[best] + np.clip(between, -1.0, 1.0)) * step


def _smooth(values: NDArray, reach: float, radius: int = 2) -> NDArray:
    """Means (H, W) over windows of what differs from their middle by at most `reach`; NaN stays."""
    height, width = values.shape
    wide = np.pad(values, radius, constant_values=np.nan)
    total, count = np.zeros(values.shape), np.zeros(values.shape)
    for dy in range(2 * radius + 1):
        for dx in range(2 * radius + 1):
            own = wide[dy : dy + height, dx : dx + width]
            with np.errstate(invalid="ignore"):
                near = np.abs(own - values) <= reach
            total += np.where(near, own, 0.0)
            count += near
    return np.divide(total, count, out=np.full(values.shape, np.nan), where=count > 0)


def _means(values: NDArray, radius: int) -> NDArray:
    """Means (H, W) of windows of 2 radius + 1 pixels; at the border of those that exist."""
    total, count = (
        uniform_filter(own.astype(np.float64), 2 * radius + 1, mode="constant") for own in (values, np.ones_like(values))
    )
    return total / count


@njit()
def _correlate(
    grey: NDArray,
    mean: NDArray,
    deviation: NDArray,
    other: NDArray,
    turn: NDArray,
    move: NDArray,
    inverse: NDArray,
    radius: int,
    score: NDArray,
) -> None:
    """Correlation (H, W) of each window with what another photograph shows at inverse depths (H, W); -2 where it does not show
    all of it."""
    height, width = grey.shape
    rows, columns = other.shape
    warped = np.empty((height, width), np.float32)
    known = np.empty((height, width), np.float32)
    h = turn

    # -------- what the other photograph shows at these depths, between its pixels --------
    for y in range(height):
        for x in range(width):
            u, v = x + 0.5, y + 0.5
            q = inverse[y, x]
            w = h[2, 0] * u + h[2, 1] * v + h[2, 2] + q * move[2]
            known[y, x] = 0.0
            warped[y, x] = 0.0
            if not w > 1e-9:  # a depth that is unknown too
                continue
            px = (h[0, 0] * u + h[0, 1] * v + h[0, 2] + q * move[0]) / w - 0.5
            py = (h[1, 0] * u + h[1, 1] * v + h[1, 2] + q * move[1]) / w - 0.5
            if px < 0.0 or py < 0.0 or px > columns - 1.001 or py > rows - 1.001:
                continue
            i, j = int(py), int(px)
            a, b = py - i, px - j
            warped[y, x] = (other[i, j] * (1 - b) + other[i, j + 1] * b) * (1 - a) + (
                other[i + 1, j] * (1 - b) + other[i + 1, j + 1] * b
            ) * a
            known[y, x] = 1.0

    # -------- moments over windows: sums over columns that go down with the rows, and over them along each row --------
    of_column = np.zeros((4, width))
    for y in range(-radius, height):
        first, last = y - radius - 1, y + radius
        if last < height:
            for x in range(width):
                value = warped[last, x]
                of_column[0, x] += value
                of_column[1, x] += value * value
                of_column[2, x] += value * grey[last, x]
                of_column[3, x] += known[last, x]
        if first >= 0:
            for x in range(width):
                value = warped[first, x]
                of_column[0, x] -= value
                of_column[1, x] -= value * value
                of_column[2, x] -= value * grey[first, x]
                of_column[3, x] -= known[first, x]
        if y < 0:
            continue
        rows_in = min(y + radius, height - 1) - max(first, -1)
        own = square = both = whole = 0.0
        for x in range(-radius, width):
            if x + radius < width:
                own += of_column[0, x + radius]
                square += of_column[1, x + radius]
                both += of_column[2, x + radius]
                whole += of_column[3, x + radius]
            if x - radius - 1 >= 0:
                own -= of_column[0, x - radius - 1]
                square -= of_column[1, x - radius - 1]
                both -= of_column[2, x - radius - 1]
                whole -= of_column[3, x - radius - 1]
            if x < 0:
                continue
            count = rows_in * (min(x + radius, width - 1) - max(x - radius - 1, -1))
            if whole < count - 0.5:
                score[y, x] = -2.0
                continue
            middle = own / count
            spread = np.sqrt(max(square / count - middle * middle, 0.0))
            # A window without texture correlates with nothing; noise of 1 % counts as none.
            below = max(spread, 0.01) * max(deviation[y, x], 0.01)
            score[y, x] = min(max((both / count - middle * mean[y, x]) / below, -1.0), 1.0)


@njit()
def _merge(scores: NDArray, least: int, plane: int, cost: NDArray) -> None:
    """Write the cost of one plane: of the mean of the best `least` correlations."""
    count, height, width = scores.shape
    best = np.empty(least, np.float32)
    for y in range(height):
        for x in range(width):
            for k in range(least):
                best[k] = -2.0
            for s in range(count):
                value = scores[s, y, x]
                for k in range(least):
                    if value > best[k]:
                        for m in range(least - 1, k, -1):
                            best[m] = best[m - 1]
                        best[k] = value
                        break
            if best[least - 1] < -1.5:
                continue
            total = 0.0
            for k in range(least):
                total += best[k]
            cost[y, x, plane] = np.uint8(min(round(127.0 * (1.0 - total / least)), 254))


@njit()
def _add_path(cost: NDArray, grey: NDArray, dy: int, dx: int, step: float, jump: float, edge: float, total: NDArray) -> None:
    """Add the least costs of all ways that come to each pixel in one direction (Eq. D.2)."""
    height, width, planes = cost.shape
    last = np.zeros((width, planes), np.float32)
    lines = np.zeros((width, planes), np.float32)
    least_of_last, least_of_line = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for row in range(height):
        y = row if dy >= 0 else height - 1 - row
        for column in range(width):
            x = column if dx >= 0 else width - 1 - column
            py, px = y - dy, x - dx
            starts = py < 0 or py >= height or px < 0 or px >= width
            if dy == 0 and not starts:
                before, floor = lines[px], least_of_line[px]
            else:
                before, floor = last[px if not starts else x], least_of_last[px if not starts else x]
            own = lines[x]
            limit = jump
            if not starts:
                limit = max(jump / (1.0 + abs(grey[y, x] - grey[py, px]) / edge), step)
            lowest = 1e30
            for d in range(planes):
                value = np.float32(cost[y, x, d]) if cost[y, x, d] != 255 else np.float32(127.0)
                if not starts:
                    reach = min(before[d], floor + limit)
                    if d > 0:
                        reach = min(reach, before[d - 1] + step)
                    if d < planes - 1:
                        reach = min(reach, before[d + 1] + step)
                    value += reach - floor
                own[d] = value
                lowest = min(lowest, value)
                total[y, x, d] += np.uint16(value)
            least_of_line[x] = lowest
        if dy != 0:
            last[:] = lines
            least_of_last[:] = least_of_line


@njit()
def _best(total: NDArray, cost: NDArray) -> NDArray:
    """(H, W) float64 place of the least total cost, between planes by a parabola; NaN where no plane is known."""
    height, width, planes = total.shape
    out = np.full((height, width), np.nan)
    for y in range(height):
        for x in range(width):
            at = 0
            for d in range(planes):
                if total[y, x, d] < total[y, x, at]:
                    at = d
            if cost[y, x, at] == 255 or at == 0 or at == planes - 1:
                continue
            before, here, after = float(total[y, x, at - 1]), float(total[y, x, at]), float(total[y, x, at + 1])
            bend = before - 2 * here + after
            out[y, x] = at + (0.5 * (before - after) / bend if bend > 0 else 0.0)
    return out
