"""The contact sheet: what every relighting changes, next to the room as it was found."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from workflow.relighting.inventory import Inventory
from workflow.settings.relight import name_of

Array = np.ndarray
GAP, TITLE, CAPTION, HEAD, LARGEST, LEAST_WIDTH = 6, 20, 18, 34, 384, 320
"""Pixels between pictures, of a line of a title, of a caption, of a line of the title of the sheet, of the longer side of a
picture, and of a relighting at least."""
AS_FOUND = "as found"
"""What is said of a relighting that changes nothing."""
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


def contact_sheet(rows: list[Row], title: str = "") -> Array:
    """Draw the relightings in the order of reading, (H, W, 3) uint8: each with its title, then pairs of pictures with captions.
    Relightings that fit next to one another share a line; the title of the sheet is at the top."""
    from PIL import Image, ImageDraw, ImageFont

    head, ruler = ImageFont.load_default(22), ImageDraw.Draw(Image.new("RGB", (1, 1)))
    blocks = [_block(row) for row in rows]
    widest = max(block.width for block in blocks)
    if len(blocks) > 1:
        widest = max(widest, PAIRS * min(block.width for block in blocks))
    placed: list[tuple[int, int, Any]] = []
    lines = _wrapped(title, head, widest - 2 * GAP, ruler) if title else []
    x, y, deepest = 0, HEAD * len(lines), 0
    for block in blocks:
        if x and x + block.width > widest:
            x, y, deepest = 0, y + deepest, 0
        placed.append((x, y, block))
        x, deepest = x + block.width, max(deepest, block.height)
    sheet = Image.new("RGB", (widest, y + deepest), "white")
    for number, line in enumerate(lines):
        ImageDraw.Draw(sheet).text((GAP, GAP + HEAD * number), line, fill="black", font=head)
    for left, top, block in placed:
        sheet.paste(block, (left, top))
    return np.asarray(sheet)


def _block(row: Row) -> Any:
    """One relighting as a picture of PIL."""
    from PIL import Image, ImageDraw, ImageFont

    title, caption = ImageFont.load_default(15), ImageFont.load_default(12)
    ruler = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    pictures = [_small(picture) for pair in row.pairs for picture in (pair.before, pair.after)]
    told = [text for pair in row.pairs for text in ("before", f"after, {pair.caption}" if pair.caption else "after")]
    width = max(sum(picture.width + GAP for picture in pictures), LEAST_WIDTH) + 2 * GAP
    lines = _wrapped(row.title, title, width - 2 * GAP, ruler)
    top = GAP + TITLE * len(lines)
    height = top + max(picture.height for picture in pictures) + CAPTION + GAP
    block = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(block)
    for number, line in enumerate(lines):
        draw.text((GAP, GAP + TITLE * number), line, fill="black", font=title)
    x = GAP
    for picture, text in zip(pictures, told, strict=True):
        block.paste(picture, (x, top))
        draw.text((x, top + picture.height + 1), text, fill="black", font=caption)
        x += picture.width + GAP
    return block


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


def described(entry: dict[str, Any], inventory: Inventory, names: Mapping[str, str] | None = None) -> str:
    """Describe what a dumped relighting changes, for captions; `names`: the setting."""
    parts, changes = [], {}
    if entry["emitters"] != 1:
        none = "" if inventory.lamps else " (there are none)"
        parts.append(f"{'all' if not entry['lamps'] else 'other'} lamps {_factor(entry['emitters'])}{none}")
    for key, lamp in entry["lamps"].items():
        told = [_factor(lamp["factor"])] if lamp["factor"] != 1 or not (lamp["colour"] or lamp["move"]) else []
        told += [f"colour {_numbers(lamp['colour'])}"] if lamp["colour"] else []
        told += [f"moved {_numbers(lamp['move'])} m"] if lamp["move"] else []
        changes[key] = ", ".join(told)
    parts += inventory.captions(changes)
    light = entry["environment"]
    if light != "keep":
        is_file = isinstance(light, str) and light != "off"
        shown = f"of {Path(light).name}" if is_file else _numbers(light) if isinstance(light, list) else _factor(light)
        parts.append(f"light from outside {shown}")
    if entry["sphere"]:
        parts.append("a luminous sphere" + (" that moves" if entry["sphere"]["path_to"] else ""))
    parts += [f"{name_of(insert)} put in" for insert in entry["insert"]]
    parts += [f"{name} painted" for name in dict.fromkeys((names or {}).get(key, key) for key in entry["materials"])]
    return "; ".join(parts) or AS_FOUND


def _factor(value: float | str) -> str:
    return {0: "off", 1: "on", "off": "off"}.get(value, f"x {value:g}" if not isinstance(value, str) else value)


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:g}" for value in values)
