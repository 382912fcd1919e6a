"""Mesh files of strangers: what their headers announce is compared with what is there, before a reader allocates it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file

AGAIN = "export the mesh again, or copy it again"
HEADER_BYTES = 1 << 20
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}


def check_mesh(path: Path) -> None:
    """Refuse a PLY or OBJ file that is too large, cut short as far as its header or its last line tells, or no such file.

    Raises:
        InputError: as said.
    """
    size = check_file(path, limits.MESH_BYTES, "a mesh")
    if path.suffix.lower() == ".ply":
        _check_ply(path, size)
    elif path.suffix.lower() == ".obj":
        _check_obj(path, size)


def _check_ply(path: Path, size: int) -> None:
    with path.open("rb") as file:
        head, mark, _ = file.read(HEADER_BYTES).partition(b"end_header")
    if not mark:
        raise InputError(f"{path}: cut short (its header has no end); {AGAIN}")
    ascii_form, elements = b"format ascii" in head, []
    for number, line in enumerate(head.split(b"\n"), 1):
        words = line.decode("ascii", "replace").split()
        where = f"{path}, line {number}"
        if words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"\d{1,18}", words[2]):
                raise InputError(f"{where}: expected `element <name> <count>`; {AGAIN}")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            kinds = words[2:4] if words[1:2] == ["list"] else words[1:2]
            words_needed = 5 if words[1:2] == ["list"] else 3
            if not elements or len(words) != words_needed or set(kinds) - set(_SIZES):
                raise InputError(f"{where}: expected a property of an element, of a type of PLY; {AGAIN}")
            of_face = elements[-1][0] == "face" and words[-1] in ("vertex_indices", "vertex_index")
            corners = [_SIZES[kinds[-1]]] * 3 if of_face and words[1] == "list" else []
            elements[-1][2].extend([_SIZES[kinds[0]], *corners])  # a list has its count at least, and a face three corners
    least = 0
    for name, count, sizes in elements:
        if count > limits.MESH_ELEMENTS:
            raise InputError(f"{path}: announces {count} of {name}; allowed are {limits.MESH_ELEMENTS}. Simplify the mesh")
        least += count * (max(1, 2 * len(sizes)) if ascii_form else sum(sizes))
    if least - ascii_form > size - len(head) - len(mark):
        said = ", ".join(f"{count} of {name}" for name, count, _ in elements)
        raise InputError(f"{path}: cut short (its header announces {said}; its {size} bytes hold fewer); {AGAIN}")


def _check_obj(path: Path, size: int) -> None:
    with path.open("rb") as file:
        file.seek(max(0, size - 4096))
        last = file.read().rstrip().rsplit(b"\n", 1)[-1].split()
    needed = {b"f": 4, b"v": 4, b"vn": 4, b"vt": 2, b"l": 3}.get(last[0] if last else b"", 0)
    if len(last) < needed:
        raise InputError(f"{path}: cut short (its last line is {b' '.join(last)[:60].decode(errors='replace')!r}); {AGAIN}")


def check_gltf(path: Path, document: dict[str, Any], there: int) -> None:
    """Refuse accessors and nodes of a glTF document that ask for more than the file has.

    Args:
        path: for messages.
        document: its JSON.
        there: bytes of all its buffers.
    """
    for name in ("accessors", "bufferViews", "buffers", "images", "materials", "meshes", "nodes", "scenes", "textures"):
        listed = document.get(name, [])
        if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
            raise InputError(f"{path}: `{name}` is no list of objects; {AGAIN}")
    if len(document.get("nodes", [])) > limits.FRAMES:
        raise InputError(f"{path}: {len(document['nodes'])} nodes; allowed are {limits.FRAMES}")
    # What Draco has compressed has no buffer, and is larger than what is there.
    is_packed = "KHR_draco_mesh_compression" in (document.get("extensionsUsed") or ())
    for number, accessor in enumerate(document.get("accessors", [])):
        count = accessor.get("count")
        most = 3 * limits.MESH_ELEMENTS if is_packed and "bufferView" not in accessor else there
        if not isinstance(count, int) or not 0 <= count <= most:
            raise InputError(f"{path}: accessor {number} announces {count!r} entries; its buffers have {there} bytes; {AGAIN}")


def check_faces(path: Path, faces: int, most: int = limits.MESH_ELEMENTS) -> None:
    """Refuse a mesh of too many faces, as of one part that thousands of nodes repeat."""
    if faces > most:
        raise InputError(f"{path}: {faces} faces with all that its nodes repeat; allowed are {most}. Simplify the mesh")
