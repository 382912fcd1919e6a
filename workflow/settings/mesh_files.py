"""Files of meshes that can be put into a room: which there are, what they need beside them, and what is wrong with them.

What the headers tell is told here, before any job; the mesh itself is read by `workflow.relighting.inserts`.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from iif_core.errors import InputError
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
    if not path.stat().st_size:
        raise InputError(f"{path}: empty (0 bytes); export the mesh again, or copy it again")
    if kind in (".glb", ".gltf"):
        document = _json_of_glb(path) if kind == ".glb" else _json_of(path, path.read_bytes())
        return [path, *_named_by_gltf(path, document)]
    if kind == ".obj":
        return [path, *_named_by_obj(path)]
    if not path.read_bytes()[:4].startswith(b"ply"):
        raise InputError(f"{path}: no PLY file; its first line is not `ply`. Export the mesh again")
    return [path]


def emissive_strengths(path: Path) -> dict[str, float]:
    """Return the factor on the emission of each material of a glTF file by its name, where it is not 1; empty for other files.

    Raises:
        InputError: as `files_of_mesh`, or materials of one name have two strengths.
    """
    if path.suffix.lower() not in (".glb", ".gltf"):
        return {}
    document = _json_of_glb(path) if path.suffix.lower() == ".glb" else _json_of(path, path.read_bytes())
    found: dict[str, float] = {}
    for material in document.get("materials", []):
        own = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        name = str(material.get("name"))
        if found.setdefault(name, float(own)) != float(own):
            raise InputError(f"{path}: two materials are called {name!r} and shine with different strength; rename one of them")
    return {name: strength for name, strength in found.items() if strength != 1.0}


def _json_of_glb(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
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
    return _json_of(path, data[start : start + size])


def _json_of(path: Path, data: bytes) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except ValueError as error:
        raise InputError(f"{path}: not readable as glTF ({error}); export the mesh again") from None
    if not isinstance(document, dict) or "asset" not in document:
        raise InputError(f"{path}: no glTF file; it has no `asset`. Export the mesh again")
    refused = [name for name in document.get("extensionsRequired", []) if name in _NOT_READ]
    if refused:
        raise InputError(f"{path}: needs the glTF extension {refused[0]}, which is not read; export the mesh without compression")
    return document


def _named_by_gltf(path: Path, document: dict[str, Any]) -> list[Path]:
    found = []
    for part, what in (("buffers", "buffer"), ("images", "texture")):
        for entry in document.get(part, []):
            uri = entry.get("uri", "")
            if uri and not uri.startswith("data:"):
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
    lines = (line.split(None, 1) for line in path.read_text(errors="replace").splitlines())
    return [words[1].strip().split()[-1] for words in lines if len(words) == 2 and words[0] in keys]


def _there(owner: Path, path: Path, what: str) -> Path:
    if not path.is_file():
        raise InputError(
            f"{owner}: its {what} {path} does not exist.{did_you_mean_path(path)} Put it there, or export the mesh again"
        )
    return path
