"""Writes scene.usdc: the scene for USD, with UsdPreviewSurface materials, mesh lights and the cameras of the photographs."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from workflow.exporters.atlas import TexturedPart
from workflow.exporters.glb import rotation_to_y
from workflow.scene.normal_form import View

APERTURE = 0.36
"""Width of the sensor of cameras in tenths of a metre, as USD counts it: the width of 35 mm film."""

BASE_COLOR, SURFACE = "textures/base_color.png", "textures/surface.png"
"""Where the textures lie, relative to the file."""


def usd_bytes(
    parts: Sequence[TexturedPart], up: np.ndarray, environment: np.ndarray, views: Sequence[View], provenance: dict[str, Any]
) -> bytes:
    """Make the scene in USD's binary form.

    Vertices stay in the world of the photographs (metres); the root prim turns `up` (3,) to +y. Names are made valid and kept
    as display names. Emitters are mesh lights with the radiance of their material. A uniform environment becomes a dome light;
    of a map (H, W, 3) only its place in the folder is noted.

    Args:
        parts: the meshes; their textures lie at `BASE_COLOR` and `SURFACE`, relative to the file.
        up: unit vector.
        environment: (3,) or (H, W, 3) radiance, as in `iif_core.light.environment`.
        views: photographs, which become cameras with their principal points.
        provenance: kept in the layer.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usdc"
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        world = UsdGeom.Xform.Define(stage, "/world")
        x, y, z, w = rotation_to_y(up)
        world.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
        stage.SetDefaultPrim(world.GetPrim())
        notes = dict(provenance)
        if environment.ndim == 3 and environment.any():
            notes["environment_map"] = "mitsuba/environment.exr"
        elif environment.any():
            dome = UsdLux.DomeLight.Define(stage, "/world/environment")
            _set_radiance(dome, environment)
        stage.GetRootLayer().customLayerData = {name: str(value) for name, value in notes.items()}
        used: set[str] = set()
        for scope in ("materials", "cameras"):
            UsdGeom.Scope.Define(stage, f"/world/{scope}")
            used.add(scope)
        for part in parts:
            name = _identifier(part.name, used)
            material = _material(stage, f"/world/materials/{name}", part, UsdShade, Sdf)
            mesh = _mesh(stage, f"/world/{name}", part, UsdGeom, Sdf)
            mesh.GetPrim().SetDisplayName(part.name)
            UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
            if part.emitter_id >= 0:
                light = UsdLux.MeshLightAPI.Apply(mesh.GetPrim())
                UsdLux.LightAPI(light).CreateIntensityAttr(1.0)  # tinted by the glow of the material, as the schema has it
        taken: set[str] = set()
        for view in views:
            _camera(stage, f"/world/cameras/{_identifier('view_' + view.name, taken)}", view, UsdGeom, Gf)
        stage.GetRootLayer().Save()
        del stage
        return path.read_bytes()


def _identifier(name: str, used: set[str]) -> str:
    from pxr import Tf

    stem = Tf.MakeValidIdentifier(name)
    candidate, number = stem, 1
    while candidate in used:
        number += 1
        candidate = f"{stem}_{number}"
    used.add(candidate)
    return candidate


def _set_radiance(light: Any, radiance: np.ndarray) -> None:
    strength = float(radiance.max())
    light.CreateIntensityAttr(strength)
    light.CreateColorAttr(tuple(float(v) / strength for v in radiance))


def _mesh(stage: Any, path: str, part: TexturedPart, UsdGeom: Any, Sdf: Any) -> Any:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(part.vertices.astype(np.float32))
    mesh.CreateFaceVertexCountsAttr(np.full(len(part.faces), 3, np.int32))
    mesh.CreateFaceVertexIndicesAttr(part.faces.astype(np.int32).ravel())
    mesh.CreateNormalsAttr(part.normals.astype(np.float32))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateExtentAttr(np.stack([part.vertices.min(0), part.vertices.max(0)]).astype(np.float32))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(part.double_sided)
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    uv.Set((part.uv * np.float32([1, -1]) + np.float32([0, 1])).astype(np.float32))  # t grows upwards in USD
    return mesh


def _material(stage: Any, path: str, part: TexturedPart, UsdShade: Any, Sdf: Any) -> Any:
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    types = Sdf.ValueTypeNames
    if part.emitter_id >= 0:
        shader.CreateInput("diffuseColor", types.Color3f).Set((0.0, 0.0, 0.0))
        shader.CreateInput("emissiveColor", types.Color3f).Set(tuple(float(v) for v in part.radiance))
        shader.CreateInput("roughness", types.Float).Set(1.0)
    else:
        reader = UsdShade.Shader.Define(stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", types.String).Set("st")
        coordinates = reader.CreateOutput("result", types.Float2)
        colour = _texture(stage, f"{path}/base_color", BASE_COLOR, "sRGB", coordinates, UsdShade, types)
        shader.CreateInput("diffuseColor", types.Color3f).ConnectToSource(colour.CreateOutput("rgb", types.Float3))
        surface = _texture(stage, f"{path}/metallic_roughness", SURFACE, "raw", coordinates, UsdShade, types)
        shader.CreateInput("roughness", types.Float).ConnectToSource(surface.CreateOutput("g", types.Float))
        shader.CreateInput("metallic", types.Float).ConnectToSource(surface.CreateOutput("b", types.Float))
        if part.opacity < 1:
            shader.CreateInput("opacity", types.Float).Set(part.opacity)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", types.Token))
    return material


def _texture(stage: Any, path: str, file: str, space: str, coordinates: Any, UsdShade: Any, types: Any) -> Any:
    texture = UsdShade.Shader.Define(stage, path)
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(f"./{file}")
    texture.CreateInput("sourceColorSpace", types.Token).Set(space)
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, types.Token).Set("clamp")
    texture.CreateInput("st", types.Float2).ConnectToSource(coordinates)
    return texture


def _camera(stage: Any, path: str, view: View, UsdGeom: Any, Gf: Any) -> None:
    camera = UsdGeom.Camera.Define(stage, path)
    camera.GetPrim().SetDisplayName(f"view {view.name}")
    pose = np.asarray(view.world_from_camera, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])  # USD looks along -z, y up
    camera.AddTransformOp().Set(Gf.Matrix4d(*(float(v) for v in pose.T.ravel())))  # row vectors
    pixel = APERTURE / view.width
    camera.CreateHorizontalApertureAttr(APERTURE)
    camera.CreateVerticalApertureAttr(pixel * view.height * view.fx / view.fy)
    camera.CreateFocalLengthAttr(pixel * view.fx)
    camera.CreateHorizontalApertureOffsetAttr(pixel * (view.width / 2 - view.cx))
    camera.CreateVerticalApertureOffsetAttr(pixel * (view.cy - view.height / 2) * view.fx / view.fy)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
