"""Reads what is inside of room.html, without the code that wrote it or shows it."""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

BLOCK = re.compile(r'<script id="data-([\w-]+)" type="application/octet-stream" ([^>]*)>([^<]*)</script>')
TYPES = {"Uint8Array": "<u1", "Uint16Array": "<u2", "Uint32Array": "<u4"}


@dataclass
class RoomPage:
    """Content of the page: `document` as viewer.js reads it; `arrays` (items, components); `pictures` (H, W, 3) uint8."""

    text: str
    document: dict[str, Any]
    arrays: dict[str, np.ndarray]
    pictures: dict[str, np.ndarray]

    @property
    def light(self) -> np.ndarray:
        """(texels, lamps, 3) float64 radiance of a white surface, before the colours of the lamps."""
        lamps = self.document["lamps"]
        halves = self.arrays["light"].astype("<u2").view("<f2").astype(np.float64).reshape(-1, len(lamps), 3)
        return halves * np.array([lamp["scale"] for lamp in lamps])[:, None]

    def picture_of(self, values: np.ndarray) -> np.ndarray:
        """(S, S, 3) light map with the values (texels, 3) at the stored texels and 0 elsewhere."""
        size = self.document["light"]["size"]
        out = np.zeros((size * size, 3))
        out[self.arrays["texels"][:, 0]] = values
        return out.reshape(size, size, 3)


def read_room(path: Path) -> RoomPage:
    text = Path(path).read_text(encoding="utf-8")
    document = json.loads(re.search(r'<script id="scene" type="application/json">(.*?)</script>', text, re.S)[1])
    arrays, pictures = {}, {}
    for name, attributes, data in BLOCK.findall(text):
        facts = dict(re.findall(r'data-(\w+)="([^"]*)"', attributes))
        raw = base64.b64decode(data)
        if facts["kind"] == "array":
            kind = np.dtype(TYPES[facts["type"]])
            planes = np.frombuffer(zlib.decompress(raw), np.uint8).reshape(kind.itemsize, -1)
            steps = np.ascontiguousarray(planes.T).view(kind).reshape(int(facts["components"]), int(facts["items"]))
            arrays[name] = np.cumsum(steps, axis=1, dtype=kind).T
        else:
            pictures[name] = np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"))
    return RoomPage(text, document, arrays, pictures)


def bilinear(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values (n, C) of a picture (S, S, C) at texture coordinates (n, 2), interpolated as a graphics card does."""
    size = np.array([picture.shape[1], picture.shape[0]])
    at = np.clip(np.asarray(uv) * size - 0.5, 0, size - 1)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, size - 1)
    (fx, fy), out = (at - low).T, 0
    for column, wx in ((low[:, 0], 1 - fx), (high[:, 0], fx)):
        for row, wy in ((low[:, 1], 1 - fy), (high[:, 1], fy)):
            out = out + (wx * wy)[:, None] * picture[row, column]
    return out
