"""The light that stage shading cached: diffuse for every pixel, specular for those that are read (docs/method/shading.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.errors import InputError
from iif_core.light.shading import PixelLight
from iif_core.surface.shading_cells import DiffuseShading, ShadingCells
from workflow.artifacts.store import StageReader, rgb, split_rgb
from workflow.runtime.job import Job
from workflow.scene.normal_form import View

UNITS = {f"half{half}_{lobe}": "relative" for half in range(2) for lobe in ("s0", "s1")}
"""Units of the columns of a table of specular light."""


@dataclass(frozen=True)
class SpecularLight:
    """Cached specular light of some pixels of a view.

    Attributes:
        index: (n,) flattened indices of the pixels, increasing.
        s0, s1: (2, n, J, 3) float32 in two independent halves, at the J roughness levels.
    """

    index: np.ndarray
    s0: np.ndarray
    s1: np.ndarray

    def at(self, index: np.ndarray) -> SpecularLight:
        """Return the light of some pixels, in their order.

        Raises:
            InputError: the light of a pixel was not traced.
        """
        place = np.minimum(np.searchsorted(self.index, index), max(len(self.index) - 1, 0))
        if len(index) and (not len(self.index) or (self.index[place] != index).any()):
            raise InputError(
                "shading.pixels: specular light was traced at fewer pixels than are read now; set `shading: {pixels: all}`"
            )
        return SpecularLight(index, self.s0[:, place], self.s1[:, place])

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns of the table of a view."""
        lobes = {f"half{h}_{name}": value[h] for h in range(2) for name, value in (("s0", self.s0), ("s1", self.s1))}
        width = 3 * self.s0.shape[2]  # a view may have no pixels here
        flat = {name: value.reshape(len(self.index), width).astype(np.float32) for name, value in lobes.items()}
        return {"index": self.index.astype(np.int32), **flat}


def table_of(view: View) -> str:
    """Return the name of the table of a view in stage shading."""
    return f"pixels/{view.name}.parquet"


def read_specular(job: Job, view: View) -> SpecularLight:
    """Read the specular light of the pixels of a view at which it was traced."""
    table = job.read("shading").table(table_of(view))
    index = table["index"]

    def lobes(name: str) -> np.ndarray:
        halves = np.stack([table[f"half{h}_{name}"] for h in range(2)])
        return halves.reshape(2, len(index), halves.shape[2] // 3, 3)

    return SpecularLight(index.astype(np.int64), lobes("s0"), lobes("s1"))


def has_lobes(job: Job) -> bool:
    """Return whether specular lobes were traced; without them, the light of a pixel is as if it came from everywhere alike."""
    return _included(job.read("shading"), "specular")


def ends_in_cache(shading: StageReader) -> bool:
    """Return whether the paths of the cached light ended in photographed radiance."""
    return _included(shading, "radiance_cache")


def _included(shading: StageReader, component: str) -> bool:
    plan = shading.json("shading.json")["plan"]
    return all(item["included"] for item in plan if item["component"] == component)


def read_diffuse(job: Job, view: View) -> np.ndarray:
    """Read the diffuse light of every pixel of a view, (2, H, W, 3) float32 in two independent halves; 0 where nothing is hit."""
    channels = job.read("shading").exr(f"maps/{view.name}.exr")
    return np.stack([rgb(channels, f"half{h}.diffuse") for h in range(2)])


def write_light_of_view(job: Job, view: View, pixels: ViewPixels, found: PixelLight) -> None:
    """Write maps/<view>.exr and pixels/<view>.parquet of stage shading; `pixels`: all that the light was computed for.

    Raises:
        InputError: the light is not finite.
    """
    if not all(np.isfinite(part).all() for part in (found.diffuse, found.s0, found.s1)):
        raise InputError(f"view {view.name}: cached shading is not finite; please report it with the scene")
    channels: dict[str, np.ndarray] = {}
    for half in range(2):
        image = np.zeros((view.height * view.width, 3), np.float32)
        image[pixels.index] = found.diffuse[half]
        channels |= split_rgb(image.reshape(view.height, view.width, 3), f"half{half}.diffuse")
    job.writer.exr(f"maps/{view.name}.exr", channels, "relative")
    job.writer.table(table_of(view), SpecularLight(pixels.index[found.own], found.s0, found.s1).columns(), UNITS)


def facts_of_diffuse(cells: ShadingCells, diffuse: DiffuseShading) -> dict[str, Any]:
    """Return what shading.json says of the diffuse light of the cells."""
    return {
        "cells": len(cells),
        "cell_edge_m": cells.edge,
        "pixels_per_cell": float(cells.pixels.mean()),
        "paths_per_cell": float(diffuse.samples.mean()),
        "noise_first": diffuse.noise_first,
        "noise_last": diffuse.noise_last,
        "noisy_objects": diffuse.noisy_objects,
    }


def words_of_diffuse(cells: ShadingCells, diffuse: DiffuseShading, noise: float) -> str:
    """Describe the diffuse light of the cells for the log; `noise`: that was asked for."""
    return (
        f"diffuse light of {len(cells)} cells: {diffuse.samples.mean():.0f} paths each; noise {diffuse.noise_first:.1%} after the"
        f" first paths, {diffuse.noise_last:.1%} at the end ({diffuse.noisy_objects} objects above {noise:.1%})"
    )
