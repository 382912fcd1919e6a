"""Black borders: what a program that removed the distortion of a lens without cropping, or a letterbox, leaves without a picture.

Read as surface they would be black walls. They are known by being black, connected to the edge, in the same place in most
photographs, and lit in none; dark surface moves with the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from workflow.sources.folder_scene.entries import evenly_spread
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.images import Photo

BLACK, MEDIAN = 16 / 255, 2 / 255
"""Largest sensor value of a border, as JPEG leaves it, and of the median of its pixels."""
BRIGHT = 40 / 255
"""Sensor value that no pixel of a border has in any photograph."""
MOST, FEWEST, MOST_READ = 0.8, 3, 12
"""Share of the photographs of a size in which a pixel is of the border; fewest from which that is known; most that are read."""
LEAST, LARGEST = 1e-3, 0.9
"""Share of a picture from which a border is one, and from which a photograph is black."""
RIM, JPEG_RIM = 1, 4
"""Pixels by which a border is widened; JPEG mixes both sides within a block."""
LOSSY = (".jpg", ".jpeg", ".heic", ".heif", ".avif", ".webp")
"""Formats whose blocks smear an edge."""

Size = tuple[int, int]


def find_borders(frames: Sequence[Frame], encoded: bool, read: Callable[[Frame], Photo]) -> dict[Size, np.ndarray]:
    """Return the border (H, W) bool of photographs of each size (width, height) that have one.

    Args:
        frames: the photographs to look at.
        encoded: whether they hold sensor values, whose borders are nearly 0; those of linear values are exactly 0.
        read: decodes a photograph.
    """
    of_size: dict[Size, list[Frame]] = {}
    for frame in frames:
        of_size.setdefault((frame.camera.width, frame.camera.height), []).append(frame)
    found = {}
    for size, own in of_size.items():
        chosen = [own[i] for i in evenly_spread(len(own), MOST_READ)]
        if len(chosen) < FEWEST:
            continue
        count, shown = np.zeros(size[::-1], np.uint8), 0
        is_lit = np.zeros(size[::-1], bool)
        for frame in chosen:
            photo = read(frame)
            border = black_border(photo.pixels, photo.valid, encoded)
            if border.mean() < LARGEST:  # a black photograph says nothing
                count, shown = count + border, shown + 1
                is_lit |= photo.valid & (photo.pixels.max(-1) > (BRIGHT if encoded else 0.0))
            if shown - int(count.max()) > (1 - MOST) * len(chosen):  # no pixel can be in enough of them any more
                break
        border = (count >= max(MOST * shown, FEWEST)) & ~is_lit
        if border.mean() >= LEAST:
            is_lossy = any(frame.image.suffix.lower() in LOSSY for frame in chosen)
            found[size] = _widened(border, JPEG_RIM if is_lossy else RIM)
    return found


def black_border(pixels: np.ndarray, valid: np.ndarray, encoded: bool) -> np.ndarray:
    """Return the black pixels (H, W) bool of a photograph that hang together with its edge. pixels: (H, W, 3); valid: (H, W)."""
    from scipy.ndimage import label

    brightest = pixels.max(-1)
    black = valid & (brightest <= (BLACK if encoded else 0.0))
    edge = np.zeros_like(black)
    edge[[0, -1]], edge[:, [0, -1]] = True, True
    if not (black & edge).any():
        return np.zeros_like(black)
    parts, _ = label(black)
    out = np.isin(parts, np.setdiff1d(parts[edge & black], 0))
    return out if not encoded or np.median(brightest[out]) <= MEDIAN else np.zeros_like(black)


def _widened(border: np.ndarray, pixels: int) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return binary_dilation(border, iterations=pixels)


def notes_of(borders: Mapping[Size, np.ndarray]) -> list[str]:
    """Say what was left out."""
    return [
        f"photographs of {width}x{height}: a black border, {mask.mean():.1%} of the picture, is left out (source.borders)"
        for (width, height), mask in borders.items()
    ]
