"""Puts the recovered scene into the form that viewer.js reads: facts as JSON and data as blobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.light.light_maps import Halves
from iif_core.light.relighting import axes_of_map
from iif_core.numerics import color
from iif_core.reflectance.brdf import R_MIN, kd_ks
from iif_core.reflectance.directional_albedo import directional_albedo
from iif_core.surface.triangles import face_geometry
from workflow.exporters.atlas import Atlas, TexturedPart
from workflow.report.pictures import false_colour
from workflow.report.wording import fit_words
from workflow.room.light import Lamps, LitTexels
from workflow.room.pack import Blob, array_blob, normals_to_bytes, picture_blob, quantized
from workflow.scene.normal_form import View

Array = np.ndarray

QUALITY = 92
"""Of the base colour as WebP."""
PHOTOGRAPH_QUALITY = 80
PHOTOGRAPH_WIDTHS = (640, 480, 320, 0)
"""Widths of photographs in the page, in pixels, of which the first that fits is taken; 0 = without photographs."""
UNCERTAINTY_MOST, UNCERTAINTY_SHOWN = 0.5, 0.2
"""Largest uncertainty, which 255 in the texture means, and the uncertainty that is shown lightest."""
HOLES = 3
"""Texels across which surface between observed cells has the uncertainty of the nearest of them."""
ROUGHNESSES = 17
EYE_HEIGHT = 1.6
"""Metres above the floor."""
BRIGHT = 0.8
"""Linear value, on the screen, of the light that 95 % of the surface do not exceed."""
NORMAL_95 = 1.959964
"""Half a 95 % interval of the normal distribution, in standard deviations."""
MARGIN = 0.15
"""Metres that the eye keeps from the ends of the room."""


@dataclass(frozen=True)
class Frame:
    """The axes of the page: z is up.

    Attributes:
        turn: (3, 3) room from world.
        floor: height of the floor, metres.
        low, high: (3,) box of the surface without its outermost half per cent.
    """

    turn: Array
    floor: float
    low: Array
    high: Array


def frame_of(parts: Sequence[TexturedPart], texels: LitTexels, up: Array, cameras: Array) -> Frame:
    """Find the floor and the extent of the room.

    The floor is the height below the middle camera at which most surface faces up.

    Args:
        parts, texels: of the surface.
        up: (3,) unit vector in the world.
        cameras: (V, 3) positions in the world.
    """
    turn = axes_of_map(up, 0.0)
    points = texels.points @ turn.T
    weight = texels.edge[texels.part] ** 2
    low, high = (np.array([_quantile(points[:, i], weight, q) for i in range(3)]) for q in (0.005, 0.995))
    eye = np.median(cameras @ turn[2]) if len(cameras) else high[2]
    height, area = [np.zeros(0)], [np.zeros(0)]
    for part in parts:
        normal, own = face_geometry(part.vertices.astype(np.float64), part.faces)
        level = (part.vertices[part.faces].mean(1) @ turn[2]).astype(np.float64)
        flat = (np.abs(normal @ turn[2]) > 0.9) & (level < eye)
        height.append(level[flat])
        area.append(own[flat])
    height, area = np.concatenate(height), np.concatenate(area)
    floor = low[2]
    if area.sum() > 0:
        bins = np.floor((height - height.min()) / 0.1).astype(np.int64)
        total = np.bincount(bins, area)
        best = bins == np.argmax(total)
        floor = _quantile(height[best], area[best], 0.5)
    return Frame(turn, float(floor), np.minimum(low, high - 0.1), high)


def _quantile(values: Array, weight: Array, q: float) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, q * total[-1])]) if len(values) else 0.0


def geometry_blobs(parts: Sequence[TexturedPart], frame: Frame) -> tuple[dict[str, Blob], list[dict[str, Any]], dict[str, Any]]:
    """Return the blobs of the surface, the place of each part in them, and the box on which positions are measured."""
    vertices = np.concatenate([part.vertices for part in parts]) @ frame.turn.T
    normals = np.concatenate([part.normals for part in parts]) @ frame.turn.T
    uv = np.concatenate([part.uv for part in parts])
    faces = np.concatenate([part.faces for part in parts])
    low, high = vertices.min(0), np.maximum(vertices.max(0), vertices.min(0) + 1e-6)
    blobs = {
        "positions": array_blob(quantized(vertices, low, high)),
        "normals": array_blob(normals_to_bytes(normals)),
        "uvs": array_blob(quantized(uv, np.zeros(2), np.ones(2))),
        "indices": array_blob(faces.astype(np.uint32)),
    }
    ends = [np.cumsum([0, *counts]).tolist() for counts in ([len(p.vertices) for p in parts], [len(p.faces) for p in parts])]
    places = [{"vertices": ends[0][i : i + 2], "faces": ends[1][i : i + 2]} for i in range(len(parts))]
    return blobs, places, {"low": low.tolist(), "high": high.tolist()}


def picture_blobs(atlas: Atlas, largest: int) -> dict[str, Blob]:
    """Return the base colour (sRGB), and as red, green and blue of one picture the uncertainty, roughness and metallic.

    Red is the uncertainty over UNCERTAINTY_MOST. Surface that no photograph shows has the uncertainty of the nearest surface that
    one shows, and alpha 0; alpha is 1 elsewhere. Interpolation between both then changes what is unknown into what is known, and
    never into a large uncertainty.
    """
    from scipy.ndimage import distance_transform_edt

    base = color.to_uint8(color.srgb_from_linear(np.clip(_smaller(atlas.base_color, largest), 0, 1)))
    known = atlas.seen | (atlas.uncertainty == 0)  # emitters are known to be black
    uncertainty, shown = np.ones(known.shape, np.float32), np.zeros(known.shape, np.float32)
    if known.any():
        distance, (row, column) = distance_transform_edt(~known, return_indices=True)
        uncertainty = np.minimum(atlas.uncertainty, UNCERTAINTY_MOST)[row, column] / UNCERTAINTY_MOST
        shown = (distance <= HOLES).astype(np.float32)
    rest = np.stack([uncertainty, atlas.roughness, atlas.metallic, shown], -1)
    return {"base": picture_blob(base, QUALITY), "surface": picture_blob(color.to_uint8(_smaller(rest, largest)), None)}


def _smaller(picture: Array, largest: int) -> Array:
    """Halve a picture (S, S, C), by means over 2 x 2, until its side is at most `largest`."""
    while len(picture) > largest:
        side = len(picture) // 2 * 2
        picture = picture[:side, :side].reshape(side // 2, 2, side // 2, 2, -1).mean((1, 3))
    return np.asarray(picture, np.float32)


def light_blobs(halves: Halves, texels: LitTexels) -> dict[str, Blob]:
    """Return the light maps and the texels at which they are stored."""
    value = halves.value[texels.source].reshape(len(texels.stored), 3 * len(halves.scale))
    return {"light": array_blob(value.view(np.uint16)), "texels": array_blob(texels.stored.astype(np.uint32)[:, None])}


def lightmap_size(wanted: int, lamps: int, fill: float, max_mb: float) -> int:
    """Return the side of the light maps: at most `wanted`, and such that they take about half of `max_mb` in the page.

    A value of a texel takes 2 bytes; deflate saves a fifth, and base64 adds a third. `fill`: share of the texels with surface.
    """
    a_texel = 2 * 3 * max(lamps, 1) * fill * 0.8 * 4 / 3
    side = int(np.sqrt(0.5 * max_mb * 1e6 / a_texel))
    return max(32, min(wanted, side // 32 * 32))


def lobe_blob() -> Blob:
    """Return the table of Eq. S.22 over cosine (fast) and roughness (ROUGHNESSES levels from 0 to 1): A_0 and A_1."""
    roughness = np.maximum(np.linspace(0, 1, ROUGHNESSES), R_MIN)
    table = np.moveaxis(directional_albedo(roughness), 0, -1).reshape(-1, 2)
    return array_blob(quantized(table, np.zeros(2), np.ones(2)))


def colour_blob() -> Blob:
    """Return 256 colours, sRGB, of uncertainty from 0 to UNCERTAINTY_SHOWN."""
    return array_blob(color.to_uint8(false_colour(np.linspace(0, 1, 256), scheme="value")))


def base_exposure(atlas: Atlas, texels: LitTexels, light: Array, lamps: Lamps) -> float:
    """Choose the factor from radiance to the screen: 95 % of the lit surface becomes no brighter than BRIGHT.

    light: (n, lamps, 3), before the colours of the lamps.
    """
    if not len(lamps.lamps):
        return 1.0
    total = np.einsum("nlc,lc->nc", light, np.stack([lamp.color for lamp in lamps.lamps]))
    row, column = np.divmod(texels.index, texels.size)
    at = tuple(np.minimum((axis + 0.5) * atlas.size / texels.size, atlas.size - 1).astype(int) for axis in (row, column))
    kd, _ = kd_ks(atlas.base_color[at], atlas.metallic[at][:, None])
    radiance = (kd * total).max(1)
    weight = texels.edge[texels.part] ** 2
    bright = _quantile(radiance[radiance > 0], weight[radiance > 0], 0.95) if (radiance > 0).any() else 0.0
    return BRIGHT / bright if bright > 0 else 1.0


def photograph_facts(views: Sequence[View], frame: Frame) -> list[dict[str, Any]]:
    """Return the camera of each photograph in the axes of the page; pixels are those of the photograph."""
    facts = []
    for view in views:
        pose = np.asarray(view.world_from_camera, np.float64)
        eye, right_down_forward = frame.turn @ pose[:3, 3], frame.turn @ pose[:3, :3]
        facts.append(
            {
                "name": view.name + (" (held out)" if view.split == "test" else ""),
                "eye": eye.tolist(),
                "direction": right_down_forward[:, 2].tolist(),
                "up": (-right_down_forward[:, 1]).tolist(),
                **{name: float(getattr(view, name)) for name in ("fx", "fy", "cx", "cy")},
                "width": view.width,
                "height": view.height,
                "picture": False,
            }
        )
    return facts


def start_of(photographs: Sequence[dict[str, Any]], frame: Frame, widest: int = 0) -> dict[str, Any]:
    """Return where the page opens: at eye height where the photograph of the given number was taken, looking the same way."""
    tall = max(frame.high[2] - frame.floor, 0.1)
    eye = frame.floor + min(EYE_HEIGHT, 0.7 * tall)
    if not photographs:
        middle = (frame.low + frame.high) / 2
        return {"eye": [middle[0], middle[1], eye], "yaw": 0.0, "pitch": 0.0}
    first = photographs[widest]
    place = np.clip(first["eye"], *walkable(frame))
    yaw = float(np.arctan2(first["direction"][1], first["direction"][0]))
    return {"eye": [float(place[0]), float(place[1]), float(eye)], "yaw": yaw, "pitch": -0.1}


def walkable(frame: Frame) -> tuple[Array, Array]:
    """Return the box (3,), (3,) that the eye does not leave."""
    middle = (frame.low + frame.high) / 2
    low = np.minimum(frame.low + MARGIN, middle)
    high = np.maximum(frame.high - MARGIN, middle)
    low[2] = min(frame.floor + 0.2, high[2])
    return low, high


def interval(name: str, value: float, error: float) -> dict[str, Any]:
    """Return a number >= 0 with its 95 % interval."""
    low, high = max(value - NORMAL_95 * error, 0.0), value + NORMAL_95 * error
    return {"name": name, "value": round(value, 6), "low": round(low, 6), "high": round(high, 6)}


def middles(vertices: Array, faces: Array, object_id: Array, area: Array) -> dict[int, list[float]]:
    """Return object id -> the mean position of its surface, in metres of the world that relightings name places in.

    Args:
        vertices: (n, 3); faces: (m, 3); object_id, area: (m,) of the faces, -1 = of no object.
    """
    known = object_id >= 0
    of, weight, middle = object_id[known], area[known], vertices[faces[known]].mean(1)
    total = np.maximum(np.bincount(of, weight), 1e-12)
    mean = np.stack([np.bincount(of, weight * middle[:, axis]) for axis in range(3)], 1) / total[:, None]
    return {int(number): [round(float(x), 2) for x in mean[number]] for number in np.unique(of)}


def object_facts(columns: Mapping[str, Sequence], middle: Mapping[int, Sequence[float]]) -> list[dict[str, Any]]:
    """Return what a click on each object says, from the columns of `object_table.object_rows` and from `middles`."""
    labels = {f"base_colour_{c}": f"albedo, {name}" for c, name in zip("rgb", ("red", "green", "blue"), strict=True)}
    labels |= {"roughness": "roughness", "metallic": "metallic"}
    out = []
    for row, number in enumerate(columns["object_id"]):
        numbers = [
            {"name": label, "value": columns[key][row], "low": columns[f"{key}_low"][row], "high": columns[f"{key}_high"][row]}
            for key, label in labels.items()
        ]
        out.append(
            {
                "id": number,
                "name": columns["name"][row],
                "model": fit_words(columns["model"][row]) or "not fitted",
                "views": columns["photographs"][row] or 0,
                "pixels": columns["pixels"][row] or 0,
                "area": columns["area_m2"][row],
                "middle": middle.get(number),
                "color": columns["base_colour_hex"][row],
                "numbers": numbers,
            }
        )
    return out


def photograph_blob(picture: Array, width: int) -> Blob:
    """Encode a photograph (H, W, 3) uint8, at most `width` pixels wide."""
    from PIL import Image

    if picture.shape[1] > width:
        height = max(1, round(picture.shape[0] * width / picture.shape[1]))
        picture = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS))
    return picture_blob(picture, PHOTOGRAPH_QUALITY)
