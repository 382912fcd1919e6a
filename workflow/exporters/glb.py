"""Writes scene.glb: glTF 2.0 with metallic-roughness materials, one mesh and one material per part, one atlas for all; and
scene_unlit.glb, with the light of the room in the colours, for viewers that compute no light.

trimesh is not used because it does not write `KHR_materials_emissive_strength`.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from iif_core.numerics.color import linear_from_srgb, tone_map
from iif_core.surface.tangents import vertex_tangents
from iif_core.surface.triangles import face_geometry
from workflow.exporters.atlas import Atlas, TexturedPart, base_color_picture, encoded, surface_picture
from workflow.scene.normal_form import View

_FLOAT, _UINT = 5126, 5125
_VERTEX, _INDEX = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP = 9729, 9987, 33071
_CHUNK_JSON, _CHUNK_BIN = 0x4E4F534A, 0x004E4942
_NEAR = 0.01  # m

JPEG_QUALITY = 92
MEGABYTE = 1e6


def glb_bytes(
    parts: Sequence[TexturedPart],
    images: dict[str, bytes],
    up: np.ndarray,
    provenance: dict[str, Any],
    views: Sequence[View] = (),
    exposure: float | None = None,
) -> bytes:
    """Make one binary glTF file of the scene.

    Vertices stay in the world of the photographs (metres); the root node turns `up` (3,) to +y, which glTF requires. Roughness is
    perceptual, as in glTF. Radiance becomes `emissiveFactor` x `KHR_materials_emissive_strength`.

    Args:
        parts: the meshes.
        images: `base_color` and `surface` (`atlas.surface_picture`), each a PNG or JPEG file, and perhaps `normal`
            (`normal_map.normal_picture`), which parts that were simplified then have.
        up: unit vector.
        provenance: stored in `asset.extras`.
        views: photographs, which become cameras; glTF has no offset of the principal point, so that it is lost.
        exposure: with a number, `base_color` is the lit room as it appears on a screen at this factor on radiance. Materials are
            then `KHR_materials_unlit`. Emitters are also `KHR_lights_punctual`, which light the things that a user adds; a
            renderer of scene.glb would count such lights twice.
    """
    blob = _Blob()
    materials, meshes, nodes = [], [], []
    textures = {name: number for number, name in enumerate(images)}
    for part in parts:
        material = _material(part, textures) if exposure is None else _unlit(part, textures, exposure)
        mesh = _mesh(blob, part, len(materials), bumpy="normalTexture" in material)
        extras = {"object_id": part.object_id, "emitter_id": part.emitter_id}
        nodes.append({"name": part.name, "mesh": len(meshes), "extras": extras})
        meshes.append(mesh)
        materials.append(material)
    cameras = [_camera(view) for view in views]
    for number, view in enumerate(views):
        pose = np.asarray(view.world_from_camera, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])  # glTF looks along -z, y up
        nodes.append({"name": f"view {view.name}", "camera": number, "matrix": [float(v) for v in pose.T.ravel()]})
    lights = [] if exposure is None else [part for part in parts if part.radiance.any()]
    for number, part in enumerate(lights):
        link = {"KHR_lights_punctual": {"light": number}}
        nodes.append({"name": f"{part.name} light", "translation": _middle(part)[0], "extensions": link})
    root = {"name": "world", "rotation": rotation_to_y(up), "children": list(range(len(nodes)))}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Intrinsic Image Fusion", "extras": provenance},
        "scene": 0,
        "scenes": [{"nodes": [len(nodes)]}],
        "nodes": [*nodes, root],
        "meshes": meshes,
        "materials": materials,
        "accessors": blob.accessors,
    }
    if cameras:
        document["cameras"] = cameras
    if images:
        document["samplers"] = [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}]
        document["textures"] = [{"source": number, "sampler": 0} for number in range(len(images))]
        document["images"] = [_image(blob, name, data) for name, data in images.items()]
    document |= {"bufferViews": blob.views, "buffers": [{"byteLength": len(blob.data)}]}
    extensions = {name for material in materials for name in material.get("extensions", {})}
    if exposure is not None and lights:
        document["extensions"] = {"KHR_lights_punctual": {"lights": [_light(part, exposure) for part in lights]}}
        extensions.add("KHR_lights_punctual")
    if extensions:
        document["extensionsUsed"] = sorted(extensions)
    return _container(document, bytes(blob.data))


def fitting_glb(
    parts: Sequence[TexturedPart],
    atlas: Atlas,
    up: np.ndarray,
    provenance: dict[str, Any],
    views: Sequence[View],
    max_mb: float,
    normals: np.ndarray | None = None,
) -> tuple[bytes, dict[str, Any]]:
    """Make the glTF file and keep it below `max_mb`: with PNG textures if they fit, then with JPEG, then with half as many texels
    a side. `normals` is a normal map (`normal_map.normal_picture`), if there shall be one.

    Returns:
        The file, and what its textures are: `format`, `size`, `mb`, and `fits`, false if the meshes alone are larger.
    """
    pictures = {"base_color": base_color_picture(atlas), "surface": surface_picture(atlas)}
    pictures |= {} if normals is None else {"normal": normals}
    size = atlas.size
    while True:
        for jpeg in (None, JPEG_QUALITY):
            images = {name: encoded(_coarser(picture, size), jpeg) for name, picture in pictures.items()}
            data = glb_bytes(parts, images, up, provenance, views)
            facts = {"format": "jpeg" if jpeg else "png", "size": size, "mb": len(data) / MEGABYTE}
            if len(data) <= max_mb * MEGABYTE:
                return data, facts | {"fits": True}
        if size <= 256:
            return data, facts | {"fits": False}
        size = -(-size // 2)


def _coarser(picture: np.ndarray, size: int) -> np.ndarray:
    """Return a picture (S, S, C) uint8 with `size` texels a side, interpolated at their centres between the nearest four, so that
    texture coordinates mean the same places and no texel has the colour of another chart."""
    if size == len(picture):
        return picture
    at = (np.arange(size) + 0.5) * len(picture) / size - 0.5
    first = np.floor(at).astype(int)
    second, share = np.minimum(first + 1, len(picture) - 1), (at - first).astype(np.float32)
    rows = picture[first] * (1 - share)[:, None, None] + picture[second] * share[:, None, None]
    return np.rint(rows[:, first] * (1 - share)[:, None] + rows[:, second] * share[:, None]).astype(np.uint8)


def rotation_to_y(up: np.ndarray) -> list[float]:
    """Return the unit quaternion [x, y, z, w] of the smallest rotation from the unit vector `up` to +y."""
    x, y, z = (float(v) for v in up)
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    q = np.array([-z, 0.0, x, 1.0 + y])
    return [float(v) for v in q / np.linalg.norm(q)]


def _mesh(blob: _Blob, part: TexturedPart, material: int, bumpy: bool) -> dict[str, Any]:
    attributes = {
        "POSITION": blob.add(part.vertices.astype("<f4"), _FLOAT, "VEC3", _VERTEX, bounds=True),
        "NORMAL": blob.add(part.normals.astype("<f4"), _FLOAT, "VEC3", _VERTEX),
    }
    if part.emitter_id < 0:  # emitters have no texture
        attributes["TEXCOORD_0"] = blob.add(part.uv.astype("<f4"), _FLOAT, "VEC2", _VERTEX)
    if bumpy:
        tangents = vertex_tangents(part.vertices, part.faces, part.uv, part.normals)
        attributes["TANGENT"] = blob.add(tangents.astype("<f4"), _FLOAT, "VEC4", _VERTEX)
    indices = blob.add(part.faces.astype("<u4").ravel(), _UINT, "SCALAR", _INDEX)
    return {"name": part.name, "primitives": [{"attributes": attributes, "indices": indices, "material": material}]}


def _material(part: TexturedPart, textures: dict[str, int]) -> dict[str, Any]:
    material: dict[str, Any] = {"name": part.name, "doubleSided": part.double_sided}
    if part.emitter_id >= 0:
        black = {"baseColorFactor": [0.0, 0.0, 0.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
        material["pbrMetallicRoughness"] = black
    else:
        material["pbrMetallicRoughness"] = {
            "baseColorFactor": [1.0, 1.0, 1.0, part.opacity],
            "baseColorTexture": {"index": textures["base_color"]},
            "metallicFactor": 1.0,
            "roughnessFactor": 1.0,
            "metallicRoughnessTexture": {"index": textures["surface"]},
        }
        if part.simplified and "normal" in textures:
            material["normalTexture"] = {"index": textures["normal"]}
    if part.opacity < 1:
        material["alphaMode"] = "BLEND"
    strength = float(part.radiance.max(initial=0.0))
    if strength > 0:
        material["emissiveFactor"] = [round(float(v) / strength, 6) for v in part.radiance]
        material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": round(strength, 6)}}
    return material


def _unlit(part: TexturedPart, textures: dict[str, int], exposure: float) -> dict[str, Any]:
    surface: dict[str, Any] = {"baseColorFactor": [1.0, 1.0, 1.0, part.opacity]}
    if part.emitter_id >= 0:
        shown = linear_from_srgb(tone_map(part.radiance, exposure))
        surface["baseColorFactor"] = [round(float(v), 6) for v in shown] + [1.0]
    else:
        surface["baseColorTexture"] = {"index": textures["base_color"]}
    surface |= {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": part.name, "doubleSided": part.double_sided, "pbrMetallicRoughness": surface}
    material["extensions"] = {"KHR_materials_unlit": {}}
    return material | ({"alphaMode": "BLEND"} if part.opacity < 1 else {})


def _middle(part: TexturedPart) -> tuple[list[float], float]:
    """Centroid of the surface of a part, metres, and its area, m^2."""
    area = face_geometry(part.vertices, part.faces)[1]
    centre = np.average(part.vertices[part.faces].mean(1), 0, area)
    return [float(v) for v in centre], float(area.sum())


def _light(part: TexturedPart, exposure: float) -> dict[str, Any]:
    """A point light with the intensity of the emitter along its normal: exposure times radiance times area, so that what it
    lights is as bright as the texture, which is exposed."""
    strength = float(part.radiance.max())
    colour = [round(float(v) / strength, 6) for v in part.radiance]
    return {"type": "point", "name": part.name, "color": colour, "intensity": round(exposure * strength * _middle(part)[1], 6)}


def _camera(view: View) -> dict[str, Any]:
    perspective = {"yfov": 2 * math.atan(0.5 * view.height / view.fy), "aspectRatio": view.width / view.height, "znear": _NEAR}
    return {"type": "perspective", "name": f"view {view.name}", "perspective": perspective}


def _image(blob: _Blob, name: str, data: bytes) -> dict[str, Any]:
    kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
    return {"name": name, "bufferView": blob.bytes(data), "mimeType": kind}


class _Blob:
    """The binary chunk: arrays and files one after the other, each aligned to four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def bytes(self, data: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += data
        self.data += b"\0" * (-len(self.data) % 4)
        return len(self.views) - 1

    def add(self, array: np.ndarray, component: int, kind: str, target: int, bounds: bool = False) -> int:
        accessor: dict[str, Any] = {"bufferView": self.bytes(array.tobytes(), target), "componentType": component}
        accessor |= {"count": len(array), "type": kind}
        if bounds:
            accessor["min"] = [float(v) for v in array.min(0)]
            accessor["max"] = [float(v) for v in array.max(0)]
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _CHUNK_JSON) + text
    chunks += struct.pack("<II", len(binary), _CHUNK_BIN) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
