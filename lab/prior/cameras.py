"""Poses as people hold a camera: upright, from free places, across the room, some near to a thing."""

from __future__ import annotations

import numpy as np

from iif_core.camera.pinhole import look_at
from lab.prior.rooms import Room

CLEARANCE = 0.12  # metres between a camera and the box around an object


def poses(room: Room, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses; each camera stands where it is far from those before.

    Args:
        room: the room.
        count: V.
        rng: random numbers.

    Returns:
        (V, 4, 4) world from camera, OpenCV axes, metres.
    """
    out: list[np.ndarray] = []
    eyes: list[np.ndarray] = []
    while len(out) < count:
        pool = _free(room, rng)
        if eyes:
            pool = pool[[np.linalg.norm(pool[:, None] - np.array(eyes)[None], axis=2).min(1).argmax()]]
        eye = pool[0]
        target = _target(room, eye, rng)
        if np.linalg.norm(target - eye) < 0.3:
            continue
        eyes.append(eye)
        out.append(look_at(eye, target, (0.05 * rng.normal(), 0.05 * rng.normal(), 1.0)))
    return np.stack(out)


def _free(room: Room, rng: np.random.Generator, tries: int = 60) -> np.ndarray:
    """Places (k, 3) outside of all objects, k >= 1; in a room without free places, any place."""
    top = min(2.1, room.size[2] - 0.25)
    for _ in range(tries):
        pool = rng.uniform((0.25, 0.25, 0.5), (*(room.size[:2] - 0.25), top), (24, 3))
        low, high = room.obstacles[:, 0] - CLEARANCE, room.obstacles[:, 1] + CLEARANCE
        free = pool[~((pool[:, None] > low) & (pool[:, None] < high)).all(2).any(1)]
        if len(free):
            return free
    return pool[:1]


def _target(room: Room, eye: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if rng.random() < 0.3 and len(room.obstacles):
        return room.obstacles[rng.integers(len(room.obstacles))].mean(0)
    ahead = (room.size / 2 - eye)[:2]
    turn = rng.uniform(-0.9, 0.9)
    ahead = np.array([np.cos(turn) * ahead[0] - np.sin(turn) * ahead[1], np.sin(turn) * ahead[0] + np.cos(turn) * ahead[1]])
    return eye + np.array([*(2 * ahead / max(np.linalg.norm(ahead), 1e-6)), rng.uniform(-1.3, 0.7)])
