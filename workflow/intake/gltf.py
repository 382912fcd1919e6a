"""glTF files of strangers: their JSON is checked before a reader sees it, and what Trimesh does not read is written plainly.

Quantised attributes become floats, instances become nodes, triangle fans and strips become triangles. Draco is left to Trimesh.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_bytes, reading, shorter
from workflow.intake.meshes import AGAIN, check_faces, check_gltf

QUANTISED, INSTANCED, DRACO = "KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_draco_mesh_compression"
_GEOMETRY = (QUANTISED, INSTANCED, DRACO)
"""Extensions that say how geometry is stored, and are read."""
_APPEARANCE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
"""How extensions begin that say nothing of geometry."""
_GLB_HEADER, _CHUNK_HEADER = struct.Struct("<4sII"), struct.Struct("<II")
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_FLOAT, _UNSIGNED = 5126, 5125
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MOST_INSTANCES = 100_000
_AS_FLOATS = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_")
"""Attributes that a reader may expect as floats."""

_PLACES = ("TRANSLATION", "ROTATION", "SCALE")
"""Attributes of an instance that say where it is."""

Document = dict[str, Any]


def document_of(path: Path) -> tuple[Document, bytes, int]:
    """Return the checked JSON of a .glb or .gltf file, the bytes of its own binary part, and the size of the file.

    Raises:
        InputError: no such file, cut short, damaged, or it needs an extension that is not known.
    """
    is_glb = path.suffix.lower() == ".glb"
    data = read_bytes(path, limits.MESH_BYTES if is_glb else limits.DOCUMENT_BYTES, "a mesh")
    text, binary = _chunks(path, data) if is_glb else (data, b"")
    return _json(path, text), binary, len(data)


def refuse_extensions(path: Path, document: Document, others: tuple[str, ...] = _APPEARANCE) -> None:
    """Refuse a file that requires an extension which is neither read nor one of `others`, told by how their names begin."""
    needed = document.get("extensionsRequired", [])
    for name in needed if isinstance(needed, list) else []:
        if name not in _GEOMETRY and not str(name).startswith(others):
            raise InputError(
                f"{path}: needs the glTF extension {str(name)[:60]}, which is not read; export the mesh without it (without"
                " compression)"
            )


def named_files(path: Path, document: Document, there: Callable[[Path, Path, str], Path]) -> list[Path]:
    """Return the files that a document names, each as `there` (owner, path, what it is) returns it."""
    found = []
    for part, what in (("buffers", "buffer"), ("images", "texture")):
        for entry in document.get(part, []):
            uri = entry.get("uri", "")
            if uri and not uri.startswith("data:"):
                if len(uri) > limits.TEXT:
                    raise InputError(f"{path}: the path of a {what} has {len(uri)} characters (allowed {limits.TEXT})")
                found.append(there(path, path.parent / unquote(uri), what))
    return found


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Return the JSON and the binary part of a GLB."""
    if len(data) < _GLB_HEADER.size + _CHUNK_HEADER.size or data[:4] != b"glTF":
        raise InputError(f"{path}: no GLB file; it does not begin with `glTF`. Export the mesh again")
    _, _, length = _GLB_HEADER.unpack_from(data)
    if length > len(data):
        raise InputError(
            f"{path}: cut short (its header announces {length} bytes, it has {len(data)}); export it again, or copy it again"
        )
    parts, at = [], _GLB_HEADER.size
    while at < len(data):  # a reader asks for as much memory as the length of a part says, also behind the last
        size, kind = _CHUNK_HEADER.unpack_from(data, at) if at + _CHUNK_HEADER.size <= len(data) else (len(data), 0)
        start = at + _CHUNK_HEADER.size
        at = start + size
        if at > len(data):
            raise InputError(f"{path}: damaged; one of its parts has {size} bytes, the file {len(data)}. Export the mesh again")
        parts.append((kind, data[start:at]))
    if parts[0][0] != _JSON_CHUNK:
        raise InputError(f"{path}: no GLB file of version 2; its first part is not JSON. Export the mesh again")
    return parts[0][1], next((part for kind, part in parts[1:] if kind == _BINARY_CHUNK), b"")


def _json(path: Path, text: bytes) -> Document:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as glTF ({shorter(error)}); export the mesh again") from None
    if not isinstance(document, dict) or "asset" not in document:
        raise InputError(f"{path}: no glTF file; it has no `asset`. Export the mesh again")
    return document


# --------------------------------------------------------------------------------------------------------- plain form


@dataclass
class _Plain:
    """A document that is being written plainly; `added` holds arrays that follow its binary part."""

    path: Path
    document: Document
    buffers: list[bytes]
    added: list[bytes] = field(default_factory=list)
    grown: int = 0

    def values(self, number: Any) -> np.ndarray:
        """Return an accessor (count, width) as it is meant: normalised integers are divided, sparse entries replaced."""
        accessor = self._entry("accessors", number)
        kind, width = _TYPES.get(accessor.get("componentType")), _WIDTHS.get(accessor.get("type"))
        if kind is None or width is None or width > 4:
            raise InputError(f"{self.path}: accessor {number} holds {accessor.get('type')!r}; {AGAIN}")
        count = accessor["count"]
        out = np.zeros((count, width), kind)
        if "bufferView" in accessor:
            out = self._array(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width)
        if sparse := accessor.get("sparse"):
            own = sparse["indices"], sparse["values"]
            at = self._array(
                own[0]["bufferView"], own[0].get("byteOffset", 0), _TYPES[own[0]["componentType"]], sparse["count"], 1
            )
            out = out.copy()
            out[at[:, 0]] = self._array(own[1]["bufferView"], own[1].get("byteOffset", 0), kind, sparse["count"], width)
        if accessor.get("normalized") and kind is not np.float32:
            # glTF 2.0, 3.6.2.2: c / 127, / 255, / 32767, / 65535, and no less than -1.
            return np.maximum(out.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return out

    def _array(self, view: Any, offset: int, kind: type, count: int, width: int) -> np.ndarray:
        of_view = self._entry("bufferViews", view)
        data = self.buffers[of_view.get("buffer", 0)]
        item = np.dtype(kind).itemsize
        step = of_view.get("byteStride") or item * width
        start = of_view.get("byteOffset", 0) + offset
        length = step * (count - 1) + item * width if count else 0
        if start + length > min(len(data), of_view.get("byteOffset", 0) + of_view["byteLength"]):
            raise InputError(f"{self.path}: an accessor reaches beyond its buffer; {AGAIN}")
        return np.ndarray((count, width), np.dtype(kind).newbyteorder("<"), data, start, (step, item)).astype(kind)

    def _entry(self, part: str, number: Any) -> Document:
        listed = self.document.get(part, [])
        if not isinstance(number, int) or not 0 <= number < len(listed):
            raise InputError(f"{self.path}: names entry {number!r} of `{part}`, which has {len(listed)}; {AGAIN}")
        return listed[number]

    def add(self, values: np.ndarray, accessor: Document) -> int:
        """Append an array as a new accessor, and return its number."""
        data = np.ascontiguousarray(values).tobytes()
        at = len(self.buffers[0]) + self.grown
        self.grown += len(data) + -len(data) % 4
        if self.grown > limits.MESH_BYTES:
            raise InputError(f"{self.path}: its attributes take more than {limits.MESH_BYTES} bytes. Simplify the mesh")
        self.document.setdefault("bufferViews", []).append({"buffer": 0, "byteOffset": at, "byteLength": len(data)})
        self.added.append(data + b"\0" * (-len(data) % 4))
        kind = "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}"
        plain = {"bufferView": len(self.document["bufferViews"]) - 1, "count": len(values), "type": kind}
        self.document.setdefault("accessors", []).append(plain | accessor)
        return len(self.document["accessors"]) - 1

    # -------- the three kinds of what is undone --------

    def primitive(self, primitive: Document, as_floats: dict[int, int]) -> None:
        """Write attributes as floats, and strips and fans as triangles. `as_floats`: accessors that were written already."""
        if DRACO in primitive.get("extensions", {}):
            return
        attributes = primitive.get("attributes", {})
        for name, number in attributes.items():
            accessor = self._entry("accessors", number)
            plain = accessor.get("componentType") == _FLOAT and "sparse" not in accessor
            if plain or not name.startswith(_AS_FLOATS):
                continue
            if number not in as_floats:
                values = self.values(number).astype(np.float32)
                extent = {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if len(values) else {}
                as_floats[number] = self.add(values, {"componentType": _FLOAT} | extent)
            attributes[name] = as_floats[number]
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_STRIP, _FAN) or "POSITION" not in attributes:
            return
        if "indices" in primitive:
            index = self.values(primitive["indices"])[:, 0].astype(np.int64)
        else:
            index = np.arange(self._entry("accessors", attributes["POSITION"])["count"])
        check_faces(self.path, self.grown // 12 + len(index))
        triangles = _of_fan(index) if mode == _FAN else _of_strip(index)
        number = self.add(triangles.reshape(-1, 1).astype(np.uint32), {"componentType": _UNSIGNED})
        primitive |= {"mode": _TRIANGLES, "indices": number}

    def instances(self, nodes: list[Document], node: Document) -> None:
        """Write the instances of a node as nodes below it; `nodes` of the document grow."""
        own = node.get("extensions", {}).get(INSTANCED)
        if not isinstance(own, dict) or "mesh" not in node:
            return
        attributes = own.get("attributes", {})
        count = min((self._entry("accessors", number)["count"] for number in attributes.values()), default=0)
        named = {key.lower(): self.values(number) for key, number in attributes.items() if key in _PLACES}
        if len(nodes) + count > _MOST_INSTANCES:
            raise InputError(f"{self.path}: {count} instances of a mesh; allowed are {_MOST_INSTANCES} in all")
        mesh, name = node.pop("mesh"), node.get("name", "instance")
        below = node.setdefault("children", [])
        for i in range(count):
            placed = {key: values[i].astype(float).tolist() for key, values in named.items()}
            below.append(len(nodes))
            nodes.append({"name": f"{name} {i + 1}", "mesh": mesh} | placed)


def _of_fan(index: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a fan (glTF 2.0, 3.7.2.1): its first vertex belongs to each of them."""
    return np.stack([index[1:-1], index[2:], np.full(max(len(index) - 2, 0), index[0] if len(index) else 0)], 1)


def _of_strip(index: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a strip: every second one is turned over."""
    out = np.stack([index[:-2], index[1:-1], index[2:]], 1)
    out[1::2] = out[1::2, [1, 0, 2]]
    return out


def plain_glb(path: Path) -> bytes:
    """Return a glTF file as a GLB with floats, nodes and triangles where it has quantised attributes, instances, strips and fans.

    Raises:
        InputError: as `document_of`, or an accessor does not fit its buffer.
    """
    document, binary, _ = document_of(path)
    refuse_extensions(path, document)
    with reading(path, "not readable as glTF", "; export the mesh again"):
        buffers = list(_buffers(path, document.get("buffers", []), binary)) or [b""]
        check_gltf(path, document, sum(map(len, buffers)))
        out = _Plain(path, document, [buffers[0] + b"\0" * (-len(buffers[0]) % 4), *buffers[1:]])
        done: dict[int, int] = {}
        for mesh in document.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                out.primitive(primitive, done)
        nodes = document.get("nodes", [])
        for node in list(nodes):
            out.instances(nodes, node)
        for key in ("extensionsUsed", "extensionsRequired"):
            left = [name for name in document.pop(key, []) if name not in (QUANTISED, INSTANCED)]
            document |= {key: left} if left else {}
        return _written(out)


def _buffers(path: Path, entries: list[Document], binary: bytes) -> Iterator[bytes]:
    """The bytes of each buffer; the first alone may be the binary part of the file (glTF 2.0, 3.6.1.1)."""
    total, known = 0, {}
    for number, entry in enumerate(entries):
        uri = entry.get("uri")
        if uri is None and number:
            raise InputError(f"{path}: buffer {number} names no file; {AGAIN}")
        if uri is None:
            data = binary
        elif not uri.startswith("data:"):
            place = path.parent / unquote(uri)
            data = known[place] = known.get(place) or read_bytes(place, limits.MESH_BYTES, "a buffer")
        else:
            head, _, text = uri.partition(",")
            data = base64.b64decode(text) if head.endswith(";base64") else unquote_to_bytes(text)
        total += len(data)
        if total > limits.MESH_BYTES:
            raise InputError(f"{path}: its buffers have more than {limits.MESH_BYTES} bytes. Simplify the mesh")
        yield data


def _written(plain: _Plain) -> bytes:
    """Return a GLB with all buffers in its binary part."""
    document, starts, parts = plain.document, [0], [plain.buffers[0], *plain.added]
    length = len(plain.buffers[0]) + plain.grown
    for buffer in plain.buffers[1:]:
        starts.append(length)
        parts += [buffer, b"\0" * (-len(buffer) % 4)]
        length += len(parts[-2]) + len(parts[-1])
    joined = b"".join(parts)
    for view in document.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view.get("buffer", 0)]
        view["buffer"] = 0
    document["buffers"] = [{"byteLength": len(joined)}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    total = _GLB_HEADER.size + 2 * _CHUNK_HEADER.size + len(text) + len(joined)
    head = _GLB_HEADER.pack(b"glTF", 2, total) + _CHUNK_HEADER.pack(len(text), _JSON_CHUNK)
    return head + text + _CHUNK_HEADER.pack(len(joined), _BINARY_CHUNK) + joined
