"""The camera response and the gains of the photographs, from surface that several of them show
(docs/method/camera.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from iif_core.camera.calibration.choice import (
    CalibratedResponse,
    calibrate_response,
    gain_rows,
    given_response,
    needs_rows,
)
from iif_core.camera.gains import CameraGains, choose_gains, radius_squared
from iif_core.camera.overlap import PatchRows, join_rows, no_rows, patch_edge, patch_numbers, patch_rows
from iif_core.camera.response import Response
from iif_core.light.emission.photographs import STATISTICS_PIXELS, Photographs
from iif_core.surface.cells import grid_origin


def calibrated(
    photos: Photographs,
    families: Sequence[str],
    measured: tuple[Response, str] | None,
    given: bool,
    stated: np.ndarray | None = None,
) -> tuple[Photographs, CalibratedResponse]:
    """Find the camera response and the gains that go with it.

    Held-out views take no part, and keep the gains that the source knows.

    Args:
        photos: whose sensor has no curve yet.
        families: of curves, of which the one is taken that fits surface seen under different exposures best.
        measured: the curve and where it is from, where it is known; `families` are not used.
        given: exposures are known, and not estimated; stated: of every view, what its file says, NaN = nothing.

    Returns:
        The photographs with both, and how they were found.
    """
    number = np.array([photos.number(view) for view in photos.views])
    exposure = photos.gains.exposure[number] if not given else photos.gains.gain[number, 0]
    if measured:
        families = ()
    estimated = not given and not photos.sensor.is_hdr
    rows = _shared_surface(photos) if estimated or (families and needs_rows(families)) else no_rows()
    if measured:
        found = given_response(*measured, exposure)
    else:
        moving = replace(rows, view=np.searchsorted(number, rows.view).astype(np.int32))
        said = None if stated is None else stated[number]
        found = calibrate_response(moving, exposure, families, photos.sensor.saturation, given, said)
    photos.log.say(f"camera response: {found.reason}")
    gains = _all_gains(photos.gains, number, found, rows) if estimated else photos.gains
    return replace(photos, sensor=replace(photos.sensor, curve=found.response), gains=gains), found


def _all_gains(start: CameraGains, number: np.ndarray, found: CalibratedResponse, rows: PatchRows) -> CameraGains:
    """Gains of all views of the capture: of the views `number` that were used as they were found, of the others as at the
    start."""
    if found.gains is None:  # the curve is given, the gains are not
        own = choose_gains(gain_rows(rows, found.response).thinned(), len(start.gain))
        return replace(own, gain=np.where(own.estimated[:, None], own.gain, start.gain))
    gain, seen = start.gain.copy(), np.zeros(len(start.gain), bool)
    gain[number], seen[number] = found.gains.gain, found.gains.estimated
    return replace(found.gains, gain=gain, estimated=seen, group=None)


def _shared_surface(photos: Photographs) -> PatchRows:
    """Patches of interior surface as the views show them."""
    scene, views = photos.scene, photos.views
    medians = [(photos.records[view].median_depth, view.fx) for view in views]
    apart = photos.records.share**-0.5  # pixels that are looked at, in pixels
    footprints = [apart * depth / focal for depth, focal in medians if depth is not None]
    extent = float(np.ptp(scene.vertices, axis=0).max())
    edge = patch_edge(float(np.median(footprints)), extent) if footprints else max(extent, 1.0)
    origin = grid_origin(scene.vertices[scene.faces.ravel()], edge)
    share = min(1.0, STATISTICS_PIXELS / max(photos.records.share * sum(view.width * view.height for view in views), 1))
    saturation = photos.sensor.saturation
    parts = [no_rows()]
    for done, view in enumerate(views):
        pixels = photos.records[view].pixels
        pixels = pixels.take(np.flatnonzero(pixels.valid & pixels.interior))
        patch = patch_numbers(pixels.points, pixels.object_id, edge, origin)
        radius2 = radius_squared(pixels.index, view.width, view.height)
        rows = (patch, pixels.normals, pixels.object_id, pixels.value, photos.number(view))
        parts.append(patch_rows(*rows, saturation, share=share, radius2=radius2))
        photos.log.progress(done + 1, len(views), "views compared for the camera response")
    return join_rows(parts)
