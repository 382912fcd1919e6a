"""What a capture says about the files that it was made from, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from iif_core.camera.exposure import ExposureGains
from iif_core.errors import InputError
from workflow.scene.normal_form import View
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.mesh import Mesh

MAX_LOG_PIXEL_ASPECT = 0.1  # |log(fl_x / fl_y)| above which a note asks whether it is right; real lenses stay below 0.01


def of_dropped(dropped: Mapping[str, float], count: int) -> list[str]:
    """Name the views, of `count`, that look at nothing; `dropped`: name -> share of the rays that hit the mesh."""
    out = [f"view {name} dropped: it looks at nothing ({share:.1%} of its rays hit the mesh)" for name, share in dropped.items()]
    if count - len(dropped) == 1:
        out.append("one view only: nothing is seen twice, so materials and exposure rest on the prior alone")
    return out


def of_origin(origin: np.ndarray) -> list[str]:
    """Say which origin (3,) was subtracted, if one was."""
    if not origin.any():
        return []
    at = ", ".join(f"{value:.0f}" for value in origin)
    return [f"coordinates are far from 0: all that is written is relative to ({at}) m, `origin` in capture.json and cameras.json"]


def of_blank(path: Path, blank: Mapping[str, list[str]], count: int) -> list[str]:
    """Name the photographs, of `count`, that are black or white all over.

    Raises:
        InputError: all are; the message names `path`, the list of cameras.
    """
    found = {kind: names for kind, names in blank.items() if names}
    if found and sum(map(len, found.values())) == count:
        raise InputError(
            f"{path}: all {count} photographs are {' or '.join(found)}"
            f" ({'no light was recorded' if 'black' in found else 'every pixel is saturated'}): check the exposure, and the"
            " conversion that wrote the files"
        )
    out = []
    for kind, names in found.items():
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        what = "are not used" if kind == "black" else "only show that their surface is bright"
        out.append(
            f"WARNING {len(names)} of {count} photographs are {kind} all over ({', '.join(names[:5])}{more}) and {what}:"
            " check their exposure"
        )
    return out


def of_exposures(gains: ExposureGains, alike: bool) -> list[str]:
    """Describe exposures that were estimated; `alike`: they count as equal."""
    out = []
    if alike:
        if not gains.pairs:
            return ["exposure: the photographs share no surface that would tell; they count as equally exposed"]
        low, high = gains.gain.min(), gains.gain.max()
        return [f"exposure: the photographs are equally exposed, as the surface that they share says ({low:.3g} to {high:.3g})"]
    apart = int((~gains.estimated).sum())
    groups = int(gains.group.max()) + 1
    if apart:
        out.append(f"exposure: {apart} view(s) share no surface with others and keep exposure 1")
    if groups > 1:
        out.append(f"exposure: the views fall into {groups} groups without shared surface; each has mean 1")
    if gains.pairs:
        low, high = gains.gain.min(), gains.gain.max()
        out.append(f"exposure estimated from shared surface: {low:.3g} to {high:.3g} (residual {gains.residual:.3f})")
    return out


def of_pixels(frames: Sequence[Frame], counts: Mapping[str, int], forms: Sequence[tuple[str, str]]) -> list[str]:
    """Say which pixels are ignored, and how files that are not 8-bit colour were read.

    Args:
        frames: all photographs.
        counts: of their pixels (`photographs.COUNTED`).
        forms: format and name of each photograph of an unusual format.
    """
    words = {
        "non_finite": "NaN or infinite pixels are ignored",
        "transparent": "transparent pixels are ignored (alpha < 0.5)",
        "negative": "pixels with negative values were set to 0",
        "outside": "pixels of the display window that the EXR does not hold are ignored",
        "masked": f"masked pixels are ignored ({sum(f.mask is not None for f in frames)} masks)",
    }
    out = [f"photographs: {counts[k]} {text}" for k, text in words.items() if counts[k]]
    grey, deep = "the same value in R, G and B", "values / 65535"
    developed = "developed by LibRaw, linear, in the white balance of daylight"
    bent = "the files ask to remove the distortion of the lens, which is left in: cameras of their JPEGs do not fit them"
    meaning = {"grey": grey, "16-bit": deep, "16-bit grey": f"{deep}, the same in R, G and B"}
    meaning |= {images.DEVELOPED: developed, images.BENT: f"{developed}; {bent}"}
    for form in sorted({form for form, _ in forms}):
        count = len({name for own, name in forms if own == form})
        out.append(f"photographs: {count} {form}: {meaning.get(form, 'converted to sRGB')}")
    turned = sum(f.turn != 1 for f in frames)
    if turned:
        out.append(f"photographs: {turned} turned upright by their EXIF orientation, as `w` x `h` say")
    return out


def of_views(frames: Sequence[Frame], views: Sequence[View], listed: bool, test_every: int, encoded: bool) -> list[str]:
    """Describe lenses, size and held-out views.

    Args:
        frames: all photographs.
        views: those that are used.
        listed: lists of the source say which are held out.
        test_every: `capture.test_every`.
        encoded: photographs hold sensor values.
    """
    out = []
    aspects = (f.camera.fx / f.camera.fy for f in frames)
    ratio = next((aspect for aspect in aspects if abs(np.log(aspect)) > MAX_LOG_PIXEL_ASPECT), None)
    if ratio:
        out.append(f"WARNING fl_x / fl_y is {ratio:.3g}: are the pixels that far from square, or is one of them wrong?")
    if listed:
        tests = sum(v.split == "test" for v in views)
        every = "; `capture.test_every` is not used" if test_every else ""
        out.append(f"lists of the source keep {tests} of {len(views)} views for testing{every}")
    bent = [f for f in frames if not f.lens.is_identity]
    if bent:
        out.append(f"lens distortion ({bent[0].lens.kind}) removed from {len(bent)} photographs")
    first = frames[0].camera
    if (views[0].width, views[0].height) != (first.width, first.height):
        out.append(
            f"photographs of {first.width}x{first.height} reduced to {views[0].width}x{views[0].height} by the mean"
            f" of {'sensor values' if encoded else 'radiance'} over each pixel's area"
        )
    return out


def of_objects(frames: Sequence[Frame], mesh: Mesh, file: str) -> list[str]:
    """Say where object ids are from; `file`: name of the mesh's."""
    out = []
    given = sum(frame.ids is not None for frame in frames)
    if 0 < given < len(frames):
        out.append(f"instances are given for {given} of {len(frames)} views")
    if mesh.from_nodes and mesh.names is not None:
        out.append(f"the {len(mesh.names)} nodes of {file} serve as instances")
    return out
