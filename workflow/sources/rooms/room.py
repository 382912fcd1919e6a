"""A room: one mesh with object ids, names, materials, one-sided emission, cameras a person would choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.camera.pinhole import look_at
from iif_core.errors import InputError
from workflow.sources.rooms.patterns import Material, MaterialTable
from workflow.sources.rooms.shapes import Shape, merge

BLACK = Material((0.0, 0.0, 0.0), roughness=(1.0, 0.0, 0.0))
"""What emitters are made of."""

_MARGIN = 0.10  # metres between a camera and the box around any part
_STEP = np.array([0.8191725, 0.6710436, 0.5497005])  # R3 sequence: even spread for any count


@dataclass(frozen=True)
class Room:
    """A closed, furnished room; metres, z up, right-handed.

    Attributes:
        name: scene name.
        vertices: (n, 3) float32.
        faces: (m, 3) int32, counter-clockwise seen from the side that can be looked at.
        object_id: (m,) int32, 0 ... len(names) - 1.
        names: one an object, unique.
        materials: one an object.
        emission: (m, 3) float32 radiance of the front side, 0 for what does not shine.
        size: (3,) inner extent; the inside is [0, size].
        parts: (p, 2, 3) boxes around the separate pieces of furniture; cameras stay out of them.
        shots: hand-chosen (position, target) pairs; the first n cover the room well for any n from 8 up.
        field_of_view: horizontal, degrees.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    names: tuple[str, ...]
    materials: MaterialTable
    emission: np.ndarray
    size: np.ndarray
    parts: np.ndarray
    shots: tuple[tuple[Sequence[float], Sequence[float]], ...]
    field_of_view: float = 72.0

    @property
    def is_emitter(self) -> np.ndarray:
        """(objects,) bool."""
        shining = np.zeros(len(self.names), bool)
        shining[self.object_id[self.emission.any(1)]] = True
        return shining

    def is_free(self, position: Sequence[float], margin: float = _MARGIN) -> bool:
        """Whether a camera may stand here: inside the room and `margin` metres away from everything."""
        p = np.asarray(position, float)
        inside = (p > margin).all() and (p < self.size - margin).all()
        return bool(inside and not ((p > self.parts[:, 0] - margin) & (p < self.parts[:, 1] + margin)).all(1).any())

    def cameras(self, count: int) -> list[np.ndarray]:
        """`world_from_camera` (4x4) of `count` different cameras: the hand-chosen, then these moved a bit.

        Raises:
            InputError: no room is left for so many cameras.
        """
        poses = [look_at(position, target, (0, 0, 1)) for position, target in self.shots[:count]]
        attempt = 0
        while len(poses) < count:
            if attempt > 20 * count:
                raise InputError(f"capture.views: {count} cameras do not fit into the room {self.name}; ask for fewer")
            base = self.shots[attempt % len(self.shots)]
            spread = (0.5 + _STEP * (attempt + 1)) % 1 - 0.5
            position = np.asarray(base[0]) + spread * (0.7, 0.7, 0.4)
            target = np.asarray(base[1]) + spread[[2, 0, 1]] * (0.8, 0.8, 0.5)
            attempt += 1
            if self.is_free(position) and np.linalg.norm(target - position) > 0.5:
                poses.append(look_at(position, target, (0, 0, 1)))
        return poses


class RoomBuilder:
    """Collects objects; `finish` makes the room."""

    def __init__(self, name: str, size: Sequence[float]):
        self.name, self.size = name, np.asarray(size, float)
        self._objects: list[tuple[str, Shape, Material, np.ndarray]] = []
        self._parts: list[np.ndarray] = []

    def add(self, name: str, *shapes: Shape, material: Material, is_part: bool = True) -> None:
        """An object of one or more shapes. `is_part=False`: cameras need not keep away (walls, floor)."""
        shape = merge(*shapes)
        self._objects.append((name, shape, material, np.zeros((len(shape[1]), 3))))
        if is_part:
            self._parts += [np.stack([s[0].min(0), s[0].max(0)]) for s in shapes]

    def add_emitter(self, name: str, *shapes: Shape, radiance: Sequence[Sequence[float]] | Sequence[float]) -> None:
        """An emitter; `radiance` (3,) for all shapes or one row a shape."""
        shape = merge(*shapes)
        per_shape = np.broadcast_to(np.asarray(radiance, float), (len(shapes), 3))
        emission = np.repeat(per_shape, [len(s[1]) for s in shapes], axis=0)
        self._objects.append((name, shape, BLACK, emission))
        self._parts += [np.stack([s[0].min(0), s[0].max(0)]) for s in shapes]

    def finish(self, shots: Sequence[tuple[Sequence[float], Sequence[float]]], field_of_view: float = 72.0) -> Room:
        """The room with its cameras."""
        names = tuple(name for name, *_ in self._objects)
        if len(set(names)) != len(names):
            raise ValueError(f"room {self.name}: two objects share a name")
        vertices, faces = merge(*(shape for _, shape, _, _ in self._objects))
        object_id = np.repeat(np.arange(len(names)), [len(shape[1]) for _, shape, _, _ in self._objects])
        return Room(
            self.name,
            vertices.astype(np.float32),
            faces.astype(np.int32),
            object_id.astype(np.int32),
            names,
            MaterialTable(tuple(material for _, _, material, _ in self._objects)),
            np.concatenate([emission for *_, emission in self._objects]).astype(np.float32),
            self.size,
            np.array(self._parts).reshape(-1, 2, 3),
            tuple(shots),
            field_of_view,
        )
