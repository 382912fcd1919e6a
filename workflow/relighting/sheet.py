"""The contact sheet: what every relighting changes, with the room as it was found beside it."""

from __future__ import annotations

import io
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
GAP, TITLE, CAPTION, LARGEST = 6, 22, 18, 384
"""Pixels between pictures, of a title, of a caption, and of the longer side of a picture."""
PAIRS = 3
"""Frames of a flight that are shown."""


class Pair(NamedTuple):
    """One frame before and after, (H, W, 3) uint8 each."""

    before: Array
    after: Array
    caption: str


class Row(NamedTuple):
    """One relighting."""

    title: str
    pairs: list[Pair]


def shown_frames(frames: int) -> list[int]:
    """Return the frames of a flight that are on the sheet."""
    return sorted({int(i) for i in np.linspace(0, frames - 1, min(PAIRS, frames)).round()})


def png(picture: Array) -> bytes:
    """Encode (H, W, 3) uint8."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(buffer, "PNG")
    return buffer.getvalue()


def contact_sheet(rows: list[Row]) -> Array:
    """Draw one row for each relighting: its title, then pairs of pictures with captions. (H, W, 3) uint8."""
    from PIL import Image, ImageDraw, ImageFont

    title, caption = ImageFont.load_default(15), ImageFont.load_default(12)
    ruler = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    laid: list[tuple[int, int, Any]] = []
    y, width = GAP, 0
    for row in rows:
        pictures = [_small(picture) for pair in row.pairs for picture in (pair.before, pair.after)]
        told = [text for pair in row.pairs for text in ("before", f"after, {pair.caption}" if pair.caption else "after")]
        room = sum(picture.width + GAP for picture in pictures)
        lines = _wrapped(row.title, title, max(room, 320), ruler)
        for line in lines:
            laid.append((GAP, y, (line, title)))
            width = max(width, GAP + int(ruler.textlength(line, font=title)))
            y += TITLE
        x, deepest = GAP, 0
        for picture, text in zip(pictures, told, strict=True):
            laid += [(x, y, picture), (x, y + picture.height + 1, (text, caption))]
            x += picture.width + GAP
            deepest = max(deepest, picture.height)
        width, y = max(width, x), y + deepest + CAPTION + GAP
    sheet = Image.new("RGB", (width + GAP, y), "white")
    draw = ImageDraw.Draw(sheet)
    for x, y, what in laid:
        if isinstance(what, tuple):
            draw.text((x, y), what[0], fill="black", font=what[1])
        else:
            sheet.paste(what, (x, y))
    return np.asarray(sheet)


def _small(picture: Array) -> Any:
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture))
    image.thumbnail((LARGEST, LARGEST))
    return image


def _wrapped(text: str, font: Any, width: int, ruler: Any) -> list[str]:
    """Break a text into lines of at most `width` pixels, at spaces."""
    lines = [""]
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and ruler.textlength(longer, font=font) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines
