"""Converts Mitsuba BSDFs to base colour a, perceptual roughness r and metallic m; the notes state every approximation.

    diffuse                    a = reflectance, r = 1, m = 0
    plastic, roughplastic      a = albedo of base and coat (`albedo_under_coat`), r = sqrt(alpha) (smooth: alpha = 0), m = 0
    conductor, roughconductor  a = F0 specular_reflectance, F0 = ((eta - 1)^2 + k^2) / ((eta + 1)^2 + k^2), m = 1
    principled                 a = base_color, r = roughness (Mitsuba's alpha = roughness^2), m = metallic
    blendbsdf                  linear in its weight; twosided, bumpmap, normalmap, mask: the BSDF inside
    dielectric, ...            transparent: no truth;  anything else: neutral grey, no truth

Mitsuba itself evaluates the textures (linear values; `to_uv`, `raw`, wrapping, filter). The target model is Eq. R.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lab.mitsuba_scene.flatten import FlatMesh
from lab.mitsuba_scene.scene import Shape, children, parameter

Array = np.ndarray

MIN_ROUGHNESS = 0.02
OPAQUE = 0.5  # faces with less opacity are left out of the mesh

_TRANSPARENT = {"SmoothDielectric", "RoughDielectric", "ThinDielectric"}
_PLASTIC = {"SmoothPlastic", "RoughPlastic", "PolarizedPlastic"}
_CONDUCTOR = {"SmoothConductor", "RoughConductor"}
_WRAPPER = {
    "TwoSidedBRDF": "brdf_0",
    "MaskBSDF": "nested_bsdf",
    "BumpMap": "nested_bsdf",
    "NormalMap": "nested_bsdf",
}
_PRINCIPLED_EXTRAS = ("anisotropic", "spec_tint", "sheen", "clearcoat", "flatness", "diff_trans")
_POINTS_AT_ONCE = 1 << 22


def albedo_under_coat(reflectance: Array, eta: float, nonlinear: bool) -> Array:
    """Compute the albedo of a diffuse base under a dielectric coat: (1 - F_ext)^2 / eta^2 * rho / (1 - s F_int), float32.

    F_ext and F_int are the diffuse Fresnel reflectances from outside and inside; s = rho for `nonlinear` plastics, else 1. Light
    is lost on its way in and out and reflected back inside the coat. The target model has no such loss, and so this average over
    directions, rather than the reflectance of the base, is its base colour.
    """
    outside = float(np.ravel(mi.fresnel_diffuse_reflectance(1.0 / eta))[0])
    inside = float(np.ravel(mi.fresnel_diffuse_reflectance(eta))[0])
    if eta > 1:  # total reflection makes the inner one larger
        outside, inside = min(outside, inside), max(outside, inside)
    returned = inside * (reflectance if nonlinear else 1.0)
    return ((1 - outside) ** 2 / eta**2 * reflectance / (1 - returned)).astype(np.float32)


@dataclass
class Surface:
    """Materials of n points: albedo (n, 3) linear, roughness (n,) perceptual, metallic (n,), truth (n,) bool = is exact."""

    albedo: Array
    roughness: Array
    metallic: Array
    truth: Array

    @staticmethod
    def neutral(n: int) -> Surface:
        """Return a grey of medium roughness that is no truth."""
        half = np.full(n, 0.5, np.float32)
        return Surface(np.full((n, 3), 0.5, np.float32), half, np.zeros(n, np.float32), np.zeros(n, bool))


class Points:
    """Points at which textures are evaluated: uv (n, 2), positions (n, 3), primitives and shapes (n,)."""

    def __init__(self, uv: Array, position: Array, primitive: Array, shape: Array, shapes: list[Shape]):
        self.count = len(uv)
        si = dr.zeros(mi.SurfaceInteraction3f, self.count)
        si.uv = mi.Point2f(*(mi.Float(np.ascontiguousarray(uv[:, i], np.float32)) for i in range(2)))
        si.p = mi.Point3f(*(mi.Float(np.ascontiguousarray(position[:, i], np.float32)) for i in range(3)))
        si.prim_index = mi.UInt32(np.maximum(primitive, 0).astype(np.uint32))
        si.wi = mi.Vector3f(0, 0, 1)
        if len(shape):
            used, which = np.unique(shape, return_inverse=True)
            ids = [int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes[i].object)))[0]) for i in used]
            si.shape = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(np.array(ids, np.uint32)[which]))
        self.si = si

    def colour(self, texture: Any, default: float) -> Array:
        """Return the linear RGB (n, 3) float32 of a texture; `default` where the BSDF has none."""
        if texture is None:
            return np.full((self.count, 3), default, np.float32)
        value = np.array(mi.Color3f(texture.eval(self.si)), np.float32).T
        return np.ascontiguousarray(np.broadcast_to(value, (self.count, 3)))

    def scalar(self, value: Any, default: float) -> Array:
        """Return the (n,) float32 values of a texture or a number; `default` for None."""
        if value is None:
            return np.full(self.count, default, np.float32)
        if not isinstance(value, mi.Texture):
            return np.full(self.count, float(np.asarray(value).ravel()[0]), np.float32)
        try:
            result = np.array(value.eval_1(self.si), np.float32)
        except RuntimeError:  # spectra have no scalar form
            result = self.colour(value, default).mean(1)
        return np.ascontiguousarray(np.broadcast_to(result, (self.count,)))


class Material:
    """One BSDF, read once.

    Attributes:
        transparent: transmits light (glass).
        two_sided: reflects on both sides.
        masked: has an opacity.
        notes: approximations of the conversion, as text.
    """

    def __init__(self, bsdf: Any):
        self.bsdf = bsdf
        self.kind: str = bsdf.class_name()
        below = children(bsdf)
        self.textures = {name: thing for name, thing in below.items() if isinstance(thing, mi.Texture)}
        self.inner = {name: Material(thing) for name, thing in below.items() if isinstance(thing, mi.BSDF)}
        self.notes: set[str] = set().union(*(inner.notes for inner in self.inner.values()))
        nested = [inner for name, inner in self.inner.items() if name != "brdf_1"]
        self.masked = self.kind == "MaskBSDF" or any(inner.masked for inner in nested)
        self.transparent = self.kind in _TRANSPARENT or (bool(nested) and all(inner.transparent for inner in nested))
        self.two_sided = self.kind in ("TwoSidedBRDF", "Null") or self.transparent or any(i.two_sided for i in nested)
        self.known = True
        self._read_kind()

    def _read_kind(self) -> None:
        note = self.notes.add
        if self.kind in _TRANSPARENT:
            note("dielectric, thindielectric, roughdielectric: transparent, no material truth")
        elif self.kind == "SmoothDiffuse":
            note("diffuse: r = 1; the target model adds a specular reflection of F0 = 0.04 that the photographs lack")
        elif self.kind in _PLASTIC:
            note("plastic, roughplastic: base colour = diffuse albedo of base and coat together, not diffuse_reflectance")
            eta = self._eta()
            if abs(((eta - 1) / (eta + 1)) ** 2 - 0.04) > 0.004:
                note("plastic, roughplastic of another index than 1.5: F0 = 0.04 stands in its place")
            if "specular_reflectance" in self.textures:
                note("plastic, roughplastic with specular_reflectance: left out")
            if self.kind == "SmoothPlastic":
                note(f"plastic: mirror-smooth coat, r = {MIN_ROUGHNESS}")
        elif self.kind in _CONDUCTOR:
            note("conductor, roughconductor: base colour = F0(eta, k) x specular_reflectance; Fresnel is Schlick's")
        elif self.kind == "Principled":
            zero = self._points_zero()
            if any(zero.scalar(self.textures.get(name), 0).max() > 0 for name in _PRINCIPLED_EXTRAS):
                note("principled with anisotropy, tint, sheen, clearcoat or flatness: those lobes are left out")
            self.transparent = bool(zero.scalar(self.textures.get("spec_trans"), 0)[0] > 0.5)
            self.two_sided |= self.transparent
            note("principled: base_color, roughness, metallic as they are; its diffuse lobe is Disney's")
        elif self.kind == "PrincipledThin":
            zero = self._points_zero()
            self.transparent = bool(zero.scalar(self.textures.get("spec_trans"), 0)[0] > 0.5)
            self.two_sided = True
            note("principledthin: base_color and roughness; light that goes through is left out")
        elif self.kind == "MaskBSDF":
            note(f"mask: faces of opacity below {OPAQUE} left out, the others opaque (in the photographs only in part)")
        elif self.kind == "Null":
            note("null: no surface, left out")
        elif self.kind in ("BumpMap", "NormalMap"):
            note("bumpmap, normalmap: the geometric normal is kept")
        elif self.kind == "BlendBSDF":
            note("blendbsdf: parameters blended linearly")
        elif self.kind == "TwoSidedBRDF":
            if "brdf_1" in self.inner and self.inner["brdf_1"].bsdf is not self.inner["brdf_0"].bsdf:
                note("twosided with two BSDFs: the front one is taken on both sides")
        else:
            self.known = False
            note(f"{self.bsdf.class_name()}: unknown BSDF, grey in its place and no material truth")

    def _eta(self) -> float:
        """Return the index of refraction of a plastic's coat; a textured one is represented by one of its values."""
        eta = parameter(self.bsdf, "eta")
        if eta is None and "eta" in self.textures:
            eta = self._points_zero().scalar(self.textures["eta"], 1.5)
        return float(np.asarray(eta).ravel()[0]) if eta is not None else 1.5

    def _points_zero(self) -> Points:
        """Return one point in the middle of the texture, for quantities that are needed once per BSDF."""
        return Points(np.full((1, 2), 0.5), np.zeros((1, 3)), np.zeros(1, np.int32), np.zeros(0, np.int32), [])

    def opacity(self, points: Points) -> Array:
        """Return the opacity (n,) in [0, 1]: the product of all nested masks, 0 for `null`."""
        if self.kind == "Null":
            return np.zeros(points.count, np.float32)
        own = points.scalar(self.textures.get("opacity"), 1)  # only a mask has one
        name = _WRAPPER.get(self.kind)
        return own * self.inner[name].opacity(points) if name in self.inner else own

    def evaluate(self, points: Points) -> Surface:
        """Return albedo, roughness and metallic at points; roughness in [0.02, 1], the others clipped to [0, 1]."""
        surface = self._evaluate(points)
        surface.albedo = np.clip(np.nan_to_num(surface.albedo), 0, 1).astype(np.float32)
        surface.roughness = np.clip(np.nan_to_num(surface.roughness, nan=1.0), MIN_ROUGHNESS, 1).astype(np.float32)
        surface.metallic = np.clip(np.nan_to_num(surface.metallic), 0, 1).astype(np.float32)
        return surface

    def _evaluate(self, points: Points) -> Surface:
        n = points.count
        sure, zero = np.ones(n, bool), np.zeros(n, np.float32)
        colour = lambda name, default: points.colour(self.textures.get(name), default)  # noqa: E731
        if self.kind in _WRAPPER:
            return self.inner[_WRAPPER[self.kind]].evaluate(points)
        if self.kind == "SmoothDiffuse":
            return Surface(colour("reflectance", 0.5), np.ones(n, np.float32), zero, sure)
        if self.kind in _PLASTIC:
            # Mitsuba reports the flag only in the description.
            nonlinear = "nonlinear = 1" in str(self.bsdf)
            albedo = albedo_under_coat(colour("diffuse_reflectance", 0.5), self._eta(), nonlinear)
            return Surface(albedo, np.sqrt(self._alpha(points)), zero, sure)
        if self.kind in _CONDUCTOR:
            eta, k = colour("eta", 0), colour("k", 1)
            f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
            return Surface(f0 * colour("specular_reflectance", 1), np.sqrt(self._alpha(points)), zero + 1, sure)
        if self.kind in ("Principled", "PrincipledThin"):
            metallic = points.scalar(self.textures.get("metallic"), 0)
            roughness = points.scalar(self.textures.get("roughness"), 0.5)
            return Surface(colour("base_color", 0.5), roughness, metallic, sure & (not self.transparent))
        if self.kind == "BlendBSDF":
            w = np.clip(points.scalar(self.textures.get("weight"), 0.5), 0, 1)
            a, b = self.inner["bsdf_0"].evaluate(points), self.inner["bsdf_1"].evaluate(points)
            mix = lambda x, y: x + (w if x.ndim == 1 else w[:, None]) * (y - x)  # noqa: E731
            truth = (a.truth | (w >= 1)) & (b.truth | (w <= 0))
            return Surface(mix(a.albedo, b.albedo), mix(a.roughness, b.roughness), mix(a.metallic, b.metallic), truth)
        surface = Surface.neutral(n)
        if self.kind in _TRANSPARENT:
            surface.albedo[:] = 1
            surface.roughness = np.sqrt(self._alpha(points))
        return surface

    def _alpha(self, points: Points) -> Array:
        """Return the microfacet alpha (n,) >= 0: the geometric mean of an anisotropic pair, 0 for the smooth kinds."""
        if self.kind in ("SmoothPlastic", "SmoothConductor", "SmoothDielectric", "ThinDielectric"):
            return np.zeros(points.count, np.float32)
        pair = []
        for name in ("alpha_u", "alpha_v") if self._has("alpha_u") else ("alpha", "alpha"):
            value = self.textures.get(name)
            pair.append(np.maximum(points.scalar(parameter(self.bsdf, name) if value is None else value, 0.1), 0))
        return np.sqrt(pair[0] * pair[1])

    def _has(self, name: str) -> bool:
        return name in self.textures or parameter(self.bsdf, name) is not None


class MaterialTable:
    """The materials of a mesh's shapes, and their evaluation at points on faces."""

    def __init__(self, shapes: list[Shape]):
        self.shapes = shapes
        self.materials: list[Material] = []
        known: dict[Any, int] = {}
        of_shape = []
        for shape in shapes:
            bsdf = shape.object.bsdf()
            if bsdf not in known:
                known[bsdf] = len(self.materials)
                self.materials.append(Material(bsdf))
            of_shape.append(known[bsdf])
        self.of_shape = np.array(of_shape, np.int32)

    def of_faces(self, mesh: FlatMesh, name: str) -> Array:
        """Return a flag (`transparent`, `two_sided`, `known`, `masked`) of the material of every face, (m,) bool."""
        flags = np.array([getattr(material, name) for material in self.materials], bool)
        return flags[self.of_shape[mesh.shape]]

    def face_opacity(self, mesh: FlatMesh) -> Array:
        """Return the mean opacity of every face, (m,) float32; 1 without a mask."""
        out = np.ones(len(mesh.faces), np.float32)
        kinds = np.array([m.masked or m.kind == "Null" for m in self.materials], bool)
        faces = np.flatnonzero(kinds[self.of_shape[mesh.shape]])
        samples = np.array([[1 / 3, 1 / 3], [0.6, 0.2], [0.2, 0.6], [0.2, 0.2]])
        total = np.zeros(len(faces))
        for b in samples:
            for rows, part in self._groups(mesh, faces, np.tile(b, (len(faces), 1)), Material.opacity):
                total[rows] += part
        out[faces] = total / len(samples)
        return out

    def evaluate(self, mesh: FlatMesh, face: Array, barycentric: Array) -> Surface:
        """Return the materials at points of faces (n,) with weights (n, 2) of their second and third corners."""
        out = Surface.neutral(len(face))
        for rows, part in self._groups(mesh, face, barycentric, Material.evaluate):
            out.albedo[rows], out.roughness[rows] = part.albedo, part.roughness
            out.metallic[rows], out.truth[rows] = part.metallic, part.truth
        return out

    def _groups(self, mesh: FlatMesh, face: Array, barycentric: Array, function: Any) -> Any:
        material = self.of_shape[mesh.shape[face]]
        order = np.argsort(material, kind="stable")
        bounds = np.searchsorted(material[order], np.arange(len(self.materials) + 1))
        for index in range(len(self.materials)):
            for start in range(bounds[index], bounds[index + 1], _POINTS_AT_ONCE):
                rows = order[start : min(start + _POINTS_AT_ONCE, bounds[index + 1])]
                f, b = face[rows], barycentric[rows]
                weights = np.column_stack([1 - b.sum(1), b])[:, :, None]
                uv = (weights * mesh.uv[f]).sum(1)
                position = (weights * mesh.vertices[mesh.faces[f]]).sum(1)
                points = Points(uv, position, mesh.primitive[f], mesh.shape[f], self.shapes)
                yield rows, function(self.materials[index], points)

    def notes(self, mesh: FlatMesh) -> list[str]:
        """Return every approximation of the conversion, with the numbers of BSDFs and faces that it concerns."""
        faces = np.bincount(self.of_shape[mesh.shape], minlength=len(self.materials))
        lines: dict[str, list[int]] = {}
        for material, count in zip(self.materials, faces.tolist(), strict=True):
            for note in material.notes if count else ():
                entry = lines.setdefault(note, [0, 0])
                entry[0] += 1
                entry[1] += count
        return [f"{note} ({bsdfs} BSDFs, {count} faces)" for note, (bsdfs, count) in sorted(lines.items())]


def barycentric_of(mesh: FlatMesh, face: Array, position: Array) -> Array:
    """Return the weights (n, 2) of the second and third corner at points (n, 3) on faces (n,), clipped into the triangle."""
    a, b, c = (mesh.vertices[mesh.faces[face, i]].astype(np.float64) for i in range(3))
    u, v, w = b - a, c - a, position.astype(np.float64) - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    determinant = np.maximum(uu * vv - uv * uv, np.finfo(np.float64).tiny)
    weights = np.column_stack([vv * wu - uv * wv, uu * wv - uv * wu]) / determinant[:, None]
    weights = np.clip(weights, 0, 1)
    return weights / np.maximum(weights.sum(1, keepdims=True), 1)
