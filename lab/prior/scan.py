"""The mesh that a capture of a room would deliver, with the errors that scans and reconstructions have.

Curtains and blinds are closed sheets, and a relief is flat (`Part.delivered`). Apart from that, a share of the meshes is exact,
as simulated captures are; the others bulge, are grainy, have holes, and lack thin objects. Their cameras may be misplaced, too.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from lab.prior.rooms import Room

EXACT = 0.4
"""Share of the captures without errors of mesh and cameras."""
_EDGE = 0.25  # metres; longer edges are halved before a mesh is bent
_WAVES = 24


@dataclass(frozen=True)
class Faults:
    """Errors of a capture's mesh and cameras.

    Attributes:
        bulge, grain: standard deviations in metres of slow and of fine displacement of the surface.
        wavelength: of the slow displacement, metres.
        holes: number of holes; hole: radius of the largest, metres.
        lost: probability that a thin object is missing.
        turn, shift: standard deviations of the errors of cameras, in radians and metres.
    """

    bulge: float = 0.0
    grain: float = 0.0
    wavelength: float = 1.0
    holes: int = 0
    hole: float = 0.0
    lost: float = 0.0
    turn: float = 0.0
    shift: float = 0.0

    def facts(self) -> dict[str, float]:
        """Return the errors for a manifest."""
        return {name: round(value, 5) for name, value in asdict(self).items() if value}


def draw_faults(rng: np.random.Generator) -> Faults:
    """Draw the errors of a capture."""
    if rng.random() < EXACT:
        return Faults()
    has = dict(
        zip(("bulge", "grain", "holes", "lost", "turn", "shift"), rng.random(6) < (0.8, 0.6, 0.5, 0.5, 0.5, 0.5), strict=True)
    )
    drawn = {
        "bulge": float(10 ** rng.uniform(-2.8, -1.6)),
        "grain": float(10 ** rng.uniform(-3.5, -2.3)),
        "holes": int(rng.integers(1, 7)),
        "lost": float(rng.uniform(0, 0.8)),
        "turn": float(np.radians(10 ** rng.uniform(-2, -0.5))),
        "shift": float(10 ** rng.uniform(-3.3, -2.0)),
    }
    sizes = {"wavelength": float(10 ** rng.uniform(-0.6, 0.5)), "hole": float(rng.uniform(0.05, 0.4))}
    return Faults(**{name: value for name, value in drawn.items() if has[name]}, **sizes)


def scan(room: Room, faults: Faults, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make the delivered mesh of a room.

    Args:
        room: the room.
        faults: errors of the mesh.
        rng: random numbers.

    Returns:
        Vertices (n, 3) float32 metres, faces (m, 3) int32, and the part of the room (m,) int32 of each face.
    """
    vertices, faces, own, count = [], [], [], 0
    for number, part in enumerate(room.parts):
        v, f = part.delivered or part.shape
        if _is_thin(v) and rng.random() < faults.lost:
            continue
        if faults.bulge or faults.grain or faults.holes:
            v, f = _refined(v, f)
        vertices.append(v)
        faces.append(f + count)
        own.append(np.full(len(f), number))
        count += len(v)
    v, f, o = np.concatenate(vertices), np.concatenate(faces), np.concatenate(own)
    v = v + faults.bulge * _waves(v, faults.wavelength, rng) + faults.grain * _waves(v, 0.08, rng)
    kept = np.ones(len(f), bool)
    middle = v[f].mean(1)
    for _ in range(faults.holes):
        centre = middle[rng.integers(len(middle))]
        kept &= np.linalg.norm(middle - centre, axis=1) > rng.uniform(0.03, faults.hole)
    return v.astype(np.float32), f[kept].astype(np.int32), o[kept].astype(np.int32)


def misplaced(pose: np.ndarray, faults: Faults, rng: np.random.Generator) -> np.ndarray:
    """Return a pose (4, 4) with the error of a registration."""
    axis, move = rng.normal(0, faults.turn, 3), rng.normal(0, faults.shift, 3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    u, _, v = np.linalg.svd(np.eye(3) + skew)  # nearest rotation
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ (u @ v)
    out[:3, 3] += move
    return out


def _is_thin(vertices: np.ndarray) -> bool:
    """Whether an object is small, or a rod or plate of less than 2 cm."""
    extent = np.sort(np.ptp(vertices, axis=0))
    return bool(extent[1] < 0.03 or extent[2] < 0.08)


def _refined(vertices: np.ndarray, faces: np.ndarray, most: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Cut faces with long edges into four until edges are short.

    Neighbours of a cut face keep their edge, so a bent mesh has gaps of second order in its bend, most of them below a pixel."""
    for _ in range(most):
        corners = vertices[faces]
        longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
        cut = longest > _EDGE
        if not cut.any():
            break
        a, b, c = corners[cut].transpose(1, 0, 2)
        points = np.stack([a, b, c, (a + b) / 2, (b + c) / 2, (c + a) / 2], 1)  # (cut, 6, 3)
        quarters = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
        new = len(vertices) + 6 * np.arange(len(points))[:, None, None] + quarters
        vertices, faces = np.concatenate([vertices, points.reshape(-1, 3)]), np.concatenate([faces[~cut], new.reshape(-1, 3)])
    return vertices, faces


def _waves(points: np.ndarray, wavelength: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth random displacement (n, 3) of unit variance in each coordinate; equal points move alike."""
    ways = rng.normal(0, 2 * np.pi / wavelength, (_WAVES, 3))
    phase = points @ ways.T + rng.uniform(0, 2 * np.pi, _WAVES)
    return np.sin(phase) @ rng.normal(0, np.sqrt(2 / _WAVES), (_WAVES, 3))
