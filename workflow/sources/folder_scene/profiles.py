"""Colour spaces of photographs: what a file says its red, green and blue are, converted to those of sRGB.

Telephones write Display P3, cameras at times Adobe RGB. Read as sRGB, their colours would be too dull, silently.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import REC709_PRIMARIES, linear_from_srgb, rec709_from_primaries, srgb_from_linear
from workflow.intake.pictures import code_points, png_chunk

SAME_LEVELS = 2
"""Levels of 255 by which a profile may differ from sRGB and still count as sRGB; profiles of sRGB round differently."""
SAME_PRIMARIES = 0.01
"""The same for the entries of the matrix of linear colours."""
LARGEST_PROFILE = 4 << 20  # bytes; those of cameras and phones have less than 10,000
SAME_GAMMA = 0.03
"""How far the gAMA of a PNG may be from 1 / 2.2, which stands for sRGB."""
_D65 = REC709_PRIMARIES[3]
_P3 = ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), _D65)
_REC2020 = ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046), _D65)
_REC601 = ((0.63, 0.34), (0.31, 0.595), (0.155, 0.07), _D65)
_REC601_625 = ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06), _D65)
_ADOBE = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), _D65)
_AP1 = ((0.713, 0.293), (0.165, 0.83), (0.128, 0.044), (0.32168, 0.33767))
_ADOBE_GAMMA = 563 / 256


def _power(exponent: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: np.power(np.maximum(values, 0.0), exponent)


def _from_video(values: np.ndarray) -> np.ndarray:
    """Inverse of the curve of ITU-R BT.709 and BT.2020."""
    return np.where(values < 0.081, values / 4.5, np.power(np.maximum((values + 0.099) / 1.099, 0.0), 1.0 / 0.45))


class Space(NamedTuple):
    """A colour space: CIE x, y of red, green, blue and white, and the light of its values; `light` None = values are light."""

    name: str
    primaries: tuple[tuple[float, float], ...]
    light: Callable[[np.ndarray], np.ndarray] | None

    @property
    def matrix(self) -> np.ndarray | None:
        """(3, 3) from its linear colours to those of Rec. 709; None where they are that."""
        found = rec709_from_primaries(np.array(self.primaries))
        return found if np.abs(found - np.eye(3)).max() > SAME_PRIMARIES else None

    def to_srgb(self, values: np.ndarray) -> np.ndarray:
        """Values (..., 3) in [0, 1] as those of sRGB, cut off at its border."""
        light = values.astype(np.float64) if self.light is None else self.light(values.astype(np.float64))
        light = light if self.matrix is None else light @ self.matrix.T
        return srgb_from_linear(np.clip(light, 0.0, 1.0)).astype(np.float32)

    def grey(self) -> Space | None:
        """The space of its grey values; None where that is sRGB."""
        return None if self.light is linear_from_srgb else self._replace(primaries=REC709_PRIMARIES)


SPACES = {
    "srgb": Space("sRGB", REC709_PRIMARIES, linear_from_srgb),
    "linear": Space("linear Rec. 709", REC709_PRIMARIES, None),
    "display_p3": Space("Display P3", _P3, linear_from_srgb),
    "adobe_rgb": Space("Adobe RGB", _ADOBE, _power(_ADOBE_GAMMA)),
    "rec2020": Space("Rec. 2020", _REC2020, _from_video),
    "acescg": Space("ACEScg", _AP1, None),
}
"""Values of `source.colour`. Of an EXR the primaries alone count."""


def converted(image: Any, path: Path) -> tuple[Any, str, Space | None]:
    """Convert a picture of Pillow, 8 bits a channel, to sRGB by its ICC profile; grey has none that counts.

    Colours outside of sRGB are cut off at its border. The curve of the profile is replaced by the sRGB curve, as in a program
    that shows the picture; the response of the camera is estimated afterwards.

    Returns:
        The picture, the name of the colour space that it had, empty if that is sRGB or not stated, and that space where the
        picture is still in it (`stated_space`).

    Raises:
        InputError: the profile is none, or what the file says of its colours cannot be read.
    """
    space, is_told = stated_space(image, path)
    if image.mode not in ("RGB", "RGBA"):
        space = None if space is None else space.grey()
        return image, "" if space is None else space.name, space
    profile = image.info.get("icc_profile")
    if is_told or not profile:
        return image, "" if space is None else space.name, space
    from PIL import ImageCms

    name, transform = _conversion(profile, image.mode, path)
    return (ImageCms.applyTransform(image, transform), name, None) if transform is not None else (image, "", None)


def of_16_bits(image: Any, path: Path) -> Space | None:
    """Return the colour space of a picture of 16 bits where it is another than sRGB.

    Raises:
        InputError: it is stated by an ICC profile, by which 8 bits alone can be converted, or cannot be read.
    """
    space, is_told = stated_space(image, path)
    if image.mode not in ("RGB", "RGBA"):
        return None if space is None else space.grey()
    profile = image.info.get("icc_profile")
    if not is_told and profile:
        name, transform = _conversion(profile, "RGB", path)
        if transform is not None:
            raise InputError(f"{path}: 16 bits in {name}; allowed: sRGB. Convert it to sRGB, or save it with 8 bits")
    return space


def stated_space(image: Any, path: Path) -> tuple[Space | None, bool]:
    """Return the colour space that a picture states without an ICC profile, None where that is sRGB, or nothing is stated; and
    whether a profile would not count beside it.

    A HEIF or AVIF states it by its code points, a PNG by its chunk cICP, or without a profile and sRGB by gAMA and cHRM (PNG 3rd
    edition, 11.3.2); a JPEG of a camera by the interoperability index R03 of EXIF, which is Adobe RGB (DCF 2.0).

    Raises:
        InputError: a transfer function or primaries that are not read, such as PQ and HLG.
    """
    coded = png_chunk(path, b"cICP")
    if coded is not None:
        return _by_code_points(path, coded), True
    info = image.info
    if info.get("icc_profile") or "srgb" in info:
        return None, False
    points = code_points(path)
    if points is not None:
        return _by_code_points(path, bytes((*(min(number, 255) for number in points), 0, 1))), True
    gamma, white_first = info.get("gamma"), info.get("chromaticity")
    if gamma is not None or white_first is not None:
        usual = gamma is None or not 0.05 < gamma < 20 or abs(gamma - 1 / 2.2) <= SAME_GAMMA
        light = linear_from_srgb if usual else None if abs(gamma - 1.0) <= SAME_GAMMA else _power(1.0 / gamma)
        points = REC709_PRIMARIES
        if white_first is not None:
            white, *points = np.reshape(np.asarray(white_first, np.float64), (4, 2)).tolist()
            points = tuple(map(tuple, (*points, white)))
        space = Space(f"the colours that its chunks state (gamma {gamma or 1 / 2.2:.3g})", points, light)
        try:
            return (None if usual and space.matrix is None else space), False
        except InputError as error:
            raise InputError(f"{path}: chunk cHRM: {error}; save the photograph again in sRGB") from None
    exif = image.getexif()
    index = exif.get_ifd(0xA005).get(1) if 0x8769 in exif else None
    return (SPACES["adobe_rgb"] if str(index).startswith("R03") else None), False


_CODED_PRIMARIES = {1: REC709_PRIMARIES, 2: REC709_PRIMARIES, 5: _REC601_625, 6: _REC601, 7: _REC601, 9: _REC2020, 12: _P3}
_CODED_CURVES = {
    **dict.fromkeys((2, 13), linear_from_srgb),
    **dict.fromkeys((1, 6, 14, 15), _from_video),
    4: _power(2.2),
    5: _power(2.8),
    8: None,
}


def _by_code_points(path: Path, coded: bytes) -> Space | None:
    """Colour space of code points, such as a chunk cICP: numbers of ITU-T H.273 for primaries and transfer function, then matrix
    and range."""
    again = "save it as linear EXR, or in sRGB"
    if len(coded) != 4 or coded[2] != 0 or coded[3] != 1:
        raise InputError(f"{path}: code points {coded[:8].hex()}: no full-range RGB; {again}")
    if coded[0] not in _CODED_PRIMARIES or coded[1] not in _CODED_CURVES:
        what = {16: " (PQ)", 18: " (HLG)"}.get(coded[1], "")
        raise InputError(
            f"{path}: its colours have primaries {coded[0]} and the curve {coded[1]}{what} of H.273, not read; {again}"
        )
    space = Space("the colours that its code points state", _CODED_PRIMARIES[coded[0]], _CODED_CURVES[coded[1]])
    return None if space.light is linear_from_srgb and space.matrix is None else space


def _conversion(profile: bytes, mode: str, path: Path) -> tuple[str, Any]:
    """Return the name of a profile and the transform to sRGB, None where there is nothing to convert."""
    from PIL import Image, ImageCms

    again = "save the photograph again in sRGB, or without a profile if it is in sRGB"
    if len(profile) > LARGEST_PROFILE:
        raise InputError(f"{path}: a colour profile of {len(profile)} bytes; allowed are {LARGEST_PROFILE}: {again}")
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if opened.profile.xcolor_space.strip() != "RGB":
            raise InputError(f"{path}: the colour profile is one of {opened.profile.xcolor_space.strip()}, not of RGB: {again}")
        name = ImageCms.getProfileDescription(opened).strip() or "a colour space without a name"
        srgb = ImageCms.createProfile("sRGB")
        transform = ImageCms.buildTransform(opened, srgb, mode, mode, ImageCms.Intent.RELATIVE_COLORIMETRIC)
        steps = np.linspace(0, 255, 18).round().astype(np.uint8)
        probe = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(1, -1, 3)
        shown = ImageCms.applyTransform(Image.fromarray(probe).convert(mode), transform)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: the colour profile cannot be read ({error}): {again}") from None
    apart = np.abs(np.asarray(shown, int)[..., :3] - probe).max()
    return name[:80], transform if apart > SAME_LEVELS else None


def linear_conversion(chromaticities: tuple[float, ...] | None, path: Path) -> np.ndarray | None:
    """Return the matrix (3, 3) from the linear colours of an EXR to those of Rec. 709; None where they are that.

    Args:
        chromaticities: CIE x, y of red, green, blue and white, as the header says; None = Rec. 709, by OpenEXR's own convention.
        path: of the file.

    Raises:
        InputError: they span no colours.
    """
    if chromaticities is None:
        return None
    try:
        matrix = rec709_from_primaries(np.reshape(chromaticities, (4, 2)))
    except InputError as error:
        advice = "remove the attribute if the colours are Rec. 709"
        raise InputError(f"{path}: `chromaticities` of the header: {error}; {advice}") from None
    return matrix if np.abs(matrix - np.eye(3)).max() > SAME_PRIMARIES else None
