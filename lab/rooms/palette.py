"""Finishes that several objects share: paints, woods, metals, glazes. Colours are written as sRGB codes and kept linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from iif_core.numerics.color import linear_from_srgb
from lab.rooms.patterns import Colour, Material, facing

UP, EAST, NORTH = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def paint(code: str) -> Colour:
    """Return the linear colour of a `#rrggbb` sRGB code."""
    r, g, b = (float(linear_from_srgb(int(code[i : i + 2], 16) / 255)) for i in (1, 3, 5))
    return r, g, b


def plain(
    code: str,
    roughness: float = 0.5,
    second: str | None = None,
    metallic: float = 0.0,
    grain: float = 7.0,
    vary: float = 0.0,
) -> Material:
    """Return one paint, clouded towards a second one.

    Args:
        code: sRGB colour, `#rrggbb`.
        roughness: perceptual, [0.02, 1].
        second: sRGB colour of the clouds; None leaves the paint uniform.
        metallic: [0, 1].
        grain: cycles of the clouds per metre.
        vary: added to the roughness inside the clouds.

    Returns:
        The material.
    """
    first = paint(code)
    clouded = paint(second) if second else first
    return Material(first, clouded, roughness=(roughness, vary, 0.0), metallic=metallic, grain=(grain, grain, grain))


def patterned(
    kind: str,
    *codes: str,
    size: tuple[float, float],
    axes: tuple[Sequence[float], Sequence[float]] = (EAST, NORTH),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    roughness: float = 0.5,
    vary: float = 0.0,
    grain: float = 6.0,
) -> Material:
    """Return two or three paints in a pattern.

    Args:
        kind: one of `patterns.KINDS`.
        *codes: sRGB colours, `#rrggbb`.
        size: sizes of the pattern along its two axes, in metres.
        axes: directions of the pattern's axes in the world.
        origin: where the pattern starts, in metres.
        roughness: perceptual, [0.02, 1].
        vary: added to the roughness where the second colour shows.
        grain: cycles of the coarse noise per metre.

    Returns:
        The material.
    """
    colours = (paint(code) for code in codes)
    frame = {"size": size, "axes": axes, "origin": origin, "grain": (grain, grain, grain)}
    return Material(*colours, roughness=(roughness, vary, 0.0), kind=kind, **frame)


def wood(
    light: str,
    dark: str,
    along: Sequence[float],
    across: Sequence[float],
    roughness: float = 0.42,
    density: float = 8.0,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Material:
    """Return solid wood with its grain along one direction.

    Args:
        light, dark: sRGB colours, `#rrggbb`.
        along: direction of the grain in the world.
        across: direction square to it.
        roughness: perceptual, [0.02, 1].
        density: cycles of the grain per metre, across.
        origin: where the pattern starts, in metres; different origins make different boards.

    Returns:
        The material.
    """
    grain = {"grain": (0.11 * density, density, density), "fine": 3.0}
    rough = (roughness, 0.14, 0.0)
    return Material(paint(light), paint(dark), roughness=rough, kind="wood", axes=(along, across), origin=origin, **grain)


def tiles(axis: str, light: str, dark: str, origin: Sequence[float], size: tuple[float, float] = (0.15, 0.10)) -> Material:
    """Return glazed tiles with grout.

    Args:
        axis: of the world, `x` or `y`, that the wall is square to.
        light, dark: sRGB colours between which the tiles vary.
        origin: a corner of a tile, in metres.
        size: width and height of a tile, in metres.

    Returns:
        The material.
    """
    frame = {"size": size, "axes": facing(axis), "origin": origin, "grain": (9.0, 9.0, 9.0)}
    colours = paint(light), paint(dark), paint("#bdb4a5")
    return Material(*colours, roughness=(0.11, 0.05, 0.6), kind="cells", amount=0.3, **frame)


def recoloured(material: Material, light: str, dark: str) -> Material:
    """Return the same finish in other colours."""
    return replace(material, first=paint(light), second=paint(dark))


OAK, OAK_DARK = "#d2a878", "#a5784a"
WALNUT, WALNUT_DARK = "#8f6142", "#5b3a26"
BIRCH, BIRCH_DARK = "#e6cfa6", "#c9a877"

STEEL = Material((0.60, 0.59, 0.57), (0.53, 0.52, 0.51), roughness=(0.30, 0.10, 0.0), metallic=1.0, grain=(1.0, 1.0, 14.0))
CHROME = plain("#d6d8da", 0.15, metallic=1.0)
COPPER = Material((0.93, 0.58, 0.43), (0.74, 0.40, 0.28), roughness=(0.20, 0.16, 0.0), metallic=1.0, grain=(9.0, 9.0, 9.0))
BRASS = Material((0.88, 0.68, 0.36), (0.78, 0.57, 0.27), roughness=(0.28, 0.12, 0.0), metallic=1.0, grain=(12.0,) * 3)
IRON = plain("#35353a", 0.55, metallic=1.0)
BLACK_GLASS = plain("#16171a", 0.07)
WHITE_GLAZE = plain("#ece8df", 0.16)
WHITE_PAINT = plain("#ece8de", 0.42, "#e4dfd3")

_BOARDS = {"kind": "cells", "size": (1.30, 0.145), "origin": (0.17, 0.03, 0.003), "grain": (0.9, 7.0, 7.0)}
FLOOR = Material(paint("#bf9062"), paint("#8a5d3a"), paint("#5a3d28"), roughness=(0.34, 0.14, 0.3), **_BOARDS)
_VEINS = {"kind": "marble", "grain": (2.6, 3.4, 3.0), "fine": 3.5}
MARBLE = Material(paint("#e9e6e0"), paint("#d5d2cc"), paint("#8d8a88"), roughness=(0.17, 0.05, 0.05), **_VEINS)
_CHIPS = {"kind": "terrazzo", "grain": (19.0, 19.0, 19.0), "fine": 1.3}
TERRAZZO = Material(paint("#dcd6ca"), paint("#c9a58a"), paint("#6f7f7a"), roughness=(0.24, 0.03, 0.05), **_CHIPS)
