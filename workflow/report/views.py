"""The views in the report: their order from worst to best, and each photograph next to its re-rendering."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from workflow.artifacts.store import rgb
from workflow.report import pictures as pic
from workflow.report.page import Pair, Picture
from workflow.report.reported import Reported
from workflow.scene.normal_form import View

HERO_WIDTH, PAIR_WIDTH = 768, 288
"""Longest side of the first picture, and of the pairs of all views. With six views and photographs as noisy as those of a phone
the page stays below 15 MB."""
PAIRS = 60
"""Largest number of photographs that are shown next to their re-rendering; of more, this many are taken evenly."""


def psnr_of_views(metrics: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return view -> PSNR of its re-rendering in dB, of those that were scored, from metrics.parquet."""
    of_photographs = np.char.startswith(metrics["quantity"].astype(str), "rgb")
    rows = of_photographs & (metrics["metric"] == "psnr") & (metrics["protocol"] == "raw")
    return {str(view): float(value) for view, value in zip(metrics["view"][rows], metrics["value"][rows], strict=True)}


def ranked(views: Iterable[View], scores: Mapping[str, float]) -> list[View]:
    """Return the views from worst to best; those without a score come last."""
    return sorted(views, key=lambda view: (scores.get(view.name, np.inf), view.view_id))


def spread(views: Sequence[View], count: int) -> list[View]:
    """Return up to `count` of the views, evenly spread, the first and the last among them."""
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))]


def hero_note(view: View, score: float | None) -> str:
    """Say which view the first picture shows; it is the median of all by its score in dB."""
    chosen = "" if score is None else f", the median of all by its score ({score:.1f} dB PSNR, sensor values)"
    return f"View {view.name}{chosen}"


def pairs_note(views: int, scored: Mapping[str, int]) -> str:
    """Say how the pairs are used, and how many of the views are among them. `scored`: `views` of summary.json."""
    text = "Drag over a picture, or use the arrow keys. The number is the PSNR of sensor values."
    if scored["scored"] < scored["of"]:
        text += f" {scored['scored']} of {scored['of']} views were scored (metrics.views)."
    return text + (f" {PAIRS} of {views} views, evenly spread from worst to best." if PAIRS < views else "")


def pair(scene: Reported, view: View, scores: Mapping[str, float], longest: int) -> Pair:
    """Return photograph and re-rendering of a view, no side longer than `longest` pixels."""
    pictures = photograph_and_rerendering(scene, view, sensor_values(scene, view)[0], longest)
    return Pair(view.name, *pictures, view.width, view.height, scores.get(view.name), view.split == "test")


def sensor_values(scene: Reported, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the photograph in sensor values (H, W, 3), and the pixels (H, W) of it that count."""
    photo, valid = scene.capture.photo(view, held_out=True)
    return np.clip(view.exposure * photo, 0, 1) if scene.capture.is_hdr else photo, valid


def photograph_and_rerendering(scene: Reported, view: View, sensor: np.ndarray, longest: int) -> tuple[Picture, Picture]:
    """Return the pictures of the photograph, whose sensor values are given, and of its re-rendering."""
    kind, unit = ("srgb", "exposed radiance") if scene.capture.is_hdr else ("sensor", "sensor value")
    show = pic.linear if scene.capture.is_hdr else pic.encoded
    rendered = rgb(scene.readers["render"].exr(f"maps/{view.name}.exr"), "ldr")
    first, second = (
        Picture(title, pic.data_uri(show(image), longest=longest), "", kind, 0.0, 1.0, unit)
        for title, image in (("photograph", sensor), ("re-rendering", rendered))
    )
    return first, second
