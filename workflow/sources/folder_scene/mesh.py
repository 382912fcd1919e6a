"""The mesh file of a `folder` scene: read, brought to metres, cleaned, checked for its size."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.sources.folder_scene.transforms import METRES

NAMES = ("mesh.ply", "mesh.obj", "mesh.glb")
SUFFIXES = (".ply", ".obj", ".glb")
MIN_AREA = 1e-12
"""m^2; smaller triangles are removed (METHOD H48)."""
DIAGONAL = (0.5, 200.0)
"""Metres; a room outside of this is in another unit (METHOD H57)."""
TYPICAL = 7.0
"""Metres across a room: the unit that comes nearest is proposed."""


@dataclass
class Mesh:
    """vertices (n, 3) float64 in metres, faces (m, 3) int32, instance (m,) int32 with -1 = none or None, and their
    names.

    `from_nodes`: the instances are the file's nodes, not ids that somebody gave.
    """

    vertices: np.ndarray
    faces: np.ndarray
    instance: np.ndarray | None = None
    names: list[str] | None = None
    from_nodes: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3): lowest and highest corner."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def diagonal(self) -> float:
        low, high = self.bounds
        return float(np.linalg.norm(high - low))


def find(folder: Path, name: str | None) -> Path:
    """The mesh file: `source.mesh`, or the only one of mesh.ply, mesh.obj, mesh.glb."""
    if name is not None:
        path = folder / name
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"`source.mesh: {name}`: allowed are {', '.join(SUFFIXES)} files")
        if not path.is_file():
            raise InputError(f"{path}: not found (`source.mesh: {name}`)")
        return path
    found = [folder / n for n in NAMES if (folder / n).is_file()]
    if len(found) > 1:
        raise InputError(f"{folder}: holds {' and '.join(p.name for p in found)}; choose one with `source.mesh`")
    if not found:
        meshes = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
        hint = f" Found {', '.join(meshes[:3])}: name it with `source.mesh`." if meshes else ""
        raise InputError(f"{folder}: no {', '.join(NAMES)}; a mesh of the scene is needed (docs/own-data.md).{hint}")
    return found[0]


@dataclass(frozen=True)
class VertexIds:
    """Object of every vertex of the file (n,) with -1 = none, the objects' names, and where they come from."""

    ids: np.ndarray
    names: dict[int, str]
    path: Path


def load(path: Path, metres: float, of_vertices: VertexIds | None = None) -> Mesh:
    """Read a mesh, merge its nodes, scale it to metres, remove what has no area, keep `instance` of the faces.

    of_vertices: ids from another file; they replace those of the mesh.

    Raises:
        InputError: unreadable, no triangles, nothing left, or instance ids that do not fit.
    """
    vertices, faces, ids, names = _read(path)
    if len(faces) == 0:
        raise InputError(f"{path}: no faces (a point cloud?); a triangle mesh is needed")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: faces name vertices {faces.min()} ... {faces.max()}, it has 0 ... {len(vertices) - 1}")
    if of_vertices is not None:
        if len(of_vertices.ids) != len(vertices):
            raise InputError(
                f"{of_vertices.path}: ids of {len(of_vertices.ids)} vertices, {path.name} has {len(vertices)}; both must come"
                " from the same release"
            )
        ids, names = majority(of_vertices.ids[faces]), None
    mesh = _cleaned(path, vertices * metres, faces, ids)
    if names is not None:
        mesh.names, mesh.from_nodes = names, True
    elif mesh.instance is not None:
        given, mesh.instance = _renumbered(mesh.instance)
        known = of_vertices.names if of_vertices is not None else {}
        mesh.names = [known.get(int(i), f"instance {i}") for i in given]
    return mesh


def majority(ids: np.ndarray) -> np.ndarray:
    """(m,) the id that at least two of a face's three vertices share, -1 where all differ. ids (m, 3)."""
    a, b, c = ids.T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, -1)).astype(np.int64)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str] | None]:
    import trimesh

    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as a mesh ({type(error).__name__}: {error})") from None
    vertices, faces, nodes, names, offset = [], [], [], [], 0
    for node in scene.graph.nodes_geometry:
        transform, key = scene.graph[node]
        part = scene.geometry[key]
        if not isinstance(part, trimesh.Trimesh) or len(part.faces) == 0:
            continue
        v = np.asarray(part.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
        f = np.asarray(part.faces, np.int64)
        if np.linalg.det(transform[:3, :3]) < 0:  # a mirrored node would turn its front inwards
            f = f[:, ::-1]
        vertices.append(v)
        faces.append(f + offset)
        nodes.append(np.full(len(f), len(names), np.int32))
        names.append(str(node))
        offset += len(v)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), None, None
    v, f = np.concatenate(vertices), np.concatenate(faces)
    if path.suffix.lower() == ".ply":
        (part,) = scene.geometry.values()
        return v, f, _face_property(path, part, len(f)), None
    if len(names) > 1 and path.suffix.lower() == ".glb":
        return v, f, np.concatenate(nodes), names
    return v, f, None, None


def _face_property(path: Path, part: Any, count: int) -> np.ndarray | None:
    """The `instance` property of the faces of a PLY."""
    data = part.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    names = data.dtype.names if isinstance(data, np.ndarray) else data.keys() if isinstance(data, dict) else ()
    if "instance" not in (names or ()):
        return None
    values = np.asarray(data["instance"])
    values = values["f1"] if values.dtype.names else values
    values = values.reshape(-1).astype(np.float64)
    if len(values) != count:
        raise InputError(f"{path}: `instance` of {len(values)} polygons, {count} triangles; triangulate the mesh first")
    whole = np.rint(np.where(np.isfinite(values), values, -1))
    if (np.abs(values - whole) > 1e-3).any():
        raise InputError(f"{path}: `instance` holds numbers between integers; ids must be integers")
    return np.where(whole < 0, -1, whole).astype(np.int64)


def _cleaned(path: Path, vertices: np.ndarray, faces: np.ndarray, ids: np.ndarray | None) -> Mesh:
    finite = np.isfinite(vertices).all(1)[faces].all(1)
    corners = np.where(np.isfinite(vertices), vertices, 0)[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = finite & (area >= MIN_AREA)
    notes = []
    if (~finite).any():
        notes.append(f"mesh: {int((~finite).sum())} faces with NaN vertices removed")
    if (finite & ~kept).any():
        notes.append(f"mesh: {int((finite & ~kept).sum())} zero-area triangles removed")
    if not kept.any():
        raise InputError(
            f"{path}: none of {len(faces)} triangles has an area above {MIN_AREA:g} m^2; if it is a good mesh, its unit"
            " is larger than `source.unit` says"
        )
    used, faces = np.unique(faces[kept], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3).astype(np.int32), None if ids is None else ids[kept], notes=notes)


def _renumbered(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ids that occur, ascending, and ids counted from 0 in that order; -1 stays."""
    given = np.unique(ids[ids >= 0])
    return given, np.where(ids < 0, -1, np.searchsorted(given, ids)).astype(np.int32)


def check_size(path: Path, mesh: Mesh, unit: str | float, metres: float, centres: np.ndarray) -> None:
    """Refuse a scene that cannot be in metres, and cameras that are not near it. centres: (v, 3) camera positions."""
    low, high = DIAGONAL
    diagonal = mesh.diagonal
    if not low <= diagonal <= high:
        found = f"{path}: the scene is {diagonal:.4g} m across (allowed {low:g} to {high:g} m), read with"
        found += f" `source.unit: {unit}`"
        cameras = float(np.linalg.norm(np.ptp(centres, axis=0)))
        if diagonal > high and 0.1 < cameras < 1e-2 * diagonal:
            raise InputError(
                f"{found}, but the cameras span {cameras:.3g} m: mesh and poses are in different units; bring the mesh"
                " into the unit of transforms.json (is it in millimetres? then scale its vertices by 0.001)"
            )
        across = {name: diagonal / metres * factor for name, factor in METRES.items()}
        name, size = min(across.items(), key=lambda item: abs(np.log(item[1] / TYPICAL)))
        if low <= size <= high:
            raise InputError(f"{found}; `source: {{unit: {name}}}` makes it {size:.3g} m")
        raise InputError(f"{found}; give its unit as a number: `source: {{unit: <metres per unit>}}`")
    bounds = mesh.bounds
    outside = np.linalg.norm(np.maximum(np.maximum(bounds[0] - centres, centres - bounds[1]), 0), axis=1)
    far = outside > diagonal
    if 2 * int(far.sum()) > len(centres):
        raise InputError(
            f"{path}: {int(far.sum())} of {len(centres)} cameras are more than the scene's size ({diagonal:.3g} m) away"
            f" from the mesh (median {np.median(outside):.3g} m); mesh and poses are in different units or frames:"
            " export both from the same tool (docs/own-data.md, mesh and poses in one frame)"
        )
