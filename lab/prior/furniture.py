"""Furniture, things on walls, clutter, rugs: each function draws one piece and finds a place for it."""

from __future__ import annotations

import numpy as np

from lab.prior import materials
from lab.prior.building import WALLS, Building, Top, bounds, box
from lab.prior.palette import of_tone
from lab.prior.solids import solid
from lab.rooms import shapes
from lab.rooms.shapes import Shape


def furnish(building: Building) -> None:
    """Fill a room with furniture, as densely as its area suggests, and put small things on it."""
    rng = building.rng
    weights = np.array([weight for _, weight in KINDS]) * rng.uniform(0.2, 1.8, len(KINDS))
    area = building.size[0] * building.size[1]
    for _ in range(int(np.clip(rng.normal(area / 2.2, 3), 3, 16))):
        KINDS[rng.choice(len(KINDS), p=weights / weights.sum())][0](building)
    for number in range(rng.integers(0, 3)):
        rug(building, number)
    for _ in range(rng.integers(1, 9)):
        on_wall(building)
    for _ in range(rng.integers(0, 3)):
        hanging(building)
    for top in list(building.tops):
        for _ in range(rng.integers(0, 6)):
            clutter(building, top)


def table(b: Building) -> None:
    """A table with a round or square top on legs, a column, or thin bent tubes."""
    w, d, h, t = b.between(0.4, 2.0), b.between(0.4, 1.0), b.between(0.35, 0.95), b.between(0.02, 0.06)
    if b.chance(0.75):
        top = box((0, 0, h - t), (w, d, h), 0.005 if b.chance(0.4) else 0)
    else:
        top = shapes.move(shapes.cylinder((0, 0, h - t), min(w, d) / 2, t, 0.004, 32), (w / 2, d / 2, 0))
    leg = b.between(0.02, 0.08)
    corners = [(x, y) for x in (0.06, w - 0.06) for y in (0.06, d - 0.06)]
    own, thin = b.material("gloss" if b.chance(0.06) else "thing"), b.material("thing")
    if b.chance(0.45):
        legs = [box((x - leg / 2, y - leg / 2, 0), (x + leg / 2, y + leg / 2, h - t)) for x, y in corners]
        thin = own if b.chance(0.5) else thin
    elif b.chance(0.4):
        foot = shapes.cylinder((w / 2, d / 2, 0), min(w, d) * 0.35, 0.03)
        legs = [shapes.cylinder((w / 2, d / 2, 0.03), leg / 2, h - t - 0.03), foot]
        thin = b.material("thin")
    else:
        legs = [shapes.tube([(x, y, 0), (x + b.between(-0.05, 0.05), y, h - t)], leg / 3, 8) for x, y in corners]
        thin = b.material("thin")
    if at := b.place(w, d):
        at.add("table", own, top)
        at.add("legs", thin, *legs)
        at.top((0, 0), (w, d), h)


def sofa(b: Building) -> None:
    """A sofa or armchair with cushions."""
    w, d, h, bevel = b.between(0.7, 2.4), b.between(0.7, 1.0), b.between(0.34, 0.48), b.between(0.01, 0.06)
    pieces = [box((0, 0, 0.06), (w, d, h), bevel), box((0, d - 0.2, h), (w, d, h + b.between(0.25, 0.55)), bevel)]
    if b.chance(0.7):
        pieces += [box((x, 0, h), (x + 0.16, d - 0.2, h + 0.2), bevel) for x in (0, w - 0.16)]
    if at := b.place(w, d, b.chance(0.7)):
        at.add("sofa", b.material("cloth"), *pieces)
        for _ in range(b.rng.integers(0, 4)):
            middle = (b.between(0.25, max(w - 0.25, 0.26)), d - 0.32, h + 0.18)
            at.add("cushion", b.material("cloth"), shapes.ellipsoid(middle, (0.2, 0.09, 0.17), 18, b.between(0, 40)))


def cabinet(b: Building) -> None:
    """A cabinet with doors or drawers and knobs or handles."""
    w, d, h = b.between(0.35, 1.8), b.between(0.3, 0.65), b.between(0.4, 2.1)
    columns, rows = int(np.clip(w / b.between(0.3, 0.6), 1, 5)), int(np.clip(h / b.between(0.2, 0.9), 1, 5))
    doors, knobs, long, bevel = [], [], b.chance(0.5), 0.003 if b.chance(0.3) else 0
    for i in range(columns):
        for j in range(rows):
            x0, z0 = i * w / columns + 0.008, 0.06 + j * (h - 0.08) / rows + 0.008
            x1, z1 = (i + 1) * w / columns - 0.008, 0.06 + (j + 1) * (h - 0.08) / rows - 0.008
            doors.append(box((x0, -0.018, z0), (x1, 0.001, z1), bevel))
            middle = (x0 + x1) / 2
            bar = [(middle - 0.06, -0.04, z1 - 0.05), (middle + 0.06, -0.04, z1 - 0.05)]
            knobs.append(shapes.tube(bar, 0.006, 8) if long else shapes.sphere((middle, -0.03, z1 - 0.05), 0.016, 12))
    body = b.material()
    if at := b.place(w, d, True):
        at.add("cabinet", body, box((0, 0, 0.04), (w, d, h)))
        at.add("doors", body if b.chance(0.4) else b.material("gloss" if b.chance(0.08) else "thing"), *doors)
        at.add("knobs", b.material("thin"), *knobs)
        at.top((0, 0), (w, d), h)


def counter(b: Building) -> None:
    """A kitchen counter with doors and rails, at times a sink with a tap, cupboards above, an appliance with a dark front."""
    w, d, h = b.between(1.0, 3.0), b.between(0.5, 0.7), b.between(0.8, 0.95)
    n = max(1, int(w / b.between(0.4, 0.7)))
    edges = [(i * w / n + 0.006, (i + 1) * w / n - 0.006) for i in range(n)]
    at = b.place(w, d, True)
    if at is None:
        return
    at.add("counter", b.material(), box((0, 0, 0.08), (w, d, h - 0.04)))
    at.add(
        "fronts",
        b.material("gloss" if b.chance(0.1) else "thing"),
        *[box((p, -0.018, 0.1), (q, 0.001, h - 0.06)) for p, q in edges],
    )
    at.add("worktop", b.material(), box((-0.01, -0.03, h - 0.04), (w + 0.01, d, h), 0.004))
    rails = [shapes.tube([(p + 0.06, -0.04, h - 0.1), (q - 0.06, -0.04, h - 0.1)], 0.006, 8) for p, q in edges]
    at.add("rails", b.material("thin"), *rails)
    if b.chance(0.5):
        x, y = b.between(0.3, w - 0.3), d - 0.12
        bend = [(x, y, h), (x, y, h + 0.25), (x, y - 0.08, h + 0.3), (x, y - 0.18, h + 0.26)]
        at.add("tap", b.material("thin"), shapes.tube(bend, 0.012, 10))
        at.add("sink", b.material("thin"), shapes.tub((x - 0.25, 0.06, h - 0.005), (x + 0.25, d - 0.16, h + 0.012), 0.015, 0.004))
    if b.chance(0.5):
        low, high = b.between(1.35, 1.5), b.between(1.9, 2.1)
        at.add("cupboards", b.material(), *[box((p, d - 0.35, low), (q, d, high)) for p, q in edges])
    if b.chance(0.5):
        at.add("appliance", b.material("gloss" if b.chance(0.6) else "thin"), box((0.1, -0.025, 0.3), (0.6, -0.019, 0.7)))
    at.top((0, 0), (w, d - 0.05), h)
    at.top((0, 0), (w, d - 0.05), h)


def shelf(b: Building) -> None:
    """Shelves with books or things."""
    w, d, h, t = b.between(0.5, 1.6), b.between(0.22, 0.4), b.between(0.6, 2.1), 0.022
    levels = np.linspace(0.05, h - t, b.rng.integers(2, 7))
    at = b.place(w, d, True)
    if at is None:
        return
    boards = [box((0, 0, z), (w, d, z + t)) for z in levels]
    at.add("shelf", b.material(), *boards, *[box((x, 0, 0), (x + t, d, h)) for x in (0, w - t)])
    if b.chance(0.6):
        at.add("back", b.material(), box((0, d - 0.008, 0), (w, d, h)))
    for z, above in zip(levels[:-1], levels[1:], strict=True):
        room = above - z - t - 0.02
        if b.chance(0.55):
            groups: dict[int, list[Shape]] = {}
            tones, x, stop = b.rng.integers(2, 7), t + 0.01, b.between(0.3, 1) * w
            while x < stop - 0.06:
                wide, high = b.between(0.012, 0.05), min(b.between(0.16, 0.32), room)
                book = box((x, 0.02, z + t), (x + wide, d - b.between(0.02, 0.1), z + t + high))
                groups.setdefault(int(b.rng.integers(tones)), []).append(book)
                x += wide + 0.001
            for books in groups.values():
                at.add("books", b.material("flat"), *books)
        else:
            for _ in range(b.rng.integers(0, 5)):
                shape = solid(b.rng, min(0.12, room / 2))
                low, high = bounds(shape)
                if high[2] - low[2] < room:
                    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
                    at.add("thing", b.material(), shapes.move(shape, np.array([b.between(0.15, w - 0.15), d / 2, z + t]) - foot))


def bed(b: Building) -> None:
    """A bed with a head, a mattress, a blanket and pillows."""
    w, d = b.between(0.9, 1.8), 2.0
    at = b.place(w, d, True)
    if at is None:
        return
    at.add("bed", b.material(), box((0, 0, 0.08), (w, d, 0.28)), box((0, d - 0.06, 0), (w, d, b.between(0.6, 1.2))))
    at.add("mattress", b.material("cloth"), box((0.03, 0.02, 0.28), (w - 0.03, d - 0.07, 0.48), 0.05))
    at.add("blanket", b.material("cloth"), box((-0.02, -0.02, 0.3), (w + 0.02, b.between(0.8, 1.4), 0.51), 0.03))
    places = (0.5,) if w < 1.2 else (0.28, 0.72)
    at.add("pillows", b.material("cloth"), *[shapes.ellipsoid((w * f, d - 0.3, 0.53), (0.28, 0.18, 0.09), 20) for f in places])


def chair(b: Building) -> None:
    """A chair or stool on thin legs."""
    w, h = b.between(0.36, 0.55), b.between(0.4, 0.7)
    corners = [(x, y) for x in (0.04, w - 0.04) for y in (0.04, w - 0.04)]
    radius, lean = b.between(0.008, 0.025), b.between(-0.02, 0.02)
    legs = [shapes.tube([(x + lean, y, 0), (x, y, h)], radius, 8) for x, y in corners]
    if b.chance(0.7):
        seat = box((0, 0, h), (w, w, h + b.between(0.02, 0.08)), 0.01)
    else:
        seat = shapes.cylinder((w / 2, w / 2, h), w / 2, 0.04, 0.008)
    at = b.place(w, w)
    if at is None:
        return
    own = b.material("cloth" if b.chance(0.4) else "thing")
    at.add("legs", b.material("thin"), *legs)
    at.add("seat", own, seat)
    if b.chance(0.7):
        back = box((0.01, w - 0.03, h + 0.12), (w - 0.01, w, h + b.between(0.35, 0.55)), 0.006)
        at.add("back", own if b.chance(0.6) else b.material(), back)
    elif b.chance(0.3):
        at.top((0, 0), (w, w), h + 0.08)


def pile(b: Building) -> None:
    """Crates, and at times a solid on top."""
    w, z = b.between(0.25, 0.7), 0.001
    at = b.place(w, w)
    if at is None:
        return
    for i in range(b.rng.integers(1, 5)):
        if i > 0 and b.chance(0.5):
            shape = solid(b.rng, 0.35 * (w - 0.08 * i))
            low, high = bounds(shape)
            at.add("solid", b.material(), shapes.move(shape, (*(w / 2 - (low[:2] + high[:2]) / 2), z - low[2])))
            return
        high = b.between(0.1, 0.5)
        inset = 0.04 * i
        at.add("crate", b.material(), box((inset, inset, z), (w - inset, w - inset, z + high), 0.01 if b.chance(0.4) else 0))
        z += high + 0.001


def boulder(b: Building) -> None:
    """One large solid."""
    shape = solid(b.rng, b.between(0.2, 0.5))
    low, high = bounds(shape)
    if at := b.place(high[0] - low[0], high[1] - low[1]):
        at.add("solid", b.material(), shapes.move(shape, -low))


def plant(b: Building) -> None:
    """A plant in a pot."""
    rng, w, h = b.rng, b.between(0.3, 0.6), b.between(0.5, 1.6)
    at = b.place(w, w)
    if at is None:
        return
    pot = [(0, 0), (w * 0.25, 0), (w * 0.35, 0.3), (w * 0.3, 0.3), (0, 0.27)]
    at.add("pot", b.material(), shapes.lathe(pot, (w / 2, w / 2, 0.001), 24))
    leaves = []
    for _ in range(rng.integers(10, 60)):
        middle = (w / 2 + rng.normal(0, w / 5), w / 2 + rng.normal(0, w / 5), b.between(0.35, h))
        blade = shapes.stretch(shapes.sphere((0, 0, 0), 1.0, 8), (b.between(0.04, 0.16), b.between(0.015, 0.06), 0.004))
        leaves.append(shapes.move(blade, middle, b.between(0, 360), b.between(-60, 60)))
    at.add("leaves", b.material("leaf"), *leaves)
    tips = [(w / 2 + rng.normal(0, 0.05), w / 2 + rng.normal(0, 0.05), h * 0.9) for _ in range(3)]
    at.add("stems", b.material(), *[shapes.tube([(w / 2, w / 2, 0.27), tip], 0.008, 6) for tip in tips])


def column(b: Building) -> None:
    """A column up to the ceiling, or a pedestal."""
    w, z = b.between(0.15, 0.45), float(b.size[2]) if b.chance(0.5) else b.between(0.6, 1.8)
    shape = box((0, 0, 0), (w, w, z)) if b.chance(0.5) else shapes.cylinder((w / 2, w / 2, 0), w / 2, z, 0.0, 32)
    if at := b.place(w, w):
        at.add("column", b.material("wall" if b.chance(0.5) else "thing"), shape)
        if z < 1.6:
            at.top((0, 0), (w, w), z)


def screen(b: Building) -> None:
    """A dark screen on a stand."""
    w, h, z = b.between(0.6, 1.4), b.between(0.4, 0.8), b.between(0.5, 0.9)
    if at := b.place(w, 0.3, True):
        foot = box((w / 2 - 0.25, 0, 0), (w / 2 + 0.25, 0.3, 0.02)), box((w / 2 - 0.05, 0.13, 0), (w / 2 + 0.05, 0.16, z))
        at.add("stand", b.material("thin"), box((0, 0.12, z), (w, 0.16, z + h), 0.004), *foot)
        dark = materials.row(of_tone(b.rng, "dark"), rough=(b.between(0.04, 0.3), 0, 0))
        at.add("screen", dark, box((0.015, 0.115, z + 0.015), (w - 0.015, 0.1195, z + h - 0.015)))


def rack(b: Building) -> None:
    """A rack of thin rods: a clothes stand, a towel rail, a trolley."""
    w, d, h, r = b.between(0.4, 1.2), b.between(0.25, 0.5), b.between(0.7, 1.6), b.between(0.006, 0.015)
    posts = [shapes.tube([(x, y, 0), (x, y, h)], r, 8) for x in (0.02, w - 0.02) for y in (0.02, d - 0.02)]
    bars = [
        shapes.tube([(0.02, y, z), (w - 0.02, y, z)], r, 8)
        for y in (0.02, d - 0.02)
        for z in np.linspace(0.15, h - 0.02, b.rng.integers(2, 5))
    ]
    if at := b.place(w, d, b.chance(0.6)):
        at.add("rack", b.material("thin"), *posts, *bars)
        if b.chance(0.5):
            at.add("tray", b.material(), box((0.02, 0.02, h), (w - 0.02, d - 0.02, h + 0.02)))
            at.top((0, 0), (w, d), h + 0.02)
        elif b.chance(0.5):
            at.add("towel", b.material("cloth"), box((0.1, 0.0, 0.4 * h), (0.6 * w, 0.012, h)))


def rug(b: Building, number: int) -> None:
    """A rug; later ones lie on earlier ones."""
    w, d = b.between(0.6, 2.4), b.between(0.6, 1.8)
    if w > b.size[0] - 0.4 or d > b.size[1] - 0.4:
        return
    x, y = b.between(0.1, b.size[0] - w - 0.1), b.between(0.1, b.size[1] - d - 0.1)
    b.add("rug", b.material("cloth", "z"), box((x, y, 0.001), (x + w, y + d, 0.010 + 0.004 * number)), obstacle=False)


def on_wall(b: Building) -> None:
    """A picture, a mirror, a poster, a box or a shelf on a wall."""
    wall = str(b.rng.choice(WALLS))
    w, h = b.between(0.15, 1.3), b.between(0.15, 1.0)
    if w > b.length(wall) - 0.3:
        return
    x, z = b.between(0.1, b.length(wall) - w - 0.1), b.between(0.9, max(b.size[2] - h - 0.15, 0.95))
    if not b.free_of_windows(wall, x, x + w):
        return
    kind, face = str(b.rng.choice(["picture", "mirror", "box", "shelf", "poster"], p=[0.33, 0.16, 0.13, 0.18, 0.2])), "x"
    if wall in ("north", "south"):
        face = "y"
    if kind == "shelf":
        depth = b.between(0.12, 0.3)
        b.add("shelf", b.material(), b.plate(wall, (x, x + w), (z, z + 0.025), (-0.002, -depth)))
        corners = np.stack([b.on_wall(wall, x, 0, -0.02), b.on_wall(wall, x + w, 0, -depth)])[:, :2]
        b.tops.append(Top(corners.min(0), corners.max(0), z + 0.026))
    elif kind == "box":
        b.add("box", b.material(), b.plate(wall, (x, x + w), (z, z + h), (-0.002, -b.between(0.05, 0.35))))
    elif kind == "poster":
        b.add("poster", b.material("flat", face), b.plate(wall, (x, x + w), (z, z + h), (-0.001, -0.004)))
    else:
        edge, depth = b.between(0.01, 0.07), b.between(0.015, 0.05)
        if kind == "mirror" and b.chance(0.4):  # down to the floor
            z, h = 0.1, min(1.9, b.size[2] - 0.4)
        sides = [((x - edge, x + w + edge), (z - edge, z)), ((x - edge, x + w + edge), (z + h, z + h + edge))]
        sides += [((x - edge, x), (z, z + h)), ((x + w, x + w + edge), (z, z + h))]
        b.add(
            "frame",
            b.material("thin" if kind == "mirror" else "thing"),
            *[b.plate(wall, *side, (-0.001, -depth)) for side in sides],
        )
        inner = b.material("mirror") if kind == "mirror" else b.material("flat", face)
        b.add(kind, inner, b.plate(wall, (x, x + w), (z, z + h), (-0.001, -0.8 * depth)))


def hanging(b: Building) -> None:
    """A solid that hangs from the ceiling."""
    x, y, z = b.between(0.4, b.size[0] - 0.4), b.between(0.4, b.size[1] - 0.4), float(b.size[2])
    drop, shape = b.between(0.3, 0.9), solid(b.rng, b.between(0.08, 0.25))
    low, high = bounds(shape)
    b.add("cord", b.material("thin"), shapes.tube([(x, y, z - drop), (x, y, z - 0.001)], 0.005, 6))
    hook = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2]])
    b.add("hanging", b.material(), shapes.move(shape, np.array([x, y, z - drop]) - hook))


def clutter(b: Building, top: Top) -> None:
    """A paper, a book, cutlery or a solid on a surface."""
    span = top.high - top.low
    if span.min() < 0.08:
        return
    kind = b.rng.choice(["paper", "rod", "solid"], p=[0.28, 0.08, 0.64])
    if kind == "paper":
        size = np.array([b.between(0.1, 0.3), b.between(0.1, 0.25)])
        x, y = b.rng.uniform(top.low, np.maximum(top.high - size, top.low + 0.01))
        high = float(b.rng.choice([0.002, 0.02, 0.06]))
        sheet = box((-size[0] / 2, -size[1] / 2, 0), (size[0] / 2, size[1] / 2, high))
        b.add(
            "paper",
            b.material("flat", "z"),
            shapes.move(sheet, (x + size[0] / 2, y + size[1] / 2, top.z + 0.001), b.between(0, 40)),
        )
        return
    if kind == "rod":
        rod = shapes.tube([(-0.09, 0, 0), (0.02, 0, 0), (0.09, 0, 0)], [0.004, 0.004, 0.012], 8)
        x, y = b.rng.uniform(top.low, top.high)
        b.add("rod", b.material("thin"), shapes.move(rod, (x, y, top.z + 0.013), b.between(0, 180)))
        return
    shape = solid(b.rng, b.between(0.03, min(0.2, span.min() / 2)))
    low, high = bounds(shape)
    if high[2] - low[2] > b.size[2] - top.z - 0.1:
        return
    x, y = b.rng.uniform(top.low, np.maximum(top.high - (high - low)[:2], top.low + 0.01))
    b.add("clutter", b.material(), shapes.move(shape, np.array([x, y, top.z + 0.001]) - low))


KINDS = (
    (table, 2.0),
    (sofa, 1.2),
    (cabinet, 2.0),
    (shelf, 1.5),
    (bed, 0.7),
    (chair, 2.0),
    (pile, 2.0),
    (plant, 1.0),
    (column, 0.8),
    (counter, 1.2),
    (boulder, 1.2),
    (screen, 0.8),
    (rack, 0.8),
)
"""Kinds of furniture and how often they are drawn, before a room's own preferences."""
