"""Colour spaces of photographs: what a file says its red, green and blue are, converted to those of sRGB.

Telephones write Display P3, cameras at times Adobe RGB. Read as sRGB, their colours would be too dull, silently.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import rec709_from_primaries

SAME_LEVELS = 2
"""Levels of 255 by which a profile may differ from sRGB and still count as sRGB; profiles of sRGB round differently."""
SAME_PRIMARIES = 0.01
"""The same for the entries of the matrix of linear colours."""
LARGEST_PROFILE = 4 << 20  # bytes; those of cameras and phones have less than 10,000


def converted(image: Any, path: Path) -> tuple[Any, str]:
    """Convert an RGB or RGBA picture of Pillow, 8 bits a channel, to sRGB.

    Colours outside of sRGB are cut off at its border. The curve of the profile is replaced by the sRGB curve, as in a program
    that shows the picture; the response of the camera is estimated afterwards.

    Returns:
        The picture, and the name of the colour space that it had; empty if that is sRGB, or not stated.

    Raises:
        InputError: the profile is none.
    """
    profile = image.info.get("icc_profile")
    if not profile or image.mode not in ("RGB", "RGBA"):
        return image, ""
    from PIL import ImageCms

    name, transform = _conversion(profile, image.mode, path)
    return (ImageCms.applyTransform(image, transform), name) if transform is not None else (image, "")


def refuse_other(image: Any, path: Path) -> None:
    """Refuse an RGB or RGBA picture of 16 bits in another colour space than sRGB, which would be converted with 8 bits only.

    Raises:
        InputError: its profile is another, or none.
    """
    profile = image.info.get("icc_profile")
    if not profile or image.mode not in ("RGB", "RGBA"):
        return
    name, transform = _conversion(profile, "RGB", path)
    if transform is not None:
        raise InputError(f"{path}: 16 bits in {name}; allowed: sRGB. Convert it to sRGB, or save it with 8 bits")


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
