"""Files of meshes that can be put into a room: the formats, the files that they need next to them, and what is wrong with them.

This module checks the headers, before any job; `workflow.relighting.inserts` reads the mesh itself.
"""

from __future__ import annotations

from pathlib import Path

from iif_core.errors import InputError
from workflow.intake import gltf, limits
from workflow.intake.documents import check_file, reading
from workflow.intake.meshes import check_gltf, check_mesh
from workflow.intake.names import shown
from workflow.settings.names import did_you_mean_path

MESHES = (".glb", ".gltf", ".ply", ".obj")
"""Files that can be put into a room."""
_SHOWN = ("KHR_materials_", "KHR_texture_transform", "KHR_lights_", "EXT_lights_", "KHR_xmp")
"""How extensions of glTF begin that a file may require, beside those of geometry, and still be shown nearly as it is meant."""


def files_of_mesh(path: Path) -> list[Path]:
    """Return a mesh that is there and the files that it names: buffers and textures of glTF, materials and textures of OBJ.

    Raises:
        InputError: the file is empty, cut short or no file of its kind, or a file that it names is missing.
    """
    kind = path.suffix.lower()
    if not check_file(path, limits.MESH_BYTES, "a mesh"):
        raise InputError(f"{path}: empty (0 bytes); export the mesh again, or copy it again")
    if kind in (".glb", ".gltf"):
        document, _, size = gltf.document_of(path)
        gltf.refuse_extensions(path, document, _SHOWN)
        with reading(path, "not readable as glTF", "; export the mesh again"):
            named = gltf.named_files(path, document, _there)
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
    document = gltf.document_of(path)[0]
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


def read_start(path: Path) -> bytes:
    """Return the first bytes of a file."""
    with reading(path, "cannot be read"), path.open("rb") as file:
        return file.read(16)


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
