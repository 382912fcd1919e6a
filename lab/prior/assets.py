"""Pictures from outside that rooms may use: colour textures with roughness, and maps of the light outside windows.

They are optional. A folder has `textures/` (colour as `*_diff`, `*_color`, `*_base_color`, `*_basecolor` or without such an
ending; roughness under the same stem as `*_rough` or `*_roughness`) and `hdri/*.exr` (latitude-longitude, linear, row 0 up).
`save` writes what is read into one file, which also serves machines that cannot read EXR. Licences are those of the files;
nothing of them is in this repository.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

SKY = (64, 128)
"""Height and width to which maps of the light outside are reduced."""
STORED = 160
"""Pixels along the shorter side of a texture in the file that `save` writes."""
_COLOUR = re.compile(r"_(diff|color|base_color|basecolor)$")
_NO_COLOUR = re.compile(r"_(rough|roughness|metal|metallic|metalness|mask|nor|normal|disp|thumbnail)$|mask|thumbnail")


@dataclass(frozen=True)
class Measured:
    """A measured material: linear base colour (3,), perceptual roughness and metallic in [0, 1]."""

    name: str
    base_color: tuple[float, float, float]
    roughness: float
    metallic: float


@dataclass(frozen=True)
class Assets:
    """Textures and light from outside; both may be empty.

    Attributes:
        names: of the textures.
        textures: each (H, W, 4) uint8: colour (sRGB-encoded) and roughness (linear), 128 everywhere where none is known.
        skies: each (64, 128, 3) float32 radiance, linear, relative.
    """

    names: tuple[str, ...] = ()
    textures: tuple[np.ndarray, ...] = ()
    skies: tuple[np.ndarray, ...] = ()

    def save(self, path: Path) -> None:
        """Write one file that `load` reads."""
        arrays = {f"texture_{name}": _encoded(texture) for name, texture in zip(self.names, self.textures, strict=True)}
        arrays |= {f"sky_{i:03d}": np.minimum(sky, 6e4).astype(np.float16) for i, sky in enumerate(self.skies)}
        np.savez_compressed(path, **arrays)


@lru_cache(1)
def measured_materials() -> tuple[Measured, ...]:
    """Read the table of measured materials (`measured.csv`, from physicallybased.info, CC0)."""
    with open(Path(__file__).with_name("measured.csv"), newline="") as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    return tuple(Measured(n, (float(r), float(g), float(b)), float(rough), float(metal)) for n, r, g, b, rough, metal in rows[1:])


def load(path: Path | None) -> Assets:
    """Read a folder of assets, or a file that `Assets.save` wrote; None = no assets.

    Raises:
        FileNotFoundError: nothing is there.
    """
    if path is None:
        return Assets()
    path = Path(path)
    if path.is_dir():
        return _from_folder(path)
    with np.load(path) as file:
        names = [key for key in file.files if key.startswith("texture_")]
        skies = sorted(key for key in file.files if key.startswith("sky_"))
        return Assets(
            tuple(name.removeprefix("texture_") for name in names),
            tuple(_decoded(file[name]) for name in names),
            tuple(file[key].astype(np.float32) for key in skies),
        )


def _from_folder(folder: Path) -> Assets:
    from PIL import Image

    def picture(path: Path, mode: str) -> np.ndarray:
        image = Image.open(path).convert(mode)
        factor = STORED / min(image.size)
        return np.asarray(image.resize([max(STORED, round(s * factor)) for s in image.size], Image.Resampling.BOX))

    files = {p.stem: p for p in sorted((folder / "textures").glob("*.jpg")) + sorted((folder / "textures").glob("*.png"))}
    names, textures = [], []
    for stem, path in files.items():
        if _NO_COLOUR.search(stem):
            continue
        base = _COLOUR.sub("", stem)
        rough = next((files[base + end] for end in ("_rough", "_roughness") if base + end in files), None)
        colour = picture(path, "RGB")
        alike = rough is not None and (layer := picture(rough, "L")).shape == colour.shape[:2]
        textures.append(np.dstack([colour, layer if alike else np.full(colour.shape[:2], 128, np.uint8)]))
        names.append(base)
    skies = tuple(_sky(path) for path in sorted((folder / "hdri").glob("*.exr")))
    if not names and not skies:
        raise FileNotFoundError(f"{folder}: neither textures/*.jpg nor hdri/*.exr; name a folder that has them, or none")
    return Assets(tuple(names), tuple(textures), skies)


def _encoded(texture: np.ndarray) -> np.ndarray:
    """A texture as bytes: the length of the first of two JPEG pictures in four bytes, then colour and roughness."""
    from PIL import Image

    parts = []
    for image in (texture[..., :3], texture[..., 3]):
        buffer = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(image)).save(buffer, "JPEG", quality=92)
        parts.append(buffer.getvalue())
    return np.frombuffer(len(parts[0]).to_bytes(4, "little") + parts[0] + parts[1], np.uint8)


def _decoded(stored: np.ndarray) -> np.ndarray:
    from PIL import Image

    data = stored.tobytes()
    end = 4 + int.from_bytes(data[:4], "little")
    colour, rough = (np.asarray(Image.open(io.BytesIO(part))) for part in (data[4:end], data[end:]))
    return np.dstack([colour, rough])


def _sky(path: Path) -> np.ndarray:
    """Read a map and average it to SKY, so that no light is lost."""
    import OpenEXR

    with OpenEXR.File(str(path)) as file:
        image = np.asarray(file.channels()["RGB"].pixels, np.float32)[..., :3]
    height, width = SKY
    rows, columns = image.shape[0] // height, image.shape[1] // width
    if not (rows and columns and rows * height == image.shape[0] and columns * width == image.shape[1]):
        raise ValueError(f"{path}: {image.shape[1]} x {image.shape[0]} pixels; a multiple of {width} x {height} is needed")
    return np.maximum(np.nan_to_num(image), 0).reshape(height, rows, width, columns, 3).mean((1, 3))
