"""`source.registration`: small corrections of poses and intrinsics that bring photographs onto the mesh; views left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.registration import MIN_VIEWS, Photo, Registration, register
from workflow import decisions
from workflow.sources.folder_scene.transforms import Frame

WIDTH = 200
"""Pictures are compared at most this wide."""
ROWS = 300_000
"""Points times views, to keep the work of a capture within a minute."""
BLURRED, ASTRAY = 0.4, 0.2
"""Sharpness, and agreement with the other views, below which a photograph is left out."""
LEFT_OUT = 1 / 3
"""More views than this share are never left out: then it is not they that are wrong. Nor is any of fewer than MIN_VIEWS."""


@dataclass(frozen=True)
class Registered:
    """Frames with corrected cameras, their poses, why some are better left out (by name), numbers, and what plan.yaml says."""

    frames: list[Frame]
    poses: list[np.ndarray]
    left_out: dict[str, str]
    facts: dict[str, Any]
    notes: list[str]
    decisions: list[decisions.Decision]


def registered(
    frames: Sequence[Frame], poses: Sequence[np.ndarray], photos: Sequence[Photo | None], axes: str, metres: float
) -> Registered:
    """Photographs (None: sees nothing) registered with the mesh and with each other."""
    seen = [i for i, photo in enumerate(photos) if photo is not None]
    if len(seen) < 2:
        return Registered(list(frames), list(poses), {}, {}, [], [])
    plain = all(frames[i].lens.is_identity for i in seen)
    found = register([photos[i] for i in seen], points=max(2000, ROWS // len(seen)), intrinsics=plain)
    scale = frames[seen[0]].camera.width / photos[seen[0]].image.shape[1]
    left_out = _hopeless([frames[i].name for i in seen], found)
    new_frames, new_poses = list(frames), list(poses)
    if found.accepted:
        for pose, i in zip(found.pose, seen, strict=True):
            new_poses[i] = pose
            new_frames[i] = replace(frames[i], camera=_camera(frames[i], found), matrix=_matrix(pose, axes, metres))
    moved = float(np.median(found.moved) * scale)
    decision = decisions.registration(found.accepted, found.gain, found.error, moved, len(left_out), len(seen))
    facts, words = _facts(frames, seen, found, scale), _words(found, moved, plain)
    return Registered(new_frames, new_poses, left_out, facts, words, [decision])


def _camera(frame: Frame, found: Registration) -> Any:
    camera = frame.camera
    fx, fy = camera.fx * found.focal, camera.fy * found.focal
    shift = found.principal
    return replace(camera, fx=fx, fy=fy, cx=camera.cx + fx * shift[0], cy=camera.cy + fy * shift[1])


def _matrix(pose: np.ndarray, axes: str, metres: float) -> np.ndarray:
    """The matrix that `transforms.opencv_pose` reads as `pose`."""
    out = pose.copy()
    out[:3, 3] /= metres
    return out @ np.diag([1.0, -1.0, -1.0, 1.0]) if axes == "opengl" else out


def _hopeless(names: list[str], found: Registration) -> dict[str, str]:
    out = {}
    for name, sharp, agreement in zip(names, found.sharpness, found.agreement, strict=True):
        if agreement != 0 and agreement < ASTRAY:
            out[name] = f"badly posed? It correlates {agreement:.2f} with what the others show of the same surface"
        elif sharp > 0 and sharp < BLURRED:
            out[name] = f"blurred: {sharp:.2f} of the texture's contrast that the others show"
    return out if len(names) >= MIN_VIEWS and len(out) <= LEFT_OUT * len(names) else {}


def _facts(frames: Sequence[Frame], seen: list[int], found: Registration, scale: float) -> dict[str, Any]:
    views = {
        frames[i].name: {
            "moved_px": round(float(found.moved[k] * scale), 2),
            "shift_px": round(float(found.shift[k] * scale), 2),
            "sharpness": round(float(found.sharpness[k]), 3),
            "agreement": round(float(found.agreement[k]), 3),
        }
        for k, i in enumerate(seen)
    }
    numbers = {
        "accepted": found.accepted,
        "focal_factor": found.focal,
        "principal_shift_focal": found.principal.tolist(),
        "texture_spread": list(found.held_out),
        "texture_gain": [found.gain, found.error],
        "edges": list(found.edges),
        "edge_gain": [found.edge_gain, found.edge_error],
    }
    rounded = {k: np.round(v, 5).tolist() if not isinstance(v, bool) else v for k, v in numbers.items()}
    # A standard error that is not known is infinite, which JSON has no word for.
    finite = {k: v if isinstance(v, bool) else np.nan_to_num(v, posinf=0.0).tolist() for k, v in rounded.items()}
    return {**finite, "views": views}


def _words(found: Registration, moved: float, plain: bool) -> list[str]:
    numbers = (
        f"on surface that the fit did not see, texture of views differs by {found.held_out[1]:.3f} instead of"
        f" {found.held_out[0]:.3f} (loss {found.gain:+.4f} +- {found.error:.4f}), photograph edges at mesh edges"
        f" {found.edges[1]:.3f} instead of {found.edges[0]:.3f} (+- {found.edge_error:.4f})"
    )
    if not found.accepted:
        return [f"registration: poses and intrinsics taken as given; a correction by {moved:.1f} pixels would not pay: {numbers}"]
    common = f", focal length times {found.focal:.4f}" if plain else ""
    return [f"registration: photographs moved by {moved:.1f} pixels (median){common}: {numbers}"]
