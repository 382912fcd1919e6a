"""The size of a scene, counted in its finished capture, or estimated before that from settings and headers of files."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from workflow import plugins
from workflow.costs.work import SceneSize
from workflow.intake.pictures import EXTRAS, PHOTOGRAPHS, RAW

MESHES = (".ply", ".obj", ".glb", ".serialized")
BYTES_PER_FACE = 36
"""Of a mesh whose header does not say how many faces it has: a guess between binary and text, which is good enough because costs
grow slowly with faces."""


def size_of_capture(manifest: dict[str, Any]) -> SceneSize:
    """Return the size of a scene from the manifest of its stage `capture`."""
    files = manifest["files"]
    photographs = [entry["shape"] for name, entry in files.items() if name.startswith("photos/")]
    return SceneSize(
        views=files["cameras.parquet"]["shape"][0],
        pixels=float(sum(math.prod(shape[:2]) for shape in photographs)),
        faces=float(files["faces.parquet"]["shape"][0]),
        exact=True,
    )


def estimate(document: dict[str, Any], files: list[Path]) -> SceneSize:
    """Return the size that a scene will have.

    Args:
        document: all settings, as plain values.
        files: that its capture reads.
    """
    source, capture = document["source"], document["capture"]
    box = capture["width"], capture["height"]
    bytes_ = {path: path.stat().st_size for path in files if path.is_file()}
    faces = sum(_faces(path, size) for path, size in bytes_.items() if path.suffix.lower() in MESHES)
    rendered = plugins.function("SIZES", source["kind"])
    if rendered:
        return SceneSize(capture["views"], float(capture["views"] * box[0] * box[1]), rendered(source, faces))
    images = [path for path in bytes_ if path.suffix.lower() in PHOTOGRAPHS + RAW and not _is_extra(path)]
    views = min(capture["views"], max(len(images), 1))
    width, height = _picture(images[0], box) if images else box
    scale = min(1.0, box[0] / width, box[1] / height)
    pixels = views * max(round(width * scale), 1) * max(round(height * scale), 1)
    unplaced = min(len(images), source["most"]) if source["kind"] == "photographs" else 0
    return SceneSize(views, float(pixels), faces, sum(bytes_.values()) / 1e6, photographs=unplaced)


def _is_extra(path: Path) -> bool:
    """Return whether a picture lies in a folder of truth, masks and the like, next to the photographs."""
    return not EXTRAS.isdisjoint((path.parent.name, path.parent.parent.name))


def _faces(path: Path, size: int) -> float:
    with path.open("rb") as file:
        found = re.search(rb"element face (\d{1,12})\s", file.read(4096)) if path.suffix.lower() == ".ply" else None
    return min(float(found[1]), size / 3) if found else size / BYTES_PER_FACE


def _picture(path: Path, box: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of a picture from its header; the size that is asked for where that cannot be read."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.size
    except (OSError, ValueError, Image.DecompressionBombError):
        return box
