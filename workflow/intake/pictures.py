"""Headers of pictures from strangers: what they ask for is known, and refused, before a pixel is decoded."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file, reading

FORMATS = ("PNG", "JPEG", "HEIF", "AVIF", "TIFF", "WEBP", "BMP")
"""Formats of Pillow that photographs may have, whatever their name; Pillow's other readers, such as its PostScript reader, are
not used. MPO, which telephones write as .jpg, is opened as JPEG; HEIF is read by pi-heif."""
EXTRAS = {"truth", "masks", "instances", "depth", "predictions"}
"""Folders of a scene whose pictures are not photographs (docs/guide/own-data.md#4-the-folder)."""
PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".exr", ".heic", ".heif", ".avif", ".tif", ".tiff", ".webp", ".bmp")
"""Extensions of photographs, and of maps that belong to them."""
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Extensions of raw files of cameras, which are read by LibRaw (workflow/intake/raws.py)."""
TEXTURES = ("PNG", "JPEG", "BMP", "TGA", "PPM")
"""The same for textures of Mitsuba scenes and of meshes."""
PNG_MAGIC = b"\x89PNG"
EXR_MAGIC = b"\x76\x2f\x31\x01"
_BOXES = b"ftyp"
"""At the fifth byte of files that consist of boxes, such as HEIF and AVIF."""
_LARGEST_FILE = 4 << 30
_LARGEST_CHUNK = 1 << 16


def check_pixels(path: Path, width: int, height: int, channels: int = 1) -> None:
    """Refuse a picture of more than `limits.PICTURE_PIXELS`, or without any."""
    if width < 1 or height < 1:
        raise InputError(f"{path}: {width}x{height} pixels; a picture needs at least one")
    if width * height > limits.PICTURE_PIXELS or width * height * channels > limits.PICTURE_VALUES:
        more = f" of {channels} channels" if channels > 1 else ""
        raise InputError(
            f"{path}: {width}x{height} pixels{more}, {width * height / 1e6:.4g} million; allowed are"
            f" {limits.PICTURE_PIXELS / 1e6:.0f} million (SECURITY.md). Reduce it, and the intrinsics with it"
        )


def check_chunks(path: Path) -> None:
    """Refuse a PNG whose chunks do not end in the file: Pillow would ask for as much memory as the length of one says."""
    size = path.stat().st_size
    with path.open("rb") as file:
        at, kind = 8, b"" if file.read(4) == PNG_MAGIC else b"IEND"
        while kind != b"IEND":
            file.seek(at)
            head = file.read(8)
            kind, length = head[4:], int.from_bytes(head[:4], "big")
            if at == 8 and kind != b"IHDR":
                raise InputError(f"{path}: not a readable image (a PNG without a header)")
            at += 12 + length
            if len(head) < 8 or at > size:
                raise InputError(f"{path}: cut short (no end mark: an interrupted copy or download?); copy the file again")


def check_boxes(path: Path) -> None:
    """Refuse a HEIF or AVIF whose boxes do not end in the file, a WebP or BMP that is shorter than it says."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(16)
        ends = None
        if start[:4] == b"RIFF":
            ends = 8 + int.from_bytes(start[4:8], "little")
        elif start[:2] == b"BM":
            ends = int.from_bytes(start[2:6], "little")
        elif start[4:8] == _BOXES:
            ends = 0
            while ends < size:
                file.seek(ends)
                head = file.read(16)
                length = int.from_bytes(head[:4], "big")
                length = int.from_bytes(head[8:], "big") if length == 1 else length
                if length == 0:  # up to the end of the file
                    return
                ends += max(length, 8)
    if ends is not None and ends > size:
        raise InputError(f"{path}: cut short ({size} bytes of {ends}: an interrupted copy or download?); copy the file again")


def png_chunk(path: Path, wanted: bytes) -> bytes | None:
    """Return the content of a chunk of a PNG that stands before its pixels; None without one, and of other files."""
    with path.open("rb") as file:
        if file.read(8)[:4] != PNG_MAGIC:
            return None
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            length = int.from_bytes(head[:4], "big")
            if head[4:] == wanted:
                return file.read(min(length, _LARGEST_CHUNK))
            file.seek(length + 4, 1)
    return None


@contextmanager
def opened(path: Path, formats: tuple[str, ...] = FORMATS) -> Iterator[Any]:
    """Open a picture by Pillow, with its size checked; raises InputError for a size that is not allowed."""
    from PIL import Image, UnidentifiedImageError

    check_file(path, _LARGEST_FILE, "a picture")
    check_chunks(path)
    check_boxes(path)
    allowed = formats
    if "HEIF" in formats:
        if begins_with_boxes(path):
            import pi_heif

            pi_heif.register_heif_opener()
        else:  # Pillow knows no format that nobody has registered
            formats = tuple(name for name in formats if name != "HEIF")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the size is checked here, against our own limit
        try:
            image = Image.open(path, formats=formats)
        except Image.DecompressionBombError as error:
            raise InputError(f"{path}: too many pixels ({error}); allowed are {limits.PICTURE_PIXELS}") from None
        except UnidentifiedImageError:
            if not path.stat().st_size:
                raise InputError(f"{path}: not a readable image (the file is empty); copy it again") from None
            kinds = ", ".join(allowed)
            why = f"its content is none of {kinds}, whatever its name"
            raise InputError(f"{path}: not a readable image ({why}); save it as one of them") from None
        with image:
            check_pixels(path, *image.size)
            yield image


def begins_with_boxes(path: Path) -> bool:
    """Return whether a file consists of boxes, as HEIF and AVIF do."""
    with path.open("rb") as file:
        return file.read(8)[4:] == _BOXES


def code_points(path: Path) -> tuple[int, int] | None:
    """Return the numbers of ITU-T H.273 for primaries and transfer function of a file of boxes, None without any."""
    if not begins_with_boxes(path):
        return None
    with path.open("rb") as file:
        start = file.read(_LARGEST_CHUNK)
    at = start.find(b"colrnclx")
    if at < 0 or at + 12 > len(start):
        return None
    return int.from_bytes(start[at + 8 : at + 10], "big"), int.from_bytes(start[at + 10 : at + 12], "big")


class ExrWindows(NamedTuple):
    """Sizes (width, height) of the pixels that an EXR holds and of the picture that it shows, and the place (x, y) of the first
    pixel in that picture, which may lie outside (overscan)."""

    data: tuple[int, int]
    display: tuple[int, int]
    place: tuple[int, int]

    @property
    def is_plain(self) -> bool:
        """The file holds the picture, and nothing else."""
        return self.data == self.display and self.place == (0, 0)


def exr_windows(path: Path) -> ExrWindows:
    """Return data and display window of an EXR from its header.

    Raises:
        InputError: no EXR, several parts, deep pixels, or more pixels or channels than are allowed.
    """
    import OpenEXR

    check_file(path, _LARGEST_FILE, "an EXR image")
    with path.open("rb") as file:
        if file.read(4) != EXR_MAGIC:
            raise InputError(f"{path}: not a readable EXR image (it does not begin like one)")
    with reading(path, "not a readable EXR image"), OpenEXR.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise InputError(f"{path}: {len(file.parts)} parts; an EXR of one part is needed")
        header = file.header()
        (left, top), data = _corner_and_size(header["dataWindow"])
        (x, y), display = _corner_and_size(header.get("displayWindow", header["dataWindow"]))
        channels = len(header["channels"])
        kind = header.get("type")
    if "deep" in str(kind).lower():
        raise InputError(f"{path}: deep pixels; flat ones are needed")
    if not 1 <= channels <= limits.PICTURE_CHANNELS:
        raise InputError(f"{path}: {channels} channels; allowed are 1 to {limits.PICTURE_CHANNELS}")
    for size in (data, display):
        check_pixels(path, *size, channels)
    return ExrWindows(data, display, (left - x, top - y))


def _corner_and_size(window: Any) -> tuple[tuple[int, int], tuple[int, int]]:
    (left, top), (right, bottom) = ([int(value) for value in corner] for corner in window)
    return (left, top), (right - left + 1, bottom - top + 1)


def exr_size(path: Path) -> tuple[int, int]:
    """Return width and height of the pixels that an EXR holds; raises InputError as `exr_windows`."""
    return exr_windows(path).data


def exr_chromaticities(path: Path) -> tuple[float, ...] | None:
    """Return CIE x, y of red, green, blue and white as the header of an EXR states them, None where it does not."""
    import OpenEXR

    with reading(path, "not a readable EXR image"), OpenEXR.File(str(path), header_only=True) as file:
        found = file.header().get("chromaticities")
    return None if found is None else tuple(float(value) for value in found)


def check_texture(path: Path) -> None:
    """Refuse a texture with more pixels than are allowed; what is no picture that we know is left to who reads it."""
    kind = path.suffix.lower()
    if kind == ".exr":
        exr_size(path)
    elif kind in (".hdr", ".rgbe"):
        with path.open("rb") as file:
            found = re.search(rb"[-+]Y (\d{1,9}) [-+]X (\d{1,9})", file.read(4096))
        if found:
            check_pixels(path, int(found[2]), int(found[1]))
    elif kind in (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm", ".pgm", ".pfm"):
        with reading(path, "not a readable picture"), opened(path, TEXTURES):
            pass
