"""Prior `files`: predictions of any model in `predictions/{albedo,roughness,metallic}/<view>_<kkk>.png|exr`.

PNG files (8 or 16 bit) hold [0, 1], EXR files the values. A map of another size is resized if it has the photograph's aspect
ratio.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.names import data_folder, did_you_mean_path
from workflow.sources.folder_scene import images

PROPERTIES = ("albedo", "roughness", "metallic")
ASPECT_TOLERANCE = 0.02
"""Largest relative difference of aspect ratio between maps of the same picture (models round sizes to multiples of 8 or 64)."""
MAX_VALUE = 1.5  # the 99th percentile of a map in [0, 1] stays below, although half floats overshoot a little
_NAME = re.compile(r"(?P<view>.+)_(?P<k>\d{3,})\.(?:png|exr)", re.IGNORECASE)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List every prediction file that a scene reads: k = 000 ... samples - 1 of all three properties.

    Raises:
        InputError: no folder, no predictions, or an incomplete set; the message names the missing files.
    """
    folder, samples = _folder(document["prior"]["path"], document["source"].get("path")), document["prior"]["samples"]
    found = {name: _listing(folder / name) for name in PROPERTIES}
    views = sorted({view for listing in found.values() for view, _ in listing})
    if not views:
        raise InputError(f"{folder}: no predictions; expected albedo/<view>_000.png (or .exr), roughness/..., metallic/...")
    wanted = [(name, view, k) for name in PROPERTIES for view in views for k in range(samples)]
    missing = [_file(name, view, k) for name, view, k in wanted if (view, k) not in found[name]]
    if missing:
        raise InputError(_missing(folder, missing, samples))
    return [found[name][view, k] for name, view, k in wanted]


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """Read the K predictions of a view.

    Args:
        view: of the capture.
        settings: sections `prior` and `source`.
        capture, seed: not used.

    Returns:
        (K, H, W, 5) float32, linear albedo, perceptual roughness, metallic; NaN where a file has no finite value.

    Raises:
        InputError: files missing, of another aspect ratio, unreadable, or with values outside [0, 1].
    """
    prior = settings.prior
    folder = _folder(prior.path, getattr(settings.source, "path", None))
    found = {name: _listing(folder / name, view.name) for name in PROPERTIES}
    missing = [
        _file(name, view.name, k) for name in PROPERTIES for k in range(prior.samples) if (view.name, k) not in found[name]
    ]
    if missing:
        raise InputError(_missing(folder, missing, prior.samples))
    out = np.empty((prior.samples, view.height, view.width, 5), np.float32)
    for k in range(prior.samples):
        albedo, roughness, metallic = (
            load(found[name][view.name, k], view.width, view.height, name == "albedo" and prior.albedo_space == "srgb")
            for name in PROPERTIES
        )
        out[k, ..., :3] = albedo
        out[k, ..., 3] = np.sqrt(roughness[..., 0]) if prior.roughness_is == "alpha" else roughness[..., 0]
        out[k, ..., 4] = metallic[..., 0]
    return out


def load(path: Path, width: int, height: int, srgb: bool) -> np.ndarray:
    """Read one map, decode it, then resize it.

    Args:
        path: png or EXR.
        width, height: of the photograph, pixels.
        srgb: whether the values are sRGB-encoded.

    Returns:
        (height, width, 3) float32 linear in [0, 1], NaN where the map has no value.

    Raises:
        InputError: another aspect ratio, or values outside [0, 1].
    """
    photo = images.load_photo(path, colour="srgb")  # the setting says how it is encoded, and no profile
    stored_height, stored_width = photo.valid.shape
    if abs(stored_width * height / (stored_height * width) - 1) > ASPECT_TOLERANCE:
        raise InputError(
            f"{path}: {stored_width}x{stored_height}, but the photograph is {width}x{height}: another aspect"
            " ratio, so not the same picture. Predict on the photographs of this capture"
        )
    counted = photo.pixels[photo.valid]
    if counted.size and np.quantile(counted, 0.99) > MAX_VALUE:
        raise InputError(
            f"{path}: values up to {counted.max():.4g}; albedo, roughness and metallic lie in [0, 1]."
            " Divide by the largest value of the encoding (255, 65535) when writing the file"
        )
    values = np.clip(photo.pixels, 0, 1)
    values = linear_from_srgb(values) if srgb else values
    if (stored_height, stored_width) == (height, width):
        valid = photo.valid
    elif stored_height >= height and stored_width >= width:
        values, valid = images.reduce_area(values, photo.valid, width, height)
    else:
        weight = bilinear(photo.valid[..., None].astype(np.float32), width, height)
        values = bilinear(np.where(photo.valid[..., None], values, 0), width, height) / np.maximum(weight, 1e-6)
        valid = weight[..., 0] >= 0.5
    return np.where(valid[..., None], values, np.nan).astype(np.float32)


def bilinear(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Interpolate (H, W, C) bilinearly to (height, width, C); pixel centres at half-integers, borders repeated."""
    for axis, wanted in ((0, height), (1, width)):
        size = image.shape[axis]
        position = np.clip((np.arange(wanted) + 0.5) * size / wanted - 0.5, 0, size - 1)
        low = np.minimum(position.astype(int), max(size - 2, 0))
        share = (position - low).astype(image.dtype).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        high = np.minimum(low + 1, size - 1)
        image = np.take(image, low, axis) * (1 - share) + np.take(image, high, axis) * share
    return image


def _folder(path: str | None, source: str | None) -> Path:
    base = path or source
    if base is None:
        raise InputError("`prior.path`: missing, and the source has no folder; name the folder that holds predictions/")
    folder = data_folder(str(base))
    folder = folder if folder.name == "predictions" else folder / "predictions"
    if not folder.is_dir():
        raise InputError(
            f"{folder}: not found; `prior: {{kind: files}}` reads albedo/, roughness/ and metallic/ below it"
            f" (set `prior.path` to the folder that holds predictions/).{did_you_mean_path(folder)}"
        )
    return folder


def _listing(folder: Path, view: str | None = None) -> dict[tuple[str, int], Path]:
    """Return (view, k) -> file, of one view or of all."""
    if not folder.is_dir():
        raise InputError(f"{folder}: not found; predictions/ needs the folders {', '.join(PROPERTIES)}")
    out: dict[tuple[str, int], Path] = {}
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match is None or (view is not None and match["view"] != view):
            continue
        key = match["view"], int(match["k"])
        if key in out:
            raise InputError(f"{out[key]} and {path.name}: two files for one prediction; remove one")
        out[key] = path
    return out


def _file(name: str, view: str, k: int) -> str:
    return f"{name}/{view}_{k:03d}"


def _missing(folder: Path, missing: list[str], samples: int) -> str:
    shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
    return (
        f"{folder}: {len(missing)} prediction files missing: {shown} (.png or .exr)."
        f" Add them, or lower `prior.samples` (now {samples})"
    )
