"""A generated capture: what a real one has, and the truth, in memory and as one file per room.

A file holds no depth and no inputs of the network: both are computed from mesh and cameras when they are needed, so that rooms
stay valid when the inputs change.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.light.irradiance import Trace
from lab.prior.sensor import Photographs
from workflow.scene.normal_form import View


@dataclass(frozen=True)
class Truth:
    """What the photographs show, at the middle of each pixel (V, H, W); albedo and roughness are means over the pixel.

    Attributes:
        albedo: (V, H, W, 3) float16 linear base colour.
        roughness, metallic: (V, H, W) uint8, 255 = 1; roughness is perceptual.
        valid: (V, H, W) bool: surface that does not shine.
    """

    albedo: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    valid: np.ndarray

    def stacked(self, view: int) -> np.ndarray:
        """Return albedo, roughness, metallic of a view: (5, H, W) float16."""
        maps = [*np.moveaxis(self.albedo[view], -1, 0), self.roughness[view] / 255, self.metallic[view] / 255]
        return np.stack(maps).astype(np.float16)


@dataclass
class Capture:
    """A capture with truth, offered as the product's `CaptureReader` offers one (used, mesh, faces, photo, gbuffer, ...).

    Attributes:
        photographs: V views of H x W pixels.
        poses: (V, 4, 4) as delivered; focal: pixels; the principal point is the middle.
        vertices: (n, 3) float32 metres; triangles: (m, 3) int32: the delivered mesh.
        instance: (m,) int32 object of each face.
        given: whether the product may know the objects; else it makes pieces of the mesh.
        truth: of the pixels.
        facts: how it was made.
    """

    photographs: Photographs
    poses: np.ndarray
    focal: float
    vertices: np.ndarray
    triangles: np.ndarray
    instance: np.ndarray
    given: bool
    truth: Truth
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def is_hdr(self) -> bool:
        """Whether photographs are radiance."""
        return self.photographs.is_hdr

    @cached_property
    def used(self) -> list[View]:
        """The views; none is held out."""
        count, height, width = self.photographs.values.shape[:3]
        camera = (width, height, self.focal, self.focal, width / 2, height / 2)
        return [View(v, f"{v:03d}", *camera, self.poses[v], float(self.photographs.exposure[v])) for v in range(count)]

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (n, 3) float32 and faces (m, 3) int32."""
        return self.vertices, self.triangles

    def faces(self) -> dict[str, np.ndarray]:
        """Return the object of each face, -1 where the product may not know it."""
        return {"instance_id": self.instance if self.given else np.full(len(self.triangles), -1, np.int32)}

    def photo(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W, 3) float32 sensor values or radiance, and (H, W) bool, all of which may be used."""
        values = self.photographs.values[view.view_id]
        return values.astype(np.float32) / (1 if self.is_hdr else 255), np.ones(values.shape[:2], bool)

    def gbuffer(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) float32 in metres (0 = miss) and face ids (H, W) int32 (-1 = miss) of the delivered mesh."""
        depth, face = self._gbuffers
        return depth[view.view_id], face[view.view_id]

    def given_instances(self, view: View) -> np.ndarray | None:
        """Return None: objects come from the mesh."""
        return None

    def points(self, view: View, depth: np.ndarray) -> np.ndarray:
        """Return (H, W, 3) float32 surface points in metres."""
        return view.points(depth)

    @cached_property
    def tracer(self) -> Trace:
        """Rays against the delivered mesh, on the active device."""
        from iif_core.light.transport.geometry import build_geometry, trace

        geometry = build_geometry(self.vertices, self.triangles, self.instance)
        return lambda origins, directions: trace(geometry, origins, directions)

    @cached_property
    def _gbuffers(self) -> tuple[np.ndarray, np.ndarray]:
        directions = np.stack([view.directions() for view in self.used])
        origins = np.broadcast_to(self.poses[:, None, None, :3, 3], directions.shape)
        face, depth = self.tracer(origins.reshape(-1, 3), directions.reshape(-1, 3))
        face = np.asarray(face, np.int32).reshape(directions.shape[:3])
        return np.where(face >= 0, np.reshape(depth, face.shape), 0).astype(np.float32), face

    def save(self, path: Path) -> None:
        """Write the capture as one file, which appears when it is complete."""
        t = self.truth
        arrays = {
            "photo": self.photographs.values,
            "exposure": self.photographs.exposure,
            "poses": self.poses,
            "focal": np.array(self.focal),
            "vertices": self.vertices,
            "triangles": self.triangles,
            "instance": self.instance,
            "given": np.array(self.given),
            **{name: getattr(t, name) for name in ("albedo", "roughness", "metallic", "valid")},
            "facts": np.array(json.dumps(self.facts)),
        }
        write_arrays(path, arrays)


def load(path: Path) -> Capture:
    """Read a capture that `Capture.save` wrote."""
    with np.load(path) as f:
        truth = Truth(*(f[name] for name in ("albedo", "roughness", "metallic", "valid")))
        mesh = f["vertices"], f["triangles"], f["instance"]
        photographs = Photographs(f["photo"], f["exposure"])
        return Capture(photographs, f["poses"], float(f["focal"]), *mesh, bool(f["given"]), truth, json.loads(str(f["facts"])))


def write_arrays(path: Path, arrays: dict[str, np.ndarray], compressed: bool = True) -> None:
    """Write arrays to a file under a temporary name and rename it, so that a killed process leaves no half file."""
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    (np.savez_compressed if compressed else np.savez)(unfinished, **arrays)
    os.replace(unfinished, path)
