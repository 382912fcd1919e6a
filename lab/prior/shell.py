"""Floor, ceiling, walls, windows with what hangs before them, and the light from outside."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from lab.prior.assets import Assets
from lab.prior.building import WALLS, Building, Hole, box, sky_of
from lab.rooms import shapes
from lab.rooms.shapes import Shape

OVERLAP = 0.02  # metres by which walls reach past their corners, so that no ray slips through
REVEAL = 0.18  # depth of a window opening, metres
RELIEF_ROOMS = 0.2
"""Share of the rooms in which floor, ceiling and walls may have a relief that the delivered mesh lacks."""


def warm(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    """Draw a tint (3,): positive is warm, negative cool, 1 a strong lamp."""
    return np.clip(1 + rng.uniform(low, high) * np.array([0.35, 0.0, -0.45]), 0.05, None)


def open_windows(building: Building) -> None:
    """Choose window openings in the east and the north wall."""
    count = int(building.rng.choice([0, 1, 2], p=[0.2, 0.4, 0.4]))
    if min(building.size[:2]) < 3.4:
        return
    for wall in ("east", "north")[:count]:
        length = building.length(wall)
        width = building.between(0.7, min(2.4, length - 1.2))
        start = building.between(0.5, length - width - 0.5)
        low = 0.1 if building.chance(0.15) else building.between(0.6, 1.1)
        building.holes.append(Hole(wall, start, start + width, low, float(building.size[2]) - building.between(0.15, 0.5)))


def build_shell(building: Building) -> None:
    """Add floor, ceiling and walls, and at times wainscots, skirting, beams, and a built-in corner."""
    x, y, z = building.size
    o = OVERLAP
    relief = building.chance(RELIEF_ROOMS)
    _sheet(building, "floor", "floor", "z", ((-o, -o, 0), (x + 2 * o, 0, 0), (0, y + 2 * o, 0)), relief)
    _sheet(building, "ceiling", "ceiling", "z", ((-o, y + o, z), (x + 2 * o, 0, 0), (0, -y - 2 * o, 0)), relief)
    same = building.material("wall", "x")
    for wall in WALLS:
        face = "x" if wall in ("west", "east") else "y"
        material = same if building.chance(0.65) else building.material("wall", face)
        hole = next((hole for hole in (*building.holes, *building.doors) if hole.wall == wall), None)
        if hole is None:
            _sheet(building, wall, material, face, _wall(building, wall)[:3], relief)
            if building.chance(0.2):
                low, high = (0.0, building.between(0.6, 1.4)) if building.chance(0.6) else (0.85, building.between(1.3, 1.9))
                along = 0.05, building.length(wall) - 0.05
                panel = building.plate(wall, along, (low, high), (-0.012, 0.0))
                building.add("panel", building.material("wall", face), panel, obstacle=False)
        else:
            building.add(wall, material, *_wall_with(building, hole), obstacle=False)
    _trim(building)


def _sheet(building: Building, name: str, material: str | np.ndarray, face: str, frame: tuple, relief: bool) -> None:
    """Add a plane surface, at times with a relief of a few millimetres that the delivered mesh does not show."""
    own = building.material(material, face) if isinstance(material, str) else material
    plain = shapes.sheet(*frame, 0.5)
    if not (relief and building.chance(0.5)):
        return building.add(name, own, plain, obstacle=False)
    vertices, faces = shapes.sheet(*frame, building.between(0.03, 0.06))
    inward = np.cross(frame[1], frame[2])
    inward = inward / np.linalg.norm(inward)
    rough = building.rng.normal(0, building.between(0.0005, 0.003), len(vertices))
    waves = building.between(0, 0.004) * np.sin(vertices @ building.rng.normal(0, 12, 3) + building.between(0, 6))
    building.add(name, own, (vertices + np.abs(rough + waves)[:, None] * inward, faces), obstacle=False, delivered=[plain])


def _wall(building: Building, wall: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origin, edge along, edge up (along x up faces the room) and outward normal of a wall, metres."""
    x, y, z = building.size
    o = OVERLAP
    up = np.array([0, 0, z + 2 * o])
    origin, along, out = {
        "north": ((-o, y, -o), (x + 2 * o, 0, 0), (0, 1, 0)),
        "south": ((x + o, 0, -o), (-x - 2 * o, 0, 0), (0, -1, 0)),
        "west": ((0, -o, -o), (0, y + 2 * o, 0), (-1, 0, 0)),
        "east": ((x, y + o, -o), (0, -y - 2 * o, 0), (1, 0, 0)),
    }[wall]
    return np.array(origin, float), np.array(along, float), up, np.array(out, float)


def _wall_with(building: Building, hole: Hole) -> list[Shape]:
    """A wall with an opening, and the four sides of the opening."""
    origin, along, up, out = _wall(building, hole.wall)
    axis = int(np.abs(along).argmax())
    sides = sorted((edge - origin[axis]) / along[axis] for edge in (hole.start, hole.stop))
    levels = [(edge + OVERLAP) / up[2] for edge in (hole.low, hole.high)]
    lines = [np.unique(np.r_[np.linspace(0, 1, 9), ends]) for ends in (sides, levels)]
    a, b = (origin + s * along for s in sides)
    low, high = (np.array([0, 0, edge + OVERLAP]) for edge in (hole.low, hole.high))
    back, rise = REVEAL * out, high - low
    return [
        shapes.grid_sheet(origin, along, up, *lines, (*sides, *levels)),
        shapes.sheet(a + low, b - a, back),
        shapes.sheet(b + high, a - b, back),
        shapes.sheet(b + low, rise, back),
        shapes.sheet(a + high, -rise, back),
    ]


def _trim(building: Building) -> None:
    x, y, z = building.size
    if building.chance(0.5):
        high, t = building.between(0.05, 0.14), 0.015
        strips = {
            "south": ((0, 0), (x, t)),
            "north": ((0, y - t), (x, y)),
            "west": ((0, 0), (t, y)),
            "east": ((x - t, 0), (x, y)),
        }
        free = [strips[wall] for wall in strips if all(door.wall != wall for door in building.doors)]
        pieces = [box((*low, 0.0), (*top, high)) for low, top in free]
        building.add("skirting", building.material("wall" if building.chance(0.5) else "thing"), *pieces, obstacle=False)
    if building.chance(0.25):
        for i in range(building.rng.integers(1, 4)):
            at, drop = (i + 0.5) * x / 3, building.between(0.1, 0.3)
            building.add("beam", building.material("wall"), box((at - 0.08, 0, z - drop), (at + 0.08, y, z)), obstacle=False)
    if building.chance(0.3) and min(x, y) > 3.2:  # a corner is built in, so the plan is an L
        w, d = building.between(0.5, 0.4 * x), building.between(0.5, 0.4 * y)
        building.add("corner", building.material("wall"), box((-OVERLAP, -OVERLAP, 0), (w, d, z)))
        building.taken.append((0, 0, w, d))


def light_from_outside(building: Building, assets: Assets) -> None:
    """Choose what is outside, and put frames, panes, curtains or blinds into the openings."""
    rng = building.rng
    kinds = ["overcast", "clear", "sun", "panes", "dusk", "map"]
    kind = str(rng.choice(kinds, p=[0.17, 0.12, 0.19, 0.17, 0.08, 0.27]))
    level = float(10 ** rng.uniform(-0.5, 1.2))
    building.outside = "panes" if kind == "panes" else "sky"
    if kind == "map" and assets.skies:
        sky = np.roll(assets.skies[rng.integers(len(assets.skies))], int(rng.integers(128)), 1)
        building.sky = np.maximum(sky * (level / max(float(np.median(sky.mean(-1))), 1e-3)), 1e-5).clip(max=3e4)
    elif kind != "panes":
        horizon, ground = level * warm(rng, -0.8, 0.3), level * rng.uniform(0.1, 0.6) * warm(rng, -0.3, 0.8)
        zenith = level * rng.uniform(0.2, 2.5) * warm(rng, -1.3, 0.2)
        if kind == "dusk":
            horizon, zenith, ground = 0.1 * horizon * warm(rng, 0, 1), 0.06 * zenith, 0.05 * ground
        shines = kind == "sun" or (kind == "map" and building.chance(0.5))
        building.outside = "sun" if shines else "dusk" if kind == "dusk" else "sky"
        sun = (building.between(8, 60), building.between(-50, 130), level * building.between(40, 400)) if shines else None
        building.sky = np.maximum(sky_of(horizon, zenith, ground, sun), 1e-5)
        if building.chance(0.5):  # trees and houses
            noise = gaussian_filter(rng.normal(size=building.sky.shape[:2]), (2, 3), mode="wrap")
            building.sky = (building.sky * np.exp(0.75 * noise / noise.std())[..., None]).astype(np.float32)
    panes = level * warm(rng, -1, 1) if kind == "panes" else None
    cover = str(rng.choice(["curtains", "blinds"])) if panes is None and building.chance(0.25) else None
    for hole in building.holes:
        _window(building, hole, panes, cover)


def _window(building: Building, hole: Hole, panes: np.ndarray | None, cover: str | None) -> None:
    wall, half = hole.wall, 0.025
    middle = 0.5 * (hole.start + hole.stop)
    posts = [hole.start + half, hole.stop - half, *([middle] if building.chance(0.7) else [])]
    bars = [building.plate(wall, (p - half, p + half), (hole.low, hole.high), (0.08, 0.13)) for p in posts]
    bars += [
        building.plate(wall, (hole.start, hole.stop), (level - half, level + half), (0.085, 0.125))
        for level in (hole.low + half, hole.high - half)
    ]
    building.add("window frame", building.material("wall" if building.chance(0.6) else "thing"), *bars)
    if panes is not None:
        corner = [building.on_wall(wall, along, hole.low, 0.15) for along in (hole.start, hole.stop)]
        first, across = corner[0], corner[1] - corner[0]
        if np.cross(across, (0, 0, 1)) @ _wall(building, wall)[3] > 0:  # the pane shines into the room
            first, across = corner[1], -across
        building.shine("window pane", shapes.sheet(first, across, (0, 0, hole.high - hole.low), 0.4), radiance=panes)
    if cover == "curtains":
        _curtain(building, hole)
    if cover == "blinds":
        _blinds(building, hole)


def _curtain(building: Building, hole: Hole) -> None:
    """Folded cloth of which every second strip of 1 cm is a gap; the delivered mesh is closed."""
    start, stop, low, high = hole.start - 0.25, hole.stop + 0.25, 0.04, hole.high + 0.1
    fold = building.between(0.015, 0.05)

    def cloth(columns: int, step: int) -> Shape:
        along = np.linspace(start, stop, columns + 1)
        out = -0.14 + fold * np.sin(2 * np.pi * (along - start) / 0.22)
        foot = np.array([building.on_wall(hole.wall, a, low, o) for a, o in zip(along, out, strict=True)])
        i = np.arange(0, columns, step)
        n = columns + 1
        faces = np.concatenate([np.stack([i, i + 1, i + 1 + n], 1), np.stack([i, i + 1 + n, i + n], 1)])
        return np.concatenate([foot, foot + (0, 0, high - low)]), faces

    fine = 2 * round((stop - start) / 0.02)
    building.add("curtain", building.material("cloth"), cloth(fine, 2), delivered=[cloth(fine // 2, 1)])


def _blinds(building: Building, hole: Hole) -> None:
    """Tilted slats; the delivered mesh has one sheet in their place."""
    across = building.on_wall(hole.wall, hole.stop, 0) - building.on_wall(hole.wall, hole.start, 0)
    tilt = 0.045 * (np.cos(0.7) * _wall(building, hole.wall)[3] + np.sin(0.7) * np.array([0, 0, 1]))
    levels = np.arange(hole.low, hole.high - 0.03, 0.045)
    slats = [shapes.sheet(building.on_wall(hole.wall, hole.start, level, 0.02), across, tilt, 5.0) for level in levels]
    plane = shapes.sheet(building.on_wall(hole.wall, hole.start, hole.low, 0.04), across, (0, 0, hole.high - hole.low), 0.2)
    building.add("blinds", building.material("wall"), *slats, delivered=[plane])
