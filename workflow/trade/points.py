"""The qualities of the measured front and what they scored (points.json, from the study `tradeoff`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from workflow.settings.names import QUALITIES, REPOSITORY, configuration
from workflow.settings.yaml_file import read_yaml

SHIPPED = Path(__file__).with_name("points.json")
SCORES = {"albedo": ("albedo", "psnr", "scaled"), "held_out": ("rgb", "psnr", "raw")}
"""Name of a score -> its quantity, metric and protocol in the table of the study `tradeoff`, in dB."""
MEASURED_AS = {"albedo": ("albedo", "psnr", "scaled"), "held_out": ("rgb_held_out", "psnr", "raw")}
"""The same in the metrics of a scene."""
WORDS = {
    "albedo": "albedo, after one gain for each image and channel",
    "held_out": "photographs that nothing was fitted to, re-rendered",
}


class Expected(NamedTuple):
    """A score of a quality: mean over the rooms of the study, the smallest and the largest."""

    mean: float
    low: float
    high: float


class Point(NamedTuple):
    """A point of the front; `rooms` maps rooms of the study to what it scored and cost there."""

    name: str
    rooms: Mapping[str, Mapping[str, float]]

    def expected(self, score: str) -> Expected:
        values = [of_room[score] for of_room in self.rooms.values()]
        return Expected(sum(values) / len(values), min(values), max(values))


@lru_cache(None)
def points(path: Path = SHIPPED) -> dict[str, Point]:
    """Return the points, the cheapest first."""
    document = json.loads(path.read_text())
    return {name: Point(name, rooms) for name, rooms in document["points"].items()}


def named() -> dict[str, str]:
    """Return `draft`, ... -> the point that it stands for; one that is no point of the front, or more than one, is not in it."""
    settings = {quality: read_yaml(configuration(f"quality/{quality}.yaml")) for quality in QUALITIES}
    return {quality: document["quality"] for quality, document in settings.items() if set(document) == {"quality"}}


def point_of(quality: str) -> Point | None:
    """Return the point of a quality; None for one that was not measured, such as a file of the working folder's own."""
    name = named().get(quality, quality)
    file = configuration(f"quality/{name}.yaml")
    return points().get(name) if file.resolve().is_relative_to(REPOSITORY) else None


def bench_points() -> list[str]:
    """Return the three points that `bench` runs: the cheapest, and those a third and two thirds of the way along the front."""
    names = list(points())
    return list(dict.fromkeys(names[round(share * (len(names) - 1))] for share in (0.0, 1 / 3, 2 / 3)))


def measured_scores(summary: Mapping[str, Any]) -> dict[str, float]:
    """Return the scores of a scene by name, from the document metrics/summary.json; those that it cannot have are left out."""
    result, out = summary["means"].get("result", {}), {}
    for name, (quantity, metric, protocol) in MEASURED_AS.items():
        found = result.get(quantity, {}).get(protocol, {}).get(metric)
        if found:
            out[name] = float(found["mean"])
    return out
