"""What a relighting can name in a room: its lamps, its objects and its views."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import luminance
from workflow.artifacts import StageReader
from workflow.scene.named import OUTSIDE, object_names, object_number, renamed
from workflow.settings.names import did_you_mean

Array = np.ndarray

MOST_EACH = 12
"""Lamps of which a relighting with `each` makes pictures."""


@dataclass(frozen=True)
class Lamp:
    """An emitter that was kept: its id in emitters.parquet, the objects that its faces belong to, those with most of them first,
    its power, in W up to a factor that all share, and its name by where it is, which the panes of a window share."""

    emitter_id: int
    objects: tuple[int, ...]
    power: float = 0.0
    name: str = ""


@dataclass(frozen=True)
class Inventory:
    """Names of a room.

    Attributes:
        names: one per object id, as the segmentation gives them.
        lamps: that were kept.
        shown: the same as people see them (setting `names`); empty where none has another name.
    """

    names: list[str]
    lamps: list[Lamp]
    shown: Sequence[str] = ()

    @staticmethod
    def read(segmentation: StageReader, emission: StageReader, wanted: Mapping[str, str]) -> Inventory:
        """Read the lamps that stage emission kept, and the objects of the segmentation; `wanted` is the setting `names`."""
        table, faces = emission.table("emitters.parquet"), emission.table("emitter_faces.parquet")
        object_id = segmentation.table("faces.parquet")["object_id"]
        lamps = []
        sides = np.where(table["side"] == 0, 2, 1)
        power = luminance(np.stack([table[f"radiance_{c}"] for c in "rgb"], 1)) * table["area_m2"] * sides
        for row in np.flatnonzero(table["kept"].astype(bool) & (table["kind"] == "area")):
            emitter = int(table["emitter_id"][row])
            own, count = np.unique(object_id[faces["face_id"][faces["emitter_id"] == emitter]], return_counts=True)
            own = own[np.argsort(-count, kind="stable")]
            lamps.append(Lamp(emitter, tuple(int(o) for o in own if o >= 0), float(power[row]), str(table["name"][row])))
        names = object_names(segmentation)
        return Inventory(names, lamps, renamed(names, wanted))

    def name_of(self, lamp: Lamp) -> str:
        """Return the object that most of a lamp is on, and how many more it is on; or its number where it is on none."""
        if not lamp.objects:
            return f"lamp {lamp.emitter_id}"
        more = f" and {len(lamp.objects) - 1} more" if len(lamp.objects) > 1 else ""
        return f"{(self.shown or self.names)[lamp.objects[0]]}{more}"

    def called(self, lamp: Lamp) -> str:
        """Return what people call a lamp: its name by where it is, or else what it is on."""
        return lamp.name or self.name_of(lamp)

    @property
    def by_name(self) -> dict[str, list[Lamp]]:
        """The lamps by what people call them, which the panes of a window share."""
        out: dict[str, list[Lamp]] = {}
        for lamp in self.lamps:
            out.setdefault(self.called(lamp), []).append(lamp)
        return out

    def is_called(self, number: int, key: str) -> bool:
        """Return whether a key of the settings is the name of an object, as people see it or as the segmentation gave it."""
        return key == self.names[number] or key in self.shown[number : number + 1]

    def lamps_called(self, key: str, where: str) -> list[int]:
        """Return the places in `lamps` that a key of the settings means: one by its id (`emitter 5`, or `5` where no object is
        called so), all of that name (`window 1`), one as `name_of` calls it, or all on objects of that name.

        Raises:
            InputError: there is no such lamp, the object does not shine, or the key means different lamps by place and by object;
                `where` is the setting, for the message.
        """
        exact = re.fullmatch(r"emitter (\d+)", key)
        if exact and any(lamp.emitter_id == int(exact[1]) for lamp in self.lamps):
            return [i for i, lamp in enumerate(self.lamps) if lamp.emitter_id == int(exact[1])]
        placed = [i for i, lamp in enumerate(self.lamps) if lamp.name == key]
        called = [i for i, lamp in enumerate(self.lamps) if lamp.objects and key == self.name_of(lamp)]
        on_object = called or [i for i, lamp in enumerate(self.lamps) if any(self.is_called(o, key) for o in lamp.objects)]
        if placed and on_object and placed != on_object:
            ids = [f"emitter {self.lamps[i].emitter_id}" for i in sorted({*placed, *on_object})]
            raise InputError(
                f"{where}: {key!r} is the name of a lamp, and of an object on which others are; use {', '.join(ids)}"
            )
        found = placed or on_object or [i for i, lamp in enumerate(self.lamps) if key == str(lamp.emitter_id)]
        if found:
            return found
        listed = [
            f"{name} (emitter {', '.join(str(lamp.emitter_id) for lamp in members)})" for name, members in self.by_name.items()
        ]
        there = f"{', '.join(listed[:8])}; the report lists them" if listed else "none"
        if key == OUTSIDE:
            raise InputError(f"{where}: {key!r} is no lamp; `environment` switches and dims it: `environment: off`")
        known = [(self.shown or self.names)[o] for lamp in self.lamps for o in lamp.objects]
        hint = did_you_mean(key, [*known, *(lamp.name for lamp in self.lamps if lamp.name)], "{!r}")
        is_there = any(self.is_called(o, key) for o in range(len(self.names)))
        what = f"object {key!r} does not shine" if is_there else f"there is no lamp {key!r}"
        raise InputError(f"{where}: {what}.{hint} Lamps of this room: {there}")

    def captions(self, changes: Mapping[str, str]) -> list[str]:
        """Return what happens to which lamps as people call them: by name where all of that name change alike (`window 1 off`),
        else with the emitters that do (`ceiling light 1 (emitter 2) off`); `changes`: key of the settings -> what changes."""
        members = self.by_name
        told: dict[tuple[str, str], list[int]] = {}
        for key, change in changes.items():
            for lamp in (self.lamps[i] for i in self.lamps_called(key, "relight.lamps")):
                told.setdefault((self.called(lamp), change), []).append(lamp.emitter_id)
        out = []
        for (name, change), some in told.items():
            ids = ", ".join(f"emitter {one}" for one in sorted(some))
            out.append(f"{name}{'' if len(some) == len(members[name]) else f' ({ids})'} {change}")
        return out

    def expanded(self, entries: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return dumped relightings, those with `each` as one for each of the strongest lamps, the strongest first."""
        of_name: dict[str, list[Lamp]] = {}
        for lamp in self.lamps:
            of_name.setdefault(lamp.name or str(lamp.emitter_id), []).append(lamp)
        strongest = sorted(of_name.items(), key=lambda item: -sum(lamp.power for lamp in item[1]))[:MOST_EACH]
        out = []
        for entry in entries:
            if not entry["each"]:
                out.append(entry)
                continue
            rest, own = (0.0, 1.0) if entry["each"] == "alone" else (1.0, 0.0)
            outside = "off" if entry["each"] == "alone" and entry["environment"] == "keep" else entry["environment"]
            for called, members in strongest:
                # By id, which means one lamp however objects are called.
                change = {"factor": own, "colour": None, "move": None}
                lamps = {f"emitter {lamp.emitter_id}": change for lamp in members}
                name = f"{entry['name']}_{called.replace(' ', '_')}"
                out.append(entry | {"name": name, "each": None, "emitters": rest, "lamps": lamps, "environment": outside})
        return out

    def check(self, entry: dict[str, Any]) -> None:
        """Check the lamps and objects that a dumped relighting names.

        Raises:
            InputError: some do not exist, or are named twice; one line for each.
        """
        where, seen = f"relight.{{}} of {entry['name']}", {}
        problems = Problems()
        for key in entry["lamps"]:
            with problems.caught():
                for lamp in self.lamps_called(key, where.format("lamps")):
                    if lamp in seen:
                        raise InputError(
                            f"{where.format('lamps')}: {key!r} and {seen[lamp]!r} are the same lamp,"
                            f" {self.lamps[lamp].emitter_id}; remove one of the two"
                        )
                    seen[lamp] = key
        for key in entry["materials"]:
            with problems.caught():
                object_number(key, self.names, where.format("materials"))
        problems.tell()


class Problems:
    """Collects what is wrong, to report all of it at once."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Go on after an `InputError` of the block."""
        try:
            yield
        except InputError as error:
            self.messages.append(str(error))

    def tell(self) -> None:
        """Raise one `InputError` with a line for each message, if there are any."""
        if self.messages:
            raise InputError("\n".join(self.messages))


def check_places(entry: dict[str, Any], low: Array, high: Array) -> None:
    """Check that what a dumped relighting puts somewhere is near the room, whose lowest and highest corners (3,) are given.

    Raises:
        InputError: something is further away from the room than the room is large.
    """
    camera, sphere = entry["camera"], entry["sphere"] or {}
    places = [(f"insert.{i}.position", one["position"]) for i, one in enumerate(entry["insert"])]
    places += [(f"camera.poses.{i}.position", one["position"]) for i, one in enumerate(camera["poses"])]
    places += [(f"sphere.{key}", sphere[key]) for key in ("center", "path_to") if sphere.get(key)]
    size, problems = float(np.linalg.norm(high - low)), Problems()
    for key, place in places:
        away = float(np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0)))
        if away > size:
            ends = " to ".join(f"[{', '.join(f'{x:.1f}' for x in np.round(end, 1) + 0.0)}]" for end in (low, high))
            problems.messages.append(
                f"relight.{key} of {entry['name']}: {list(place)} is {away:.0f} m away from the room, which reaches from"
                f" {ends} m; positions are in metres along the axes of the capture"
            )
    problems.tell()


def check_views(entry: dict[str, Any], names: Iterable[str], left_out: Mapping[str, str] | None = None) -> None:
    """Check the views that a dumped relighting names; `left_out`: photograph that is no view -> why.

    Raises:
        InputError: one does not exist.
    """
    known = list(names)
    for name in entry["camera"]["views"]:
        if name not in known:
            why = f", a photograph that was left out ({left_out[name]})" if left_out and name in left_out else ""
            raise InputError(
                f"relight.camera.views of {entry['name']}: found {name}{why}; the views are {', '.join(known[:8])}"
                f"{f' and {len(known) - 8} more' if len(known) > 8 else ''}.{'' if why else did_you_mean(name, known)}"
            )
