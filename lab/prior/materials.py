"""What surface looks like at a point: one row of numbers per object, evaluated alike by NumPy and by the renderer.

The product's solid textures (`lab.rooms.patterns`) are the base. Added are patterns of things in rooms, layers of
pictures, dirt and uneven gloss:

    albedo = (1 - dirt n^2) mix(mix(first, second, t), third, s)      or (1 - dirt n^2) first * picture
    roughness = r_0 + r_t t + r_s s + uneven (n' - 1/2)               or with t = roughness of the picture - 1/2

with value noise n, n' in [0, 1]. A picture is projected along the third axis of the object's frame, sheared, so that the
sides of a solid are not smeared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from iif_core.numerics.xp import Namespace
from lab.rooms import patterns

Array = np.ndarray
Colour = tuple[float, float, float]

_ADDED = ("text", "weave", "spots", "ramp", "patches", "flakes", "zigzag")
KINDS = (*patterns.KINDS, *_ADDED, "picture")
COLUMNS = (
    *(f"{colour}_{c}" for colour in ("first", "second", "third") for c in "rgb"),
    *("r_0", "r_t", "r_s", "metallic", "kind", "size_u", "size_v"),
    *(f"{axis}_{c}" for axis in "uvw" for c in "xyz1"),
    *("grain_u", "grain_v", "grain_w", "fine", "amount"),
    *("dirt", "dirt_f", "uneven", "uneven_f", "layer"),
)
"""The entries of a row; the first ones are those that `patterns.evaluate` asks for."""
WIDTH = -(-len(COLUMNS) // 4) * 4
"""Length of a row: whole groups of four, because one aligned read fetches four entries."""
DARKEST, BRIGHTEST, SMOOTHEST = 0.006, 0.97, 0.03
"""Bounds of albedo and roughness: what rooms hold, and what the product's transport renders without fireflies."""
LAYER = 128
"""Edge of a layer in pixels."""
_SHEAR = 0.7


def row(
    first: Sequence[float],
    second: Sequence[float] | None = None,
    third: Sequence[float] | None = None,
    *,
    rough: tuple[float, float, float] = (0.6, 0.0, 0.0),
    metallic: float = 0.0,
    kind: str = "plain",
    size: tuple[float, float] = (0.1, 0.1),
    axes: tuple[Sequence[float], Sequence[float]] = ((1, 0, 0), (0, 1, 0)),
    origin: Sequence[float] = (0, 0, 0),
    grain: Sequence[float] = (6, 6, 6),
    **more: float,
) -> Array:
    """Write one material as a row.

    Args:
        first, second, third: linear base colours; None repeats the colour before. Of a `picture`, `first` multiplies its colour.
        rough: (r_0, r_t, r_s), perceptual.
        metallic: [0, 1].
        kind: one of KINDS.
        size: metres along u and v; their meaning depends on the kind. Of a `picture`, its extent before it is mirrored.
        axes: directions of u and v in the world, orthonormal.
        origin: (3,) metres, where u = v = w = 0.
        grain: (3,) cycles per metre of the coarse noise.
        **more: fine (3), amount (1), dirt (0), dirt_f (2), uneven (0), uneven_f (3), layer (0); frequencies are cycles per metre.

    Returns:
        (WIDTH,) float32 in the order of COLUMNS.
    """
    second = first if second is None else second
    third = second if third is None else third
    rest = {"fine": 3.0, "amount": 1.0, "dirt": 0.0, "dirt_f": 2.0, "uneven": 0.0, "uneven_f": 3.0, "layer": 0.0}
    if unknown := set(more) - set(rest):
        raise TypeError(f"row: unknown entries {sorted(unknown)}; known: {', '.join(rest)}")
    u, v = (np.asarray(a, float) for a in axes)
    frame = [x for axis in (u, v, np.cross(u, v)) for x in (*axis, -float(axis @ np.asarray(origin, float)))]
    out = np.zeros(WIDTH, np.float32)
    values = [*first, *second, *third, *rough, metallic, KINDS.index(kind), *size, *frame, *grain, *(rest | more).values()]
    out[: len(values)] = values
    return out


def entry(material: Array, name: str) -> float:
    """Return one entry of a row by name."""
    return float(material[COLUMNS.index(name)])


Column = Callable[[str], Any]
Texel = Callable[[Any, Any, Any], tuple[Any, Any, Any, Any]]
"""(layer, x, y) -> linear red, green, blue and roughness; x and y in extents of the picture."""


def evaluate(xp: Namespace, point: Sequence[Any], column: Column, texel: Texel | None) -> tuple[tuple[Any, ...], Any, Any]:
    """Evaluate materials.

    Args:
        xp: array namespace.
        point: world coordinates x, y, z, metres.
        column: gives the entries of the points' objects by name.
        texel: looks up layers; None where no material is a picture.

    Returns:
        Albedo (linear r, g, b), perceptual roughness, metallic.
    """
    x, y, z = point
    kind = column("kind")
    albedo, rough, metallic = patterns.evaluate(xp, point, column)
    local = [column(f"{a}_x") * x + column(f"{a}_y") * y + column(f"{a}_z") * z + column(f"{a}_1") for a in "uvw"]
    t, s = _blends(xp, local, column)
    own = kind >= float(KINDS.index(_ADDED[0]))
    mixed = [(column(f"first_{c}") * (1 - t) + column(f"second_{c}") * t) * (1 - s) + column(f"third_{c}") * s for c in "rgb"]
    albedo = [xp.where(own, m, a) for m, a in zip(mixed, albedo, strict=True)]
    rough = xp.where(own, column("r_0") + column("r_t") * t + column("r_s") * s, rough)
    if texel is not None:
        u, v, w = local
        shown = kind == float(KINDS.index("picture"))
        size = column("size_u"), column("size_v")
        *colour, gloss = texel(column("layer"), (u + _SHEAR * w) / size[0], (v + _SHEAR * w) / size[1])
        albedo = [xp.where(shown, column(f"first_{c}") * q, a) for c, q, a in zip("rgb", colour, albedo, strict=True)]
        rough = xp.where(shown, column("r_0") + column("r_t") * (gloss - 0.5), rough)
    f, g = column("dirt_f"), column("uneven_f")
    cloud = patterns.noise(xp, x * f + 3.3, y * f + 7.7, z * f + 1.1)
    clean = 1 - column("dirt") * cloud * cloud
    rough = rough + column("uneven") * (patterns.noise(xp, x * g + 5.1, y * g + 2.2, z * g + 9.4) - 0.5)
    bounded = tuple(xp.minimum(xp.maximum(clean * a, DARKEST), BRIGHTEST) for a in albedo)
    return bounded, xp.minimum(xp.maximum(rough, SMOOTHEST), 1.0), metallic


def _blends(xp: Namespace, local: Sequence[Any], column: Column) -> tuple[Any, Any]:
    """Blend weights (t, s) in [0, 1] of the added kinds."""
    u, v, w = local
    grain = [column(f"grain_{a}") for a in "uvw"]
    fine, kind = column("fine"), column("kind")
    coarse = patterns.noise(xp, *(q * f for q, f in zip((u, v, w), grain, strict=True)))
    detail = patterns.noise(xp, *(q * f * fine + 11.5 for q, f in zip((u, v, w), grain, strict=True)))
    zero = 0 * u
    one = 1 + zero
    fu, fv = u / column("size_u"), v / column("size_v")
    i, j = xp.floor(fu), xp.floor(fv)
    du, dv = fu - i, fv - j
    # Text: cells of random ink, four to a word; some lines are headings in the third colour.
    written = (_hash(xp, i, j, 3 + zero) > 0.3) & (_hash(xp, xp.floor(i * 0.25), j, 5 + zero) > 0.22)
    ink = xp.where(written & (dv < 0.62) & (dv > 0.15) & (du < 0.8), one, zero)
    heading = xp.where(_hash(xp, xp.floor(j * 0.2), 2 + zero, zero) > 0.85, ink, zero)
    # Spots: one disc of random place and size in each cell.
    cu, cv = du - 0.3 - 0.4 * _hash(xp, i, j, 11 + zero), dv - 0.3 - 0.4 * _hash(xp, i, j, 13 + zero)
    radius = 0.08 + 0.22 * _hash(xp, i, j, 17 + zero)
    disc = cu * cu + cv * cv < radius * radius
    band = fv + 0.7 * xp.abs(2 * du - 1)
    choices = {
        "text": (ink, heading),
        "weave": (0.5 + 0.5 * xp.sin(2 * np.pi * fu) * xp.sin(2 * np.pi * fv), zero),
        "spots": (xp.where(disc, one, 0.15 * detail), xp.where(disc & (_hash(xp, i, j, 19 + zero) > 0.5), one, zero)),
        "ramp": (xp.minimum(xp.maximum(fv, 0.0), 1.0), zero),
        "patches": (_hash(xp, i, j, 23 + zero), xp.where(_hash(xp, i, j, 29 + zero) > 0.6, _hash(xp, i, j, 31 + zero), zero)),
        "flakes": (xp.where(coarse > 0.55, one, zero), xp.where(detail > 0.72, one, zero)),
        "zigzag": (xp.where(band - 2 * xp.floor(band * 0.5) < 1, one, zero), 0.2 * detail),
    }
    t, s = zero, zero
    for name, (choice_t, choice_s) in choices.items():
        chosen = kind == float(KINDS.index(name))
        t, s = xp.where(chosen, choice_t, t), xp.where(chosen, choice_s, s)
    return t, s


def _hash(xp: Namespace, i: Any, j: Any, k: Any) -> Any:
    """A number in [0, 1] for three whole numbers: a permutation polynomial modulo 289, exact in float32."""

    def modulo(a: Any) -> Any:
        return a - 289 * xp.floor((a + 0.5) * (1 / 289))

    out = modulo(i)
    for other in (j, k, None):
        out = modulo((34 * out + 1) * out)
        out = out if other is None else modulo(out + modulo(other))
    return out * (1 / 288)


def layer_of(texture: Array, rng: np.random.Generator) -> Array:
    """Cut a random square of a texture (H, W, 4) uint8 and resize it: (LAYER, LAYER, 4) float32, linear colour and roughness."""
    from PIL import Image

    from iif_core.numerics.color import linear_from_srgb

    edge = int(rng.uniform(0.5, 1.0) * min(texture.shape[:2]))
    top, left = (int(rng.integers(0, side - edge + 1)) for side in texture.shape[:2])
    piece = Image.fromarray(np.ascontiguousarray(texture[top : top + edge, left : left + edge]), "RGBA")
    bands = [np.asarray(band.resize((LAYER, LAYER), Image.Resampling.BILINEAR), np.float32) / 255 for band in piece.split()]
    turned = np.rot90(np.stack(bands, -1), int(rng.integers(4)))
    return np.concatenate([linear_from_srgb(turned[..., :3]), turned[..., 3:]], -1).astype(np.float32)


class Materials:
    """The materials of a room.

    Args:
        rows: (n, WIDTH), one for each object.
        layers: (LAYER, LAYER, 4) each, that `picture` rows name by number.
    """

    def __init__(self, rows: Sequence[Array], layers: Sequence[Array] = ()):
        self.rows = np.stack(rows)
        self.layers = np.stack(layers) if len(layers) else None

    def numpy(self, points: Array, object_id: Array) -> tuple[Array, Array, Array]:
        """Return albedo (n, 3) linear, roughness (n,) and metallic (n,), float32, at points (n, 3) of objects (n,)."""
        from iif_core.numerics.xp import NUMPY

        columns = dict(zip(COLUMNS, self.rows.T.copy(), strict=False))
        texel = None if self.layers is None else _texel(NUMPY, lambda i: self.layers.reshape(-1, 4)[i.astype(np.int64)].T)
        albedo, rough, metal = evaluate(NUMPY, np.asarray(points, np.float32).T, lambda name: columns[name][object_id], texel)
        return np.stack(albedo, 1).astype(np.float32), rough.astype(np.float32), metal.astype(np.float32)

    def drjit(self) -> Callable[..., tuple[Any, Any, Any]]:
        """Return the renderer's `material(point, face, object_id, active)` for the active Mitsuba variant."""
        import drjit as dr
        import mitsuba as mi

        from iif_core.light.transport.arrays import on_device
        from iif_core.numerics.xp import DRJIT

        table = on_device(self.rows.ravel())
        # A room without pictures gets an empty layer, so that all rooms share one kernel.
        pixels = on_device((np.zeros((1, LAYER, LAYER, 4), np.float32) if self.layers is None else self.layers).ravel())

        def material(point: Any, face: Any, object_id: Any, active: Any) -> tuple[Any, Any, Any]:
            first = mi.UInt32(object_id) * (WIDTH // 4)
            groups = [dr.gather(mi.Vector4f, table, first + k, active) for k in range(WIDTH // 4)]

            def column(name: str) -> Any:
                return groups[COLUMNS.index(name) // 4][COLUMNS.index(name) % 4]

            shown = active & (column("kind") == float(KINDS.index("picture")))
            texel = _texel(DRJIT, lambda i: dr.gather(mi.Vector4f, pixels, mi.UInt32(i), shown))
            albedo, rough, metal = evaluate(DRJIT, (point.x, point.y, point.z), column, texel)
            return mi.Color3f(*albedo), rough, metal

        return material

    def at(self, points: Array, object_id: Array) -> tuple[Array, Array, Array]:
        """Return what `numpy` returns, computed on the active device: faster by far, and equal up to rounding."""
        import mitsuba as mi

        from iif_core.light.transport.arrays import on_device, to_numpy, vectors

        place = vectors(mi.Point3f, np.asarray(points, np.float32))
        own = on_device(np.asarray(object_id, np.uint32), mi.UInt32)
        albedo, rough, metal = self.drjit()(place, None, own, mi.Bool(True))
        return to_numpy(albedo), to_numpy(rough), to_numpy(metal)


def _texel(xp: Namespace, fetch: Callable[[Any], Any]) -> Texel:
    """Bilinear look-up in layers that are mirrored at their edges; `fetch(index)` gives four values per pixel."""

    def texel(layer: Any, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
        corner, part = [], []
        for q in (x, y):
            q = q - 2 * xp.floor(q * 0.5)
            q = xp.minimum(q, 2 - q) * (LAYER - 1)
            corner.append(xp.minimum(xp.floor(q), LAYER - 2.0))
            part.append(q - corner[-1])
        (i, j), (a, b) = corner, part
        # Whole numbers below 2^24 are exact in float32: room for a thousand layers.
        first = layer * (LAYER * LAYER) + j * LAYER + i
        low = [p * (1 - a) + q * a for p, q in zip(fetch(first), fetch(first + 1), strict=True)]
        high = [p * (1 - a) + q * a for p, q in zip(fetch(first + LAYER), fetch(first + LAYER + 1), strict=True)]
        return tuple(p * (1 - b) + q * b for p, q in zip(low, high, strict=True))

    return texel
