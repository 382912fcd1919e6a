"""Checks of relightings. They run before any job, as far as the stages that they need are finished."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts.files import facts_in
from workflow.relighting.inserts import light_of, load_insert
from workflow.relighting.inventory import Inventory, Problems, check_places, check_views
from workflow.relighting.video import require_codec
from workflow.scene.named import finished
from workflow.scene.normal_form import CaptureReader
from workflow.settings import relight_origin
from workflow.settings.relight import require_relighting


def check_relightings(document: dict[str, Any], scene: str, quality: str) -> None:
    """Check everything that relightings name as far as it is known before their jobs run, so that a mistake stops at once.

    Args:
        document: dumped settings of the scene.
        scene: whose finished stages are looked at; quality: of its settings.

    Raises:
        InputError: lamps, objects or views do not exist, something is far from the room, a mesh cannot be read, or a codec is not
            there; one line for each.
    """
    entries = require_relighting(document, scene)
    with blamed_on_plan(scene):
        _check(entries, scene, quality, document.get("names", {}))


@contextmanager
def blamed_on_plan(scene: str) -> Iterator[None]:
    """Let messages about relightings of a scene, one a line, begin with the file that lists them."""
    try:
        yield
    except InputError as error:
        where = relight_origin(scene)
        raise InputError("\n".join(f"{where}: {line}" for line in str(error).splitlines())) from None


def _left_out(capture: CaptureReader, scene: str) -> dict[str, str]:
    """Return the photographs that are no views -> why."""
    of_photographs = capture.facts.get("source") == "photographs"
    alone = facts_in(Path("results") / scene / "reconstruction/reconstruction.json") if of_photographs else {}
    placed_nowhere = {Path(name).stem: why for name, why in alone.get("left_out", {}).items()}
    return placed_nowhere | capture.facts.get("dropped_views", {}) | capture.facts.get("left_out_views", {})


def _check(entries: list[dict[str, Any]], scene: str, quality: str, names: dict[str, str]) -> None:
    capture, segmentation, emission = (finished(stage, scene, quality) for stage in ("capture", "segmentation", "emission"))
    photographed = CaptureReader(capture) if capture is not None else None
    inventory = None
    if segmentation is not None and emission is not None:
        inventory = Inventory.read(segmentation, emission, names)
    vertices = photographed.mesh()[0] if photographed else None
    left_out = _left_out(photographed, scene) if photographed else {}
    problems = Problems()
    for entry in entries:
        with problems.caught():
            if entry["video"] and entry["camera"]["frames"] > 1:
                require_codec(entry["video"]["codec"], entry["name"])
        for insert in entry["insert"]:
            with problems.caught():
                light_of(load_insert(Path(insert["file"])), insert)
        if photographed:
            with problems.caught():
                check_views(entry, [view.name for view in photographed], left_out)
            with problems.caught():
                check_places(entry, vertices.min(0), vertices.max(0))
        if inventory:
            with problems.caught():
                inventory.check(entry)
    problems.tell()
