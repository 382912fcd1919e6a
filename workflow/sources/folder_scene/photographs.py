"""Decodes the files of a frame at the size of its view: the photograph, its object ids and its truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from iif_core.camera.distortion import Pinhole, pinhole_inside, undistort_image
from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from workflow.scene.normal_form import Truth, View
from workflow.sources.folder_scene import alignment, images
from workflow.sources.folder_scene.frames import Frame

BLACK, WHITE = 2.5 / 255, 253.5 / 255  # sensor values of all channels below and above which a pixel tells nothing about the light
EVERYWHERE = 0.999  # share of such pixels that makes a photograph black or white
COUNTED = ("non_finite", "transparent", "negative", "masked", "outside")


@dataclass(frozen=True)
class Photograph:
    """A photograph at the size of its view.

    Attributes:
        pixels: (H, W, 3) sensor values, or radiance.
        valid: (H, W) bool, the pixels that may be used.
        counts: of the pixels of the file, by `COUNTED`.
        form: of the file other than 8-bit colour, else empty.
    """

    pixels: np.ndarray
    valid: np.ndarray
    counts: Counter[str]
    form: str

    def blank(self, encoded: bool) -> str:
        """Return `black` or `white` where nearly all usable pixels are, else an empty text."""
        shown = self.pixels[self.valid]
        if not len(shown):
            return ""
        if (shown.max(1) <= (BLACK if encoded else 0)).mean() >= EVERYWHERE:
            return "black"
        return "white" if encoded and (shown.min(1) >= WHITE).mean() >= EVERYWHERE else ""

    def without_black(self, encoded: bool) -> Photograph:
        """Return the photograph without a usable pixel if it is black: it would say that all surface that it shows is black."""
        return replace(self, valid=np.zeros_like(self.valid)) if self.blank(encoded) == "black" else self


def view_of(
    frame: Frame, pose: np.ndarray, view_id: int, limits: tuple[float, float], exposure: float = 1.0, split: str = "train"
) -> View:
    """Return the pinhole camera of a frame at a size of at most `limits` (width, height)."""
    full = _target(frame)
    camera = alignment.scaled(full, *images.fitted_size(full.width, full.height, *limits))
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return View(view_id, frame.name, *intrinsics, pose, exposure, split)


def size_of(frame: Frame) -> tuple[int, int]:
    """Return width and height of the picture to which the camera belongs: of an EXR that tells its windows apart."""
    return frame.camera.width, frame.camera.height


def decoded(frame: Frame) -> images.Photo:
    """Read a photograph as its file has it.

    Raises:
        InputError: it cannot be read, or is not of the size that its header says.
    """
    photo = images.load_photo(frame.image, frame.turn, size_of(frame), frame.colour)
    _upright(frame, frame.image, photo.pixels)
    return photo


def photograph(frame: Frame, view: View, encoded: bool, gain: float, border: np.ndarray | None = None) -> Photograph:
    """Decode a photograph, undistorted and reduced by area.

    Args:
        frame: the files.
        view: the camera whose picture is made.
        encoded: the values are sensor values; else they are radiance, which is divided by `gain`, the exposure.
        border: (H, W) bool of the file, pixels without a picture.

    Raises:
        InputError: the photograph or its mask cannot be read, or they differ in size.
    """
    photo = decoded(frame)
    if border is not None:
        photo.valid &= ~border
    if frame.mask is not None:
        kept = _upright(frame, frame.mask, images.load_mask(frame.mask, frame.turn, frame.mask_full))
        photo.masked = int((photo.valid & ~kept).sum())
        photo.valid &= kept
    counts = Counter({name: getattr(photo, name) for name in COUNTED})
    pixels, valid = _resized(frame, view, photo.pixels, photo.valid)
    return Photograph(pixels if encoded else pixels / np.float32(gain), valid, counts, photo.form)


def object_ids(frame: Frame, view: View, load: Callable[[Path, int, tuple[int, int]], np.ndarray]) -> np.ndarray:
    """Read the map of object ids of a frame that has one, (H, W) int32, -1 = none."""
    ids = _upright(frame, frame.ids, load(frame.ids, frame.turn, size_of(frame)))
    if not frame.lens.is_identity:
        moved, seen = undistort_image(ids, frame.lens, frame.camera, _target(frame), nearest=True)
        ids = np.where(seen, moved, -1)
    return images.reduce_nearest(ids, view.width, view.height)


def truth(frame: Frame, view: View, taken: Photograph, encoded: bool, face: np.ndarray) -> Truth:
    """Read the truth of a frame that has it; `face`: (H, W) what the view meets, -1 = nothing."""
    maps, known = {}, np.ones(face.shape, bool)
    for kind, path in frame.truth.items():
        channels = 1 if kind in ("roughness", "metallic") else 3
        values = images.TURNS[frame.turn](images.load_map(path, channels, size_of(frame)))
        values = _upright(frame, path, values.reshape(*values.shape[:2], channels))
        finite = np.isfinite(values).all(-1)
        values, covered = _resized(frame, view, np.where(finite[..., None], values, 0), finite)
        maps[kind] = values if channels == 3 else values[..., 0]
        known &= covered
    if "radiance" not in maps:
        maps["radiance"] = linear_from_srgb(taken.pixels) if encoded else taken.pixels
    return Truth(**maps, valid=known & taken.valid & (face >= 0))


def pinhole(view: View) -> Pinhole:
    """Return the camera of a view without its pose."""
    return Pinhole(view.fx, view.fy, view.cx, view.cy, view.width, view.height)


def _target(frame: Frame) -> Pinhole:
    """Return the pinhole camera at full size."""
    return frame.camera if frame.lens.is_identity else pinhole_inside(frame.lens, frame.camera)


def _upright(frame: Frame, path: Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            f"{path}: {pixels.shape[1]}x{pixels.shape[0]} pixels, its photograph has"
            f" {frame.camera.width}x{frame.camera.height}; give both in one size"
        )
    return pixels


def _resized(frame: Frame, view: View, pixels: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture undistorted and reduced by area."""
    if not frame.lens.is_identity:
        pixels, valid = undistort_image(pixels, frame.lens, frame.camera, _target(frame), valid)
    return images.reduce_area(pixels, valid, view.width, view.height)
