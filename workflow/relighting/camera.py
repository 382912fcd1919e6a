"""From where pictures are taken, and how bright they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.pinhole import direction_derivatives, look_at, pixel_directions
from iif_core.errors import InputError
from iif_core.light.relighting import camera_path, frame_times
from workflow.relighting.inventory import check_views
from workflow.scene.normal_form import CaptureReader, View, widest

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry

Array = np.ndarray
STEPS = 64
"""Pieces into which the way from one key to the next is cut to see whether it leads through surface, at least."""


@dataclass(frozen=True)
class Flight:
    """The frames of a relighting: poses (F, 4, 4) at eased times (F,), between key poses (k, 4, 4), and the intrinsics of all of
    them, in pixels. `view` is the photograph that its exposure is taken from."""

    poses: Array
    times: Array
    keys: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    view: View

    def rays(self, frame: int) -> tuple[Array, Array, tuple[Array, Array]]:
        """Return the eye (3,), the directions (H * W, 3) of a frame, and their change to the next pixel."""
        pose = self.poses[frame]
        directions = pixel_directions(self.fx, self.fy, self.cx, self.cy, self.width, self.height, pose).reshape(-1, 3)
        return pose[:3, 3], directions, direction_derivatives(self.fx, self.fy, pose)


def plan_flight(capture: CaptureReader, entry: dict[str, Any], up: Array) -> Flight:
    """Return the frames of a dumped relighting.

    Raises:
        InputError: a view does not exist, or a pose looks at itself.
    """
    camera = entry["camera"]
    check_views(entry, [view.name for view in capture.views])
    by_name = {view.name: view for view in capture.views}
    if camera["poses"]:
        keys = np.stack([look_at(pose["position"], pose["look_at"], up) for pose in camera["poses"]])
        first = _nearest(capture.views, keys[0])
    else:
        names = camera["views"] or [widest(capture).name]
        keys, first = np.stack([by_name[name].world_from_camera for name in names]), by_name[names[0]]
    width, height = camera["width"] or first.width, camera["height"] or first.height
    scale = width / first.width
    fx, fy = first.fx * scale, first.fy * scale
    cx, cy = width * first.cx / first.width, height * first.cy / first.height
    if camera["fov"]:
        fx = fy = 0.5 * width / np.tan(np.radians(camera["fov"]) / 2)
        cx, cy = width / 2, height / 2
    times = frame_times(camera["frames"])
    # The exposure of a photograph that is held out is not known where exposures are estimated.
    told = _nearest(capture.used, keys[0]) if first.split == "test" and capture.facts.get("exposure_estimated") else first
    return Flight(camera_path(keys, times), times, keys, fx, fy, cx, cy, width, height, told)


def _nearest(views: list[View], pose: Array) -> View:
    """The view that is nearest to a pose, a turn by 90 degrees counting as a metre."""
    poses = np.stack([view.world_from_camera for view in views])
    away = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    turn = np.arccos(np.clip(poses[:, :3, 2] @ pose[:3, 2], -1, 1)) / (np.pi / 2)
    return views[int(np.argmin(away + turn))]


def check_way(flight: Flight, geometry: Geometry, object_id: Array, names: list[str], entry: dict[str, Any]) -> None:
    """Check that the way of a camera is free.

    Args:
        flight: the frames; geometry: of the room; object_id: (m,) of its faces; names: of the objects.
        entry: the dumped relighting.

    Raises:
        InputError: it leads through surface; the message says through what, and between which frames.
    """
    frames = len(flight.poses)
    if frames < 2 or entry["camera"]["through_surface"]:
        return
    from iif_core.light.transport.geometry import trace

    times = np.unique(np.concatenate([np.linspace(0, 1, STEPS * max(len(flight.keys) - 1, 1) + 1), flight.times]))
    place = camera_path(flight.keys, times)[:, :3, 3]
    step = np.diff(place, axis=0)
    goes = np.flatnonzero(np.linalg.norm(step, axis=1) > 1e-6)
    if not len(goes):
        return
    face, share = trace(geometry, place[goes], step[goes])
    hit = np.flatnonzero((face >= 0) & (share <= 1))
    if not len(hit):
        return
    first = hit[0]
    at = place[goes[first]] + share[first] * step[goes[first]]
    owner = int(object_id[face[first]])
    what = f"{names[owner]!r}" if owner >= 0 else "surface of no object"
    after = int(np.clip(np.searchsorted(flight.times, times[goes[first] + 1] - 1e-12), 1, frames - 1))
    where = ", ".join(f"{x:.2f}" for x in np.round(at, 2) + 0.0)
    raise InputError(
        f"relight.camera of {entry['name']}: the way of the camera leads through {what} at [{where}] m,"
        f" between frames {after - 1} and {after}; add a view or a pose that leads around it, or set `through_surface: true`"
    )


def photograph_exposure(capture: CaptureReader, gains: CameraGains, view: View) -> Array | None:
    """Return the factors (3,) on radiance with which a photograph was taken: exposure and white balance, without the falloff of
    the lens; None for linear photographs, which have no exposure to be shown with."""
    if capture.is_hdr:
        return None
    number = next(i for i, other in enumerate(capture.views) if other.view_id == view.view_id)
    return np.asarray(gains.gain[number], np.float64)
