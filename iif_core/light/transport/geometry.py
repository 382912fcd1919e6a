"""The mesh of a scene, its ray tracing and the tables that kernels read about a face."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import chunks, on_device, rows_of, to_numpy, vectors

Array = np.ndarray

MIN_AREA = 1e-12
"""Faces below this area (m^2) are degenerate: never hit, never drawn, with an arbitrary unit normal
(docs/method/numerics.md#degenerate-faces)."""

NO_FACE = -1


class Geometry:
    """One merged mesh, ready for ray tracing; made by `build_geometry`. Not a Dr.Jit struct, so kernels do not carry it as state.

    Attributes:
        vertices: (n, 3) float32 metres; faces: (m, 3) int32; object_id: (m,) int32.
        normals: (m, 3) float32 unit right-hand normals, finite for degenerate faces too.
        areas: (m,) float64 m^2, 0 for degenerate faces.
        transmittance: (m,) float32 in [0, 1), share of the rays that pass straight through a face; None = none does anywhere.
    """

    def __init__(self, vertices: Array, faces: Array, object_id: Array, transmittance: Array | None = None):
        self.vertices, self.faces, self.object_id, self.transmittance = vertices, faces, object_id, transmittance
        # float64, because edges are differences of nearby coordinates and a normal is one of nearby products.
        corners = vertices.astype(np.float64)[faces]
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normals = np.cross(edge1, edge2)
        twice = np.linalg.norm(normals, axis=1)
        solid = twice / 2 >= MIN_AREA
        self.areas = np.where(solid, twice / 2, 0.0)
        up = np.array([0.0, 0.0, 1.0])
        self.normals = np.where(solid[:, None], normals / np.where(solid, twice, 1.0)[:, None], up).astype(np.float32)
        if not solid.any():
            raise InputError(f"the mesh has no face of area >= {MIN_AREA} m^2 among {len(faces)}; give a mesh with surface")

        # -------- ray tracing --------
        # The tracer holds faces with area only and numbers them anew; `_face_of_primitive` leads back to ids of the mesh.
        primitives = np.flatnonzero(solid)
        mesh = mi.Mesh("scene", len(vertices), len(primitives), has_vertex_normals=False, has_vertex_texcoords=False)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = vertices.ravel()
        parameters["faces"] = faces[primitives].astype(np.uint32).ravel()
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "mesh": mesh})

        # -------- tables that kernels read by face --------
        self._face_of_primitive = None if solid.all() else on_device(primitives, mi.UInt32)
        # The bits of the id ride in the fourth float, so that one read fetches both.
        self._normal_object = on_device(np.column_stack([self.normals, object_id.view(np.float32)]))
        self._corner = on_device(_padded(corners[:, 0]))
        self._edge1, self._edge2 = on_device(_padded(edge1)), on_device(_padded(edge2))
        self._transmittance = None if transmittance is None else on_device(transmittance)

    def normal_and_object(self, face: Any, active: Any) -> tuple[Any, Any]:
        """Unit right-hand normal and object id of a face (device types)."""
        record = dr.gather(mi.Vector4f, self._normal_object, face, active)
        return mi.Vector3f(record.x, record.y, record.z), dr.reinterpret_array(mi.Int32, record.w)

    def point_on_face(self, face: Any, b1: Any, b2: Any, active: Any) -> Any:
        """Return v0 + b1 (v1 - v0) + b2 (v2 - v0).

        Args:
            face, active: ids, and lanes that need a point.
            b1, b2: barycentric coordinates of the second and the third corner.

        Returns:
            Point3f, metres.
        """
        v0 = dr.gather(mi.Vector4f, self._corner, face, active)
        e1 = dr.gather(mi.Vector4f, self._edge1, face, active)
        e2 = dr.gather(mi.Vector4f, self._edge2, face, active)
        p = v0 + b1 * e1 + b2 * e2
        return mi.Point3f(p.x, p.y, p.z)

    def intersect(self, origin: Any, direction: Any, active: Any, salt: Any = 0) -> tuple[Any, Any, Any]:
        """(hit, face, t) of the nearest face along origin + t direction that stops the ray; face is 0 where nothing is hit.

        A face lets a ray pass with the probability `transmittance` (docs/method/shading.md#surface-that-lets-light-through).
        Whether it does follows from the ray, the face and `salt` (`draw_salt`).
        """
        if self._transmittance is None:
            return self.nearest(origin, direction, active)
        return _first_stop(self, origin, direction, active, mi.UInt32(salt))

    def draw_salt(self, rng: Any) -> Any:
        """Draw what distinguishes equal rays that may pass a face; without such faces nothing is drawn."""
        return 0 if self._transmittance is None else rng.next_uint32()

    def passes(self, face: Any, direction: Any, t: Any, active: Any, salt: Any) -> Any:
        """Decide by chance whether a ray passes a face; the random number is a hash of the face, the ray and `salt`."""
        share = dr.gather(mi.Float, self._transmittance, face, active)
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(value)) for value in (t, direction.x, direction.y)]
        first, second = bits[0] ^ (bits[1] * 0x9E3779B1), bits[2] + face * 0x85EBCA77
        return active & (mi.sample_tea_float32(first ^ salt, second) < share)

    def nearest(self, origin: Any, direction: Any, active: Any) -> tuple[Any, Any, Any]:
        """As `intersect`, with faces that stop every ray."""
        found = self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=False, active=active)
        hit = active & found.is_valid()
        face = dr.select(hit, found.prim_index, 0)
        if self._face_of_primitive is not None:
            face = dr.gather(mi.UInt32, self._face_of_primitive, face, hit)
        return hit, face, found.t

    def occluded(self, origin: Any, direction: Any, distance: Any, active: Any, salt: Any = 0) -> Any:
        """Test for anything between two points that stops the ray.

        Args:
            origin, direction: start of the ray and unit direction.
            distance, active: metres up to which something counts, and lanes that need the answer.
            salt: as in `intersect`.

        Returns:
            Bool, true where something lies on origin + t direction with 0 < t < distance.
        """
        if self._transmittance is not None:
            hit, _, t = self.intersect(origin, direction, active, salt)
            return hit & (t < distance)
        return self.scene.ray_test(mi.Ray3f(origin, direction, distance, 0.0, mi.Color0f()), coherent=False, active=active)


@dr.syntax
def _first_stop(geometry: Geometry, origin: Any, direction: Any, active: Any, salt: Any) -> tuple[Any, Any, Any]:
    """(hit, face, t) of the first face that a ray does not pass."""
    hit, face, t = geometry.nearest(origin, direction, active)
    going = geometry.passes(face, direction, t, hit, salt)
    while going:
        # A new ray starts behind the sheet. `offset_from` moves it along the ray in place of a normal.
        past = offset_from(mi.Point3f(dr.fma(direction, t, origin)), direction * dr.rcp(dr.norm(direction)))
        hit, face, further = geometry.nearest(past, direction, going)
        # Distance of the whole ray, so that densities per solid angle hold behind any number of sheets (Eq. S.5).
        t = dr.norm(past - origin) * dr.rcp(dr.norm(direction)) + further
        going = geometry.passes(face, direction, t, hit, salt)
    return hit, face, t


def _padded(rows: Array) -> Array:
    return np.column_stack([rows, np.zeros(len(rows))])


def build_geometry(
    vertices: ArrayLike, faces: ArrayLike, object_id: ArrayLike, transmittance: ArrayLike | None = None
) -> Geometry:
    """Build a mesh from vertices (n, 3) metres, faces (m, 3) vertex ids, object_id (m,) (-1 = none) and the share (m,) of the
    rays that pass straight through each face (None = none passes).

    Degenerate faces keep their id and are never hit. Raises InputError for wrong shapes, ids out of range, non-finite vertices
    or a mesh without surface.
    """
    vertices = np.ascontiguousarray(vertices, np.float32)
    faces = np.ascontiguousarray(faces, np.int32)
    object_id = np.ascontiguousarray(object_id, np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise InputError(f"mesh of vertices {vertices.shape} and faces {faces.shape}; both must be (count, 3), not empty")
    if object_id.shape != (len(faces),):
        raise InputError(f"object_id has shape {object_id.shape}, expected ({len(faces)},): one id for each face")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"faces name vertices {faces.min()} ... {faces.max()}, the mesh has 0 ... {len(vertices) - 1}")
    if not np.isfinite(vertices[faces.ravel()]).all():
        raise InputError("the mesh has faces with NaN or infinite vertices; remove them first")
    if object_id.min() < -1:
        raise InputError(f"object ids start at {object_id.min()}; -1 means none, others count from 0")
    share = None
    if transmittance is not None and np.any(transmittance):
        share = rows_of(transmittance, len(faces), None, "transmittance")
        if share.min() < 0 or share.max() >= 1:
            raise InputError(f"transmittance of {share.min():g} to {share.max():g}; expected shares in [0, 1)")
    # Vertices that no face uses may still be non-finite here.
    return Geometry(np.where(np.isfinite(vertices), vertices, 0), faces, object_id, share)


def offset_from(point: Any, normal: Any) -> Any:
    """Move a point off the surface along the viewer's normal by max(1e-4, 3e-6 |x|_inf) metres (Eq. S.12,
    docs/method/numerics.md#self-intersection)."""
    reach = dr.maximum(dr.maximum(dr.abs(point.x), dr.abs(point.y)), dr.abs(point.z))
    return mi.Point3f(dr.fma(normal, dr.maximum(1e-4, 3e-6 * reach), point))


@dataclass
class Hit:
    """A nearest intersection on the device: `normal` is the right-hand normal, `t` counts lengths of the direction."""

    valid: Any
    face: Any
    object_id: Any
    point: Any
    normal: Any
    t: Any


def nearest_hit(geometry: Geometry, origin: Any, direction: Any, active: Any, salt: Any = 0) -> Hit:
    """Intersect rays with the mesh.

    Args:
        geometry: the mesh.
        origin, direction: Point3f in metres, and Vector3f of any length above 0.
        active: lanes that have a ray.
        salt: as in `Geometry.intersect`; None = every face stops every ray.

    Returns:
        Everything that a path needs to know about the nearest intersection.
    """
    ray = (origin, direction, active)
    valid, face, t = geometry.nearest(*ray) if salt is None else geometry.intersect(*ray, salt)
    normal, object_id = geometry.normal_and_object(face, valid)
    return Hit(valid, face, object_id, mi.Point3f(dr.fma(direction, t, origin)), normal, t)


def cosine_directions(normals: ArrayLike, rng: np.random.Generator) -> Array:
    """Draw one direction (n, 3) float64 around each unit normal (n, 3), of density cos / pi per steradian; not of unit length."""
    normals = np.asarray(normals, np.float64)
    ball = rng.normal(size=normals.shape)
    # A uniform point on the sphere that touches the surface from above is cosine-distributed.
    # The factor keeps the sum off 0 where the point lies opposite to the normal.
    return (1 + 1e-6) * normals + ball / np.linalg.norm(ball, axis=1, keepdims=True)


def trace(geometry: Geometry, origins: ArrayLike, directions: ArrayLike, chunk: int = 1 << 20) -> tuple[Array, Array]:
    """Find the nearest face along rays; both sides of a face are hit.

    Args:
        geometry: the mesh.
        origins, directions: (n, 3) or (3,) metres, and (n, 3) of any length above 0.
        chunk: rays on the device at once.

    Returns:
        Face (n,) int32, -1 = miss, and distance (n,) float32 in lengths of the direction, inf = miss. With
        `pinhole.pixel_directions` the distance is the z-depth.
    """
    directions = np.asarray(directions, np.float32).reshape(-1, 3)
    origins = np.broadcast_to(np.asarray(origins, np.float32), directions.shape)
    face_id = np.full(len(directions), NO_FACE, np.int32)
    distance = np.full(len(directions), np.inf, np.float32)
    for part in chunks(len(directions), chunk):
        hit, face, t = geometry.intersect(
            vectors(mi.Point3f, origins[part]), vectors(mi.Vector3f, directions[part]), mi.Bool(True)
        )
        face = dr.select(hit, mi.Int32(face), NO_FACE)
        t = dr.select(hit, t, dr.inf)
        dr.eval(face, t)
        face_id[part], distance[part] = to_numpy(face), to_numpy(t)
    return face_id, distance
