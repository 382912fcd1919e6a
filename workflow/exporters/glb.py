"""Writes scene.glb: glTF 2.0 with metallic-roughness materials, one mesh and one material per part, albedo as linear `COLOR_0`.

trimesh is not used because it stores vertex colours in 8 bits (docs/method/numerics.md#albedo-in-eight-bits).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from workflow.exporters.surface import Part

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_VERTEX, _INDEX = 34962, 34963
_CHUNK_JSON, _CHUNK_BIN = 0x4E4F534A, 0x004E4942


def glb_bytes(parts: Sequence[Part], up: np.ndarray, provenance: dict[str, Any]) -> bytes:
    """Make one binary glTF file of the scene.

    Vertices stay in the world of the photographs (metres); the root node turns `up` (3,) to +y, which glTF requires.
    Roughness is perceptual, as in glTF. Radiance becomes `emissiveFactor` x `KHR_materials_emissive_strength`. `provenance` is
    stored in `asset.extras`.
    """
    blob = _Blob()
    materials, meshes, nodes = [], [], []
    for part in parts:
        colour = np.full((len(part.vertices), 4), 65535, np.uint16)
        colour[:, :3] = np.rint(part.albedo * 65535)
        attributes = {
            "POSITION": blob.add(part.vertices.astype("<f4"), _FLOAT, "VEC3", _VERTEX, bounds=True),
            "NORMAL": blob.add(part.normals.astype("<f4"), _FLOAT, "VEC3", _VERTEX),
            "COLOR_0": blob.add(colour.astype("<u2"), _USHORT, "VEC4", _VERTEX, normalized=True),
        }
        indices = blob.add(part.faces.astype("<u4").ravel(), _UINT, "SCALAR", _INDEX)
        primitive = {"attributes": attributes, "indices": indices, "material": len(materials)}
        extras = {"object_id": part.object_id, "emitter_id": part.emitter_id}
        nodes.append({"name": part.name, "mesh": len(meshes), "extras": extras})
        meshes.append({"name": part.name, "primitives": [primitive]})
        materials.append(_material(part))
    root = {"name": "world", "rotation": rotation_to_y(up), "children": list(range(len(nodes)))}
    if not nodes:
        del root["children"]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Intrinsic Image Fusion", "extras": provenance},
        "scene": 0,
        "scenes": [{"nodes": [len(nodes)]}],
        "nodes": [*nodes, root],
    }
    if parts:
        document |= {"meshes": meshes, "materials": materials, "accessors": blob.accessors}
        document |= {"bufferViews": blob.views, "buffers": [{"byteLength": len(blob.data)}]}
    if any("extensions" in material for material in materials):
        document["extensionsUsed"] = ["KHR_materials_emissive_strength"]
    return _container(document, bytes(blob.data))


def rotation_to_y(up: np.ndarray) -> list[float]:
    """Return the unit quaternion [x, y, z, w] of the smallest rotation from the unit vector `up` to +y."""
    x, y, z = (float(v) for v in up)
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    q = np.array([-z, 0.0, x, 1.0 + y])
    return [float(v) for v in q / np.linalg.norm(q)]


def _material(part: Part) -> dict[str, Any]:
    surface = {
        "baseColorFactor": [1.0, 1.0, 1.0, part.opacity],
        "metallicFactor": _mean(part.metallic, 0.0),
        "roughnessFactor": _mean(part.roughness, 1.0),
    }
    material: dict[str, Any] = {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": part.double_sided}
    if part.opacity < 1:
        material["alphaMode"] = "BLEND"
    strength = float(part.radiance.max(initial=0.0))
    if strength > 0:
        material["emissiveFactor"] = [round(float(v) / strength, 6) for v in part.radiance]
        material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": round(strength, 6)}}
    return material


def _mean(values: np.ndarray, default: float) -> float:
    return round(float(values.mean(dtype=np.float64)), 6) if values.size else default


class _Blob:
    """The binary chunk: arrays one after the other, each aligned to four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, array: np.ndarray, component: int, kind: str, target: int, bounds: bool = False, normalized: bool = False
    ) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes, "target": target}
        self.views.append(view)
        self.data += array.tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(array)}
        accessor["type"] = kind
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = [float(v) for v in array.min(0)]
            accessor["max"] = [float(v) for v in array.max(0)]
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _CHUNK_JSON) + text
    if binary:
        chunks += struct.pack("<II", len(binary), _CHUNK_BIN) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
