"""Which materials rooms hold: colours, gloss, patterns, metals, drawn at random.

Walls and ceilings are mostly white, off-white, grey or beige, and saturated colours are rare, as in real rooms. One room in
WILD_ROOMS draws all tones alike, so that the network does not take every colour for light.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field

import numpy as np

from iif_core.numerics.color import linear_from_srgb
from lab.prior import materials
from lab.prior.assets import Assets, measured_materials
from lab.prior.materials import DARKEST, Colour
from lab.rooms import patterns

Rng = np.random.Generator

WILD_ROOMS = 0.15
WHITEST = 0.92
"""Highest albedo of paint; polished metals may reflect more."""
_TONES = ("white", "grey", "beige", "dark", "pastel", "strong", "brown", "any")
TONE_SHARES = {
    "thing": (0.22, 0.19, 0.15, 0.15, 0.06, 0.06, 0.15, 0.02),
    "wall": (0.50, 0.18, 0.17, 0.03, 0.07, 0.03, 0.01, 0.01),
    "ceiling": (0.84, 0.06, 0.07, 0.00, 0.01, 0.00, 0.02, 0.00),
    "floor": (0.08, 0.25, 0.24, 0.10, 0.02, 0.03, 0.27, 0.01),
    "wild": (0.14, 0.14, 0.12, 0.12, 0.12, 0.14, 0.12, 0.10),
}
"""Shares of the tones (in the order white, grey, beige, dark, pastel, strong, brown, any) by place; `wild` is for wild rooms."""
_CLASSES = ("paint", "cloth", "wood", "ceramic", "metal", "stone", "print", "tiles", "picture", "measured")
CLASS_SHARES = {
    "thing": (0.27, 0.05, 0.14, 0.11, 0.15, 0.05, 0.08, 0.03, 0.06, 0.06),
    "thin": (0.22, 0.00, 0.13, 0.05, 0.52, 0.00, 0.00, 0.00, 0.00, 0.08),
    "wall": (0.68, 0.02, 0.06, 0.00, 0.01, 0.03, 0.05, 0.09, 0.06, 0.00),
    "floor": (0.10, 0.15, 0.32, 0.00, 0.01, 0.10, 0.03, 0.17, 0.12, 0.00),
    "ceiling": (0.90, 0.00, 0.04, 0.00, 0.01, 0.01, 0.00, 0.02, 0.02, 0.00),
    "cloth": (0.00, 0.72, 0.00, 0.00, 0.00, 0.00, 0.20, 0.00, 0.08, 0.00),
    "flat": (0.10, 0.08, 0.05, 0.00, 0.00, 0.03, 0.44, 0.00, 0.30, 0.00),
    "leaf": (0.90, 0.00, 0.00, 0.10, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
}
"""Shares of the classes of materials by place; `thin` are legs, handles, taps, rails; `flat` are prints and pictures."""
MATTE_SHARES = {
    "wall": 0.55,
    "ceiling": 0.65,
    "paint": 0.3,
    "cloth": 0.6,
    "wood": 0.15,
    "stone": 0.2,
    "print": 0.35,
    "picture": 0.35,
}
"""Shares of the surfaces without any gloss (roughness 1): of painted, papered and pictured walls and ceilings, and of classes of
materials elsewhere. Emulsion paint, plaster, paper, unglazed clay, untreated wood and most cloth are Lambertian to the eye."""
_PRINTS = ("text", "spots", "ramp", "patches", "flakes", "zigzag", "checks", "stripes", "rug", "painting", "marble", "spines")


def from_hsv(hue: float, saturation: float, value: float) -> Colour:
    """Return the linear colour of an HSV colour whose RGB is sRGB-encoded, within the bounds of albedo."""
    encoded = colorsys.hsv_to_rgb(hue % 1, min(max(saturation, 0), 1), min(max(value, 0), 1))
    return tuple(float(c) for c in np.clip(linear_from_srgb(np.array(encoded)), DARKEST, WHITEST))


def near(rng: Rng, colour: Colour, amount: float) -> Colour:
    """Draw a colour near another: log-normal factors of spread `amount` for all channels and 0.35 `amount` for each."""
    factors = np.exp(amount * rng.standard_normal() + 0.35 * amount * rng.standard_normal(3))
    return tuple(float(c) for c in np.clip(np.asarray(colour) * factors, DARKEST, WHITEST))


def of_tone(rng: Rng, tone: str) -> Colour:
    """Draw a linear colour of a tone."""
    u = rng.random
    match tone:
        case "white":  # off-whites are warm more often than cool
            return from_hsv(0.05 + 0.12 * u() if u() < 0.7 else u(), 0.09 * u() ** 1.5, 0.84 + 0.14 * u())
        case "grey":
            return from_hsv(u(), 0.09 * u() ** 1.5, 0.25 + 0.6 * u())
        case "beige":
            return from_hsv(0.06 + 0.10 * u(), 0.08 + 0.25 * u(), 0.6 + 0.35 * u())
        case "dark":
            return from_hsv(u(), 0.5 * u() ** 2, 0.06 + 0.26 * u())
        case "pastel":
            return from_hsv(u(), 0.12 + 0.25 * u(), 0.7 + 0.28 * u())
        case "strong":
            return from_hsv(u(), 0.5 + 0.48 * u(), 0.3 + 0.65 * u())
        case "brown":
            return from_hsv(0.04 + 0.06 * u(), 0.35 + 0.4 * u(), 0.22 + 0.6 * u())
        case "any":
            return tuple(float(c) for c in rng.uniform(0.01, 0.9, 3))
    raise ValueError(f"tone {tone!r}; known: {', '.join(_TONES)}")


@dataclass
class Palette:
    """The materials of one room: a few colours that come again, and layers of pictures.

    Attributes:
        rng: of the room.
        assets: what pictures are cut from.
        wild: whether all tones are alike likely.
        colours: colours that come again.
        layers: pictures that materials of this room show, cut when they are first drawn.
    """

    rng: Rng
    assets: Assets
    wild: bool = False
    colours: list[Colour] = field(default_factory=list)
    layers: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.wild = bool(self.rng.random() < WILD_ROOMS)
        self.colours = [self.colour() for _ in range(self.rng.integers(3, 8))]

    def colour(self, place: str = "thing") -> Colour:
        """Draw a linear colour for a place (a key of TONE_SHARES; any other place counts as `thing`)."""
        shares = TONE_SHARES["wild" if self.wild else place if place in TONE_SHARES else "thing"]
        return of_tone(self.rng, str(self.rng.choice(_TONES, p=shares)))

    def material(self, place: str = "thing", face: str | None = None) -> np.ndarray:
        """Draw a material.

        Args:
            place: a key of CLASS_SHARES, or `mirror` or `gloss` (screens, lacquer: dielectric and very smooth).
            face: axis `x`, `y` or `z` that the surface is square to; None = any.

        Returns:
            (WIDTH,) float32 row.
        """
        rng, u = self.rng, self.rng.random
        if place == "mirror":
            return materials.row(of_tone(rng, "white"), rough=(float(rng.uniform(0.03, 0.12)), 0, 0), metallic=1.0)
        if place == "gloss":
            tone = of_tone(rng, "dark") if u() < 0.6 else self.colour()
            return materials.row(tone, rough=(float(rng.uniform(0.03, 0.14)), 0, 0))
        kind = str(rng.choice(_CLASSES, p=CLASS_SHARES[place]))
        if kind == "picture" and not self.assets.textures:
            kind = "print" if place == "flat" else "paint"
        if place == "leaf":
            base = from_hsv(rng.uniform(0.18, 0.42), rng.uniform(0.3, 0.8), rng.uniform(0.2, 0.7))
        else:
            base = self._pick(place)
        draw = getattr(self, f"_{kind}")
        return draw(base, place, self._common(face))

    def _pick(self, place: str) -> Colour:
        """A colour that comes again, or a new one; walls, floors and ceilings always get a new one."""
        again = place not in ("wall", "ceiling", "floor") and self.rng.random() < 0.5
        return self.colours[self.rng.integers(len(self.colours))] if again else self.colour(place)

    def _common(self, face: str | None) -> dict:
        """Frame of the pattern (at times turned in its plane), dirt and uneven gloss."""
        rng, u = self.rng, self.rng.random
        a, b = (np.asarray(axis, float) for axis in patterns.facing(face or str(rng.choice(["x", "y", "z"]))))
        if u() < 0.3:
            turn = rng.uniform(0, np.pi)
            a, b = np.cos(turn) * a + np.sin(turn) * b, -np.sin(turn) * a + np.cos(turn) * b
        return {
            "axes": (a, b),
            "origin": rng.uniform(-1, 1, 3),
            "dirt": 0.0 if u() < 0.6 else float(0.5 * u()),
            "dirt_f": float(10 ** rng.uniform(-0.3, 1.0)),
            "uneven": 0.0 if u() < 0.6 else float(0.35 * u()),
            "uneven_f": float(10 ** rng.uniform(0, 1.2)),
        }

    def _gloss(self) -> float:
        low, high = [(0.05, 0.2), (0.2, 0.45), (0.45, 0.8), (0.8, 1.0)][self.rng.choice(4, p=[0.2, 0.28, 0.27, 0.25])]
        return float(self.rng.uniform(low, high))

    def _rough(self, kind: str, place: str, gloss: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return (1, 0, 0) for the share of the surfaces that are matte, `gloss` (r_0, r_t, r_s) for the others."""
        papered = place in ("wall", "ceiling") and kind in ("paint", "print", "picture")
        return (1.0, 0.0, 0.0) if self.rng.random() < MATTE_SHARES[place if papered else kind] else gloss

    def _cycles(self, low: float, high: float, count: int = 1) -> tuple[float, ...]:
        """(3,) frequencies between 10^low and 10^high, equal (count 1) or drawn apart (count 3)."""
        drawn = 10 ** self.rng.uniform(low, high, count)
        return tuple(float(f) for f in np.broadcast_to(drawn, 3))

    def _paint(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        clouds = near(rng, base, (0.12 if place in ("wall", "ceiling") else 0.3) * u()) if u() < 0.7 else base
        rough = float(rng.uniform(0.4, 1.0)) if place in ("wall", "ceiling") else self._gloss()
        gloss = self._rough("paint", place, (rough, float(rng.uniform(-0.05, 0.1)), 0))
        return materials.row(base, clouds, rough=gloss, grain=self._cycles(-0.2, 1.4), **_of(gloss, common))

    def _metal(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        kind = rng.choice(["measured", "grey", "gold", "copper", "dark", "coloured"], p=[0.3, 0.35, 0.1, 0.08, 0.11, 0.06])
        known = [m.base_color for m in measured_materials() if m.metallic == 1]
        first = {
            "measured": known[rng.integers(len(known))],
            "grey": from_hsv(u(), 0.06 * u(), 0.6 + 0.38 * u()),
            "gold": from_hsv(0.11 + 0.03 * u(), 0.3 + 0.4 * u(), 0.7 + 0.28 * u()),
            "copper": from_hsv(0.04 + 0.03 * u(), 0.35 + 0.3 * u(), 0.65 + 0.3 * u()),
            "dark": from_hsv(u(), 0.1 * u(), 0.15 + 0.35 * u()),
            "coloured": of_tone(rng, "strong"),
        }[kind]
        low, high = [(0.05, 0.2), (0.2, 0.4), (0.4, 0.75)][rng.integers(3)]
        rough = float(rng.uniform(low, high)), float(rng.uniform(-0.1, 0.15)), 0
        metallic = 1.0 if u() < 0.92 else float(rng.uniform(0.5, 1))
        return materials.row(
            first, near(rng, first, 0.2 * u()), rough=rough, metallic=metallic, grain=self._cycles(0, 1.6, 3), **common
        )

    def _wood(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        first = of_tone(rng, "brown") if u() < 0.8 else base
        second = near(rng, tuple(0.6 * c for c in first), 0.25)
        rough = self._rough("wood", place, (self._gloss(), float(rng.uniform(0, 0.2)), 0.2))
        common = _of(rough, common)
        if place in ("floor", "wall") and u() < 0.8:  # boards
            wide = float(rng.uniform(0.06, 0.22))
            size = wide * float(rng.uniform(5, 12)), wide
            joints, grain = near(rng, tuple(0.35 * c for c in first), 0.3), (0.9, float(rng.uniform(4, 12)), 7.0)
            return materials.row(first, second, joints, rough=rough, kind="cells", size=size, grain=grain, **common)
        grain = tuple(float(s * rng.uniform(0.6, 2.0)) for s in rng.permutation([1.0, 9.0, 9.0]))
        return materials.row(first, second, rough=(*rough[:2], 0), kind="wood", grain=grain, **common)

    def _tiles(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        edge = float(10 ** rng.uniform(-1.4, -0.2))
        joints = self._pick("thing") if u() < 0.3 else of_tone(rng, "grey")
        rough = float(rng.uniform(0.08, 0.6)), 0.05, float(rng.uniform(0, 0.4))
        size = edge * float(rng.choice([1, 1, 2, 3])), edge
        more = {"kind": "cells", "size": size, "grain": (9.0,) * 3, "amount": float(u())}
        return materials.row(base, near(rng, base, 0.35 * u()), joints, rough=rough, **more, **common)

    def _stone(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng = self.rng
        rough = self._rough("stone", place, (self._gloss(), float(rng.uniform(-0.05, 0.15)), 0.05))
        common = _of(rough, common)
        more = {"kind": str(rng.choice(["marble", "terrazzo", "flakes"])), "fine": float(rng.uniform(1.2, 4))}
        veins = near(rng, base, 0.4), self._pick("thing")
        return materials.row(base, *veins, rough=rough, grain=self._cycles(0.2, 1.4, 3), **more, **common)

    def _cloth(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        kinds = ["plain", "weave", "stripes", "checks", "zigzag", "spots", "rug"]
        kind = str(rng.choice(kinds, p=[0.34, 0.24, 0.12, 0.10, 0.07, 0.07, 0.06]))
        edge = float(10 ** rng.uniform(-2.0, -0.7))
        size = (0.9, 0.6) if kind == "rug" else (edge * float(rng.uniform(0.6, 1.6)), edge)
        second = near(rng, base, 0.4) if u() < 0.6 else self._pick("thing")
        rough = self._rough("cloth", place, (float(rng.uniform(0.7, 1.0)), 0, 0))
        common = _of(rough, common)
        grain = self._cycles(0.3, 1.9)
        return materials.row(base, second, self._pick("thing"), rough=rough, kind=kind, size=size, grain=grain, **common)

    def _print(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng, u = self.rng, self.rng.random
        kind = str(rng.choice(_PRINTS, p=[0.22, *[0.78 / (len(_PRINTS) - 1)] * (len(_PRINTS) - 1)]))
        edge = float(10 ** rng.uniform(-1.9, -0.4))
        size = (0.4, 0.3) if kind in ("rug", "painting") else (edge * float(rng.uniform(0.5, 2)), edge)
        if kind == "text":  # dark on paper, or the reverse
            base = of_tone(rng, str(rng.choice(["white", "beige", "pastel", "dark"], p=[0.6, 0.2, 0.1, 0.1])))
        second = of_tone(rng, "dark") if kind == "text" and u() < 0.7 else self.colour("wild")
        rough = self._rough("print", place, (self._gloss(), float(rng.uniform(-0.1, 0.2)), 0))
        common = _of(rough, common)
        grain = self._cycles(0.2, 1.5, 3)
        return materials.row(base, second, self.colour("wild"), rough=rough, kind=kind, size=size, grain=grain, **common)

    def _ceramic(self, base: Colour, place: str, common: dict) -> np.ndarray:
        rng = self.rng
        kind = str(rng.choice(["plain", "plain", "rings", "spots", "stripes"]))
        size = tuple(sorted(float(s) for s in 10 ** rng.uniform(-1.6, -0.6, 2)))
        rough = (float(rng.uniform(0.04, 0.25)), 0.05, 0)
        second = near(rng, base, 0.25), self._pick("thing")
        return materials.row(base, *second, rough=rough, kind=kind, size=size, grain=self._cycles(0.3, 1.4), **common)

    def _measured(self, base: Colour, place: str, common: dict) -> np.ndarray:
        """A measured material; smooth ones are roughened a little, because the table has 0 for whatever may be polished."""
        rng = self.rng
        table = measured_materials()
        own = table[rng.integers(len(table))]
        first = near(rng, own.base_color, 0.05)
        rough = (float(np.clip(own.roughness + abs(rng.normal(0, 0.12)), 0.03, 1)), 0, 0)
        return materials.row(
            first, near(rng, first, 0.1), rough=rough, metallic=own.metallic, grain=self._cycles(0.2, 1.4), **common
        )

    def _picture(self, base: Colour, place: str, common: dict) -> np.ndarray:
        """A picture from the assets, in its own colours or tinted, of 0.3 to 3 metres."""
        rng, u = self.rng, self.rng.random
        if len(self.layers) < 8 or u() < 0.3:
            self.layers.append(materials.layer_of(self.assets.textures[rng.integers(len(self.assets.textures))], rng))
        layer = len(self.layers) - 1 if u() < 0.5 else int(rng.integers(len(self.layers)))
        mean = self.layers[layer][..., :3].mean((0, 1))
        if u() < 0.5:
            gain = np.full(3, np.exp(rng.normal(0, 0.25)))
        else:  # tinted: the mean becomes a colour of the place
            gain = np.clip(np.asarray(base) / np.maximum(mean, 0.02), 0.1, 4)
        edge = (
            float(10 ** rng.uniform(-0.5, 0.5)) if place in ("wall", "floor", "ceiling") else float(10 ** rng.uniform(-0.9, 0.0))
        )
        rough = self._rough("picture", place, (float(np.clip(self._gloss(), 0.1, 0.95)), float(rng.uniform(0, 0.6)), 0))
        common = _of(rough, common)
        size = (edge, edge * float(rng.uniform(0.7, 1.4)))
        return materials.row(tuple(gain), rough=rough, kind="picture", size=size, layer=float(layer), **common)


def _of(rough: tuple[float, float, float], common: dict) -> dict:
    """Return the entries that all classes share; a matte surface has no uneven gloss."""
    return common if rough[0] < 1 else common | {"uneven": 0.0}
