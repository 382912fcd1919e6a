"""`source.registration`: small corrections of poses and intrinsics that align photographs with the mesh, and views left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.alignment import Photo
from iif_core.camera.registration import MIN_VIEWS, Registration, register
from workflow.decisions import camera as decisions
from workflow.sources.folder_scene.frames import Frame

WIDTH = 200  # pixels; photographs are reduced to at most this width before they are compared
MAX_ROWS = 300_000  # points times views; a capture registers within some ten seconds
MIN_SHARPNESS, MIN_AGREEMENT = 0.4, 0.2
"""Sharpness, and agreement with the other views, below which a photograph is left out."""
MAX_SHARE_LEFT_OUT = 1 / 3
"""If more views than this share fail, or there are fewer than MIN_VIEWS, none is left out: the fault lies elsewhere."""


@dataclass(frozen=True)
class Registered:
    """The result of a registration.

    Attributes:
        frames: with corrected cameras.
        poses: (4, 4) `world_from_camera` of each frame.
        left_out: name of a frame -> why it should not be used.
        facts: numbers for capture.json.
        notes: the same as text.
        plan: entries of plan.yaml.
    """

    frames: list[Frame]
    poses: list[np.ndarray]
    left_out: dict[str, str]
    facts: dict[str, Any]
    notes: list[str]
    plan: list[decisions.Decision]


def register_frames(
    frames: Sequence[Frame], poses: Sequence[np.ndarray], photos: Sequence[Photo | None], axes: str, metres: float
) -> Registered:
    """Register photographs with the mesh and with each other.

    Args:
        frames: all frames of the scene.
        poses: (4, 4) `world_from_camera` of each frame.
        photos: reduced photograph of each frame with depth and normals of the mesh; None where it sees no surface.
        axes: `opengl` or `opencv`, camera axes of the frames' matrices.
        metres: per unit of the frames' matrices.

    Returns:
        The corrected frames; those given where the correction does not pay. A held-out photograph is neither judged nor left out:
        nothing but its own pose depends on what it shows.
    """
    seen = [i for i, photo in enumerate(photos) if photo is not None]
    used = [k for k, i in enumerate(seen) if not photos[i].held]
    if len(seen) < 2:
        return Registered(list(frames), list(poses), {}, {}, [], [])
    plain = all(frames[i].lens.is_identity for i in seen)
    found = register([photos[i] for i in seen], points=max(2000, MAX_ROWS // len(seen)), intrinsics=plain)
    scale = frames[seen[0]].camera.width / photos[seen[0]].image.shape[1]
    names = {frames[seen[k]].name: k for k in used}
    left_out = _unusable(names, found)
    new_frames, new_poses = list(frames), list(poses)
    if found.accepted:
        for pose, i in zip(found.pose, seen, strict=True):
            new_poses[i] = pose
            new_frames[i] = replace(frames[i], camera=_camera(frames[i], found), matrix=_matrix(pose, axes, metres))
    moved = float(np.median(found.moved[used]) * scale) if used else 0.0
    decision = decisions.registration(found.accepted, found.each, found.evidence, found.needed, moved, len(left_out), len(used))
    facts, words = _facts(names, found, scale), _words(found, moved, plain)
    return Registered(new_frames, new_poses, left_out, facts, words, [decision])


def _camera(frame: Frame, found: Registration) -> Any:
    camera = frame.camera
    fx, fy = camera.fx * found.focal, camera.fy * found.focal
    shift = found.principal
    return replace(camera, fx=fx, fy=fy, cx=camera.cx + fx * shift[0], cy=camera.cy + fy * shift[1])


def _matrix(pose: np.ndarray, axes: str, metres: float) -> np.ndarray:
    """Return the matrix that `transforms.opencv_pose` converts to `pose`."""
    out = pose.copy()
    out[:3, 3] /= metres
    return out @ np.diag([1.0, -1.0, -1.0, 1.0]) if axes == "opengl" else out


def _unusable(names: Mapping[str, int], found: Registration) -> dict[str, str]:
    out = {}
    for name, k in names.items():
        sharp, agreement = found.sharpness[k], found.agreement[k]
        if agreement != 0 and agreement < MIN_AGREEMENT:
            out[name] = f"badly posed? It correlates {agreement:.2f} with what the others show of the same surface"
        elif sharp > 0 and sharp < MIN_SHARPNESS:
            out[name] = f"blurred: {sharp:.2f} of the texture's contrast that the others show"
    return out if len(names) >= MIN_VIEWS and len(out) <= MAX_SHARE_LEFT_OUT * len(names) else {}


def _facts(names: Mapping[str, int], found: Registration, scale: float) -> dict[str, Any]:
    views = {
        name: {
            "moved_px": round(float(found.moved[k] * scale), 2),
            "shift_px": round(float(found.shift[k] * scale), 2),
            "sharpness": round(float(found.sharpness[k]), 3),
            "agreement": round(float(found.agreement[k]), 3),
        }
        for name, k in names.items()
    }
    numbers = {
        "accepted": found.accepted,
        "each": found.each,
        "focal_factor": found.focal,
        "principal_shift_focal": found.principal.tolist(),
        "texture_spread": list(found.held_out),
        "texture_gain": [found.gain, found.error],
        "edges": list(found.edges),
        "edge_gain": [found.edge_gain, found.edge_error],
    }
    rounded = {k: np.round(v, 5).tolist() if not isinstance(v, bool) else v for k, v in numbers.items()}
    # An unknown standard error is infinite, which JSON cannot represent.
    finite = {k: v if isinstance(v, bool) else np.nan_to_num(v, posinf=0.0).tolist() for k, v in rounded.items()}
    return {**finite, "views": views}


def _words(found: Registration, moved: float, plain: bool) -> list[str]:
    numbers = (
        f"at edges of the mesh photographs have edges of {found.edges[1]:.3f} instead of {found.edges[0]:.3f}"
        f" (+- {found.edge_error:.4f}), and on surface that was left aside for this they spread by {found.held_out[1]:.3f}"
        f" instead of {found.held_out[0]:.3f} (fall of the loss {found.gain:+.4f} +- {found.error:.4f}); both together speak for"
        f" it by {found.evidence:.1f} standard errors, {found.needed:.1f} are needed"
    )
    if not found.accepted:
        return [
            f"registration: poses and focal length are taken as given, because moving them shows no clear gain (by {moved:.1f}"
            f" pixels, {numbers})"
        ]
    off = abs(found.focal - 1)
    lens = "" if not plain else f"; the focal length was {off:.1%} too {'long' if found.focal < 1 else 'short'}"
    how = "each for itself" if found.each else "all alike"
    return [
        f"registration: the photographs lay beside the mesh by {moved:.1f} pixels (median), which is corrected, {how}{lens}"
        f" ({numbers})"
    ]
