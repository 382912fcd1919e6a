"""A room: one mesh with object ids, names, materials, one-sided emission and the cameras that photograph it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.camera.pinhole import look_at
from iif_core.errors import InputError
from lab.rooms.patterns import Material, MaterialTable
from lab.rooms.shapes import Shape, merge, quarter
from lab.simulated.photographs import ResponseCurve

EMITTER_MATERIAL = Material((0.0, 0.0, 0.0), roughness=(1.0, 0.0, 0.0))
CAMERA_MARGIN = 0.10  # metres between a camera and the box around any piece of furniture
_STEP = np.array([0.8191725, 0.6710436, 0.5497005])  # generator of the R3 sequence, which spreads any number of points evenly


@dataclass(frozen=True)
class Scan:
    """The mesh of a room that is delivered with its photographs.

    Attributes:
        vertices: (n, 3) float32 metres; faces: (m, 3) int32.
        object_id: (m,) int32 rows of `names`.
        material_id: (m,) int32 rows of the room's materials.
        names: one per object.
        emission: (m, 3) float32 radiance of the front side.
    """

    vertices: np.ndarray
    faces: np.ndarray
    object_id: np.ndarray
    material_id: np.ndarray
    names: tuple[str, ...]
    emission: np.ndarray


@dataclass(frozen=True)
class Room:
    """A furnished room; metres, z up, right-handed.

    Attributes:
        name: scene name.
        vertices: (n, 3) float32.
        faces: (m, 3) int32, counter-clockwise seen from the side that faces the room.
        object_id: (m,) int32, 0 ... len(names) - 1.
        names: one unique name per object.
        materials: one material per object.
        emission: (m, 3) float32 radiance of the front side, relative, linear RGB; 0 for faces that do not emit.
        size: (3,) inner extent; the inside of the room is [0, size].
        parts: (p, 2, 3) bounding boxes of the separate pieces of furniture; cameras stay out of them.
        shots: (s, 2, 3) hand-chosen positions and targets, ordered so that the first n cover the room well for any n >= 8.
        field_of_view: horizontal, degrees.
        environment: (H, W, 3) float32 radiance of what surrounds the room (`iif_core.light.environment`); None = nothing.
        scanned: object id -> shape that the delivered mesh has in place of the object's own.
        one_object: the delivered mesh tells no objects apart.
        max_bounces: longest path of its photographs.
        response: of the camera that photographs it; None = that of all rooms.
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
    shots: np.ndarray
    field_of_view: float = 72.0
    environment: np.ndarray | None = None
    scanned: Mapping[int, Shape] = field(default_factory=dict)
    one_object: bool = False
    max_bounces: int = 16
    response: ResponseCurve | None = None

    @property
    def scan(self) -> Scan:
        """The mesh that is delivered: the room's own but for the objects in `scanned`, which do not emit."""
        vertices, faces, material, emission = self.vertices, self.faces, self.object_id, self.emission
        if self.scanned:
            kept = ~np.isin(self.object_id, list(self.scanned))
            vertices, faces = merge((vertices, faces[kept]), *self.scanned.values())
            added = np.repeat(list(self.scanned), [len(shape[1]) for shape in self.scanned.values()])
            material = np.concatenate([material[kept], added]).astype(np.int32)
            emission = np.concatenate([emission[kept], np.zeros((len(added), 3), np.float32)])
        owner, names = (np.zeros_like(material), ("room",)) if self.one_object else (material, self.names)
        return Scan(vertices.astype(np.float32), faces.astype(np.int32), owner, material, names, emission)

    def quartered(self) -> Room:
        """The same room with four faces in place of each one, as a finer scan has them."""
        vertices, faces = quarter(self.vertices, self.faces)
        return replace(
            self,
            vertices=vertices.astype(np.float32),
            faces=faces.astype(np.int32),
            object_id=np.repeat(self.object_id, 4),
            emission=np.repeat(self.emission, 4, 0),
            scanned={number: quarter(*shape) for number, shape in self.scanned.items()},
        )

    def is_free(self, position: Sequence[float], margin: float = CAMERA_MARGIN) -> bool:
        """Return whether a camera may stand at `position`: inside the room and `margin` metres away from all furniture."""
        p = np.asarray(position, float)
        inside = (p > margin).all() and (p < self.size - margin).all()
        return bool(inside and not ((p > self.parts[:, 0] - margin) & (p < self.parts[:, 1] + margin)).all(1).any())

    def cameras(self, count: int) -> list[np.ndarray]:
        """Return `world_from_camera` (4, 4) of `count` different cameras: the hand-chosen ones, then shifted copies of them.

        Raises:
            InputError: the room has no space for so many cameras.
        """
        poses = [look_at(position, target, (0, 0, 1)) for position, target in self.shots[:count]]
        attempt = 0
        while len(poses) < count:
            if attempt > 20 * count:
                raise InputError(f"capture.views: {count} cameras do not fit into the room {self.name}; ask for fewer")
            base = self.shots[attempt % len(self.shots)]
            spread = (0.5 + _STEP * (attempt + 1)) % 1 - 0.5
            position = base[0] + spread * (0.7, 0.7, 0.4)
            target = base[1] + spread[[2, 0, 1]] * (0.8, 0.8, 0.5)
            attempt += 1
            if self.is_free(position) and np.linalg.norm(target - position) > 0.5:
                poses.append(look_at(position, target, (0, 0, 1)))
        return poses


class RoomBuilder:
    """Collects the objects of a room; `finish` makes the room."""

    def __init__(self, name: str, size: Sequence[float]):
        self.name, self.size = name, np.asarray(size, float)
        self._objects: list[tuple[str, Shape, Material, np.ndarray]] = []
        self._parts: list[np.ndarray] = []
        self._scanned: dict[int, Shape] = {}

    def add(
        self, name: str, material: Material, *shapes: Shape, is_part: bool = True, scanned: Sequence[Shape] | None = None
    ) -> None:
        """Add an object of one or more shapes.

        Args:
            name: unique in the room.
            material: of all its shapes.
            *shapes: merged into one object.
            is_part: False where cameras need not keep their distance (walls, floor).
            scanned: shapes that the delivered mesh has instead; None = the same.
        """
        if scanned is not None:
            self._scanned[len(self._objects)] = merge(*scanned)
        self._add(name, material, shapes, (0.0, 0.0, 0.0), is_part)

    @property
    def parts(self) -> np.ndarray:
        """(p, 2, 3) bounding boxes of what cameras keep their distance from."""
        return np.array(self._parts).reshape(-1, 2, 3)

    def add_emitter(self, name: str, *shapes: Shape, radiance: Sequence[Sequence[float]] | Sequence[float]) -> None:
        """Add an emitter; `radiance` is (3,) for all shapes or one row per shape."""
        self._add(name, EMITTER_MATERIAL, shapes, radiance, True)

    def _add(self, name: str, material: Material, shapes: Sequence[Shape], radiance: Sequence, is_part: bool) -> None:
        per_shape = np.broadcast_to(np.asarray(radiance, float), (len(shapes), 3))
        emission = np.repeat(per_shape, [len(faces) for _, faces in shapes], axis=0)
        self._objects.append((name, merge(*shapes), material, emission))
        if is_part:
            self._parts += [np.stack([vertices.min(0), vertices.max(0)]) for vertices, _ in shapes]

    def finish(self, shots: str) -> Room:
        """Return the room; `shots` holds rows of six numbers, a camera's position and target in metres."""
        names, shapes, materials, emission = zip(*self._objects, strict=True)
        if len(set(names)) != len(names):
            raise ValueError(f"room {self.name}: two objects share a name")
        vertices, faces = merge(*shapes)
        object_id = np.repeat(np.arange(len(names)), [len(shape[1]) for shape in shapes])
        return Room(
            self.name,
            vertices.astype(np.float32),
            faces.astype(np.int32),
            object_id.astype(np.int32),
            names,
            MaterialTable(materials),
            np.concatenate(emission).astype(np.float32),
            self.size,
            self.parts,
            np.array(shots.split(), float).reshape(-1, 2, 3),
            scanned=self._scanned,
        )
