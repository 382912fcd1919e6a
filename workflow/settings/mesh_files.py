"""Files of meshes that can be put into a room: the formats, the files that they need next to them, and what is wrong with them.

This module checks the headers, before any job; `workflow.relighting.inserts` reads the mesh itself.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file, read_bytes, reading, shorter
from workflow.intake.meshes import check_gltf, check_mesh
from workflow.intake.names import shown
from workflow.settings.names import did_you_mean_path

MESHES = (".glb", ".gltf", ".ply", ".obj")
"""Files that can be put into a room."""
_GLB_HEADER = struct.Struct("<4sII")
_CHUNK_HEADER = struct.Struct("<II")
_JSON_CHUNK = 0x4E4F534A
_NOT_READ = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "EXT_texture_webp")
"""Extensions of glTF without which a file that requires them cannot be shown as it is meant."""


def files_of_mesh(path: Path) -> list[Path]:
    """Return a mesh that is there and the files that it names: buffers and textures of glTF, materials and textures of OBJ.

    Raises:
        InputError: the file is empty, cut short or no file of its kind, or a file that it names is missing.
    """
    kind = path.suffix.lower()
    if not check_file(path, limits.MESH_BYTES, "a mesh"):
        raise InputError(f"{path}: empty (0 bytes); export the mesh again, or copy it again")
    if kind in (".glb", ".gltf"):
        document, size = _gltf(path)
        with reading(path, "not readable as glTF", "; export the mesh again"):
            named = _named_by_gltf(path, document)
            there = size + sum(file.stat().st_size for file in named)
            check_gltf(path, document, there)
            return [path, *named]
    if kind == ".obj":
        check_mesh(path)
        return [path, *_named_by_obj(path)]
    if not read_start(path).startswith(b"ply"):
        raise InputError(f"{path}: no PLY file; its first line is not `ply`. Export the mesh again")
    check_mesh(path)
    return [path]


def emissive_strengths(path: Path) -> dict[str, float]:
    """Return the factor on the emission of each material of a glTF file by its name, where it is not 1; empty for other files.

    Raises:
        InputError: as `files_of_mesh`, or materials of one name have two strengths.
    """
    if path.suffix.lower() not in (".glb", ".gltf"):
        return {}
    document, _ = _gltf(path)
    found: dict[str, float] = {}
    with reading(path, "not readable as glTF", "; export the mesh again"):
        for material in document.get("materials", []):
            own = float(material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
            name = str(material.get("name"))
            if not 0 <= own <= limits.RADIANCE:
                said = f"the material {shown(name)} shines with a strength of {own:g}; allowed are 0 ... {limits.RADIANCE:g}"
                raise InputError(f"{path}: {said}. Export the mesh again")
            if found.setdefault(name, own) != own:
                twins = f"two materials are called {shown(name)} and shine with different strength"
                raise InputError(f"{path}: {twins}; rename one of them")
    return {name: strength for name, strength in found.items() if strength != 1.0}


def _gltf(path: Path) -> tuple[dict[str, Any], int]:
    """Return the document of a glTF file, and the bytes of the file."""
    is_glb = path.suffix.lower() == ".glb"
    data = read_bytes(path, limits.MESH_BYTES if is_glb else limits.DOCUMENT_BYTES, "a mesh")
    return _json_of(path, _json_of_glb(path, data) if is_glb else data), len(data)


def read_start(path: Path) -> bytes:
    """Return the first bytes of a file."""
    with reading(path, "cannot be read"), path.open("rb") as file:
        return file.read(16)


def _json_of_glb(path: Path, data: bytes) -> bytes:
    if len(data) < _GLB_HEADER.size + _CHUNK_HEADER.size or data[:4] != b"glTF":
        raise InputError(f"{path}: no GLB file; it does not begin with `glTF`. Export the mesh again")
    _, _, length = _GLB_HEADER.unpack_from(data)
    if length > len(data):
        raise InputError(
            f"{path}: cut short (its header announces {length} bytes, it has {len(data)}); export it again, or copy it again"
        )
    size, kind = _CHUNK_HEADER.unpack_from(data, _GLB_HEADER.size)
    start = _GLB_HEADER.size + _CHUNK_HEADER.size
    if kind != _JSON_CHUNK:
        raise InputError(f"{path}: no GLB file of version 2; its first part is not JSON. Export the mesh again")
    at = _GLB_HEADER.size
    while at < len(data):  # the reader asks for as much memory as the length of a part says, also behind the last
        part = _CHUNK_HEADER.unpack_from(data, at)[0] if at + _CHUNK_HEADER.size <= len(data) else len(data)
        at += _CHUNK_HEADER.size + part
        if at > len(data):
            raise InputError(f"{path}: damaged; one of its parts has {part} bytes, the file {len(data)}. Export the mesh again")
    return data[start : start + size]


def _json_of(path: Path, data: bytes) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as glTF ({shorter(error)}); export the mesh again") from None
    if not isinstance(document, dict) or "asset" not in document:
        raise InputError(f"{path}: no glTF file; it has no `asset`. Export the mesh again")
    needed = document.get("extensionsRequired", [])
    refused = [name for name in needed if name in _NOT_READ] if isinstance(needed, list) else []
    if refused:
        raise InputError(f"{path}: needs the glTF extension {refused[0]}, which is not read; export the mesh without compression")
    return document


def _named_by_gltf(path: Path, document: dict[str, Any]) -> list[Path]:
    found = []
    for part, what in (("buffers", "buffer"), ("images", "texture")):
        for entry in document.get(part, []):
            uri = entry.get("uri", "")
            if uri and not uri.startswith("data:"):
                if len(uri) > limits.TEXT:
                    raise InputError(f"{path}: the path of a {what} has {len(uri)} characters (allowed {limits.TEXT})")
                found.append(_there(path, path.parent / unquote(uri), what))
    return found


def _named_by_obj(path: Path) -> list[Path]:
    found = []
    for name in _words_after(path, ("mtllib",)):
        library = _there(path, path.parent / name, "file of materials")
        found.append(library)
        found += [_there(library, library.parent / texture, "texture") for texture in _words_after(library, ("map_Kd",))]
    return found


def _words_after(path: Path, keys: tuple[str, ...]) -> list[str]:
    out: dict[str, None] = {}
    with reading(path, "cannot be read"), path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            words = line.split(None, 1)
            if len(words) == 2 and words[0] in keys:
                name = words[1].split()[-1]
                if len(name) > limits.TEXT or "\0" in name:
                    raise InputError(f"{path}: `{words[0]}` names no file ({shown(name)})")
                out[name] = None
    return list(out)


def _there(owner: Path, path: Path, what: str) -> Path:
    with reading(owner, f"its {what} cannot be read"):
        there = path.is_file()
    if not there:
        raise InputError(
            f"{owner}: its {what} {path} does not exist.{did_you_mean_path(path)} Put it there, or export the mesh again"
        )
    return path
