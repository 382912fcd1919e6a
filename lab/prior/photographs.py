"""The photographs of a room and their truth: path tracing by the product's transport, denoised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iif_core.camera.pinhole import direction_derivatives, pixel_directions
from lab.prior import cameras, scan, sensor
from lab.prior.captures import Capture, Truth
from lab.prior.rooms import VERSION, Room

Denoiser = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(radiance, albedo, normal), each (H, W, 3) -> radiance (H, W, 3)."""
PIECES = 2 / 3
"""Share of the captures without given objects: the product makes pieces of the mesh there, which is its default."""
BOUNCES = 8
_STREAM = 0x63616D
_LANES = 1 << 21


@dataclass(frozen=True)
class Session:
    """How a room is photographed: `views` pictures of `size` x `size` pixels with `samples` paths each."""

    views: int
    size: int
    samples: int = 40


def draw_session(seed: int, samples: int = 40) -> Session:
    """Draw size and number of photographs: mostly small ones, because a network sees crops of 128 pixels."""
    rng = np.random.default_rng([seed, 7])
    size = int(rng.choice([128, 160, 192], p=[0.6, 0.25, 0.15]))
    low, high = {128: (12, 25), 160: (10, 18), 192: (8, 14)}[size]
    return Session(int(rng.integers(low, high)), size, samples)


@dataclass(frozen=True)
class _Shown:
    """What rays through the middles of pixels meet: face (p,) or -1, z-depth (p,), part (p,), cosine (p,) of normal and ray."""

    face: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    cosine: np.ndarray
    normal: np.ndarray


def photograph(room: Room, seed: int, session: Session, denoise: Denoiser | None = None) -> Capture:
    """Render a room and photograph it.

    Args:
        room: the room.
        seed: of cameras, noise and errors.
        session: number, size and quality of the photographs.
        denoise: removes the noise of path tracing; None = none does.

    Returns:
        The capture. Its mesh and cameras have the errors of `scan`; photographs and truth do not.
    """
    rng = np.random.default_rng([seed, _STREAM])
    faults = scan.draw_faults(rng)
    poses = cameras.poses(room, session.views, rng)
    focal = 0.5 * session.size / np.tan(np.radians(rng.uniform(40, 88) / 2))
    radiance, truth = render(room, poses, focal, session, int(rng.integers(1 << 30)), denoise)
    photographs = sensor.photograph(radiance, truth.valid, rng)
    vertices, faces, part = scan.scan(room, faults, rng)
    given = bool(rng.random() >= PIECES)
    delivered = np.stack([scan.misplaced(pose, faults, rng) for pose in poses])
    facts = {"seed": seed, "generator": VERSION, "views": session.views, "size": session.size, "samples": session.samples}
    facts |= {"given": given, "hdr": photographs.is_hdr, "faults": faults.facts()}
    return Capture(photographs, delivered, focal, vertices, faces, part, given, truth, facts)


def render(
    room: Room, poses: np.ndarray, focal: float, session: Session, seed: int, denoise: Denoiser | None
) -> tuple[np.ndarray, Truth]:
    """Render the radiance (V, H, W, 3) float32 of a room from V true poses, and its truth."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.render import render as trace_paths
    from iif_core.light.transport.scene import PathOptions, Scene

    vertices, faces, part = room.mesh()
    geometry = build_geometry(vertices, faces, part)
    emission = room.emission()[part]
    emitters = Emitters(geometry, emission, np.ones(len(faces), np.int8), environment=room.sky)
    scene = Scene(geometry, room.materials.drjit(), emitters)
    count, size = len(poses), session.size
    ways = np.stack([pixel_directions(focal, focal, size / 2, size / 2, size, size, pose) for pose in poses]).reshape(-1, 3)
    origins = np.repeat(poses[:, :3, 3], size * size, 0)
    steps = [
        np.repeat(np.stack(d), size * size, 0) for d in zip(*[direction_derivatives(focal, focal, p) for p in poses], strict=True)
    ]
    image = trace_paths(scene, origins, ways, PathOptions(session.samples, BOUNCES, seed, chunk=_LANES), jitter=tuple(steps))
    image = np.maximum(np.nan_to_num(image), 0).reshape(count, size, size, 3)
    shown = _first(geometry, part, origins, ways)
    truth = _truth(room, shown, origins, ways, steps, emission, (count, size, size))
    if denoise is not None:
        hit = shown.face >= 0
        normal = np.where(hit[:, None], -np.sign(shown.cosine)[:, None] * shown.normal, 0).reshape(image.shape).astype(np.float32)
        image = np.stack([denoise(i, a.astype(np.float32), n) for i, a, n in zip(image, truth.albedo, normal, strict=True)])
    return image, truth


def _first(geometry, part: np.ndarray, origins: np.ndarray, ways: np.ndarray) -> _Shown:
    from iif_core.light.transport.geometry import trace

    face, depth = trace(geometry, origins, ways)
    on = np.maximum(face, 0)
    normal = geometry.normals[on]
    return _Shown(face, np.where(face >= 0, depth, 0), part[on], (normal * ways).sum(1), normal)


def _truth(
    room: Room, shown: _Shown, origins: np.ndarray, ways: np.ndarray, steps: list, emission: np.ndarray, shape: tuple
) -> Truth:
    """Material at four points of each pixel on the plane of the face in its middle, averaged: textures finer than a pixel would
    make the value at the middle a matter of chance."""
    hit = shown.face >= 0
    total = 0
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        way = ways + du * steps[0] + dv * steps[1]
        reach = shown.depth * shown.cosine / np.where(np.abs(c := (shown.normal * way).sum(1)) > 1e-6, c, 1e-6)
        # A face seen edge-on has no such plane: near the middle the reach stays within a tenth.
        reach = np.clip(reach, 0.9 * shown.depth, 1.1 * shown.depth)
        albedo, rough, metal = room.materials.at(origins + reach[:, None] * way, shown.part)
        total = total + np.column_stack([albedo, rough, metal])
    mean = np.where(hit[:, None], total / 4, 0)
    shines = emission[np.maximum(shown.face, 0)].any(1) & (shown.cosine < 0)
    bytes_of = lambda a: np.rint(255 * np.clip(a, 0, 1)).astype(np.uint8).reshape(shape)  # noqa: E731
    albedo = mean[:, :3].astype(np.float16).reshape(*shape, 3)
    return Truth(albedo, bytes_of(mean[:, 3]), bytes_of(mean[:, 4]), (hit & ~shines).reshape(shape))
