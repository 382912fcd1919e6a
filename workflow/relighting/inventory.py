"""What a relighting can name in a room: its lamps, its objects and its views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts import StageReader
from workflow.relighting.inserts import load_insert
from workflow.scene.named import finished, names_of, object_number
from workflow.settings.names import did_you_mean
from workflow.settings.relight import name_of, require_relighting


@dataclass(frozen=True)
class Lamp:
    """An emitter that was kept: its id in emitters.parquet, and the objects that its faces belong to."""

    emitter_id: int
    objects: tuple[int, ...]


@dataclass(frozen=True)
class Inventory:
    """Names of a room; `names` has one entry per object id."""

    names: list[str]
    lamps: list[Lamp]

    @staticmethod
    def read(segmentation: StageReader, emission: StageReader) -> Inventory:
        """Read the lamps that stage emission kept, and the objects of the segmentation."""
        table, faces = emission.table("emitters.parquet"), emission.table("emitter_faces.parquet")
        object_id = segmentation.table("faces.parquet")["object_id"]
        lamps = []
        for emitter in table["emitter_id"][table["kept"].astype(bool) & (table["kind"] == "area")]:
            own = np.unique(object_id[faces["face_id"][faces["emitter_id"] == emitter]])
            lamps.append(Lamp(int(emitter), tuple(int(o) for o in own if o >= 0)))
        return Inventory(names_of(segmentation), lamps)

    def name_of(self, lamp: Lamp) -> str:
        """Return the names of the objects that a lamp is on, or its number where it is on none."""
        return " + ".join(self.names[o] for o in lamp.objects) or f"lamp {lamp.emitter_id}"

    def lamps_called(self, key: str, where: str) -> list[int]:
        """Return the places in `lamps` that a key of the settings means: one by its id, or all on objects of that name.

        Raises:
            InputError: there is no such lamp, or the object does not shine; `where` is the setting, for the message.
        """
        by_name = [i for i, lamp in enumerate(self.lamps) if key in [self.names[o] for o in lamp.objects]]
        found = by_name or [i for i, lamp in enumerate(self.lamps) if key == str(lamp.emitter_id)]
        if found:
            return found
        there = ", ".join(f"{lamp.emitter_id} ({self.name_of(lamp)})" for lamp in self.lamps[:8]) or "none"
        hint = did_you_mean(key, [self.names[o] for lamp in self.lamps for o in lamp.objects], "{!r}")
        what = f"object {key!r} does not shine" if key in self.names else f"there is no lamp {key!r}"
        raise InputError(f"{where}: {what}.{hint} Lamps of this room: {there}; ids are those of emitters.parquet")

    def check(self, entry: dict[str, Any]) -> None:
        """Check the lamps and objects that a dumped relighting names.

        Raises:
            InputError: one does not exist, or is named twice.
        """
        where, seen = f"relight.{{}} of {entry['name']}", {}
        for key in entry["lamps"]:
            for lamp in self.lamps_called(key, where.format("lamps")):
                if lamp in seen:
                    raise InputError(
                        f"{where.format('lamps')}: {key!r} and {seen[lamp]!r} are the same lamp,"
                        f" {self.lamps[lamp].emitter_id}; remove one of the two"
                    )
                seen[lamp] = key
        for key in entry["materials"]:
            object_number(key, self.names, where.format("materials"))


def check_views(entry: dict[str, Any], names: Iterable[str]) -> None:
    """Check the views that a dumped relighting names.

    Raises:
        InputError: one does not exist.
    """
    known = list(names)
    for name in entry["camera"]["views"]:
        if name not in known:
            raise InputError(
                f"`relight.camera.views` of {entry['name']}: found {name}; the views are"
                f" {', '.join(known[:8])}{' ...' if len(known) > 8 else ''}.{did_you_mean(name, known)}"
            )


def check_relightings(document: dict[str, Any], scene: str, quality: str) -> None:
    """Check everything that relightings name as far as it is known before their jobs run, so that a mistake stops at once.

    Args:
        document: dumped settings of the scene.
        scene: whose finished stages are looked at; quality: of its settings.

    Raises:
        InputError: a lamp, an object or a view does not exist, a mesh cannot be read, or a codec is not there.
    """
    from workflow.relighting.video import require_codec

    entries = require_relighting(document, scene)
    capture, segmentation, emission = (finished(stage, scene, quality) for stage in ("capture", "segmentation", "emission"))
    for entry in entries:
        if entry["video"] and entry["camera"]["frames"] > 1:
            require_codec(entry["video"]["codec"], entry["name"])
        for insert in entry["insert"]:
            load_insert(Path(insert["file"]))
        if capture is not None:
            check_views(entry, map(str, capture.table("cameras.parquet")["name"]))
        if segmentation is not None and emission is not None:
            Inventory.read(segmentation, emission).check(entry)


def described(entry: dict[str, Any], default: str = "as found") -> str:
    """Return what a dumped relighting changes, in words, for captions."""
    parts = []
    if entry["emitters"] != 1:
        parts.append(f"{'all' if not entry['lamps'] else 'other'} lamps {_factor(entry['emitters'])}")
    for key, lamp in entry["lamps"].items():
        told = [_factor(lamp["factor"])] if lamp["factor"] != 1 or not (lamp["colour"] or lamp["move"]) else []
        told += [f"colour {_numbers(lamp['colour'])}"] if lamp["colour"] else []
        told += [f"moved {_numbers(lamp['move'])} m"] if lamp["move"] else []
        parts.append(f"{key if not key.isdigit() else f'lamp {key}'} {', '.join(told)}")
    light = entry["environment"]
    if light != "keep":
        is_file = isinstance(light, str) and light != "off"
        shown = f"of {Path(light).name}" if is_file else _numbers(light) if isinstance(light, list) else _factor(light)
        parts.append(f"light from outside {shown}")
    if entry["sphere"]:
        parts.append("a luminous sphere" + (" that moves" if entry["sphere"]["path_to"] else ""))
    parts += [f"{name_of(insert)} put in" for insert in entry["insert"]]
    parts += [f"{key} painted" for key in entry["materials"]]
    return "; ".join(parts) or default


def _factor(value: float | str) -> str:
    return {0: "off", 1: "on", "off": "off"}.get(value, f"x {value:g}" if not isinstance(value, str) else value)


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:g}" for value in values)
