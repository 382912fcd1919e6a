"""Writes mitsuba/scene.xml, the recovered scene for Mitsuba 3; `mitsuba -m scalar_rgb scene.xml` renders it.

Meshes are PLY files with the material as vertex attributes, in world coordinates and metres; paths are relative.
"""

from __future__ import annotations

import inspect
import math
import re
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics import xp
from iif_core.reflectance import brdf
from workflow.artifacts.files import write_exr
from workflow.artifacts.store import split_rgb
from workflow.exporters import mitsuba_bsdf, mitsuba_render
from workflow.exporters.mitsuba_lobes import blended
from workflow.exporters.surface import Part
from workflow.scene.normal_form import View

_NOTE = """
  Recovered by Intrinsic Image Fusion. Lengths in metres, all values linear, roughness perceptual (alpha = roughness^2).

  The model of the workflow: k_d = (1 - m) a, k_s = 0.04 (1 - m) + m a, GGX, Schlick, no loss of the diffuse lobe.
  Mitsuba has no such BSDF. Half a `diffuse` of reflectance 2 k_d is its diffuse lobe; half a metal of `principled` is close
  to its specular lobe, with base colours that reflect as much light in all. `albedo` and `metallic` of the meshes are the
  recovered ones; `python render.py` beside this file renders them with the exact model.

  Curtains and blinds that let light through are a `mask`. Shadow rays do not pass it, so light behind it is noisy: take more
  samples.

  Relight: change or remove the emitters below, or add your own.
  Sizes: mitsuba -m scalar_rgb scene.xml -Dspp=256 -Dresx=640 -Dresy=480
  Other views: mitsuba -m scalar_rgb -s 1 scene.xml  (one sensor a photograph, in order)
"""

# Mitsuba's map has +y up, its left edge towards -z, and the opposite sense of rotation: columns are mirrored, then turned.
_ENVIRONMENT = """\t<emitter type="envmap">
\t\t<string name="filename" value="environment.exr"/>
\t\t<transform name="to_world"><matrix value="0 0 -1 0 -1 0 0 0 0 1 0 0 0 0 0 1"/></transform>
\t</emitter>"""

ENVIRONMENT_ROWS = 256
"""Texels are repeated up to about this many rows, because Mitsuba interpolates and the workflow's texels are constant."""

MASKS = 8
"""Passages through surface that lets light through that a path may have in addition."""
THINNEST = 1e-3
"""Height of a face over its longest edge below which it counts as a sliver."""
BACK_OFFSET = 1e-4  # metres between the two sides of a sheet that emits on both


def mitsuba_files(parts: Sequence[Part], views: Sequence[View], environment: np.ndarray, max_depth: int = 9) -> dict[str, bytes]:
    """Make the files of the scene.

    Args:
        parts: of the surface.
        views: at least one; each becomes a sensor. Mitsuba's cameras have square pixels, so fy is replaced by fx.
        environment: (3,) constant radiance around the scene or (H, W, 3), a map as in `iif_core.light.environment`; 0 = none.
        max_depth: path length; 1 = emitters only.

    Returns:
        Content by relative name: `scene.xml`, `meshes/<part>.ply`, and `render.py` with what it imports.
    """
    files = exact_files()
    body = []
    for part, stem in zip(parts, _stems(parts), strict=True):
        thin = slivers(part) & (part.emitter_id < 0)
        for some, suffix in ((~thin, ""), (thin, ".slivers")):
            if some.any():
                name = f"meshes/{stem}{suffix}.ply"
                files[name] = ply_bytes(replace(part, faces=part.faces[some]), of_faces=bool(suffix))
                body.append(_shape(part, name, "face" if suffix else "vertex"))
        if part.emitter_id >= 0 and part.double_sided:
            back = f"meshes/{stem}.back.ply"
            files[back] = ply_bytes(part, back=True)
            body.append(_shape(part, back))
    if environment.ndim == 3 and np.any(environment > 0):
        files["environment.exr"] = _environment_exr(environment)
        body.append(_ENVIRONMENT)
    elif np.any(environment > 0):
        body.append(f'\t<emitter type="constant">\n\t\t{_rgb("radiance", environment)}\n\t</emitter>')
    if any(part.opacity < 1 for part in parts):  # Mitsuba counts the passage through a mask as an interaction
        max_depth += MASKS
    first = views[0]
    head = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<!--{_NOTE}-->",
        '<scene version="3.0.0">',
        '\t<default name="spp" value="64"/>',
        f'\t<default name="resx" value="{first.width}"/>',
        f'\t<default name="resy" value="{first.height}"/>',
        f'\t<integrator type="path">\n\t\t<integer name="max_depth" value="{max_depth}"/>\n\t</integrator>',
    ]
    text = "\n".join([*head, *(_sensor(view) for view in views), *body, "</scene>"]) + "\n"
    return {"scene.xml": text.encode(), **files}


def exact_files() -> dict[str, bytes]:
    """Return `render.py` and the package `iif_bsdf`: the modules of the reflectance, with their imports made local."""
    modules = {"iif_core.numerics.xp": xp, "iif_core.reflectance.brdf": brdf, "workflow.exporters.mitsuba_bsdf": mitsuba_bsdf}
    files = {
        "render.py": mitsuba_render,
        **{f"iif_bsdf/{name.rpartition('.')[2]}.py": module for name, module in modules.items()},
    }
    local = [(f"from {name} import", f"from iif_bsdf.{name.rpartition('.')[2]} import") for name in modules]
    local += [(f"from {name.rpartition('.')[0]} import", "from iif_bsdf import") for name in modules]
    out = {"iif_bsdf/__init__.py": b""}
    for file, module in files.items():
        text = inspect.getsource(module)
        for before, after in local:
            text = text.replace(before, after)
        out[file] = text.encode()
    return out


def _environment_exr(environment: np.ndarray) -> bytes:
    repeat = max(1, ENVIRONMENT_ROWS // len(environment))
    image = environment[:, ::-1].repeat(repeat, 0).repeat(repeat, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "environment.exr"
        write_exr(path, split_rgb(np.ascontiguousarray(image, np.float32)))
        return path.read_bytes()


def slivers(part: Part) -> NDArray:
    """Return which faces (F,) are too thin for Mitsuba to interpolate the attributes of their corners: its barycentric
    coordinates divide by a determinant that cancels in single precision, and the result is NaN."""
    a, b, c = part.vertices[part.faces].astype(np.float64).transpose(1, 0, 2)
    longest = np.max([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))], 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) < THINNEST * longest


def ply_bytes(part: Part, back: bool = False, of_faces: bool = False) -> bytes:
    """Return a binary PLY of x y z, nx ny nz; and albedo_0..2, roughness_0, metallic_0, with diffuse_0..2 and specular_0..2 of
    `mitsuba_lobes.blended`, of the vertices or of the faces. Mitsuba reads them as `vertex_albedo` or `face_albedo` and so on.

    With `back` it is the other side of the same sheet, moved by `BACK_OFFSET` so that a ray meets only one of the two.
    """
    attributes = ["albedo_0", "albedo_1", "albedo_2", "roughness_0", "metallic_0"]
    attributes += [f"{lobe}_{c}" for lobe in ("diffuse", "specular") for c in range(3)]
    materials = part.albedo, part.roughness[:, None], part.metallic[:, None]
    if of_faces:
        materials = tuple(values[part.faces].mean(1) for values in materials)
    values = np.concatenate([*materials, *blended(materials[0], materials[1][:, 0], materials[2][:, 0])], 1).astype("<f4")
    normals = -part.normals if back else part.normals
    vertices = part.vertices + BACK_OFFSET * normals if back else part.vertices
    columns = np.concatenate([vertices, normals] if of_faces else [vertices, normals, values], 1).astype("<f4")
    own = [(name, "<f4") for name in attributes] if of_faces else []
    faces = np.zeros(len(part.faces), np.dtype([("count", "u1"), ("corner", "<i4", 3), *own]))
    faces["count"] = 3
    faces["corner"] = part.faces[:, ::-1] if back else part.faces
    for (name, _), column in zip(own, values.T, strict=False):
        faces[name] = column
    names = ["x", "y", "z", "nx", "ny", "nz", *([] if of_faces else attributes)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(part.vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [f"property float {name}" for name, _ in own] + ["end_header", ""]
    return "\n".join(header).encode() + columns.tobytes() + faces.tobytes()


def _stems(parts: Sequence[Part]) -> list[str]:
    """Return file names that every file system accepts and that differ even where case is ignored."""
    out: list[str] = []
    used: set[str] = set()
    for i, part in enumerate(parts):
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", part.name).strip("._")[:80] or "part"
        if stem.lower() in used:
            stem = f"{stem}-{i}"
        used.add(stem.lower())
        out.append(stem)
    return out


def _shape(part: Part, file: str, place: str = "vertex") -> str:
    lines = [f'\t<shape type="ply" id={quoteattr(file.removeprefix("meshes/").removesuffix(".ply"))}>']
    lines.append(f'\t\t<string name="filename" value={quoteattr(file)}/>')
    if part.emitter_id >= 0:
        black = '<bsdf type="diffuse"><rgb name="reflectance" value="0, 0, 0"/></bsdf>'
        lines += [f"\t\t{black}", f'\t\t<emitter type="area">{_rgb("radiance", part.radiance)}</emitter>']
    else:
        if part.opacity < 1:
            lines += ['\t\t<bsdf type="mask">', f'\t\t\t<float name="opacity" value="{part.opacity:.9g}"/>']
        lines += ['\t\t<bsdf type="twosided"><bsdf type="blendbsdf"><float name="weight" value="0.5"/>']
        lines += [
            f'\t\t\t<bsdf type="diffuse">{_attribute("reflectance", place, "diffuse")}</bsdf>',
            '\t\t\t<bsdf type="principled">',
        ]
        lines += [
            f"\t\t\t\t{_attribute(name, place, of)}" for name, of in (("base_color", "specular"), ("roughness", "roughness"))
        ]
        lines += ['\t\t\t\t<float name="metallic" value="1"/>', "\t\t\t</bsdf>", "\t\t</bsdf></bsdf>"]
        lines += ["\t\t</bsdf>"] if part.opacity < 1 else []
    return "\n".join([*lines, "\t</shape>"])


def _attribute(parameter: str, place: str, name: str) -> str:
    text = f'<string name="name" value="{place}_{name}"/>'
    return f'<texture type="mesh_attribute" name="{parameter}">{text}</texture>'


def _sensor(view: View) -> str:
    # Mitsuba's camera looks along +z with x to the left and y up; OpenCV's has x to the right and y down.
    pose = np.asarray(view.world_from_camera, np.float64) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    fov = 2 * math.degrees(math.atan(0.5 * view.width / view.fx))
    centre = (0.5 - view.cx / view.width, 0.5 - view.cy / view.height)  # Mitsuba's offset moves the image
    matrix = " ".join(f"{v:.9g}" for v in pose.ravel())
    return "\n".join(
        [
            f'\t<sensor type="perspective" id={quoteattr("view-" + view.name)}>',
            f'\t\t<float name="fov" value="{fov:.9g}"/>',
            '\t\t<string name="fov_axis" value="x"/>',
            f'\t\t<float name="principal_point_offset_x" value="{centre[0]:.9g}"/>',
            f'\t\t<float name="principal_point_offset_y" value="{centre[1]:.9g}"/>',
            '\t\t<float name="near_clip" value="0.001"/>',
            f'\t\t<transform name="to_world"><matrix value="{matrix}"/></transform>',
            '\t\t<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>',
            '\t\t<film type="hdrfilm">',
            '\t\t\t<integer name="width" value="$resx"/>',
            '\t\t\t<integer name="height" value="$resy"/>',
            '\t\t\t<rfilter type="box"/>',
            "\t\t</film>",
            "\t</sensor>",
        ]
    )


def _rgb(name: str, value: np.ndarray) -> str:
    return f'<rgb name="{name}" value="{", ".join(f"{float(v):.9g}" for v in value)}"/>'
