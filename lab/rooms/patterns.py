"""Solid textures, written once for NumPy (truth maps) and Dr.Jit (renderer) on `iif_core.numerics.xp`.

The material of an object is a row of numbers. A pattern computes two blend weights (t, s) at a point in the object's frame:

    albedo = mix(mix(first, second, t), third, s)      roughness = r0 + r_t t + r_s s      metallic = m

Randomness is value noise over a permutation polynomial of integers below 2^24, which float32 represents exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from iif_core.numerics.xp import Namespace

Colour = tuple[float, float, float]
KINDS = ("plain", "wood", "cells", "checks", "marble", "terrazzo", "stripes", "rug", "painting", "rings", "spines")

_SQUARE = {"z": ((1, 0, 0), (0, 1, 0)), "y": ((1, 0, 0), (0, 0, 1)), "x": ((0, 1, 0), (0, 0, 1))}


@dataclass(frozen=True)
class Material:
    """The material of one object.

    Attributes:
        first, second, third: linear base colours that the pattern mixes; None repeats the colour before.
        roughness: (r0, r_t, r_s), perceptual; the sum must stay in [0.02, 1].
        metallic: in [0, 1].
        kind: one of KINDS.
        size: sizes of the pattern in metres along u and v of the frame; their meaning depends on the kind.
        axes: directions of u and v in the world (orthonormal); w = u x v.
        origin: where (u, v, w) = 0.
        grain: cycles per metre of the coarse noise along u, v, w.
        fine: frequency of the fine noise as a multiple of `grain`.
        amount: contribution of the noise to `plain` and `cells`, 0 to 1.
    """

    first: Colour
    second: Colour | None = None
    third: Colour | None = None
    roughness: tuple[float, float, float] = (0.6, 0.0, 0.0)
    metallic: float = 0.0
    kind: str = "plain"
    size: tuple[float, float] = (0.1, 0.1)
    axes: tuple[Sequence[float], Sequence[float]] = _SQUARE["z"]
    origin: Sequence[float] = (0.0, 0.0, 0.0)
    grain: tuple[float, float, float] = (6.0, 6.0, 6.0)
    fine: float = 3.0
    amount: float = 1.0


def facing(axis: str) -> tuple[Sequence[float], Sequence[float]]:
    """Return the (u, v) axes of a surface square to the world axis `axis`: v points up on walls and along y on floors."""
    return _SQUARE[axis]


_COLUMNS = (
    *(f"{colour}_{c}" for colour in ("first", "second", "third") for c in "rgb"),
    *("r_0", "r_t", "r_s", "metallic", "kind", "size_u", "size_v"),
    *(f"{axis}_{c}" for axis in "uvw" for c in "xyz1"),
    *("grain_u", "grain_v", "grain_w", "fine", "amount"),
)


def _row(material: Material) -> list[float]:
    if material.kind not in KINDS:
        raise ValueError(f"material kind {material.kind!r}; known: {', '.join(KINDS)}")
    second = material.second or material.first
    u, v = (np.asarray(a, float) for a in material.axes)
    origin = np.asarray(material.origin, float)
    frame = [value for axis in (u, v, np.cross(u, v)) for value in (*axis, -float(axis @ origin))]
    return [
        *material.first,
        *second,
        *(material.third or second),
        *material.roughness,
        material.metallic,
        float(KINDS.index(material.kind)),
        *material.size,
        *frame,
        *material.grain,
        material.fine,
        material.amount,
    ]


@dataclass(frozen=True)
class MaterialTable:
    """The materials of all objects, in order of their ids: `numpy` evaluates them for truth maps, `drjit` for the renderer."""

    materials: tuple[Material, ...]
    _columns: dict[str, np.ndarray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rows = np.array([_row(m) for m in self.materials], np.float32).reshape(-1, len(_COLUMNS))
        object.__setattr__(self, "_columns", {name: rows[:, k].copy() for k, name in enumerate(_COLUMNS)})

    def numpy(self, points: np.ndarray, object_id: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return albedo (n, 3) linear, perceptual roughness (n,) and metallic (n,), float32, at points (n, 3) of objects (n,)."""
        from iif_core.numerics.xp import NUMPY

        points = np.asarray(points, np.float32).reshape(-1, 3)
        albedo, roughness, metallic = evaluate(NUMPY, points.T, lambda name: self._columns[name][object_id])
        return np.stack(albedo, 1), roughness, metallic

    def drjit(self) -> Callable[..., tuple[Any, Any, Any]]:
        """Return the renderer's `material(point, face, object_id, active) -> (base_color, roughness, metallic)`.

        It works on the active Mitsuba variant.
        """
        import drjit as dr
        import mitsuba as mi

        from iif_core.numerics.xp import DRJIT

        # Rows are padded to whole groups of four, because one aligned read fetches four entries.
        width = -(-len(_COLUMNS) // 4)
        rows = np.zeros((len(self.materials), 4 * width), np.float32)
        rows[:, : len(_COLUMNS)] = np.stack([self._columns[name] for name in _COLUMNS], 1)
        table = mi.Float(rows.ravel())

        def material(point: Any, face: Any, object_id: Any, active: Any) -> tuple[Any, Any, Any]:
            first = mi.UInt32(object_id) * width
            groups = [dr.gather(mi.Vector4f, table, first + k, active) for k in range(width)]

            def column(name: str) -> Any:
                position = _COLUMNS.index(name)
                return groups[position // 4][position % 4]

            albedo, roughness, metallic = evaluate(DRJIT, (point.x, point.y, point.z), column)
            return mi.Color3f(*albedo), roughness, metallic

        return material


def evaluate(xp: Namespace, point: Sequence[Any], column: Callable[[str], Any]) -> tuple[tuple[Any, Any, Any], Any, Any]:
    """Return (albedo, roughness, metallic) at world points (x, y, z); `column(name)` gives the entries of their objects."""
    x, y, z = point
    u, v, w = (column(f"{a}_x") * x + column(f"{a}_y") * y + column(f"{a}_z") * z + column(f"{a}_1") for a in "uvw")
    frequency = [column(f"grain_{a}") for a in "uvw"]
    coarse = noise(xp, *(q * f for q, f in zip((u, v, w), frequency, strict=True)))
    fine = column("fine")
    detail = noise(xp, *(q * f * fine + 11.5 for q, f in zip((u, v, w), frequency, strict=True)))
    t, s = _blends(xp, (u, v, w), coarse, detail, column)
    t, s = (xp.minimum(xp.maximum(b, 0.0), 1.0) for b in (t, s))
    albedo = tuple(
        (column(f"first_{c}") * (1 - t) + column(f"second_{c}") * t) * (1 - s) + column(f"third_{c}") * s for c in "rgb"
    )
    roughness = column("r_0") + column("r_t") * t + column("r_s") * s
    return albedo, xp.minimum(xp.maximum(roughness, 0.02), 1.0), column("metallic")


def _blends(xp: Namespace, local: Sequence[Any], coarse: Any, detail: Any, column: Callable[[str], Any]) -> tuple[Any, Any]:
    u, v, _ = local
    kind, su, sv, amount = (column(name) for name in ("kind", "size_u", "size_v", "amount"))
    zero = 0 * u
    cloud = 0.65 * coarse + 0.35 * detail

    # wood: contour lines of stretched noise, with fine streaks
    rings = 3.5 * coarse + 0.25 * detail
    grain = xp.abs(2 * (rings - xp.floor(rings)) - 1)
    grain = 0.45 * grain * grain * (3 - 2 * grain) + 0.3 * coarse + 0.25 * detail

    # cells of su x sv: boards (rows shifted at random, seams of 5 mm) or tiles (odd rows shifted by half, grout of 8 mm)
    row = xp.floor(v / sv)
    odd = row - 2 * xp.floor(row * 0.5)
    boards = su > 4 * sv
    along = u / su + xp.where(boards, _hash(xp, row, 3 + zero, zero), xp.where(su > sv, 0.5 * odd, zero))
    col = xp.floor(along)
    tone = _hash(xp, col, row, 7 + zero)
    edge = xp.minimum(_to_edge(xp, along - col) * su, _to_edge(xp, v / sv - row) * sv)
    seam = xp.where(edge < xp.where(boards, 0.0025, 0.004), 1.0 + zero, zero)
    cells = xp.where(boards, 0.45 * tone + 0.55 * grain, tone * (1 - amount) + amount * cloud)

    # checks: gingham; an odd column and an odd row each add half of the second colour
    column_index = xp.floor(u / su)
    checks = 0.5 * (_parity(xp, column_index) + odd)

    # marble: veins where noise crosses a half; terrazzo: chips where noise is high
    warped = coarse + 0.3 * (detail - 0.5)
    vein = xp.maximum(1 - xp.abs(warped - 0.5) * 18, 0.0)
    chips = _step(xp, 0.68, 0.72, detail)

    # stripes along u of width sv; every fourth band shows the third colour
    quarter = row - 4 * xp.floor(row * 0.25)
    stripe_s = xp.where(quarter == 2, 1.0 + zero, zero)

    # rug: nested frames and a lattice of diamonds; size = half extents
    across = xp.maximum(xp.abs(u) / su, xp.abs(v) / sv)
    frame = xp.floor(across * 12)
    lattice = xp.abs(2 * (u / 0.24 - xp.floor(u / 0.24)) - 1) + xp.abs(2 * (v / 0.24 - xp.floor(v / 0.24)) - 1)
    border = frame >= 9
    rug_t = xp.where(border, xp.where(frame == 10, 1.0 + zero, zero), xp.where(lattice < 0.75, 1.0 + zero, 0.12 * detail))
    rug_s = xp.where(border, zero, xp.where(xp.abs(lattice - 1.1) < 0.12, 1.0 + zero, zero))

    # painting: sky, a sun and two ridges; size = half extents
    pu, pv = u / su, v / sv
    far = 0.05 + 0.16 * xp.sin(4.1 * pu + 0.6) + 0.06 * xp.sin(9.7 * pu)
    near = -0.42 + 0.13 * xp.sin(3.1 * pu + 2.2) + 0.03 * detail
    sun = (pu - 0.38) * (pu - 0.38) * (su * su) / (sv * sv) + (pv - 0.5) * (pv - 0.5)
    paint_t = xp.where(pv < near, 1.0 + zero, xp.where(pv < far, 0.62 + 0.2 * detail, 0.25 - 0.25 * pv + 0.1 * coarse))
    paint_s = xp.where(pv < near, 0.18 * detail, xp.where(pv < far, zero, xp.where(sun < 0.05, 1.0 + zero, zero)))

    # rings about w: a band from radius su to sv in the second colour
    radius = xp.sqrt(u * u + v * v)
    band = xp.where((radius > su) & (radius < sv), 1.0 + zero, zero)

    # spines: books side by side along u, each with its own colour and a band across
    book = _hash(xp, column_index, 5 + zero, zero)
    second = _hash(xp, column_index, 9 + zero, zero)
    title = xp.where(xp.abs(v - sv) < 0.012, 0.8 + zero, zero)

    plain = amount * cloud
    t, s = plain, zero
    choices = {
        "wood": (grain, zero),
        "cells": (cells, seam),
        "checks": (checks, 0.1 * detail),
        "marble": (cloud, 0.8 * vein),
        "terrazzo": (_step(xp, 0.55, 0.6, coarse), chips),
        "stripes": (odd, stripe_s),
        "rug": (rug_t, rug_s),
        "painting": (paint_t, paint_s),
        "rings": (band, zero),
        "spines": (book, xp.maximum(xp.where(second > 0.6, 0.7 + zero, zero), title)),
    }
    for name, (choice_t, choice_s) in choices.items():
        chosen = kind == float(KINDS.index(name))
        t, s = xp.where(chosen, choice_t, t), xp.where(chosen, choice_s, s)
    return t, s


def _to_edge(xp: Namespace, fraction: Any) -> Any:
    return xp.minimum(fraction, 1 - fraction)


def _parity(xp: Namespace, index: Any) -> Any:
    return index - 2 * xp.floor(index * 0.5)


def _step(xp: Namespace, low: float, high: float, x: Any) -> Any:
    x = xp.minimum(xp.maximum((x - low) * (1 / (high - low)), 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _permute(xp: Namespace, x: Any) -> Any:
    """(34 x + 1) x mod 289 of integers 0 <= x < 578, exact in float32 thanks to the first reduction."""
    x = xp.where(x >= 289, x - 289, x)
    x = (34 * x + 1) * x
    return x - 289 * xp.floor((x + 0.5) * (1 / 289))


def _modulo(xp: Namespace, i: Any) -> Any:
    return i - 289 * xp.floor((i + 0.5) * (1 / 289))


def _hash(xp: Namespace, i: Any, j: Any, k: Any) -> Any:
    """Return a number in [0, 1] for three integers."""
    h = _permute(xp, _modulo(xp, i))
    h = _permute(xp, h + _modulo(xp, j))
    return _permute(xp, h + _modulo(xp, k)) * (1 / 288)


def noise(xp: Namespace, x: Any, y: Any, z: Any) -> Any:
    """Compute value noise: random values at the integers, smoothly interpolated, with stretched contrast.

    Args:
        xp: array namespace.
        x, y, z: coordinates; the noise has about one cycle per unit.

    Returns:
        Values in [0, 1] of mean 1/2.
    """
    i, j, k = xp.floor(x), xp.floor(y), xp.floor(z)
    fx, fy, fz = (f * f * (3 - 2 * f) for f in (x - i, y - j, z - k))
    i0, j0, k0 = (_modulo(xp, c) for c in (i, j, k))
    i1, j1, k1 = (_modulo(xp, c + 1) for c in (i, j, k))
    plane = []
    for a in (_permute(xp, i0), _permute(xp, i1)):
        lines = []
        for b in (_permute(xp, a + j0), _permute(xp, a + j1)):
            low, high = _permute(xp, b + k0), _permute(xp, b + k1)
            lines.append(low + fz * (high - low))
        plane.append(lines[0] + fy * (lines[1] - lines[0]))
    value = (plane[0] + fx * (plane[1] - plane[0])) * (1 / 288)
    return xp.minimum(xp.maximum(0.5 + 1.5 * (value - 0.5), 0.0), 1.0)
