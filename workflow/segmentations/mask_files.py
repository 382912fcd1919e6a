"""Reads mask files `masks/<view>.png|exr` (label maps) or `masks/<view>/*.png` (docs/guide/segmentation.md); 0 is no mask.

Masks belong to the photographs as they are stored, at any size of the same aspect ratio.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.camera.distortion import Distortion, Pinhole, distort
from iif_core.errors import InputError
from iif_core.objects.mask_clustering import flatten_masks
from workflow import plugins
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.names import data_folder, did_you_mean_path
from workflow.sources.folder_scene import images

ASPECT_TOLERANCE = 0.02
"""Largest relative difference of aspect ratio between masks of the same picture (models round sizes to multiples of 8 or 64)."""

MAPS = (".png", ".exr")
PHOTOGRAPHED = ("folder", "scannetpp", "fipt")
"""Sources whose photographs are files, which may be distorted or turned."""


@dataclass(frozen=True)
class Photograph:
    """Camera, lens and EXIF orientation of a stored photograph, which its masks share."""

    camera: Pinhole
    lens: Distortion | None = None
    turn: int = 1


@dataclass(frozen=True)
class MaskFiles:
    """The mask files of a scene.

    Attributes:
        folder: that holds them.
        maps: name of a view -> its label map.
        binary: name of a view -> its binary masks.
        photographs: name of a view -> its photograph; empty for sources that have no photographs in files.
    """

    folder: Path
    maps: dict[str, Path]
    binary: dict[str, list[Path]]
    photographs: dict[str, Photograph]

    def files(self) -> list[Path]:
        """List all files."""
        return [*self.maps.values(), *(path for paths in self.binary.values() for path in paths)]

    @staticmethod
    def of_capture(settings: SimpleNamespace, capture: CaptureReader) -> MaskFiles:
        """Find the mask files and check them against the views of the capture.

        Raises:
            InputError: names that no view has, or no masks for the views of the capture.
        """
        found = mask_files(vars(settings.segmentation), vars(settings.source), vars(settings.capture))
        views = {view.name for view in capture}
        if not found.photographs:
            _refuse_unknown(found.folder, {*found.maps, *found.binary}, views)
        if not views & {*found.maps, *found.binary}:
            raise InputError(f"{found.folder}: no masks for any of the {len(views)} views that are used")
        return found

    def labels(self, view: View) -> np.ndarray:
        """Return the labels (H, W) int32 of the pixels of a view, 0 = no mask; all 0 for a view without masks.

        Raises:
            InputError: a picture of another aspect ratio, in colour, or with ids between integers.
        """
        camera = Pinhole(view.fx, view.fy, view.cx, view.cy, view.width, view.height)
        photograph = self.photographs.get(view.name, Photograph(camera))
        # Without distortion, pixels of the view are pixels of the photograph, even where its intrinsics were corrected.
        straight = photograph.lens is None or photograph.lens.is_identity
        sampled = replace(photograph, camera=camera) if straight else photograph
        if view.name in self.maps:
            path = self.maps[view.name]
            return _sampled(np.maximum(self._upright(path, images.load_ids(path), photograph), 0), sampled, camera)
        if view.name not in self.binary:
            return np.zeros((view.height, view.width), np.int32)
        masks = []
        for path in self.binary[view.name]:
            stored = np.maximum(images.load_ids(path), 0)
            inside = self._upright(path, 2 * stored > max(int(stored.max()), 1), photograph)
            masks.append(_sampled(inside, sampled, camera))
        return flatten_masks(masks)

    def _upright(self, path: Path, stored: np.ndarray, photograph: Photograph) -> np.ndarray:
        turn = _turn(path, stored.shape[1::-1], photograph)
        return images.TURNS[turn](stored)


def mask_files(own: dict[str, Any], source: dict[str, Any], capture: dict[str, Any]) -> MaskFiles:
    """Find the mask files of the views that the capture uses, and check their names and headers.

    Raises:
        InputError: see `raw_inputs` of segmentation `masks`.
    """
    folder = _folder(own.get("path"), source.get("path"))
    maps, binary = _listing(folder)
    photographs: dict[str, Photograph] = {}
    if source["kind"] in PHOTOGRAPHED:
        find_inputs = importlib.import_module(plugins.implementation("source", source["kind"])).find_inputs
        known = find_inputs(source, {**capture, "views": 1_000_000_000}).cameras.frames
        photographs = {frame.name: Photograph(frame.camera, frame.lens, frame.turn) for frame in known}
        _refuse_unknown(folder, {*maps, *binary}, set(photographs))
        used = {frame.name for frame in find_inputs(source, capture).cameras.frames}
        maps = {name: path for name, path in maps.items() if name in used}
        binary = {name: paths for name, paths in binary.items() if name in used}
        if not maps and not binary:
            raise InputError(f"{folder}: no masks for any of the {len(used)} views that are used")
        for name, path in [*maps.items(), *((name, path) for name, paths in binary.items() for path in paths)]:
            _turn(path, images.header(path).size, photographs[name])
    return MaskFiles(folder, maps, binary, photographs)


def _folder(path: str | Path | None, source: str | Path | None) -> Path:
    base = path or source
    if base is None:
        raise InputError("`segmentation.path`: missing, and the source has no folder; name the folder that holds masks/")
    folder = Path(base).parent if Path(base).is_file() else data_folder(str(base))  # a source may be a file: a scene's XML
    folder = folder if folder.name == "masks" else folder / "masks"
    if not folder.is_dir():
        raise InputError(
            f"{folder}: not found; `segmentation: {{kind: masks}}` reads masks/<view>.png or masks/<view>/<n>.png there"
            " (set `segmentation.path` to the folder that holds masks/). Masks come from any tool, such as SAM 2; without"
            f" any: `segmentation: {{kind: geometry}}`.{did_you_mean_path(folder)}"
        )
    return folder


def _listing(folder: Path) -> tuple[dict[str, Path], dict[str, list[Path]]]:
    maps: dict[str, Path] = {}
    binary: dict[str, list[Path]] = {}
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        name = entry.name if entry.is_dir() else entry.stem
        if name in maps or name in binary:
            first = maps[name].name if name in maps else f"{name}/"
            raise InputError(f"{folder}: {first} and {entry.name} are masks of the same view; remove one")
        if entry.is_dir():
            binary[name] = sorted(path for path in entry.iterdir() if path.suffix.lower() == ".png")
            if not binary[name]:
                raise InputError(f"{entry}: holds no .png; expected one binary mask a file, or remove the folder")
        elif entry.suffix.lower() in MAPS:
            maps[name] = entry
        else:
            raise InputError(f"{entry}: not a mask file; allowed: <view>.png, <view>.exr, or a folder <view>/ of binary .png")
    if not maps and not binary:
        raise InputError(f"{folder}: empty; expected masks/<view>.png (or .exr), or masks/<view>/<n>.png")
    return maps, binary


def _refuse_unknown(folder: Path, found: set[str], views: set[str]) -> None:
    unknown = sorted(found - views)
    if unknown:
        shown = ", ".join(unknown[:3]) + (f" and {len(unknown) - 3} more" if len(unknown) > 3 else "")
        raise InputError(
            f"{folder}: {shown}: no view of that name; views are called like their photographs without extension, such as"
            f" {sorted(views)[0]}. Rename or remove; masks of what counts (`mask_path`) and masks of objects need folders of"
            " their own: `segmentation: {path: ...}`"
        )


def _turn(path: Path, size: tuple[int, int], photograph: Photograph) -> int:
    """Return the EXIF turn that a mask needs, judged by its shape, and refuse masks of another picture."""
    camera, turn = photograph.camera, photograph.turn
    upright = _same_shape(size, (camera.width, camera.height))
    stored = (camera.height, camera.width) if turn >= 5 else (camera.width, camera.height)
    turned = turn != 1 and _same_shape(size, stored)
    if upright and turned:
        raise InputError(
            f"{path}: its photograph has EXIF orientation {turn}, and nothing tells whether the mask was made of the turned"
            " picture; save photographs and masks upright"
        )
    if not upright and not turned:
        raise InputError(
            f"{path}: {size[0]}x{size[1]} pixels, but the photograph is {camera.width}x{camera.height}: another aspect ratio,"
            " so not the same picture. Make the masks on the photographs of this scene"
        )
    return turn if turned else 1


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= ASPECT_TOLERANCE


def _sampled(picture: np.ndarray, photograph: Photograph, target: Pinhole) -> np.ndarray:
    """Sample a picture of the photograph's shape at the nearest pixels, as the `target` camera sees it, (H, W); 0 outside."""
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx
    y = (np.arange(target.height) + 0.5 - target.cy) / target.fy
    at, unique = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1), True
    if photograph.lens is not None and not photograph.lens.is_identity:
        at, unique = distort(photograph.lens, at)
    camera = photograph.camera
    column = np.floor((at[..., 0] * camera.fx + camera.cx) / camera.width * picture.shape[1] + 1e-9).astype(np.int64)
    row = np.floor((at[..., 1] * camera.fy + camera.cy) / camera.height * picture.shape[0] + 1e-9).astype(np.int64)
    inside = unique & (column >= 0) & (column < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    values = picture[np.clip(row, 0, picture.shape[0] - 1), np.clip(column, 0, picture.shape[1] - 1)]
    return np.where(inside, values, 0).astype(picture.dtype)
