"""How many digits of the result survive when its input moves by its own rounding, and what amplifies the movement.

Photographs, depths, mesh and cameras of a capture are moved by at most one unit in the last place of their formats, each number
up, down or not at all by chance; in other series the predictions are, which have half precision, and 8-bit photographs by at most
one grey level (linear ones by their rounding to half precision). Of each output the number of significant digits is
-log10(spread / |mean|) over the runs (Parker 1997). The amplification is the relative change of the output over the relative
change of what was moved.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.stability import chain
from lab.stability.chain import Capture, Result

RUNS = 30
ENOUGH = 3.0
"""Digits that are asked for."""
SHARE = 0.99
"""Of the pixels that must have them."""
MOST_DIGITS = 16.0


class Digits(NamedTuple):
    """Digits of one output of a stage in all runs.

    Attributes:
        room, moved: which capture, and what was moved; stage, column: the output.
        median, low: median over the pixels, and the digits that `SHARE` of them have; enough: share with `ENOUGH` digits.
        amplification: root mean square of the relative change, over the same of the input that was moved most.
    """

    room: str
    moved: str
    stage: str
    column: str
    median: float
    low: float
    enough: float
    amplification: float


class Flips(NamedTuple):
    """How often a decision came out otherwise than without a movement: in `count` of `of` cases over all runs."""

    room: str
    moved: str
    decision: str
    count: int
    of: int


def _ulp(values: NDArray, rng: np.random.Generator) -> NDArray:
    """Each number up, down or not at all to its neighbour; 0 stays, because 0 says something."""
    way = rng.integers(-1, 2, values.shape)
    bound = np.where(way > 0, np.inf, -np.inf).astype(values.dtype)
    return np.where((way == 0) | (values == 0), values, np.nextafter(values, bound)).astype(values.dtype)


def one_ulp(capture: Capture, rng: np.random.Generator) -> Capture:
    """Move photographs, depths, mesh and cameras by at most one unit in the last place."""
    rasters = {name: {view: _ulp(raster, rng) for view, raster in getattr(capture, name).items()} for name in ("photo", "depth")}
    views = []
    for view in capture.views:
        pose = view.world_from_camera.copy()
        pose[:3] = _ulp(pose[:3], rng)
        fx, fy, cx, cy = (float(value) for value in _ulp(np.array([view.fx, view.fy, view.cx, view.cy]), rng))
        views.append(replace(view, world_from_camera=pose, fx=fx, fy=fy, cx=cx, cy=cy))
    return replace(capture, views=tuple(views), vertices=_ulp(capture.vertices, rng), **rasters)


def half_ulp(capture: Capture, rng: np.random.Generator) -> Capture:
    """Move predictions by at most one unit in the last place of half precision; they stay in [0, 1]."""
    maps = {view: np.clip(_ulp(raster, rng), 0, 1).astype(raster.dtype) for view, raster in capture.maps.items()}
    return replace(capture, maps=maps)


def last_bit(capture: Capture, rng: np.random.Generator) -> Capture:
    """Move 8-bit photographs by at most one grey level, and linear ones by at most one unit of half precision."""
    if capture.facts["dynamic_range"] == "hdr":
        photo = {view: image * (1 + rng.integers(-1, 2, image.shape) * 2.0**-10) for view, image in capture.photo.items()}
    else:
        photo = {view: np.clip(image + rng.integers(-1, 2, image.shape) / 255, 0, 1) for view, image in capture.photo.items()}
    return replace(capture, photo={view: image.astype(np.float32) for view, image in photo.items()})


MOVEMENTS: dict[str, Callable[[Capture, np.random.Generator], Capture]] = {
    "photographs, mesh and cameras by one ulp": one_ulp,
    "predictions by one ulp (half precision)": half_ulp,
    "photographs by their last bit": last_bit,
}


def digits_of(values: NDArray) -> NDArray:
    """Return the significant digits (...) of runs (R, ...): -log10(spread / |mean|), between 0 and 16."""
    mean, spread = values.mean(0), values.std(0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = -np.log10(spread / np.abs(mean))
    return np.clip(np.where(spread == 0, MOST_DIGITS, np.where(mean == 0, 0.0, found)), 0.0, MOST_DIGITS)


def measure(room: str, runs: int = RUNS) -> Iterator[Digits | Flips]:
    """Run one of `chain.ROOMS` with input that is moved, in three series."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        capture = chain.make_capture(folder / "capture", chain.ROOMS[room])
        free = {**capture.document, "components": chain.document_of({**chain.ROOMS[room], "components": {}})["components"]}
        capture = replace(capture, document=free)  # what the plan decides belongs to the result here
        reference = chain.run(capture, folder / "reference")
        for moved, movement in MOVEMENTS.items():
            captures = [movement(capture, np.random.default_rng([13, run])) for run in range(runs)]
            by = max(
                np.sqrt(np.mean([_relative(getattr(one, of), getattr(capture, of)) ** 2 for one in captures]))
                for of in ("photo", "maps")
            )
            results = [chain.run(one, folder / "run") for one in captures]
            yield from _digits(room, moved, reference, results, float(by))
            alike = [result for result in results if result.lamps == reference.lamps]
            if 1 < len(alike) < len(results):
                yield from _digits(room, f"{moved}: {len(alike)} runs with the same lamps", reference, alike, float(by))
            yield from _flips(room, moved, reference, results)


def _relative(moved: Mapping[str, NDArray], before: Mapping[str, NDArray]) -> float:
    """Root mean square of the relative change of rasters where they are not dark."""
    a, b = (np.concatenate([np.asarray(of[name], np.float64).ravel() for name in before]) for of in (moved, before))
    lit = np.abs(b) > 1e-3 * np.abs(b).mean()
    return float(np.sqrt(np.mean(((a - b)[lit] / b[lit]) ** 2))) if lit.any() else 0.0


def _columns(result: Result) -> dict[tuple[str, str], NDArray]:
    """(stage, column) -> its values at all pixels that show an object, or the numbers of the scene."""
    seen = np.concatenate([result.seen[name].ravel() for name in result.maps])

    def of(rasters: Mapping[str, NDArray], channels: slice) -> NDArray:
        flat = np.concatenate([rasters[name].reshape(-1, rasters[name].shape[-1]) for name in result.maps])
        return flat[seen][:, channels].astype(np.float64).ravel()

    parts = {"albedo": slice(0, 3), "roughness": slice(3, 4), "metallic": slice(4, 5)}
    out = {("base", name): of(result.base, channels) for name, channels in parts.items()}
    out["emission", "power"] = result.power
    out["shading", "diffuse light"] = of(result.diffuse, slice(0, 3))
    return out | {("affines", name): of(result.maps, channels) for name, channels in parts.items()}


def _digits(room: str, moved: str, reference: Result, results: Sequence[Result], by: float) -> Iterator[Digits]:
    first, others = _columns(reference), [_columns(result) for result in results]
    for key, before in first.items():
        values = np.stack([columns[key] for columns in others])
        found = digits_of(values)
        known = np.abs(before) > 1e-3 * np.abs(before).mean() if len(before) else np.zeros(0, bool)
        change = np.sqrt(np.mean(((values - before)[:, known] / before[known]) ** 2)) if known.any() else 0.0
        low = float(np.quantile(found, 1 - SHARE))
        enough = float((found >= ENOUGH).mean())
        yield Digits(room, moved, *key, float(np.median(found)), low, enough, float(change / by) if by > 0 else 0.0)


def _flips(room: str, moved: str, reference: Result, results: Sequence[Result]) -> Iterator[Flips]:
    for name, value in reference.decisions.items():
        count = sum(result.decisions.get(name) != value for result in results)
        if count:
            yield Flips(room, moved, f"plan: {name}", count, len(results))
    yield Flips(room, moved, "which objects are lamps", sum(one.lamps != reference.lamps for one in results), len(results))
    count = sum(int((result.selected != reference.selected).sum()) for result in results)
    yield Flips(room, moved, "selected predictions", count, reference.selected.size * len(results))
    metal = [_metal(result) for result in results]
    before = _metal(reference)
    yield Flips(room, moved, "pixels of metal", sum(int((one != before).sum()) for one in metal), before.size * len(results))
    families = [result.documents["emission"]["response"]["family"] for result in (reference, *results)]
    yield Flips(room, moved, "family of the response", sum(one != families[0] for one in families[1:]), len(results))


def _metal(result: Result) -> NDArray:
    return np.concatenate([(result.maps[name][..., 4] > 0.5)[result.seen[name]] for name in result.maps])
