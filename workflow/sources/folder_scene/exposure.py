"""`capture.exposure`: exposures from exposures.json, or estimated from surface that several views show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from iif_core.camera.exposure import ExposureGains, estimate_gains
from iif_core.camera.response import response
from iif_core.errors import InputError
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices
from workflow.intake import limits
from workflow.intake.documents import read_json
from workflow.intake.names import shown
from workflow.sources.folder_scene.frames import Frame

MAX_PIXELS = 2_000_000  # of all views together
MIN_CELL_EDGE = 0.02  # metres; finer cells would hold single pixels
DARK, BRIGHT = 0.03, 0.97  # sensor values outside of this range are dominated by noise or saturated
ALIKE = 0.1
"""Nine tenths of photographs whose log exposures are off by less from their mean count as equally exposed."""


def read_given(path: Path, frames: list[tuple[str, str]]) -> list[float]:
    """Read the exposure of every frame (name, file_path) from exposures.json: {file_path or name: factor on radiance}.

    Raises:
        InputError: unreadable, an entry missing, or not a positive number.
    """
    table = read_json(path, "exposures")
    if not isinstance(table, dict):
        raise InputError(f"{path}: found a {type(table).__name__}; expected {{file_path or name: exposure}}")
    table = {key.removeprefix("./"): value for key, value in table.items()}
    out = []
    for name, file_path in frames:
        value = table.get(file_path, table.get(name))
        if value is None:
            raise InputError(f"{path}: no entry for {file_path!r} (or {name!r}); every photograph needs one")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not (math.isfinite(value) and value > 0):
            raise InputError(f"{path}: exposure of {name!r} is {shown(value)}; expected a positive number")
        if not limits.GAIN[0] <= value <= limits.GAIN[1]:
            raise InputError(f"{path}: exposure of {name!r} is {value:g}; expected {limits.GAIN[0]:g} to {limits.GAIN[1]:g}")
        out.append(float(value))
    return out


def given(path: Path | None, frames: Sequence[Frame], setting: str) -> tuple[list[float], list[str]]:
    """Return the exposure of every frame, 1 where nothing is known or used, and notes.

    Args:
        path: exposures.json, if there is one.
        frames: of which the source may know exposures itself.
        setting: `capture.exposure`.

    Raises:
        InputError: as `read_given`.
    """
    known, ones = [frame.exposure for frame in frames if frame.exposure is not None], [1.0] * len(frames)
    if setting == "estimate":
        return ones, ["exposures.json is not used: `capture.exposure` is estimate"] if path else []
    if known:
        return known, []
    if path:
        return read_given(path, [(frame.name, frame.file_path) for frame in frames]), []
    if setting == "given" and len(frames) > 1:
        note = "no exposures.json: the photographs count as equally exposed; with automatic exposure, set"
        return ones, [f"{note} `capture: {{exposure: estimate}}`"]
    return ones, []


def are_asked_for(path: Path | None, frames: Sequence[Frame], setting: str, encoded: bool) -> bool:
    """Return whether exposures are looked for in the photographs. Arguments as of `given`; `encoded`: they are 8-bit values."""
    unknown = path is None and all(frame.exposure is None for frame in frames)
    return setting == "estimate" or (setting == "auto" and encoded and unknown and len(frames) > 1)


def are_alike(gains: ExposureGains) -> bool:
    """Return whether photographs are equally exposed, as far as the surface that they share tells (`ALIKE`)."""
    return not gains.estimated.any() or float(np.quantile(np.abs(np.log(gains.gain[gains.estimated])), 0.9)) < ALIKE


class SharedSurface:
    """Collects some pixels of every view, then estimates one gain per view."""

    def __init__(self, views: int, encoded: bool):
        self.limit, self.encoded = max(1, MAX_PIXELS // max(views, 1)), encoded
        self.points: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self.footprints: list[float] = []

    def add(self, photo: np.ndarray, usable: np.ndarray, points: np.ndarray, footprint: float) -> None:
        """Add a view.

        Args:
            photo: (H, W, 3) sensor values or radiance.
            usable: (H, W) bool, valid pixels that hit the mesh.
            points: (H, W, 3) surface points, metres.
            footprint: median size of a pixel on the surface, metres.
        """
        if self.encoded:
            usable = usable & (photo > DARK).all(-1) & (photo < BRIGHT).all(-1)
        else:
            usable = usable & (photo > 0).all(-1)
        rows = np.flatnonzero(usable)
        rows = rows[:: max(1, math.ceil(len(rows) / self.limit))]
        self.points.append(points.reshape(-1, 3)[rows].astype(np.float32))
        self.values.append(photo.reshape(-1, 3)[rows].astype(np.float32))
        self.footprints.append(footprint)

    def gains(self) -> ExposureGains:
        """Estimate the gains of the views in the order in which they were added; the inverse of x^0.449 makes values linear."""
        points, values = np.concatenate(self.points), np.concatenate(self.values)
        view = np.repeat(np.arange(len(self.points)), [len(p) for p in self.points])
        if len(points) == 0:
            return estimate_gains(np.zeros(0, int), view, values, len(self.points))
        edge = max(3 * float(np.median(self.footprints)), MIN_CELL_EDGE)
        keys = pack_keys(voxel_indices(points, edge, grid_origin(points, edge)))
        cell = np.unique(keys, return_inverse=True)[1].ravel()
        linear = response("ggcm").inverse(values) if self.encoded else values
        return estimate_gains(cell, view, linear, len(self.points))
