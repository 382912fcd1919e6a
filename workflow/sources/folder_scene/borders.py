"""What photographs hold in the same place and is no surface: black borders, and what a camera writes into all of them.

Borders are what a program that removed the distortion of a lens without cropping, or a letterbox, leaves without a picture. Read
as surface they would be black walls. They are known by being black, connected to the edge, in the same place in most photographs,
and lit in none; dark surface moves with the camera. A date or a watermark is known by being brighter, or darker, than what is
around it, in the same pixels of nearly all photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from workflow.sources.folder_scene.entries import evenly_spread
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.images import Photo, fitted_size, reduce_area, reduce_nearest

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

LONGEST, WINDOW = 800, 40
"""Pixels to which photographs are reduced for what is written into them, and width of a picture over that of a neighbourhood."""
CONTRAST = 0.12
"""Sensor values by which a written pixel differs from the mean around it."""
ALWAYS, FEWEST_WRITTEN = 0.9, 8
"""Share of the photographs in which it does, with the same sign; fewest from which that is known."""
LEAST_WRITTEN, LARGEST_WRITTEN = 8, 0.1
"""Reduced pixels of the smallest mark, and share of a picture above which nothing is left out: then the camera stood still."""

Size = tuple[int, int]


class Unpictured(NamedTuple):
    """Pixels (H, W) bool without a picture of the room: of a black border, and of what is written into the photographs."""

    border: np.ndarray
    written: np.ndarray

    @property
    def all(self) -> np.ndarray:
        return self.border | self.written


class _Marks:
    """Counts in how many photographs a pixel is brighter, and darker, than what is around it."""

    def __init__(self, size: Size):
        self.size, self.reduced = size, fitted_size(*size, LONGEST, LONGEST)
        self.counts, self.shown = np.zeros((2, *self.reduced[::-1], 3), np.uint8), 0
        self.window = 2 * (self.reduced[0] // WINDOW // 2) + 3

    def add(self, photo: Photo) -> None:
        from scipy.ndimage import uniform_filter

        pixels, _ = reduce_area(photo.pixels, photo.valid, *self.reduced)
        contrast = pixels - uniform_filter(pixels, (self.window, self.window, 1), mode="nearest")  # dates are often orange
        self.counts += np.stack([contrast, -contrast]) > CONTRAST
        self.shown += 1

    def are_possible(self, count: int) -> bool:
        """Return whether a pixel may still differ in enough of `count` photographs."""
        return self.shown - int(self.counts.max()) <= (1 - ALWAYS) * count

    def found(self, border: np.ndarray) -> np.ndarray:
        """Return rectangles around marks, (H, W) bool like `border`, whose edge is none; digits that change lie in between."""
        from scipy.ndimage import binary_dilation, find_objects, label

        width, height = self.size
        edge = binary_dilation(reduce_nearest(border, *self.reduced), iterations=self.window)
        marks = (self.counts.max((0, 3)) >= ALWAYS * self.shown) & ~edge
        near, _ = label(binary_dilation(marks, iterations=self.window))
        out = np.zeros((height, width), bool)
        for number, (rows, columns) in enumerate(find_objects(near), 1):
            if marks[near == number].sum() >= LEAST_WRITTEN:
                across, down = width / self.reduced[0], height / self.reduced[1]
                top, left = int(rows.start * down), int(columns.start * across)
                out[top : round(rows.stop * down), left : round(columns.stop * across)] = True
        return out if out.mean() <= LARGEST_WRITTEN else np.zeros_like(out)


def find_borders(frames: Sequence[Frame], encoded: bool, read: Callable[[Frame], Photo]) -> dict[Size, Unpictured]:
    """Return what photographs of each size (width, height) hold without a picture, of sizes that have such pixels.

    Args:
        frames: the photographs to look at.
        encoded: whether they hold sensor values, whose borders are nearly 0; those of linear values are exactly 0, and nothing is
            written into them.
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
        is_lit, marks = np.zeros(size[::-1], bool), _Marks(size)
        bordered, written = True, encoded and len(chosen) >= FEWEST_WRITTEN
        for frame in chosen:
            photo = read(frame)
            border = black_border(photo.pixels, photo.valid, encoded)
            if border.mean() < LARGEST:  # a black photograph says nothing
                count, shown = count + border, shown + 1
                is_lit |= photo.valid & (photo.pixels.max(-1) > (BRIGHT if encoded else 0.0))
            if written:
                marks.add(photo)
            # No pixel can be in enough of them any more.
            bordered &= shown - int(count.max()) <= (1 - MOST) * len(chosen)
            written &= marks.are_possible(len(chosen))
            if not (bordered or written):
                break
        else:
            border = (count >= max(MOST * shown, FEWEST)) & ~is_lit
            border &= border.mean() >= LEAST
            is_lossy = any(frame.image.suffix.lower() in LOSSY for frame in chosen)
            border = _widened(border, JPEG_RIM if is_lossy else RIM) if border.any() else border
            own = Unpictured(border, marks.found(border) if written else np.zeros_like(border))
            own = own._replace(written=own.written & ~border)
            if own.all.any():
                found[size] = own
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


def notes_of(found: Mapping[Size, Unpictured]) -> list[str]:
    """Say what was left out."""
    what = {"border": "a black border", "written": "what is written into all of them, such as a date"}
    return [
        f"photographs of {width}x{height}: {words}, {mask.mean():.1%} of the picture, is left out (source.borders)"
        for (width, height), own in found.items()
        for name, words in what.items()
        if (mask := getattr(own, name)).any()
    ]
