"""Vertices, faces and face ids of PLY files, text or binary, whose faces may have any and different numbers of corners."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from iif_core.errors import InputError
from workflow.intake.meshes import AGAIN, HEADER_BYTES, check_faces
from workflow.intake.polygons import naming, triangulated

Array = np.ndarray
_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
_UNPACK = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d", "i8": "q", "u8": "Q"}
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """An element of the header: `properties` are (name, kind, kind of a list's count or None)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]


def read_ply(path: Path) -> tuple[Array, Array, Array | None]:
    """Return vertices (n, 3) float64, triangles (m, 3) int64, and the property `instance` of the face of each (m,) float64, None
    where faces have no such property. The header was checked before (`meshes.check_mesh`).

    Raises:
        InputError: no vertices with x, y, z; the data end before the header says so; a face names a vertex that is not there.
    """
    data = path.read_bytes()
    mark = re.search(rb"^end_header[^\n]*\n?", data, re.MULTILINE)
    if mark is None:
        raise InputError(f"{path}: cut short (its header has no end); {AGAIN}")
    body = mark.end()
    order, elements = _header(path, data[: mark.start()])
    vertices, ids = None, None
    polygons: list[tuple[Array, Array]] = []
    source = _Words(path, data[body:]) if order == "ascii" else _Bytes(path, data, body, order)
    for element in elements:
        scalars, lists = source.read(element)
        if element.name == "vertex":
            missing = [axis for axis in "xyz" if axis not in scalars]
            if missing:
                raise InputError(f"{path}: vertices without {', '.join(missing)}; {AGAIN}")
            vertices = np.stack([scalars[axis] for axis in "xyz"], 1).astype(np.float64)
        elif element.name == "face":
            polygons, ids = next((lists[name] for name in _CORNERS if name in lists), []), scalars.get("instance")
    if vertices is None:
        raise InputError(f"{path}: no vertices; {AGAIN}")
    for _, corners in polygons:
        if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
            raise InputError(f"{path}: faces name vertices {corners.min()} ... {corners.max()}, it has 0 ... {len(vertices) - 1}")
    check_faces(path, sum(len(own) * max(own.shape[1] - 2, 0) for _, own in polygons))
    with naming(path):
        faces, place = triangulated(vertices, polygons)
    return vertices, faces, None if ids is None else ids[place].astype(np.float64)


def face_properties(path: Path) -> set[str]:
    """Return the names of the properties of faces in the header of a file that was checked before (`meshes.check_mesh`)."""
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    mark = re.search(rb"^end_header", head, re.MULTILINE)
    elements = _header(path, head[: mark.start()])[1] if mark else []
    return {name for element in elements if element.name == "face" for name, _, _ in element.properties}


def _header(path: Path, head: bytes) -> tuple[str, list[_Element]]:
    order, elements = "", []
    for line in head.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}.get(" ".join(words[1:2]), "")
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            is_list = words[1] == "list"
            elements[-1].properties.append((words[-1], _KINDS[words[-2]], _KINDS[words[2]] if is_list else None))
    if not order:
        raise InputError(f"{path}: its header names no format of PLY (ascii, binary_little_endian, binary_big_endian); {AGAIN}")
    return order, elements


_Read = tuple[dict[str, Array], dict[str, list[tuple[Array, Array]]]]
"""Scalar properties (count,) by name, and lists by name: for each length k the places (p,) and entries (p, k)."""


@dataclass
class _Bytes:
    """Reads the elements of a binary file one after the other; `at` is where the next begins."""

    path: Path
    data: bytes
    at: int
    order: str

    def read(self, element: _Element) -> _Read:
        if all(counted is None for _, _, counted in element.properties):
            record = np.dtype([(f"{i}", self.order + kind) for i, (_, kind, _) in enumerate(element.properties)])
            self._reach(self.at + record.itemsize * element.count)
            rows = (
                np.frombuffer(self.data, record, element.count, self.at) if record.itemsize else np.zeros(element.count, record)
            )
            self.at += record.itemsize * element.count
            return {name: rows[f"{i}"] for i, (name, _, _) in enumerate(element.properties)}, {}

        if not element.count:
            return {}, {}
        even = self._even(element)
        if even is not None:
            return even

        # -------- records of lists have different sizes: find where each property of each begins --------
        start = np.zeros((len(element.properties), element.count), np.int64)
        length = np.ones_like(start)
        sizes = [(np.dtype(kind).itemsize, counted and struct.Struct(self.order + _UNPACK[counted]))
                 for _, kind, counted in element.properties]  # fmt: skip
        at, end = self.at, len(self.data)
        for row in range(element.count):
            for i, (size, counted) in enumerate(sizes):
                if counted:
                    if at + counted.size > end:
                        self._reach(end + 1)
                    length[i, row] = count = int(counted.unpack_from(self.data, at)[0])
                    at += counted.size
                    if not 0 <= count <= end:
                        self._reach(end + 1)
                    start[i, row] = at
                    at += size * count
                else:
                    start[i, row] = at
                    at += size
        self._reach(at)
        self.at = at
        scalars, lists, raw = {}, {}, np.frombuffer(self.data, np.uint8)
        for i, (name, kind, counted) in enumerate(element.properties):
            parts = []
            for k in np.unique(length[i]):
                own = np.flatnonzero(length[i] == k)
                width = int(k) * np.dtype(kind).itemsize
                cut = raw[start[i, own][:, None] + np.arange(width)]
                parts.append((own, np.ascontiguousarray(cut).view(self.order + kind).reshape(len(own), int(k))))
            if counted:
                lists[name] = [(own, values.astype(np.int64)) for own, values in parts]
            else:
                scalars[name] = parts[0][1][:, 0] if parts else np.zeros(0)
        return scalars, lists

    def _even(self, element: _Element) -> _Read | None:
        """Read an element whose lists are all as long as those of its first record; None if they are not."""
        fields, at = [], self.at
        for i, (_, kind, counted) in enumerate(element.properties):
            if counted:
                size = np.dtype(counted).itemsize
                self._reach(at + size)
                count = int(np.frombuffer(self.data, self.order + counted, 1, at)[0])
                if not 0 <= count <= len(self.data):
                    return None
                fields += [(f"count {i}", self.order + counted), (f"{i}", self.order + kind, (count,))]
                at += size + count * np.dtype(kind).itemsize
            else:
                fields.append((f"{i}", self.order + kind))
                at += np.dtype(kind).itemsize
        record = np.dtype(fields)
        if self.at + record.itemsize * element.count > len(self.data):
            return None
        rows = np.frombuffer(self.data, record, element.count, self.at)
        scalars, lists, every = {}, {}, np.arange(element.count)
        for i, (name, _, counted) in enumerate(element.properties):
            if counted and (rows[f"count {i}"] != rows[f"{i}"].shape[1]).any():
                return None
            if counted:
                lists[name] = [(every, rows[f"{i}"].astype(np.int64))]
            else:
                scalars[name] = rows[f"{i}"]
        self.at += record.itemsize * element.count
        return scalars, lists

    def _reach(self, end: int) -> None:
        if end > len(self.data):
            raise InputError(f"{self.path}: cut short (its header announces more than its {len(self.data)} bytes hold); {AGAIN}")


class _Words:
    """Reads the elements of a text file one after the other."""

    def __init__(self, path: Path, data: bytes):
        self.path, self.at = path, 0
        try:
            self.numbers = np.array(data.split(), np.float64)
        except ValueError as error:
            raise InputError(f"{path}: holds text where its header announces numbers ({str(error)[:80]}); {AGAIN}") from None

    def read(self, element: _Element) -> _Read:
        if all(counted is None for _, _, counted in element.properties):
            width = len(element.properties)
            rows = self._next(width * element.count).reshape(element.count, width)
            return {name: rows[:, i] for i, (name, _, _) in enumerate(element.properties)}, {}
        even = self._even(element)
        if even is not None:
            return even
        scalars: dict[str, list[float]] = {name: [] for name, _, counted in element.properties if counted is None}
        found: dict[str, dict[int, tuple[list[int], list[Array]]]] = {
            name: {} for name, _, counted in element.properties if counted
        }
        for row in range(element.count):
            for name, _, counted in element.properties:
                value = self._next(1)[0]
                if counted is None:
                    scalars[name].append(value)
                    continue
                places, entries = found[name].setdefault(int(value), ([], []))
                places.append(row)
                entries.append(self._next(int(value)))
        lists = {
            name: [(np.array(rows), self._whole(np.array(own).reshape(len(rows), k))) for k, (rows, own) in sorted(some.items())]
            for name, some in found.items()
        }
        return {name: np.array(values) for name, values in scalars.items()}, lists

    def _even(self, element: _Element) -> _Read | None:
        """Read an element whose lists are all as long as those of its first record; None if they are not."""
        spans, width = [], 0
        for _, _, counted in element.properties:
            head = self.numbers[self.at + width : self.at + width + 1]
            count = int(head[0]) if counted and len(head) and 0 <= head[0] <= len(self.numbers) else 0
            spans.append((width, count))
            width += 1 + count
        if self.at + width * element.count > len(self.numbers) or not element.count:
            return None
        rows = self.numbers[self.at : self.at + width * element.count].reshape(element.count, width)
        scalars, lists, every = {}, {}, np.arange(element.count)
        for (name, _, counted), (start, count) in zip(element.properties, spans, strict=True):
            if counted and (rows[:, start] != count).any():
                return None
            if counted:
                lists[name] = [(every, self._whole(rows[:, start + 1 : start + 1 + count]))]
            else:
                scalars[name] = rows[:, start]
        self.at += width * element.count
        return scalars, lists

    def _whole(self, values: Array) -> Array:
        if not (values == np.rint(values)).all():
            raise InputError(f"{self.path}: a list of corners holds numbers that are no integers; {AGAIN}")
        return values.astype(np.int64)

    def _next(self, count: int) -> Array:
        out = self.numbers[self.at : self.at + count]
        if count < 0 or len(out) < count:
            raise InputError(f"{self.path}: cut short (its header announces more numbers than follow); {AGAIN}")
        self.at += count
        return out
