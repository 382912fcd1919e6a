"""Reads the mesh file of a scene, scales it to metres, removes degenerate faces and checks its size."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from iif_core.errors import InputError
from iif_core.surface.axes import AS_IS, turn_of
from iif_core.surface.enclosure import enclosure
from iif_core.surface.holes import close_holes
from iif_core.surface.triangles import face_geometry
from workflow.intake import limits
from workflow.intake.documents import check_file, reading
from workflow.intake.gltf import plain_glb
from workflow.intake.meshes import AGAIN, check_faces, check_mesh
from workflow.intake.obj import read_obj
from workflow.intake.ply import read_ply
from workflow.settings.names import did_you_mean_path
from workflow.sources.folder_scene.camera import METRES

NAMES = ("mesh.ply", "mesh.obj", "mesh.glb")
SUFFIXES = (".ply", ".obj", ".glb")
MIN_AREA = 1e-12  # m^2; smaller triangles are removed (docs/method/numerics.md#degenerate-faces)
DIAGONAL = (0.5, 200.0)  # metres; a room outside of this range is in another unit (docs/method/numerics.md#unit-of-the-mesh)
FACTORS = (0.1, 0.01, 0.001)
"""Factors on camera positions far away that are tried: decimetres, centimetres and millimetres, in addition to metres."""
LEAST_SPREAD = 0.05  # of the scene's size; cameras nearer to one another lie in the mesh by any small factor
MAX_UNUSED = 0.05
"""Share of the vertices of an OBJ file that may belong to no face; one that is cut short has vertices first, and then part of the
faces."""
FARTHEST = 1000.0
"""Metres from the origin beyond which an origin of the scene's own is subtracted: single precision, in which rays are traced, is
0.06 mm there, and half a metre where projected coordinates of a map are."""
UPRIGHT = 0.8  # cosine with the vertical from which a side is a floor or a ceiling
MARGIN = 0.01  # share of the vertices at each end that does not tell the size
TYPICAL_DIAGONAL = 7.0  # metres; the unit that comes nearest to it is proposed


@dataclass
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (n, 3) float64, metres.
        faces: (m, 3) int32.
        instance: (m,) int32 object of each face with -1 = none, or None.
        names: of the objects.
        from_nodes: whether the objects are the nodes of the file rather than given ids.
        notes: what was removed, as text.
    """

    vertices: np.ndarray
    faces: np.ndarray
    instance: np.ndarray | None = None
    names: list[str] | None = None
    from_nodes: bool = False
    notes: list[str] = field(default_factory=list)

    def closed(self, widest: float) -> Mesh:
        """Close holes up to `widest` metres across; what closes one belongs to an object beside it."""
        found = close_holes(self.vertices, self.faces, widest, self.instance)
        if not found.holes:
            return self
        note = f"mesh: {found.holes} holes ({found.area:.2g} m2) up to {widest:g} m across were closed (source.close_holes)"
        faces = np.concatenate([self.faces, found.faces.astype(self.faces.dtype)])
        instance = None if self.instance is None else np.concatenate([self.instance, self.instance[found.beside]])
        return replace(self, faces=faces, instance=instance, notes=[*self.notes, note])

    def enclosed(self, kind: Literal["none", "box", "planes"], poses: Sequence[np.ndarray]) -> Mesh:
        """Add walls, floor and ceiling around the mesh and the cameras at `poses` (v, 4, 4)."""
        if kind == "none":
            return self
        placed = np.asarray(poses)
        found = enclosure(self.vertices, self.faces, placed[:, :3, 3], kind)
        up = -placed[:, :3, 1].mean(0)
        upright = found.normal @ up / max(float(np.linalg.norm(up)), 1e-12)
        names = np.where(upright > UPRIGHT, "floor", np.where(upright < -UPRIGHT, "ceiling", "wall"))
        names = [f"added {name} {i + 1}" for i, name in enumerate(names)]
        area = np.bincount(found.side, face_geometry(found.vertices, found.faces)[1])
        note = (
            f"mesh: {len(names)} sides were added around it (source.close: {kind}), {area.sum():.3g} m2, of which"
            f" {found.from_plane.sum()} prolong planes of the mesh: what they are made of is not known"
        )
        of_scan = 0 if self.names is None else len(self.names)
        return replace(
            self,
            vertices=np.concatenate([self.vertices, found.vertices]),
            faces=np.concatenate([self.faces, (found.faces + len(self.vertices)).astype(self.faces.dtype)]),
            instance=None if self.instance is None else np.concatenate([self.instance, (found.side + of_scan).astype(np.int32)]),
            names=None if self.names is None else [*self.names, *names],
            notes=[*self.notes, note],
        )

    def from_origin(self, origin: np.ndarray) -> Mesh:
        """Return the mesh relative to an origin (3,), metres."""
        return replace(self, vertices=self.vertices - origin) if origin.any() else self

    @property
    def origin(self) -> np.ndarray:
        """(3,) what to subtract, whole metres: the middle of a mesh with coordinates beyond `FARTHEST`, else 0."""
        is_far = np.abs(self.bounds).max() > FARTHEST
        return np.round(self.bounds.mean(0)) if is_far else np.zeros(3)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3), the lowest and the highest corner."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def diagonal(self) -> float:
        low, high = self.bounds
        return float(np.linalg.norm(high - low))


def find(folder: Path, name: str | None, others: Sequence[str] = ()) -> Path:
    """Return the mesh file: `source.mesh`, the only one of mesh.ply, mesh.obj, mesh.glb, or the first of `others` that is there.

    Raises:
        InputError: no such file, several, or one of another kind.
    """
    if name is not None:
        path = folder / name
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"`source.mesh: {name}`: allowed are {', '.join(SUFFIXES)} files")
        if not path.is_file():
            raise InputError(f"{path}: not found (`source.mesh: {name}`).{did_you_mean_path(path)}")
        _refuse_empty(path)
        check_mesh(path)
        return path
    found = [folder / n for n in NAMES if (folder / n).is_file()]
    found = found or [folder / n for n in others if (folder / n).is_file()][:1]
    if len(found) > 1:
        raise InputError(f"{folder}: holds {' and '.join(p.name for p in found)}; choose one with `source.mesh`")
    if not found:
        meshes = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
        hint = f" Found {', '.join(meshes[:3])}: name it with `source.mesh`." if meshes else ""
        raise InputError(
            f"{folder}: no {', '.join((*others, *NAMES))}; a mesh of the scene is needed (docs/guide/own-data.md).{hint}"
        )
    _refuse_empty(found[0])
    check_mesh(found[0])
    return found[0]


def _refuse_empty(path: Path) -> None:
    """Refuse what its first bytes show to be no mesh."""
    check_file(path, limits.MESH_BYTES, "a mesh")
    with open(path, "rb") as file:
        start = file.read(64)
    if not start:
        raise InputError(f"{path}: empty (0 bytes); {AGAIN}")
    if path.suffix.lower() == ".ply" and not start.startswith(b"ply"):
        raise InputError(f"{path}: not a PLY file (it begins with {start[:16]!r}, not with 'ply'); {AGAIN}")


def _refuse_cut(path: Path) -> None:
    """Refuse a PLY in text form that holds fewer lines than its header says, of which the reader would return a part."""
    if path.suffix.lower() != ".ply":
        return
    with open(path, "rb") as file:
        head = file.read(1 << 20).partition(b"end_header")[0]
    if b"format ascii" not in head:
        return  # the reader itself compares the length of binary files with the header
    data = path.read_bytes()
    counts = re.findall(rb"^element\s+(\w+)\s+(\d+)", head, re.MULTILINE)
    promised = sum(int(count) for _, count in counts)
    body = data[data.find(b"\n", len(head)) + 1 :].rstrip()
    found = body.count(b"\n") + 1 if body else 0
    if found == promised and re.search(rb"element\s+face\s+[1-9]\d*\s+property\s+list[^\n]*\Z", head.rstrip()):
        corners, *last = body[body.rfind(b"\n") + 1 :].split()  # of a header that ends with faces, and these with their vertices
        found -= not corners.isdigit() or len(last) < int(corners)
    if found < promised:
        said = ", ".join(f"{int(count)} of {name.decode()}" for name, count in counts)
        raise InputError(f"{path}: cut short (its header announces {said}; {found} lines of {promised} follow); {AGAIN}")


@dataclass(frozen=True)
class VertexIds:
    """The object of every vertex of a mesh file (n,) with -1 = none, the names of the objects, and the file of the ids."""

    ids: np.ndarray
    names: dict[int, str]
    path: Path


def load(path: Path, metres: float, of_vertices: VertexIds | None = None, axes: str = AS_IS) -> Mesh:
    """Read a mesh (PLY, OBJ or GLB), merge its nodes, scale it to metres, turn it, remove faces without area, keep `instance` of
    the faces.

    `metres` is the unit of the file; `of_vertices` are ids from another file, which replace those of the mesh; `axes`:
    those of the poses, as axes of the file (`turn_of`).

    Raises:
        InputError: unreadable, no triangles, none with an area, or instance ids that do not fit.
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
        ids, names = majority_id(of_vertices.ids[faces]), None
    mesh = _cleaned(path, vertices * metres @ turn_of(axes).T, faces, ids)
    if names is not None:
        mesh.names, mesh.from_nodes = names, True
    elif mesh.instance is not None:
        given, mesh.instance = _renumbered(mesh.instance)
        known = of_vertices.names if of_vertices is not None else {}
        mesh.names = [known.get(int(i), f"instance {i}") for i in given]
    return mesh


def majority_id(ids: np.ndarray) -> np.ndarray:
    """Return the id (m,) that at least two of the three vertices of a face share, -1 where all differ; ids (m, 3).

    >>> majority_id(np.array([[4, 7, 4], [1, 2, 3]])).tolist()
    [4, -1]
    """
    a, b, c = ids.T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, -1)).astype(np.int64)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str] | None]:
    """Return vertices, faces, the objects of the faces and, where these are nodes of the file, their names."""
    _refuse_empty(path)
    check_mesh(path)
    _refuse_cut(path)
    with reading(path, "cannot be read as a mesh", f"; it is damaged or cut short: {AGAIN}"):
        if path.suffix.lower() == ".ply":
            vertices, faces, ids = read_ply(path)
            return vertices, faces, None if ids is None else _whole(path, ids), None
        if path.suffix.lower() == ".obj":
            return *read_obj(path), None, None
        import trimesh

        # glTF has one precision, so nothing is lost on the way through it.
        return _merged(path, trimesh.load_scene(BytesIO(plain_glb(path)), file_type="glb", process=False, maintain_order=True))


def _merged(path: Path, scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str] | None]:
    """Return the same of a scene of Trimesh."""
    import trimesh

    vertices, faces, nodes, names, offset, count = [], [], [], [], 0, 0
    for node in scene.graph.nodes_geometry:
        transform, key = scene.graph[node]
        part = scene.geometry[key]
        if not isinstance(part, trimesh.Trimesh) or len(part.faces) == 0:
            continue
        count += len(part.faces)
        check_faces(path, count)
        v = np.asarray(part.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
        f = np.asarray(part.faces, np.int64)
        if np.linalg.det(transform[:3, :3]) < 0:  # a mirrored node would have its front inside
            f = f[:, ::-1]
        vertices.append(v)
        faces.append(f + offset)
        nodes.append(np.full(len(f), len(names), np.int32))
        names.append(str(node))
        offset += len(v)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), None, None
    own = (np.concatenate(nodes), names) if len(names) > 1 else (None, None)
    return np.concatenate(vertices), np.concatenate(faces), *own


def _whole(path: Path, values: np.ndarray) -> np.ndarray:
    """Return the `instance` property of faces as integers, -1 = none."""
    whole = np.rint(np.where(np.isfinite(values), values, -1))
    if (np.abs(values - whole)[np.isfinite(values)] > 1e-3).any():
        raise InputError(f"{path}: `instance` holds numbers between integers; ids must be integers")
    return np.where(whole < 0, -1, whole).astype(np.int64)


def _cleaned(path: Path, vertices: np.ndarray, faces: np.ndarray, ids: np.ndarray | None) -> Mesh:
    finite = np.isfinite(vertices).all(1)[faces].all(1)
    kept = finite & (face_geometry(np.where(np.isfinite(vertices), vertices, 0), faces)[1] >= MIN_AREA)
    notes = []
    if (~finite).any():
        notes.append(f"mesh: {int((~finite).sum())} faces with NaN vertices removed")
    if (finite & ~kept).any():
        notes.append(f"mesh: {int((finite & ~kept).sum())} zero-area triangles removed")
    kept, doubled = _first_of_doubled(vertices, faces, kept)
    if doubled:
        notes.append(f"mesh: {doubled} faces that lie on another one removed (two-sided export?)")
    if not kept.any():
        raise InputError(
            f"{path}: none of {len(faces)} triangles has an area above {MIN_AREA:g} m^2; if it is a good mesh, its unit"
            " is larger than `source.unit` says"
        )
    used, faces = np.unique(faces[kept], return_inverse=True)
    if path.suffix.lower() == ".obj" and len(used) < (1 - MAX_UNUSED) * len(vertices):
        share = 1 - len(used) / len(vertices)
        notes.append(f"WARNING {share:.0%} of the vertices of {path.name} belong to no face: is the file cut short?")
    return Mesh(vertices[used], faces.reshape(-1, 3).astype(np.int32), None if ids is None else ids[kept], notes=notes)


def _first_of_doubled(vertices: np.ndarray, faces: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, int]:
    """Keep (m,) bool one of the faces whose three corners lie in the same places, and count the others."""
    own = np.flatnonzero(kept)
    used, index = np.unique(faces[own], return_inverse=True)
    place = np.unique(vertices[used], axis=0, return_inverse=True)[1].reshape(-1)
    corners = np.sort(place[index.reshape(-1, 3)], 1)
    first = np.unique(corners, axis=0, return_index=True)[1]
    out = np.zeros(len(kept), bool)
    out[own[first]] = True
    return out, len(own) - len(first)


def _renumbered(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ids that occur, ascending, and the ids renumbered from 0 in that order; -1 stays."""
    given = np.unique(ids[ids >= 0])
    return given, np.where(ids < 0, -1, np.searchsorted(given, ids)).astype(np.int32)


def check_size(path: Path, mesh: Mesh, unit: str | float, metres: float, centres: np.ndarray) -> None:
    """Refuse a scene that cannot be in metres, and cameras that are not near it.

    Args:
        path: file that messages name.
        mesh: in metres.
        unit: `source.unit`, for messages.
        metres: per unit.
        centres: (v, 3) camera positions, metres.

    Raises:
        InputError: the size is implausible, or most cameras are far from the mesh.
    """
    check_across(path, mesh.vertices, unit, metres, centres)
    diagonal = mesh.diagonal
    bounds = mesh.bounds
    outside = np.linalg.norm(np.maximum(np.maximum(bounds[0] - centres, centres - bounds[1]), 0), axis=1)
    far = outside > diagonal
    if 2 * int(far.sum()) > len(centres):
        raise InputError(
            f"{path}: {int(far.sum())} of {len(centres)} cameras are more than the scene's size ({diagonal:.3g} m) away"
            f" from the mesh (median {np.median(outside):.3g} m); {_factor_advice(bounds, centres)}"
            " export both from the same tool (docs/guide/own-data.md, mesh and poses in one frame)"
        )


def check_across(path: Path, vertices: np.ndarray, unit: str | float, metres: float, centres: np.ndarray | None = None) -> None:
    """Refuse a scene whose size (m) cannot be that of a room; the message proposes the unit that would make it one.

    Raises:
        InputError: its vertices (n, 3), in metres, reach less than 0.5 m or more than 200 m, and so do those without a hundredth
            at each end, as the ground around a house has it; other arguments as `check_size`.
    """
    low, high = DIAGONAL
    diagonal, most = (float(np.linalg.norm(np.ptp(np.quantile(vertices, (q, 1 - q), axis=0), axis=0))) for q in (0.0, MARGIN))
    if low <= diagonal <= high or low <= most <= high:
        return
    found = f"{path}: the scene is {diagonal:.4g} m across (allowed {low:g} to {high:g} m), read with `source.unit: {unit}`"
    cameras = 0.0 if centres is None else float(np.linalg.norm(np.ptp(centres, axis=0)))
    if diagonal > high and 0.1 < cameras < 1e-2 * diagonal:
        # A room is larger than the space that its photographs are taken from.
        units = {
            name: factor for name, factor in METRES.items() if factor < metres and cameras <= diagonal * factor / metres <= high
        }
        name = min(units, key=lambda name: abs(np.log(diagonal * units[name] / metres / TYPICAL_DIAGONAL)), default=None)
        likely = (
            f": in {name} it would be {diagonal * units[name] / metres:.3g} m across, so" if name else "; bring it into theirs:"
        )
        by = f"{units[name] / metres:g}" if name else "<the right factor>"
        raise InputError(
            f"{found}, but the cameras span {cameras:.3g} m: mesh and poses are in different units{likely} scale the vertices of"
            f" the mesh by {by}"
        )
    size = diagonal if 2 * most > diagonal else most
    across = {name: size / metres * factor for name, factor in METRES.items()}
    name, size = min(across.items(), key=lambda item: abs(np.log(item[1] / TYPICAL_DIAGONAL)))
    if low <= size <= high:
        raise InputError(f"{found}; `source: {{unit: {name}}}` makes it {size:.3g} m")
    raise InputError(f"{found}; give its unit as a number: `source: {{unit: <metres per unit>}}`")


def _factor_advice(bounds: np.ndarray, centres: np.ndarray) -> str:
    """Describe how mesh and poses differ, with the power of ten that brings nine of ten cameras into the mesh, if one does."""
    for factor in FACTORS:
        scaled = centres * factor
        spread = np.linalg.norm(np.ptp(scaled, axis=0)) > LEAST_SPREAD * np.linalg.norm(bounds[1] - bounds[0])
        if spread and ((scaled >= bounds[0]) & (scaled <= bounds[1])).all(1).mean() >= 0.9:
            return (
                f"with camera positions times {factor:g} they are inside it, so mesh and poses seem to be in different units:"
                " scale the positions in transform_matrix, or"
            )
    return "mesh and poses are in different units or frames:"
