"""Meshes that are put into a room: geometry and metallic-roughness materials of GLB, glTF, PLY and OBJ files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from workflow.intake import limits
from workflow.intake.documents import reading
from workflow.intake.gltf import plain_glb
from workflow.intake.meshes import check_faces
from workflow.intake.pictures import TEXTURES, check_pixels, check_texture
from workflow.settings.mesh_files import emissive_strengths, files_of_mesh

Array = np.ndarray
LARGEST_TEXTURE = 1024
"""Pixels along the longer side to which textures are reduced."""
PLAIN = np.array([0.5, 0.5, 0.5, 0.5, 0.0], np.float32)
"""Material of surface whose file has none."""


@dataclass(frozen=True)
class InsertedMesh:
    """A mesh as its file has it.

    Attributes:
        corners: (k, 3, 3) float64 of its faces, in the units and axes of the file.
        uv: (k, 3, 2) texture coordinates, v counted downwards.
        texture: (k,) int, which of `textures` a face has.
        textures: (h, w, 5) float32 each: linear albedo R, G, B, roughness, metallic.
        is_y_up: by the rules of its format.
        radiance: (textures, 3) float64 that the material of each emits: factor times strength of glTF.
        double_sided: (textures,) bool, the material is seen, and emits, on both sides.
        glowing: names of materials whose emission has a texture.
        left_out: what else of the file is not shown, as text.
    """

    corners: Array
    uv: Array
    texture: Array
    textures: list[Array]
    is_y_up: bool
    radiance: Array
    double_sided: Array
    glowing: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def load_insert(path: Path) -> InsertedMesh:
    """Read a mesh with its materials.

    Raises:
        InputError: the file cannot be read, has no surface, or numbers that are not finite.
    """
    for file in files_of_mesh(path)[1:]:
        check_texture(file)
    strengths = emissive_strengths(path)
    import trimesh

    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    with reading(path, "not readable as a mesh", "; export it again"):
        if is_gltf:
            named = trimesh.resolvers.FilePathResolver(path)
            loaded = trimesh.load_scene(BytesIO(plain_glb(path)), file_type="glb", resolver=named, process=False)
        else:
            loaded = trimesh.load_scene(str(path), process=False)
        parts = list(_parts(path, loaded, is_gltf))
        materials = [part[3] for part in parts]
        emitted = np.array([_emission(material, strengths) for material in materials])
    if not parts:
        raise InputError(f"{path}: has no triangles; export a mesh with surface")
    corners = np.concatenate([part[0] for part in parts])
    uv = np.concatenate([part[1] for part in parts])
    if not (np.isfinite(corners).all() and np.isfinite(uv).all()):
        raise InputError(f"{path}: has corners or texture coordinates that are not finite; export the mesh again")
    number = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    double_sided = np.array([bool(getattr(material, "doubleSided", False)) for material in materials])
    textured = (getattr(material, "emissiveTexture", None) is not None for material in materials)
    glowing = {str(m.name) for m, light, has in zip(materials, emitted, textured, strict=True) if has and light.any()}
    textures, left_out = [part[2] for part in parts], _left_out(materials)
    return InsertedMesh(corners, uv, number, textures, is_gltf, emitted, double_sided, tuple(sorted(glowing)), left_out)


def light_of(mesh: InsertedMesh, insert: dict[str, Any]) -> Array:
    """Return the radiance (k, 3) float64 of the faces of a mesh: from a dumped `insert`, or else from its materials.

    Raises:
        InputError: the emission of a material of the file, which would shine, has a texture, or is no radiance.
    """
    given = insert["radiance"]
    if given is not None or insert["material"] is not None:
        return np.tile(np.zeros(3) if given is None else np.asarray(given, np.float64), (len(mesh.corners), 1))
    if mesh.glowing:
        raise InputError(
            f"{insert['file']}: material {mesh.glowing[0]!r} has a texture of emission, which is not read; allowed: one colour"
            " (emissiveFactor). Export it so, or give `radiance` of the object under `insert`, where [0, 0, 0] is dark"
        )
    if not ((mesh.radiance >= 0) & (mesh.radiance <= limits.RADIANCE)).all():
        raise InputError(
            f"{insert['file']}: a material emits light that is no number of 0 ... {limits.RADIANCE:g}; export it again, or give"
            " `radiance` of the object under `insert`"
        )
    return mesh.radiance[mesh.texture]


def _emission(material: Any, strengths: dict[str, float]) -> Array:
    """Radiance (3,) that a material of trimesh emits."""
    factor = getattr(material, "emissiveFactor", None)
    return np.zeros(3) if factor is None else np.asarray(factor, np.float64).reshape(3) * strengths.get(str(material.name), 1.0)


def _left_out(materials: list[Any]) -> tuple[str, ...]:
    """What of some materials is not shown."""
    see_through = any(getattr(material, "alphaMode", None) in ("BLEND", "MASK") for material in materials)
    bumpy = any(getattr(material, "normalTexture", None) is not None for material in materials)
    return ("transparency",) * see_through + ("normal maps",) * bumpy


def _parts(path: Path, scene: Any, is_gltf: bool) -> Iterator[tuple[Array, Array, Array, Any]]:
    """(corners, uv, texture, material) of every mesh of a trimesh scene, in world axes of the file."""
    count = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not len(getattr(mesh, "faces", ())):
            continue
        count += len(mesh.faces)
        check_faces(path, count, limits.INSERT_FACES)
        vertices = np.asarray(mesh.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
        uv, texture = _material(path, mesh, is_gltf)
        # A node that mirrors its mesh turns the order of the corners, and with it the side that an emitter shines to.
        order = slice(None, None, -1 if np.linalg.det(transform[:3, :3]) < 0 else 1)
        yield vertices[mesh.faces][:, order], uv[:, order], texture, getattr(mesh.visual, "material", None)


def _material(path: Path, mesh: Any, is_gltf: bool) -> tuple[Array, Array]:
    """Texture coordinates (k, 3, 2) and texture (h, w, 5) of a mesh. Colours of vertices are linear in glTF, sRGB elsewhere."""
    faces, visual = mesh.faces, mesh.visual
    uv = getattr(visual, "uv", None)
    decoded = np.asarray if is_gltf else linear_from_srgb
    if visual.kind == "texture":
        texture = _texture(path, visual.material)
        if uv is None or texture.shape[:2] == (1, 1):
            colours = (visual.vertex_attributes or {}).get("color")
            if colours is None or texture.shape[:2] != (1, 1):
                return np.zeros((len(faces), 3, 2)), texture
            texture = np.tile(texture, (1, len(faces), 1))
            texture[0, :, :3] *= decoded(np.asarray(colours)[:, :3] / 255.0)[faces].mean(1)
            return _face_by_face(len(faces)), texture
        flipped = np.asarray(uv, np.float64) * [1, -1] + [0, 1]  # trimesh counts v upwards
        return flipped[faces], texture
    if visual.kind in ("vertex", "face"):
        of_vertices = visual.kind == "vertex"
        colours = decoded(np.asarray(visual.vertex_colors if of_vertices else visual.face_colors)[:, :3] / 255.0)
        texture = np.tile(PLAIN, (1, len(faces), 1))
        texture[0, :, :3] = colours[faces].mean(1) if of_vertices else colours
        return _face_by_face(len(faces)), texture
    return np.zeros((len(faces), 3, 2)), PLAIN[None, None].copy()


def _face_by_face(count: int) -> Array:
    """Texture coordinates (k, 3, 2) for a texture of one row with a texel for each face, which is read in its middle."""
    middle = (np.arange(count) + 0.5) / count
    return np.repeat(np.stack([middle, np.full(count, 0.5)], 1)[:, None], 3, 1)


def _texture(path: Path, material: Any) -> Array:
    """Factors times pictures of a material of trimesh, as (h, w, 5)."""
    if not hasattr(material, "baseColorFactor"):  # of OBJ files: a colour or a picture, and nothing of gloss
        if not hasattr(material, "diffuse"):
            return PLAIN[None, None].copy()
        picture = _pixels(path, getattr(material, "image", None))
        colour = linear_from_srgb(np.asarray(material.diffuse, np.float64)[:3] / 255.0) if picture is None else np.ones(3)
        albedo = np.ones((1, 1, 3)) if picture is None else linear_from_srgb(picture / 255.0)
        return _stacked(albedo * colour, PLAIN[3:])
    factor = material.baseColorFactor
    colour = np.ones(3) if factor is None else np.asarray(factor, np.float64)[:3] / 255.0
    picture, gloss = _pixels(path, material.baseColorTexture), _pixels(path, material.metallicRoughnessTexture)
    albedo = np.ones((1, 1, 3)) if picture is None else linear_from_srgb(picture / 255.0)
    rough, metal = (1.0 if value is None else float(value) for value in (material.roughnessFactor, material.metallicFactor))
    if gloss is None:
        return _stacked(albedo * colour, np.array([rough, metal]))
    if picture is None:
        albedo = np.ones((*gloss.shape[:2], 3))
    elif gloss.shape[:2] != albedo.shape[:2]:
        gloss = _resized(gloss, albedo.shape[:2])
    return _stacked(albedo * colour, gloss[..., 1:] / 255.0 * [rough, metal])  # G is roughness, B metallic


def _stacked(albedo: Array, gloss: Array) -> Array:
    return np.concatenate([albedo, np.broadcast_to(gloss, (*albedo.shape[:2], 2))], -1).astype(np.float32)


def _pixels(path: Path, picture: Any) -> Array | None:
    """(h, w, 3) 0 ... 255 of a picture of PIL, reduced to `LARGEST_TEXTURE`; None without one."""
    if picture is None:
        return None
    check_pixels(path, *picture.size)
    if picture.format not in (None, "WEBP", "MPO", *TEXTURES):  # of a file that is opened and not decoded yet
        raise InputError(f"{path}: a texture of the format {picture.format}; allowed are {', '.join(TEXTURES)} and WEBP")
    picture = picture.convert("RGB")
    picture.thumbnail((LARGEST_TEXTURE, LARGEST_TEXTURE))
    return np.asarray(picture, np.float64)


def _resized(pixels: Array, shape: tuple[int, int]) -> Array:
    from PIL import Image

    picture = Image.fromarray(pixels.astype(np.uint8)).resize(shape[::-1], Image.Resampling.BILINEAR)
    return np.asarray(picture, np.float64)


def placed(mesh: InsertedMesh, insert: dict[str, Any], up: Array) -> Array:
    """Return the corners (k, 3, 3) float64 of a mesh where a dumped `insert` puts it, in metres and world axes.

    The y axis of glTF is turned to `up` by the shortest turn; then come scale and rotation, and then the middle of the lowest
    side is moved to `position`.
    """
    from scipy.spatial.transform import Rotation

    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    corners = mesh.corners.reshape(-1, 3) * float(insert["scale"])
    if mesh.is_y_up:
        turn = np.cross([0.0, 1.0, 0.0], up)
        sine, cosine = np.linalg.norm(turn), up[1]
        axis = turn / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
        corners = corners @ Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix().T
    corners = corners @ Rotation.from_euler("xyz", insert["rotation"], degrees=True).as_matrix().T
    height = corners @ up
    middle = 0.5 * (corners.min(0) + corners.max(0))
    foot = middle + up * (height.min() - middle @ up)
    return (corners - foot + np.asarray(insert["position"], np.float64)).reshape(-1, 3, 3)
