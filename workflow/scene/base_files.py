"""The files in which stage base writes cells, segments and maps (docs/reference/artefacts.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.problem import FusionResult, with_every_object
from iif_core.reflectance.material import CHANNELS, PROPERTIES
from iif_core.surface.cell_grid import CellGrid, CellValues
from iif_core.surface.cells import unpack_keys
from workflow.artifacts.store import ids_from_disk, ids_to_disk, split_rgb
from workflow.decisions import numerics
from workflow.runtime.job import Job
from workflow.scene.fusion_input import Inputs
from workflow.scene.normal_form import View


def write_base(
    job: Job,
    found: Inputs,
    result: FusionResult,
    *,
    solver: str = "direct",
    variant: str = "full",
    calibrated: bool = True,
    facts: Mapping[str, Any] | None = None,
    over: Callable[[View, np.ndarray], dict[str, np.ndarray]] | None = None,
) -> None:
    """Write the artefacts of stage base.

    Args:
        job: the job; found: what was fused; result: of it.
        solver, variant: how; calibrated: whether `uncertainty_*` are errors, or only rank cells.
        facts: further ones for base.json.
        over: channels of a view, from the pixels (H, W) bool that show a cell, that replace those of the cells.
    """
    result = with_every_object(result, found.n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", found.views[dropped.view].name, dropped.reason)
    _write_cells(job, found.grid, found.n_objects, result)
    _write_segments(job, result, found.segment_id, found.problem.object_of_segment)
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unseen = np.quantile(every[:, 5:], 0.9, axis=0)  # scale and uncertainty of surface that no prediction shows
    values, views = CellValues(found.grid, every), found.decoded.capture.views
    for done, view in enumerate(views):
        maps = _maps_of_view(found, values, unseen, result, view)
        if over is not None:
            maps |= over(view, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(views), "maps")
    grid, problem = found.grid, found.problem
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": grid.edge,
            "origin": [float(x) for x in grid.origin],
            "cells": len(grid),
            "predictions": found.used,
            "solver": solver,
            "variant": variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": {
                str(name): count for name, count in parts_per_object(grid.object_id, result.part_of_cell).items()
            },
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": calibrated,
            "numerics": numerics.of_base(result, found.used * len(problem.cell_of_pixel)),
            **(facts or {}),
        },
    )
    job.log.info(
        "%d cells of %.1f mm (%.0f %% seen in one view), %d segments; %s",
        len(grid),
        1e3 * grid.edge,
        100 * (result.views == 1).mean(),
        len(np.unique(np.concatenate([np.unique(m[m >= 0]) for m in problem.segment_of_pixel]))),
        ", ".join(f"{name} {value:.4g}" for name, value in result.history[-1].items()),
    )


def _write_cells(job: Job, grid: CellGrid, n_objects: int, result: FusionResult) -> None:
    """Write cells.parquet and objects.parquet."""
    ijk, objects = unpack_keys(grid.keys)
    job.writer.table(
        "cells.parquet",
        {
            "cell_id": np.arange(len(grid), dtype=np.int32),
            **{name: ijk[:, a] for a, name in enumerate("ijk")},
            "object_id": objects,
            "part_id": result.part_of_cell,
            **{name: grid.centre[:, a] for a, name in enumerate("xyz")},
            "observations": result.observations,
            "views": result.views,
            "coverage": result.coverage,
            **{name: result.value[:, c] for c, name in enumerate(CHANNELS)},
            **{f"scale_{name}": result.scale[:, c] for c, name in enumerate(CHANNELS)},
            **{f"uncertainty_{name}": result.uncertainty[:, c] for c, name in enumerate(CHANNELS)},
        },
        {**dict.fromkeys("xyz", "m"), "coverage": "weighted pixels"},
    )
    means, counted = result.object_value[:n_objects], result.object_cells[:n_objects].astype(np.int32)
    columns = {name: means[:, c] for c, name in enumerate(CHANNELS)}
    job.writer.table("objects.parquet", {"object_id": np.arange(n_objects, dtype=np.int32), "cells": counted, **columns})


def _write_segments(job: Job, result: FusionResult, segment_id: np.ndarray, object_id: np.ndarray) -> None:
    """Write segments.parquet and selection.parquet; `object_id` (S,) of the segments that were solved for."""
    n, k = result.weight.shape[:2]
    ids = segment_id.astype(np.int32) if n == len(segment_id) else np.arange(n, dtype=np.int32)
    best = result.weight.argmax(1).astype(np.int32)
    job.writer.table(
        "segments.parquet",
        {
            "segment_id": ids,
            "object_id": np.asarray(object_id, np.int32),
            **{f"best_{name}": best[:, p] for p, name in enumerate(PROPERTIES)},
            **{f"margin_{name}": result.margin[:, p] for p, name in enumerate(PROPERTIES)},
            **{f"effective_{name}": result.effective[:, p] for p, name in enumerate(PROPERTIES)},
        },
    )
    job.writer.table(
        "selection.parquet",
        {
            "segment_id": np.repeat(ids, k),
            "k": np.tile(np.arange(k, dtype=np.int32), n),
            **{f"weight_{name}": result.weight[..., p].ravel() for p, name in enumerate(PROPERTIES)},
            **{f"probability_{name}": result.probability[..., p].ravel() for p, name in enumerate(PROPERTIES)},
            "affine_albedo": result.affine_albedo.reshape(n * k, 12),
            "affine_roughness": result.affine_roughness.reshape(n * k, 2),
            "affine_metallic": result.affine_metallic.reshape(n * k, 2),
            **{f"error_{name}": result.error[..., p].ravel() for p, name in enumerate(PROPERTIES)},
        },
    )


def _maps_of_view(
    found: Inputs, cells: CellValues, unseen: np.ndarray, result: FusionResult, view: View
) -> dict[str, np.ndarray]:
    """Channels of one view; pixels without surface are 0.

    `cells` holds value, scale and uncertainty (n_cells, 15). Surface in no cell, which test views show, has the mean of the
    cells around it, or else the mean of its object with the scale and uncertainty `unseen` (10,).
    """
    pixels = found.decoded.on_objects(view, found.normals)
    index, points, objects = pixels.index, pixels.points, pixels.object_id
    fallback = np.concatenate([result.object_value[objects], np.broadcast_to(unseen, (len(index), 10))], 1)
    values, row = cells.at(points, objects, fallback)
    shape, size = (view.height, view.width), view.height * view.width
    cell, covered, full = np.full(size, -1, np.int32), np.zeros(size, np.float32), np.zeros((size, 15), np.float32)
    cell[index], full[index] = row, values
    covered[index] = np.where(row >= 0, result.coverage[row], 0)
    full = full.reshape(*shape, 15)
    out = {
        "cell.id": ids_to_disk(cell.reshape(shape)),
        **split_rgb(full[..., :3], "albedo"),
        "roughness": full[..., 3],
        "metallic": full[..., 4],
        "coverage": covered.reshape(shape),
    }
    for name, first in (("scale", 5), ("uncertainty", 10)):
        out[f"{name}.albedo"] = full[..., first : first + 3].mean(-1)
        out[f"{name}.roughness"], out[f"{name}.metallic"] = full[..., first + 3], full[..., first + 4]
    return out
