"""What another program reads of an exported glTF file: its meshes by trimesh, and its materials pixel by pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from iif_core.camera.pinhole import pixel_directions
from iif_core.numerics.color import linear_from_srgb


def read_back(path: Path, up: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, Any]]:
    """Read a file: vertices (n, 3) in the world of the photographs, where `up` (3,) was turned to +y, faces (m, 3) and trimesh's
    visual, by the names of the meshes."""
    import trimesh

    loaded = trimesh.load(path, process=False)
    turn = Rotation.align_vectors([[0, 1, 0]], [up])[0]  # the smallest one
    if up[1] < -1 + 1e-9:
        turn = Rotation.from_euler("x", 180, degrees=True)  # of all half turns, the one that the exporter takes
    world = np.eye(4)
    world[:3, :3] = turn.inv().as_matrix()
    meshes = {}
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        matrix = world @ matrix
        mesh = loaded.geometry[name]
        xyz = np.asarray(mesh.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
        meshes[name] = (xyz, np.asarray(mesh.faces), mesh.visual)
    return meshes


def maps_of(meshes: dict[str, tuple[np.ndarray, np.ndarray, Any]], camera: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Look at meshes that `read_back` read from a camera (`workflow.scene.normal_form.View`).

    Returns:
        values (H W, 5): linear base colour, roughness, metallic of each pixel, nan where nothing is hit; points (H W, 3); and the
        number of the mesh (H W,), -1 = none. Textures are read at the nearest texel.
    """
    import open3d as o3d

    rays = pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.world_from_camera)
    rays = rays.reshape(-1, 3).astype(np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    for xyz, faces, _ in meshes.values():
        scene.add_triangles(o3d.core.Tensor(xyz.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    eye = np.tile(np.float32(camera.world_from_camera[:3, 3]), (len(rays), 1))
    hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([eye, rays], 1)))
    of, face, second = (hit[name].numpy() for name in ("geometry_ids", "primitive_ids", "primitive_uvs"))
    of = np.where(of == scene.INVALID_ID, -1, of.astype(np.int64))
    weights = np.stack([1 - second.sum(1), second[:, 0], second[:, 1]], 1)
    values, pictures = np.full((len(rays), 5), np.nan), {}
    for number, (_, faces, visual) in enumerate(meshes.values()):
        own = np.flatnonzero(of == number)
        material = visual.material
        if material.baseColorTexture is None:  # an emitter
            values[own] = [0, 0, 0, 1, 0]
            continue
        images = material.baseColorTexture, material.metallicRoughnessTexture
        if len(own) and id(images[0]) not in pictures:
            pictures[id(images[0])] = [np.asarray(image, np.float64) / 255 for image in images]
        if not len(own):
            continue
        colour, surface = pictures[id(images[0])]
        uv = np.einsum("nk,nkc->nc", weights[own], np.asarray(visual.uv)[faces[face[own]]])
        size = len(colour)
        column = np.clip((uv[:, 0] * size).astype(int), 0, size - 1)
        row = np.clip(((1 - uv[:, 1]) * size).astype(int), 0, size - 1)  # trimesh turns v upwards
        values[own, :3] = linear_from_srgb(colour[row, column, :3])
        values[own, 3:] = surface[row, column][:, [1, 2]]
    return values, eye + hit["t_hit"].numpy()[:, None] * rays, of
