"""Raw files of cameras: developed by LibRaw (rawpy) to linear Rec. 709, all of a capture by the same constants.

White balance is that of daylight and no level follows the picture, so that photographs of one room differ by their exposures
alone. What a DNG states of its lens and is no more than a factor on a pixel is applied (DNG 1.7.1, chapter 7, *Opcode list
processing*): LibRaw leaves that out, and the corners of a telephone's pictures would be two stops too dark.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iif_core.errors import InputError
from workflow.intake.documents import check_file, reading
from workflow.intake.pictures import check_pixels

DEVELOP = "Develop all of them to linear EXR in sRGB primaries (darktable-cli <name>.DNG <name>.exr), or to JPEG"
_LARGEST_FILE = 1 << 30
_ORIENTATION = {0: 1, 3: 3, 5: 8, 6: 6}
"""How LibRaw says that a picture is to be turned -> the orientation of EXIF."""
_LEAST_CROP = 0.8
"""Share of the pixels that the crop of a file keeps at least; with less it is no border of the sensor."""
_OPCODES_OF_THE_MOSAIC, _OPCODES_OF_THE_PICTURE = 51009, 51022
_WARPS, _VIGNETTE, _BAD_PIXELS, _GAIN_MAP = (1, 2), 3, (4, 5), 9
_MOST_OPCODES, _MOST_POINTS, _MOST_PAGES = 1000, 1 << 20, 16
_LARGEST_GAIN = 64.0


class RawHeader(NamedTuple):
    """What is known before a pixel is read.

    Attributes:
        size: (width, height) as stored, within the crop of the file.
        orientation: of EXIF.
        exposure: time (s), ISO speed and f number, 0 = not stated.
        focal: length, mm, 0 = not stated.
        crop: rows and columns of the visible picture that are kept.
    """

    size: tuple[int, int]
    orientation: int
    exposure: tuple[float, float, float]
    focal: float
    crop: tuple[slice, slice]


class GainMap(NamedTuple):
    """Factors on the pixels of a raw picture.

    Attributes:
        rows, columns: which pixels, with their pitch.
        planes: of a picture of several colours; a mosaic has plane 0.
        gains: (rows, columns, planes) of the map.
        spacing, origin: (vertical, horizontal), of the points of the map, as shares of the picture.
    """

    rows: slice
    columns: slice
    planes: slice
    gains: np.ndarray
    spacing: tuple[float, float]
    origin: tuple[float, float]

    def over(self, height: int, width: int) -> np.ndarray:
        """Return the factors (rows, columns, planes of the map) at the pixels concerned, bilinear between points."""

        def weights(at: np.ndarray, size: int, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            # The coordinates of the specification: from 0 at the centre of the first pixel to 1 at that of the last.
            count = self.gains.shape[axis]
            place = (at / max(size - 1, 1) - self.origin[axis]) / self.spacing[axis] if count > 1 else np.zeros(len(at))
            place = np.clip(place, 0, count - 1)
            first = np.minimum(place.astype(int), max(count - 2, 0))
            return first, np.minimum(first + 1, count - 1), place - first

        r0, r1, r = weights(np.arange(height)[self.rows], height, 0)
        c0, c1, c = weights(np.arange(width)[self.columns], width, 1)
        upper = self.gains[r0] * (1 - r)[:, None, None] + self.gains[r1] * r[:, None, None]
        return upper[:, c0] * (1 - c)[None, :, None] + upper[:, c1] * c[None, :, None]


class Vignette(NamedTuple):
    """Factor 1 + k0 r^2 + ... + k4 r^10 on a pixel; r is 1 at the corner that is farthest from the centre (x, y), in shares."""

    k: tuple[float, ...]
    centre: tuple[float, float]

    def over(self, height: int, width: int) -> np.ndarray:
        """Return the factors (height, width)."""
        y = np.arange(height, dtype=np.float64)[:, None] - self.centre[1] * (height - 1)
        x = np.arange(width, dtype=np.float64)[None] - self.centre[0] * (width - 1)
        square = x * x + y * y
        square /= max(square[[0, 0, -1, -1], [0, -1, 0, -1]].max(), 1e-9)
        return 1 + square * np.polyval(self.k[::-1], square)


class Corrections(NamedTuple):
    """What a DNG asks for: factors on the mosaic and on the developed picture, and whether it also asks to remove distortion."""

    mosaic: tuple[GainMap, ...]
    picture: tuple[Vignette, ...]
    warps: bool


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import rawpy

    check_file(path, _LARGEST_FILE, "a raw file")
    with reading(path, "not a raw file that LibRaw reads", f"; {DEVELOP}"):
        with path.open("rb") as file:
            raw = rawpy.imread(file)
        with raw:
            yield raw


def raw_header(path: Path) -> RawHeader:
    """Read size, orientation and exposure of a raw file; raises InputError for one that cannot be read, or is too large."""
    with _opened(path) as raw:
        return _header_of(path, raw)


def _header_of(path: Path, raw: Any) -> RawHeader:
    sizes, other = raw.sizes, raw.other
    check_pixels(path, sizes.width, sizes.height, 3)
    if (sizes.iwidth, sizes.iheight) != (sizes.width, sizes.height) or abs(sizes.pixel_aspect - 1) > 1e-3:
        raise InputError(f"{path}: a sensor whose pixels are turned or not square, which is not read; {DEVELOP}")
    left, top = sizes.crop_left_margin - sizes.left_margin, sizes.crop_top_margin - sizes.top_margin
    width, height = sizes.crop_width, sizes.crop_height
    fits = left >= 0 and top >= 0 and left + width <= sizes.width and top + height <= sizes.height
    if not fits or width * height < _LEAST_CROP * sizes.width * sizes.height:
        left, top, width, height = 0, 0, sizes.width, sizes.height
    exposure = float(other.shutter_speed), float(other.iso_speed), float(other.aperture)
    crop = slice(top, top + height), slice(left, left + width)
    return RawHeader((width, height), _ORIENTATION.get(sizes.flip, 1), exposure, float(other.focal_length), crop)


def raw_pixels(path: Path) -> tuple[np.ndarray, bool]:
    """Develop a raw file.

    Returns:
        (H, W, 3) uint16 linear Rec. 709, as stored (not turned), 65535 = the sensor is saturated; and whether the file asks to
        remove distortion, which is left to the camera model.
    """
    import rawpy

    with _opened(path) as raw:
        crop = _header_of(path, raw).crop
        wanted = corrections(path)
        for one in wanted.mosaic:
            _apply(raw, one)
        pixels = raw.postprocess(
            rawpy.Params(
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,  # otherwise the white level follows the picture
                highlight_mode=rawpy.HighlightMode.Clip,
                output_color=rawpy.ColorSpace.sRGB,
                user_flip=0,
            )
        )
    for factor in wanted.picture:
        gain = factor.over(*pixels.shape[:2])
        pixels = np.minimum(pixels * gain[..., None], 65535).astype(np.uint16)
    return pixels[crop], wanted.warps


def _apply(raw: Any, one: GainMap) -> None:
    """Multiply the light of the mosaic in place: what is above the black level, up to the white level."""
    stored = raw.raw_image_visible
    light = stored.reshape(*stored.shape[:2], -1)  # a view: a mosaic has one plane
    blacks = np.array(raw.black_level_per_channel, np.float64)
    gains = one.over(*stored.shape[:2])
    part = light[one.rows, one.columns, one.planes]
    if stored.ndim == 2:
        black = blacks[raw.raw_colors_visible[one.rows, one.columns]][..., None]
    else:
        black = blacks[: light.shape[2]][one.planes]
    gains = gains if gains.shape[2] == part.shape[2] else gains[..., :1]
    white = float(raw.white_level or 65535)
    light[one.rows, one.columns, one.planes] = np.clip((part - black) * gains + black, 0, white).astype(stored.dtype)


# --------------------------------------------------------------------------------------------------------- opcodes of a DNG


def corrections(path: Path) -> Corrections:
    """Return what a DNG asks for; nothing of other files.

    Raises:
        InputError: an opcode that changes values in another way, and is not optional.
    """
    if path.suffix.lower() != ".dng":
        return Corrections((), (), False)
    mosaic: list[GainMap] = []
    picture: list[Vignette] = []
    warps = False
    with reading(path, "its list of corrections is damaged", f"; {DEVELOP}"):
        for tag, data in _lists(path):
            for number, is_optional, body in _opcodes(data):
                if number == _GAIN_MAP and tag == _OPCODES_OF_THE_MOSAIC:
                    mosaic.append(_gain_map(body))
                elif number == _VIGNETTE and tag == _OPCODES_OF_THE_PICTURE:
                    *k, x, y = struct.unpack(">7d", body[:56])
                    picture.append(Vignette(tuple(k), (x, y)))
                elif number in _WARPS:
                    warps = True
                elif number not in _BAD_PIXELS and not is_optional:
                    raise InputError(f"{path}: asks for correction {number} of DNG, which is not known here; {DEVELOP}")
    return Corrections(tuple(mosaic), tuple(picture), warps)


def _lists(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lists of opcodes of the raw picture: their tags and contents."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        # Of a damaged file the list of pages has no end.
        pages = [page for first in islice(file.pages, _MOST_PAGES) for page in (first, *islice(first.pages or (), _MOST_PAGES))]
        own = [page for page in pages if int(page.photometric) in (32803, 34892)]  # a mosaic, or linear colours
        if not own:
            return
        raw = max(own, key=lambda page: page.size)
        for tag in (_OPCODES_OF_THE_MOSAIC, _OPCODES_OF_THE_PICTURE):
            if tag in raw.tags:
                yield tag, bytes(raw.tags[tag].value)


def _opcodes(data: bytes) -> Iterator[tuple[int, bool, bytes]]:
    """Yield number, whether it is optional, and parameters of the opcodes of a list, big-endian."""
    (count,) = struct.unpack_from(">I", data)
    if count > _MOST_OPCODES:
        raise ValueError(f"{count} opcodes")
    at = 4
    for _ in range(count):
        number, _version, flags, size = struct.unpack_from(">4I", data, at)
        at += 16
        if at + size > len(data):
            raise ValueError("cut short")
        yield number, bool(flags & 1), data[at : at + size]
        at += size


def _gain_map(body: bytes) -> GainMap:
    top, left, bottom, right, plane, planes, row_pitch, column_pitch, down, across = struct.unpack_from(">10I", body)
    spacing_v, spacing_h, origin_v, origin_h, of_map = struct.unpack_from(">4dI", body, 40)
    points = down * across * of_map
    if not 0 < points <= _MOST_POINTS or min(row_pitch, column_pitch) < 1:
        raise ValueError(f"a map of {down} x {across} x {of_map} points")
    gains = np.frombuffer(body, ">f4", points, 76).astype(np.float64).reshape(down, across, of_map)
    steps = (spacing_v, spacing_h)
    if not (np.isfinite(gains).all() and gains.min() > 0 and gains.max() <= _LARGEST_GAIN):
        raise ValueError("gains that no lens has")
    if not all(np.isfinite(v) for v in (*steps, origin_v, origin_h)) or min(steps) <= 0 < max(down, across) - 1:
        raise ValueError("points of a map at no distance")
    return GainMap(
        slice(top, bottom, row_pitch),
        slice(left, right, column_pitch),
        slice(plane, plane + planes),
        gains,
        steps,
        (origin_v, origin_h),
    )
