"""Reads image files: headers for the checks, pixels as floats, and masks of pixels that cannot be used."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iif_core.errors import InputError
from workflow.intake.documents import reading
from workflow.intake.pictures import FORMATS, PHOTOGRAPHS, RAW, ExrWindows, exr_chromaticities, exr_windows, opened
from workflow.intake.raws import raw_header, raw_pixels
from workflow.sources.folder_scene.profiles import SPACES, Space, converted, linear_conversion, of_16_bits

EXTENSIONS = PHOTOGRAPHS + RAW
DEVELOPED, BENT = "raw", "raw, not rectified"
"""`Photo.form` of raw files; the latter state a distortion that is to be removed."""
STRIP_PIXELS = 1 << 20
"""Pixels that are converted or reduced at a time, so that a photograph takes little more memory than its result."""
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16", "I;16B", "I")
TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
"""EXIF orientation -> function that turns stored pixels upright."""


_PHOTO_IFD = 0x8769
_EXPOSURE_TAGS = ((33434, (1e-7, 1e4)), (34855, (1.0, 65534.0)), (33437, (0.3, 256.0)))
"""EXIF tags of exposure time (s), ISO speed (65535 stands for more than 16 bits hold) and f number, and their limits."""


class Stated(NamedTuple):
    """What EXIF says of an exposure: time (s) times ISO speed, and f number, None = not stated."""

    time_speed: float
    number: float | None


@dataclass(frozen=True)
class Header:
    """Size (width, height) as stored, EXIF orientation 1 ... 8 (1 = upright), the exposure that EXIF states, and the size of the
    display window of an EXR that holds other pixels than those."""

    size: tuple[int, int]
    orientation: int = 1
    stated: Stated | None = None
    display: tuple[int, int] | None = None

    @property
    def shown(self) -> tuple[int, int]:
        """Size of the picture that the file shows."""
        return self.display or self.size


@dataclass
class Photo:
    """A decoded photograph.

    Attributes:
        pixels: (H, W, 3) float32 sensor values in [0, 1], or radiance.
        valid: (H, W) bool.
        non_finite, transparent, negative, masked, outside: counts of such pixels; outside: of the data window of an EXR.
        form: format of the file other than 8-bit colour (`grey`, `16-bit`, `16-bit grey`, `raw`), or the colour space from which
            it was converted (`in Display P3`), else empty.
    """

    pixels: np.ndarray
    valid: np.ndarray
    non_finite: int = 0
    transparent: int = 0
    negative: int = 0
    masked: int = 0
    outside: int = 0
    form: str = ""


@lru_cache(4096)
def _header(path: Path, _stamp: tuple[int, int]) -> Header:
    if path.suffix.lower() == ".exr":
        windows = exr_windows(path)
        return Header(windows.data, display=None if windows.is_plain else windows.display)
    if path.suffix.lower() in RAW:
        raw = raw_header(path)
        stated = dict(zip((tag for tag, _ in _EXPOSURE_TAGS), (value or None for value in raw.exposure), strict=True))
        return Header(raw.size, raw.orientation, _stated_exposure(stated))
    with reading(path, "not a readable image", "; copy it again"):
        with opened(path) as image:
            if image.mode not in MODES:
                raise InputError(f"{path}: colour mode {image.mode}; allowed: grey, RGB, RGBA of 8 or 16 bits. Convert it")
            if image.format == "TIFF" and getattr(image, "n_frames", 1) > 1:
                _refuse_thumbnail(path)
            exif = image.getexif()
            orientation = exif.get(274, 1) or 1
            # Pillow turns the pixels of a TIFF itself, and tells their size as turned.
            turned = isinstance(orientation, int) and 1 <= orientation <= 8 and image.format != "TIFF"
            found = Header(image.size, orientation if turned else 1, _stated_exposure(exif.get_ifd(_PHOTO_IFD)))
        if not _complete(path):
            raise InputError(f"{path}: cut short (no end mark: an interrupted copy or download?); copy the file again")
    return found


def _refuse_thumbnail(path: Path) -> None:
    """Refuse a TIFF whose first picture, which is the one that is read, is not the largest."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        sizes = [page.size for page in islice(file.pages, 64)]  # of a damaged file the list has no end
    if max(sizes) > sizes[0]:
        raise InputError(f"{path}: {len(sizes)} pictures, of which the first is not the largest; save the photograph alone")


def exif_upright(path: Path) -> tuple[bytes, tuple[str, float]]:
    """Return the EXIF of a photograph that was turned upright, and what it says of the camera: its model, and the focal length as
    that of 35 mm film (else in mm, 0 = not stated)."""
    if path.suffix.lower() == ".exr":
        return b"", ("", 0.0)
    from PIL import Image

    is_raw = path.suffix.lower() in RAW
    if is_raw and not _is_tiff(path):
        return b"", ("", raw_header(path).focal)
    with reading(path, "not a readable image", "; copy it again"), opened(path, ("TIFF",) if is_raw else FORMATS) as image:
        found = image.getexif()
        own = found.get_ifd(_PHOTO_IFD)
        kept = Image.Exif()
        kept[274] = 1
        lens = {}
        for tag in (41989, 37386):  # focal length as that of 35 mm film, and in mm
            try:
                value = float(own.get(tag) or 0.0)
            except (TypeError, ValueError, ZeroDivisionError):
                continue
            if 0 < value < 10_000:
                lens[tag] = value
        for tag in (271, 272):  # make and model
            if isinstance(found.get(tag), str):
                kept[tag] = found[tag][:100]
        if 41989 in lens:
            kept.get_ifd(_PHOTO_IFD)[41989] = round(lens[41989])
        if 37386 in lens:
            kept.get_ifd(_PHOTO_IFD)[37386] = lens[37386]
        return kept.tobytes(), (str(kept.get(272, "")), lens.get(41989, lens.get(37386, 0.0)))


def _stated_exposure(photo: Mapping[int, Any]) -> Stated | None:
    """Exposure by the tags of a photograph; None if time or speed is missing, or a tag is no number that a camera could have."""
    values: list[float | None] = []
    for tag, (least, most) in _EXPOSURE_TAGS:
        told = photo.get(tag)
        try:
            value = None if told is None else float(told[0] if isinstance(told, tuple | list) else told)
        except (TypeError, ValueError, IndexError, ZeroDivisionError):
            return None
        if value is not None and not least <= value <= most:
            return None
        values.append(value)
    time, speed, number = values
    return None if time is None or speed is None else Stated(time * speed, number)


def header(path: Path) -> Header:
    """Size and orientation from the file's header; what is unreadable, CMYK, cut short or too large is refused by name."""
    with reading(path, "not a readable image", "; copy it again"):
        status = path.stat()
    return _header(path, (status.st_size, status.st_mtime_ns))


def _complete(path: Path) -> bool:
    """Return whether a png or jpg has its end mark; in a jpg it must follow the start of the scan, as thumbnails have one too."""
    if path.stat().st_size == 0:
        return False
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:4] == b"\x89PNG":
            return data.rfind(b"IEND") > 0
        if data[:2] != b"\xff\xd8":
            return True
        at = 2
        while data[at : at + 2] != b"\xff\xda":  # segments before the start of the scan state their length
            if at + 4 > len(data) or data[at] != 0xFF:
                return data.rfind(b"\xff\xd9") > 0
            at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        return data.rfind(b"\xff\xd9") > at


def _is_16_bit_png(path: Path) -> bool:
    with open(path, "rb") as file:
        start = file.read(25)
    return start[:4] == b"\x89PNG" and len(start) == 25 and struct.unpack("B", start[24:25])[0] == 16


def _png_of_16_bits(path: Path) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.Bitmap(str(path)))


def _is_tiff(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(4) in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def _is_16_bit_tiff(path: Path) -> bool:
    if not _is_tiff(path):
        return False
    import tifffile

    with tifffile.TiffFile(path) as file:
        return file.pages[0].dtype == np.uint16


def _tiff_of_16_bits(path: Path) -> np.ndarray:
    """Read the first picture of a TIFF, (H, W) or (H, W, C) uint16; Pillow truncates 16-bit colour to 8 bits."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        if page.compression not in (1, 8, 32946, 32773):
            kind = getattr(page.compression, "name", page.compression)
            raise InputError(f"{path}: 16 bits compressed by {kind}, not read; save it uncompressed, by deflate, or as PNG")
        pixels, extra = page.asarray(), tuple(page.extrasamples)
        tag = page.tags.get(274)
        turn = tag.value if tag is not None and tag.value in TURNS else 1
        inverted = page.photometric == 0
    pixels = np.moveaxis(pixels, 0, -1) if page.planarconfig == 2 and pixels.ndim == 3 else pixels
    if extra and pixels.ndim == 3:
        colours = pixels[..., : -len(extra)]
        alpha = pixels[..., -len(extra)] if extra[0] in (1, 2) else None  # others are no opacity
        if extra[0] == 1:  # colours multiplied by opacity
            colours = np.minimum(colours * (65535.0 / np.maximum(alpha, 1))[..., None], 65535).astype(np.uint16)
        pixels = colours if alpha is None else np.concatenate([colours, alpha[..., None]], -1)
    if inverted:
        pixels = np.concatenate([65535 - pixels[..., :1], pixels[..., 1:]], -1) if pixels.ndim == 3 else 65535 - pixels
    return TURNS[turn](pixels)


def _stored(path: Path) -> np.ndarray:
    """Read the pixels of a png or jpg, (H, W) or (H, W, C), integer, as they are; palettes are resolved."""
    return _pixels_of(path, colour=None)[0]


def _pixels_of(path: Path, colour: str | None) -> tuple[np.ndarray, str, Space | None]:
    """Read the pixels of a png, jpg or raw file, (H, W) or (H, W, C), integer.

    With a `colour` (`source.colour`) also from which colour space they were, or are still to be, converted to sRGB, and that
    space in the latter case.
    """
    header(path)
    if path.suffix.lower() in RAW:
        pixels, warps = raw_pixels(path)
        return pixels, BENT if warps else DEVELOPED, SPACES["linear"]
    with reading(path, "cannot be read", "; the file is damaged or cut short"):
        given = SPACES.get(colour or "")
        is_srgb = colour == "srgb"
        is_tiff = _is_16_bit_tiff(path)
        if is_tiff or _is_16_bit_png(path):  # Pillow truncates 16-bit colour to 8 bits
            space = given
            if colour == "file":
                with opened(path) as image:
                    space = of_16_bits(image, path)
            name = "" if space is None or is_srgb else f"in {space.name}"
            return _tiff_of_16_bits(path) if is_tiff else _png_of_16_bits(path), name, None if is_srgb else space
        with opened(path) as image:
            name = ""
            if image.mode in ("P", "PA"):
                image = image.convert("RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB")
            elif image.mode == "1":
                image = image.convert("L")
            space = None
            if colour == "file":
                image, name, space = converted(image, path)
            elif given is not None and not is_srgb:
                name, space = given.name, given
            return np.asarray(image), f"in {name}" if name else "", space


def _exr(path: Path, size: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
    """Read the channels of an EXR: the picture in its display window if that has the given size, otherwise all pixels that it
    holds. Where the display window lacks pixels, channels are NaN, or the largest integer (`_held`)."""
    from workflow.artifacts.files import read_exr

    windows = exr_windows(path)
    (width, height), (x, y) = windows.data, windows.place
    with reading(path, "cannot be read", "; the file is damaged, cut short or has several parts"):
        channels = read_exr(path)
        if any(values.shape != (height, width) for values in channels.values()):
            raise InputError(f"{path}: channels of different sizes (subsampled?); write all of them at full size")
        if windows.is_plain or size != windows.display:
            return channels
        rows, columns = _held(windows)
        out = {}
        for name, values in channels.items():
            none = np.nan if values.dtype.kind == "f" else np.iinfo(values.dtype).max
            out[name] = np.full(windows.display[::-1], none, values.dtype)
            out[name][rows, columns] = values[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
        return out


def _held(windows: ExrWindows) -> tuple[slice, slice]:
    """Rows and columns of the display window that the file holds."""
    spans = []
    for size, shown, at in zip(windows.data, windows.display, windows.place, strict=True):
        first = min(max(at, 0), shown)
        spans.append(slice(first, max(min(at + size, shown), first)))
    return spans[1], spans[0]


def _colours(path: Path, channels: dict[str, np.ndarray]) -> list[str]:
    """Return the names of R G B [A], or three times the name of one grey channel [and A]."""
    if all(c in channels for c in "RGB"):
        names = list("RGB")
    else:
        names = [c for c in channels if c != "A"] * 3
        if len(names) != 3:
            shown = ", ".join(list(channels)[:8])
            raise InputError(f"{path}: channels {shown}; expected R G B (and A), or one grey channel")
    return names + (["A"] if "A" in channels else [])


def _exr_colour(path: Path, channels: dict[str, np.ndarray]) -> np.ndarray:
    """Return (H, W, 3) or (H, W, 4) float32 of R G B [A], or of one grey channel [and A]."""
    return np.stack([channels[name].astype(np.float32) for name in _colours(path, channels)], -1)


def load_photo(path: Path, turn: int = 1, size: tuple[int, int] | None = None, colour: str = "file") -> Photo:
    """Read a photograph: 8 or 16 bits become [0, 1], EXR values stay, grey becomes RGB. Of an EXR the display window is read
    if it has the given size (width, height), otherwise the data window.

    Colours of another space, by the profile, the chunks or the EXIF of the file, or the primaries of an EXR, are converted to
    sRGB; a `colour` other than `file` is the space whatever the file says (`source.colour`).
    Pixels with alpha < 0.5 and those that are NaN or infinite are not valid and become 0. EXR stores colour multiplied by alpha,
    so it is divided by alpha. Negative EXR values become 0.
    """
    form, held = "", None
    if path.suffix.lower() == ".exr":
        found, windows = _exr(path, size), exr_windows(path)
        held = None if windows.is_plain or size != windows.display else _held(windows)
        names = _colours(path, found)
        height, width = found[names[0]].shape
        stated = SPACES[colour].primaries if colour in SPACES else None
        points = exr_chromaticities(path) if stated is None else tuple(np.ravel(stated))
        to_rec709 = linear_conversion(points, path) if names[0] != names[1] else None
        form = "of other primaries" if to_rec709 is not None else ""

        def strip(rows: slice) -> tuple[np.ndarray, np.ndarray | None]:
            values = np.stack([found[name][rows].astype(np.float32) for name in names], -1)
            if held is not None:
                values[~_within(held, slice(rows.start, rows.start + len(values)), width)] = np.nan
            if to_rec709 is not None:
                values[..., :3] = values[..., :3] @ to_rec709.T
            if len(names) < 4:
                return values, None
            alpha = values[..., 3]
            return values[..., :3] / np.where(np.isfinite(alpha) & (alpha >= 0.5), np.minimum(alpha, 1), 1)[..., None], alpha
    else:
        stored, name, space = _pixels_of(path, colour)
        stored = stored[..., None] if stored.ndim == 2 else stored
        if stored.ndim != 3 or stored.dtype.kind not in "iu":
            raise InputError(f"{path}: pixels of type {stored.dtype}, shape {stored.shape}; expected 8 or 16 bits")
        height, width, channels = stored.shape
        if space is not None and channels < 3:
            space = space.grey()
            name = name if space is not None else ""
        form = " ".join(["16-bit"] * (stored.dtype.itemsize > 1) + ["grey"] * (channels < 3) + [name] * bool(name))
        form = name if path.suffix.lower() in RAW else form

        def strip(rows: slice) -> tuple[np.ndarray, np.ndarray | None]:
            values = stored[rows].astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
            shown = values[..., :3] if channels >= 3 else np.repeat(values[..., :1], 3, -1)
            shown = shown if space is None else space.to_srgb(shown)
            return shown, values[..., -1] if channels in (2, 4) else None

    photo = Photo(np.empty((height, width, 3), np.float32), np.empty((height, width), bool), form=form)
    step = max(1, STRIP_PIXELS // width)
    for rows in (slice(top, top + step) for top in range(0, height, step)):
        values, alpha = strip(rows)
        finite = np.isfinite(values).all(-1) & (np.isfinite(alpha) if alpha is not None else True)
        opaque = np.ones(finite.shape, bool) if alpha is None else np.nan_to_num(alpha) >= 0.5
        values = np.where(finite[..., None], values, 0)
        photo.pixels[rows], photo.valid[rows] = np.maximum(values, 0), finite & opaque
        photo.non_finite += int((~finite).sum())
        photo.transparent += int((finite & ~opaque).sum())
        photo.negative += int((values.min(-1) < 0).sum())
    if held is not None:  # what an EXR does not hold was read as NaN
        photo.outside = height * width - int(_within(held, slice(0, height), width).sum())
        photo.non_finite -= photo.outside
    photo.pixels, photo.valid = TURNS[turn](photo.pixels), TURNS[turn](photo.valid)
    return photo


def _within(held: tuple[slice, slice], rows: slice, width: int) -> np.ndarray:
    """(rows, width) bool, the pixels of some rows that lie within `held` rows and columns."""
    own = np.arange(rows.start, rows.stop)
    return ((own >= held[0].start) & (own < held[0].stop))[:, None] & (
        (np.arange(width) >= held[1].start) & (np.arange(width) < held[1].stop)
    )


def load_mask(path: Path, turn: int = 1, full: bool = False) -> np.ndarray:
    """Read which pixels may be used, (H, W) bool: those that are not 0 (nerfstudio, COLMAP).

    With `full` only the largest value of the type counts (ScanNet++: 255), because interpolation leaves smaller values at the
    borders of hidden regions.
    """
    stored = _stored(path)
    stored = stored[..., 0] if stored.ndim == 3 else stored
    kept = stored == np.iinfo(stored.dtype).max if full else stored > 0
    return TURNS[turn](kept)


def load_map(path: Path, channels: int, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read an EXR map, (H, W, 3) or (H, W) float32; values that are not finite are kept for the caller to mask. `size`: as in
    `load_photo`."""
    values = _exr_colour(path, found) if "R" in (found := _exr(path, size)) else _one_channel(path, found)[..., None]
    if channels == 3:
        return np.repeat(values, 3, -1) if values.shape[-1] == 1 else values[..., :3]
    return values[..., 0]


def _one_channel(path: Path, channels: dict[str, np.ndarray]) -> np.ndarray:
    if len(channels) != 1:
        raise InputError(f"{path}: channels {', '.join(channels)}; expected exactly one")
    return next(iter(channels.values()))


def load_ids(path: Path, turn: int = 1, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read object ids (H, W) int32 from a one-channel png (8 or 16 bit) or EXR, -1 = none.

    Files mark pixels without an id by a negative number or NaN (float EXR), 4294967295 (UINT EXR) or 65535 (16-bit png). 0 is an
    id.

    Raises:
        InputError: a colour picture, or ids between integers (docs/method/numerics.md#ids-between-integers).
    """
    if path.suffix.lower() == ".exr":
        stored = _one_channel(path, _exr(path, size))
    else:
        header(path)
        with reading(path, "cannot be read", "; the file is damaged or cut short"), opened(path) as image:
            palette = image.mode == "P"
            stored = np.asarray(image) if palette else _stored(path)
        if stored.ndim == 3 and stored.shape[-1] == 1:
            stored = stored[..., 0]
        if stored.ndim != 2:
            raise InputError(f"{path}: a colour picture; ids need one channel (16-bit grey png, or EXR)")
    if stored.dtype.kind == "f":
        known = np.isfinite(stored) & (stored >= -0.5)
        whole = np.rint(np.where(known, stored, -1))
        off = int((np.abs(stored - whole)[known] > 1e-3).sum())
        if off:
            raise InputError(f"{path}: {off} pixels lie between integers; ids must not be filtered or anti-aliased")
        ids = whole.astype(np.int64)
    else:
        ids = stored.astype(np.int64)
        none = {"uint16": 65535, "uint32": 4294967295}.get(stored.dtype.name)
        ids = np.where((ids == none) | (ids < 0), -1, ids)
    if ids.size and ids.max() >= 2**31 - 1:
        raise InputError(f"{path}: id {ids.max()} is too large; ids must be below 2147483647")
    return TURNS[turn](ids.astype(np.int32))


def load_depth(path: Path, unit: float | None, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read z-depth (H, W) float32 in metres, 0 = unknown; `unit` is metres per value, by default 0.001 (png) or 1 (EXR)."""
    if path.suffix.lower() == ".exr":
        found = _exr(path, size)
        named = next((found[name] for name in ("Z", "depth.Z", "Y", "R") if name in found), None)
        depth = (_one_channel(path, found) if named is None else named).astype(np.float32)
        scale = 1.0 if unit is None else unit
        known = np.isfinite(depth) & (depth > 0)
    else:
        stored = _stored(path)
        if stored.ndim != 2:
            stored = stored[..., 0]
        if stored.dtype == np.uint8:
            raise InputError(f"{path}: 8 bits are too few for depth; give 16-bit png or EXR, or remove `depth_file_path`")
        depth = stored.astype(np.float32)
        scale = 0.001 if unit is None else unit
        known = (depth > 0) & (depth < 65535)
    return np.where(known, depth * np.float32(scale), 0).astype(np.float32)


def fitted_size(width: int, height: int, max_width: float, max_height: float) -> tuple[int, int]:
    """Return the largest size within a limit that keeps the aspect ratio and does not enlarge.

    Args:
        width, height: pixels.
        max_width, max_height: the limit, pixels.

    Returns:
        Width and height, at least 1.

    >>> fitted_size(640, 480, 320, 320)
    (320, 240)
    """
    scale = min(max_width / width, max_height / height, 1.0)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _overlap(size: int, wanted: int) -> Any:
    """Return a sparse (wanted, size) matrix: the share of target pixel i that source pixel j covers; rows sum to 1."""
    from scipy.sparse import csr_matrix

    step = size / wanted
    edges = np.arange(wanted + 1) * step
    first = np.floor(edges[:-1] + 1e-9).astype(int)
    reach = int(np.ceil(step)) + 1
    column = first[:, None] + np.arange(reach)
    share = np.minimum(column + 1, edges[1:, None]) - np.maximum(column, edges[:-1, None])
    share = np.where(column < size, np.clip(share, 0, None), 0)
    rows = np.repeat(np.arange(wanted), reach)
    flat = (share / share.sum(1, keepdims=True)).ravel()
    return csr_matrix((flat, (rows, np.minimum(column, size - 1).ravel())), (wanted, size))


def reduce_area(image: np.ndarray, valid: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Reduce an image: every target pixel is the mean of the valid part of its area.

    Args:
        image: (H, W, C) float32, finite.
        valid: (H, W) bool.
        width, height: of the result, pixels.

    Returns:
        (height, width, C) float32, and (height, width) bool: where at least half of the area is valid.
    """
    if image.shape[:2] == (height, width):
        return np.where(valid[..., None], image, 0), valid
    rows, columns = _overlap(image.shape[0], height), _overlap(image.shape[1], width)

    step = max(1, STRIP_PIXELS // image.shape[0])
    parts = [slice(left, left + step) for left in range(0, image.shape[1], step)]

    def mean(values: Callable[[slice], np.ndarray]) -> np.ndarray:
        upright = np.concatenate([rows @ values(part).astype(np.float64) for part in parts], 1)
        return np.asarray((columns @ upright.T).T)

    covered = mean(lambda part: valid[:, part])
    total = np.stack([mean(lambda part, c=c: np.where(valid[:, part], image[:, part, c], 0)) for c in range(image.shape[2])], -1)
    kept = covered >= 0.5 - 1e-9
    out = np.where(kept[..., None], total / np.maximum(covered, 1e-9)[..., None], 0)
    return out.astype(np.float32), kept


def reduce_nearest(ids: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the values at the centres of the target pixels, (height, width)."""
    row = np.minimum(((np.arange(height) + 0.5) * ids.shape[0] / height).astype(int), ids.shape[0] - 1)
    column = np.minimum(((np.arange(width) + 0.5) * ids.shape[1] / width).astype(int), ids.shape[1] - 1)
    return ids[np.ix_(row, column)]
