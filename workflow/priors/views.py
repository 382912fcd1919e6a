"""The photographs of a capture with the surface that they show, as priors read them that use all photographs."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from iif_core.camera.calibration.choice import calibrate_response
from iif_core.camera.overlap import PatchRows, join_rows, patch_edge, patch_numbers, patch_rows
from iif_core.camera.pixels import ViewMaps
from iif_core.camera.response import Response
from iif_core.light.irradiance import Trace
from iif_core.priors.features import borders
from iif_core.surface.cells import grid_origin
from iif_core.surface.triangles import face_geometry, towards_viewer
from workflow.runtime import device
from workflow.scene.decoded import DecodedViews, Kept
from workflow.scene.normal_form import CaptureReader, View, stated_exposures
from workflow.scene.photograph import GAMMA
from workflow.segmentations.geometry import pieces
from workflow.segmentations.surface import Surface

SATURATED = 0.99  # sensor value
FAMILY = "spline"
"""Curve of the response: the richest, because there is no choice to make yet (stage emission makes it)."""
MEMORY_MB = 256.0
"""Megabytes of decoded files that are kept in memory, and as many of views."""
PATCH_PIXELS = 4_000_000
"""Photographs are thinned to about this many pixels for the response."""
PIECES = SimpleNamespace(scale=0.05, min_faces=100, min_area=0.01, colour=0.1)
"""Pieces of the mesh take the place of objects where no one gives them (the defaults of segmentation `geometry`)."""


class CaptureViews:
    """Every photograph that is not held out, read when it is asked for, `factor` times smaller in both directions.

    Args:
        capture: the normal form.
        objects_given: whether the objects of the capture may be read; otherwise pieces of the mesh take their place.
        factor: a pixel is the mean of factor x factor pixels of the photograph, and has the surface of the middle one.
    """

    def __init__(self, capture: CaptureReader, objects_given: bool, factor: int = 1):
        self.capture, self.factor, self.objects_given = capture, factor, objects_given
        self.views = capture.used
        self.vertices, self.faces = capture.mesh()
        self.face_normals, _ = face_geometry(self.vertices, self.faces)
        given = capture.faces()["instance_id"].astype(np.int64) if objects_given else np.zeros(0, np.int64)
        by_face = bool((given >= 0).any())
        self.decoded, self._kept = DecodedViews(capture, memory_mb=MEMORY_MB), Kept(MEMORY_MB)
        self.face_group = given if by_face else pieces(Surface(capture, decoded=self.decoded), PIECES).astype(np.int64)
        self.number = {view.view_id: i for i, view in enumerate(self.views)}
        self.exposure = np.array([view.exposure if view.exposure > 1e-6 else 1.0 for view in self.views])
        self.response: Response | None = None

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> ViewMaps:
        return self.of(self.views[index])

    def of(self, view: View) -> ViewMaps:
        """Read one photograph; an 8-bit one becomes linear by the response, or by the power 2.2 as long as there is none."""
        return self._kept.once(view.view_id, lambda: self._of(self.number[view.view_id], self.factor))

    def full(self, view: View) -> ViewMaps:
        """Read one photograph at its own size."""
        return self._of(self.number[view.view_id], 1)

    def _of(self, number: int, f: int) -> ViewMaps:
        capture, view = self.capture, self.views[number]
        own = self.decoded.maps(view)
        photo, valid, depth, face = own.value, own.valid, own.depth, own.face
        saturated = np.zeros(photo.shape[:2], bool)
        exposure = 1.0
        if not capture.is_hdr:
            saturated = photo.max(-1) >= SATURATED
            photo = np.clip(photo, 0, 1)
            photo = photo**GAMMA if self.response is None else self._linear(photo)
            exposure = float(self.exposure[number])
        directions = view.directions()
        group = capture.given_instances(view) if self.objects_given else None
        valid = valid & np.isfinite(photo).all(-1)
        camera = replace(view, exposure=exposure)
        if f > 1:
            photo, valid, saturated = _means(photo, valid, f), _any(valid, f), _any(saturated, f)
            depth, face, directions = (_middles(array, f) for array in (depth, face, directions))
            group = None if group is None else _middles(group, f)
            # The middle pixel of a block lies at the middle of a smaller pixel.
            middle = {name: (getattr(view, name) - (f // 2 + 0.5)) / f + 0.5 for name in ("cx", "cy")}
            camera = replace(camera, width=depth.shape[1], height=depth.shape[0], fx=view.fx / f, fy=view.fy / f, **middle)
        made = ViewMaps(camera=camera, value=photo, valid=valid, depth=depth, face=face, saturated=saturated)
        hit = made.hit
        towards = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        normals, _ = towards_viewer(self.face_normals[face].reshape(-1, 3), towards.reshape(-1, 3))
        normals = np.where(hit[..., None], normals.reshape(*hit.shape, 3), 0)
        if group is None:
            group = np.where(hit, self.face_group[face], -1)
        surface = {"normals": normals.astype(np.float32), "object_id": group.astype(np.int32)}
        return replace(made, valid=hit & valid, depth=np.where(hit, depth, 0).astype(np.float32), **surface)

    def _linear(self, photo: np.ndarray) -> np.ndarray:
        """Invert the response, by a table of a sixteenth of the steps of 8-bit values."""
        nodes = np.linspace(0, 1, 16 * 255 + 1)
        table = self._table
        return np.stack([np.interp(photo[..., c], nodes, table[:, c]) for c in range(3)], -1).astype(np.float32)

    @cached_property
    def _table(self) -> np.ndarray:
        assert self.response is not None
        return self.response.inverse(np.repeat(np.linspace(0, 1, 16 * 255 + 1)[:, None], 3, 1))

    def shrunk(self, picture: np.ndarray) -> np.ndarray:
        """Return what the middle pixel of every block of factor x factor pixels shows."""
        return _middles(picture, self.factor) if self.factor > 1 else picture

    def calibrate(self) -> str:
        """Estimate the response, and exposures that are not given, from surface that several photographs show (Eq. C.17 to C.28);
        returns why this response. Radiance needs none."""
        if self.capture.is_hdr or not self.views:
            return "photographs are linear radiance"
        given = not self.capture.facts.get("exposure_estimated", False)
        stated = stated_exposures(self.capture.facts, self.views)
        found = calibrate_response(self._shared_surface(), self.exposure, (FAMILY,), SATURATED, given, stated)
        self.exposure = np.asarray(found.exposure, np.float64)
        self._kept.forget()
        if not found.rows and found.response.family != "sampled":
            return f"{found.reason.split(':')[0]}: taken as the power {GAMMA}"
        self.response = found.response
        return found.reason

    def _shared_surface(self) -> PatchRows:
        """Patches of surface away from borders, as all views show them."""
        footprints, pixels = [], 0
        for i in range(len(self)):
            own = self[i]
            pixels += own.depth.size
            if (hit := own.hit).any():
                footprints.append(float(np.median(own.depth[hit])) / own.camera.fx)
        corners = self.vertices[np.unique(self.faces)]
        extent = float(np.ptp(corners, axis=0).max())
        edge = patch_edge(float(np.median(footprints)), extent) if footprints else max(extent, 1.0)
        origin = grid_origin(corners, edge)
        share = min(1.0, PATCH_PIXELS / max(pixels, 1))
        parts = []
        for number, view in enumerate(self.views):
            own = self.of(view)
            # The response applies to single sensor values, not to means, so the middle pixel stands for its block.
            value, valid = (_middles(array, self.factor) for array in self.decoded.photo(view))
            use = own.valid & valid & ~borders(own.object_id)
            group = own.object_id[use]
            patch = patch_numbers(own.points()[use], group, edge, origin)
            parts.append(patch_rows(patch, own.normals[use], group, value[use], number, SATURATED, share=share))
        return join_rows(parts)

    def tracer(self) -> Trace:
        """Return a function that intersects rays with the mesh."""
        device.mitsuba()
        from iif_core.light.transport.geometry import build_geometry, trace

        geometry = build_geometry(self.vertices, self.faces, np.full(len(self.faces), -1, np.int32))
        return lambda origins, directions: trace(geometry, origins, directions)


def _padded(array: np.ndarray, factor: int) -> np.ndarray:
    """Repeat the last row and column until the sizes are multiples of the factor."""
    h, w = array.shape[:2]
    return np.pad(array, [(0, -h % factor), (0, -w % factor), *[(0, 0)] * (array.ndim - 2)], "edge")


def _blocks(array: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, ...) -> (H / f, f, W / f, f, ...)."""
    array = _padded(array, factor)
    return array.reshape(array.shape[0] // factor, factor, array.shape[1] // factor, factor, *array.shape[2:])


def _means(photo: np.ndarray, valid: np.ndarray, factor: int) -> np.ndarray:
    """Mean of the valid pixels of every block; 0 without any."""
    total = _blocks(np.where(valid[..., None], photo, 0), factor).sum((1, 3))
    return (total / np.maximum(_blocks(valid, factor).sum((1, 3)), 1)[..., None]).astype(np.float32)


def _any(mask: np.ndarray, factor: int) -> np.ndarray:
    return _blocks(mask, factor).any((1, 3))


def _middles(array: np.ndarray, factor: int) -> np.ndarray:
    return _blocks(array, factor)[:, factor // 2, :, factor // 2]
