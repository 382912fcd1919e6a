"""What can be wrong with relightings, told before any job where the stages that know it are finished."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.relighting.inserts import light_of, load_insert
from workflow.relighting.inventory import Inventory, check_views
from workflow.relighting.video import require_codec
from workflow.scene.named import finished
from workflow.settings import relight_origin
from workflow.settings.relight import require_relighting


def check_relightings(document: dict[str, Any], scene: str, quality: str) -> None:
    """Check everything that relightings name as far as it is known before their jobs run, so that a mistake stops at once.

    Args:
        document: dumped settings of the scene.
        scene: whose finished stages are looked at; quality: of its settings.

    Raises:
        InputError: a lamp, an object or a view does not exist, a mesh cannot be read, or a codec is not there.
    """
    entries = require_relighting(document, scene)
    with blamed_on_plan(scene):
        _check(entries, scene, quality)


@contextmanager
def blamed_on_plan(scene: str) -> Iterator[None]:
    """Let messages about relightings of a scene begin with the file that lists them."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{relight_origin(scene)}: {error}") from None


def _check(entries: list[dict[str, Any]], scene: str, quality: str) -> None:
    capture, segmentation, emission = (finished(stage, scene, quality) for stage in ("capture", "segmentation", "emission"))
    for entry in entries:
        if entry["video"] and entry["camera"]["frames"] > 1:
            require_codec(entry["video"]["codec"], entry["name"])
        for insert in entry["insert"]:
            light_of(load_insert(Path(insert["file"])), insert)
        if capture is not None:
            check_views(entry, map(str, capture.table("cameras.parquet")["name"]))
        if segmentation is not None and emission is not None:
            Inventory.read(segmentation, emission).check(entry)
