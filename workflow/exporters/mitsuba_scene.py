"""Writes mitsuba/scene.xml, the recovered scene for Mitsuba 3; `mitsuba -m scalar_rgb scene.xml` renders it.

Meshes are PLY files in world coordinates and metres, textures linear EXR files; paths are relative.
"""

from __future__ import annotations

import inspect
import math
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics import xp
from iif_core.reflectance import brdf
from workflow.artifacts.files import write_exr
from workflow.artifacts.store import split_rgb
from workflow.exporters import mitsuba_bsdf, mitsuba_render
from workflow.exporters.atlas import Atlas, TexturedPart
from workflow.exporters.mitsuba_lobes import blended
from workflow.scene.normal_form import View

_NOTE = """
  Recovered by Intrinsic Image Fusion. Lengths in metres, all values linear, roughness perceptual (alpha = roughness^2).

  The model of the workflow: k_d = (1 - m) a, k_s = 0.04 (1 - m) + m a, GGX, Schlick, no loss of the diffuse lobe.
  Mitsuba has no such BSDF. Half a `diffuse` of reflectance 2 k_d is its diffuse lobe; half a metal of `principled` is close
  to its specular lobe, with base colours that reflect as much light in all. textures/albedo.exr, roughness.exr and metallic.exr
  are the recovered ones; `python render.py`, next to this file, renders them with the exact model.

  Curtains and blinds that let light through are a `mask`. Shadow rays do not pass it, so light behind it is noisy: take more
  samples.

  Faces are flat, as they were when materials and light were recovered: rounded ones reflect less at grazing angles. The PLY files
  have vertex normals, too; remove `face_normals` of a shape to have them.

  All surface has one material, `surface`; to change a thing, give its shape its own bsdf in place of the reference.
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
BACK_OFFSET = 1e-4  # metres between the two sides of a sheet that emits on both


def mitsuba_files(
    parts: Sequence[TexturedPart], atlas: Atlas, views: Sequence[View], environment: np.ndarray, max_depth: int = 9
) -> dict[str, bytes]:
    """Make the files of the scene.

    Args:
        parts: of the surface.
        atlas: their materials.
        views: at least one; each becomes a sensor. Mitsuba's cameras have square pixels, so fy is replaced by fx.
        environment: (3,) constant radiance around the scene or (H, W, 3), a map as in `iif_core.light.environment`; 0 = none.
        max_depth: path length; 1 = emitters only.

    Returns:
        Content by relative name: `scene.xml`, `meshes/<part>.ply`, `textures/<quantity>.exr`, and `render.py`
        with what it imports.
    """
    files = exact_files() | texture_files(atlas)
    body = [_texture(name) for name in ("albedo", "roughness", "metallic", "diffuse", "specular")]
    body.append(_SURFACE)
    for part, stem in zip(parts, _stems(parts), strict=True):
        name = f"meshes/{stem}.ply"
        files[name] = ply_bytes(part)
        body.append(_shape(part, name))
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
    return exr_bytes(split_rgb(np.ascontiguousarray(image, np.float32)))


def exr_bytes(channels: dict[str, NDArray]) -> bytes:
    """Return an EXR file of some channels (H, W) float16 or float32."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.exr"
        write_exr(path, channels)
        return path.read_bytes()


def ply_bytes(part: TexturedPart, back: bool = False) -> bytes:
    """Return a binary PLY of x y z, nx ny nz and the texture coordinates u v.

    With `back` it is the other side of the same sheet, moved by `BACK_OFFSET` so that a ray meets only one of the two.
    """
    normals = -part.normals if back else part.normals
    vertices = part.vertices + BACK_OFFSET * normals if back else part.vertices
    columns = np.concatenate([vertices, normals, part.uv], 1).astype("<f4")
    faces = np.zeros(len(part.faces), np.dtype([("count", "u1"), ("corner", "<i4", 3)]))
    faces["count"] = 3
    faces["corner"] = part.faces[:, ::-1] if back else part.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(part.vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode() + columns.tobytes() + faces.tobytes()


def texture_files(atlas: Atlas) -> dict[str, bytes]:
    """Return the textures as EXR files of linear half floats: the materials, and `mitsuba_lobes.blended` of them."""
    albedo, roughness, metallic = (a.reshape(-1, *a.shape[2:]) for a in (atlas.base_color, atlas.roughness, atlas.metallic))
    shape = (atlas.size, atlas.size, 3)
    diffuse, specular = (values.reshape(shape) for values in blended(albedo, roughness, metallic))
    pictures = {"albedo": atlas.base_color, "diffuse": diffuse, "specular": specular}
    files = {f"textures/{name}.exr": exr_bytes(split_rgb(picture.astype(np.float16))) for name, picture in pictures.items()}
    for name in ("roughness", "metallic"):
        files[f"textures/{name}.exr"] = exr_bytes({"Y": getattr(atlas, name).astype(np.float16)})
    return files


def _stems(parts: Sequence[TexturedPart]) -> list[str]:
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


def _shape(part: TexturedPart, file: str) -> str:
    lines = [f'\t<shape type="ply" id={quoteattr(file.removeprefix("meshes/").removesuffix(".ply"))}>']
    lines.append(f'\t\t<string name="filename" value={quoteattr(file)}/>')
    lines.append('\t\t<boolean name="face_normals" value="true"/>')
    if part.opacity < 1:
        lines += ['\t\t<bsdf type="mask">', f'\t\t\t<float name="opacity" value="{part.opacity:.9g}"/>']
    lines += ['\t\t<ref id="surface"/>']  # the texels of lamps are black, and gloss a little as ours do
    lines += ["\t\t</bsdf>"] if part.opacity < 1 else []
    if part.emitter_id >= 0:
        lines += [f'\t\t<emitter type="area">{_rgb("radiance", part.radiance)}</emitter>']
    return "\n".join([*lines, "\t</shape>"])


# One material for all parts, whose textures are in one atlas: a renderer traces and compiles each material once.
_SURFACE = """\t<bsdf type="twosided" id="surface"><bsdf type="blendbsdf"><float name="weight" value="0.5"/>
\t\t<bsdf type="diffuse"><ref name="reflectance" id="diffuse"/></bsdf>
\t\t<bsdf type="principled">
\t\t\t<ref name="base_color" id="specular"/>
\t\t\t<ref name="roughness" id="roughness"/>
\t\t\t<float name="metallic" value="1"/>
\t\t</bsdf>
\t</bsdf></bsdf>"""


def _texture(name: str) -> str:
    return (
        f'\t<texture type="bitmap" id="{name}"><string name="filename" value="textures/{name}.exr"/>'
        '<boolean name="raw" value="true"/><string name="wrap_mode" value="clamp"/></texture>'
    )


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
