"""The exported scene of Mitsuba with materials from surface cells instead of textures: what is left is not due to resampling."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from workflow.exporters import mitsuba_bsdf, mitsuba_render
from workflow.exporters.atlas import TexturedPart, photographed
from workflow.exporters.mitsuba_scene import mitsuba_files
from workflow.scene.recovered import Recovered

NAME = "iif_cells"
OBJECT = "face_object"
"""Attribute of the faces that holds their object id."""


def unsimplified(parts: Sequence[TexturedPart], recovered: Recovered) -> list[TexturedPart]:
    """Return the parts with the mesh of the photographs; they lose their texture coordinates."""
    out = []
    for part in parts:
        if part.simplified:
            vertices, faces = photographed(part, recovered)
            count = len(vertices)
            normals, uv = np.tile(np.float32([0, 0, 1]), (count, 1)), np.zeros((count, 2), np.float32)
            part = replace(part, vertices=vertices, normals=normals, uv=uv, faces=faces.astype(np.int32))
        out.append(part)
    return out


def load_with_cells(parts: Sequence[TexturedPart], atlas: Any, views: Sequence[Any], recovered: Recovered) -> Any:
    """Load what the exporter writes, with the exact reflectance, where materials are looked up as the workflow's renderer does.

    Args:
        parts, atlas, views, recovered: as in `mitsuba_files`; the atlas is not looked at.
    """
    import mitsuba as mi

    black = recovered.surface.n_objects
    materials = recovered.surface.materials()
    mi.register_bsdf(NAME, lambda props: _cells(materials)(props))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, data in mitsuba_files(parts, atlas, views, recovered.light.environment).items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        text = mitsuba_render.exact_scene((folder / "scene.xml").read_text()).replace(mitsuba_bsdf.NAME, NAME)
        object_of = f'<texture name="object" type="mesh_attribute"><string name="name" value="{OBJECT}"/></texture>'
        end = text.index("</bsdf>", text.index(NAME))
        mi.file_resolver().prepend(str(folder))
        scene = mi.load_string(text[:end] + object_of + text[end:], optimize=False)  # so that meshes are not merged
    shown = [part for part in parts for _ in range(2 if part.emitter_id >= 0 and part.double_sided else 1)]
    for part, mesh in zip(shown, scene.shapes(), strict=True):
        number = black if part.emitter_id >= 0 else part.object_id
        mesh.add_attribute(OBJECT, 1, np.full(mesh.face_count(), number, np.float32))
    return scene


def _cells(materials: Any) -> type:
    """The plug-in, with the materials of `iif_core.light.transport.materials`."""
    import drjit as dr
    import mitsuba as mi

    from iif_core.numerics.xp import DRJIT
    from iif_core.reflectance import brdf

    class Cells(mitsuba_bsdf.plugin()):  # type: ignore[misc]
        def __init__(self, props: Any):
            super().__init__(props)
            self.object = props.get_texture("object")

        def _surface(self, si: Any, active: Any) -> tuple[Any, Any, Any, Any]:
            number = mi.Int32(dr.round(self.object.eval_1(si, active)))
            colour, roughness, metallic = materials(si.p, None, number, active)
            kd, ks = brdf.kd_ks(colour, metallic)
            viewer = dr.abs(mi.Frame3f.cos_theta(si.wi))
            return kd, ks, roughness, brdf.specular_chance(DRJIT, dr.max(kd), dr.max(ks), viewer)

    return Cells
