"""The waist of the workflow: every source ends in this form, every later stage begins with it (docs/artefacts.md, capture)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from workflow.artifacts.store import StageReader, StageWriter, ids_from_disk, ids_to_disk, rgb, split_rgb


@dataclass(frozen=True)
class View:
    """One photograph's camera. OpenCV axes, pixel centres at (u + 0.5, v + 0.5), lengths in metres."""

    view_id: int
    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray  # (4, 4) float64
    exposure: float = 1.0  # multiplies radiance before the response
    split: str = "train"


@dataclass(frozen=True)
class Truth:
    """Ground truth of one view; `valid` is where material truth means something (not glass, not background)."""

    albedo: np.ndarray  # (H, W, 3) linear
    roughness: np.ndarray  # (H, W) perceptual
    metallic: np.ndarray  # (H, W)
    emission: np.ndarray  # (H, W, 3) radiance
    radiance: np.ndarray  # (H, W, 3) noise of the render included
    valid: np.ndarray  # (H, W) bool


class CaptureWriter:
    """Writes the normal form; the order of calls does not matter, `finish` comes last."""

    def __init__(self, writer: StageWriter):
        self.writer = writer

    def cameras(self, views: list[View]) -> None:
        """All cameras; names must be unique."""
        columns = {
            name: [getattr(v, name) for v in views]
            for name in ("name", "width", "height", "fx", "fy", "cx", "cy", "exposure", "split")
        }
        for name in ("width", "height"):
            columns[name] = np.array(columns[name], np.int32)
        poses = np.array([v.world_from_camera.ravel() for v in views], np.float64).reshape(len(views), 16)
        ids = np.array([v.view_id for v in views], np.int32)
        units = {"fx": "pixel", "fy": "pixel", "cx": "pixel", "cy": "pixel", "world_from_camera": "m"}
        self.writer.table("cameras.parquet", {"view_id": ids, **columns, "world_from_camera": poses}, units)

    def mesh(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        instance_id: np.ndarray | None = None,
        instance_names: list[str] | None = None,
        emission: np.ndarray | None = None,
    ) -> None:
        """Vertices (n, 3) in metres, faces (m, 3), ids (m,) with -1 = none, emission (m, 3) of the front side if known."""
        v, f = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
        n = np.arange(len(v), dtype=np.int32)
        self.writer.table(
            "vertices.parquet", {"vertex_id": n, "x": v[:, 0], "y": v[:, 1], "z": v[:, 2]}, dict.fromkeys("xyz", "m")
        )
        ids = np.full(len(f), -1, np.int32) if instance_id is None else np.asarray(instance_id, np.int32)
        columns: dict[str, Any] = {"face_id": np.arange(len(f), dtype=np.int32)}
        columns |= {"v0": f[:, 0], "v1": f[:, 1], "v2": f[:, 2], "instance_id": ids}
        if emission is not None:
            columns |= {f"emission_{c}": np.asarray(emission, np.float32)[:, i] for i, c in enumerate("rgb")}
        self.writer.table("faces.parquet", columns)
        if instance_names is not None:
            rows = {"instance_id": np.arange(len(instance_names), dtype=np.int32), "name": list(instance_names)}
            self.writer.table("instances.parquet", rows)

    def photo(self, name: str, image: np.ndarray, valid: np.ndarray | None = None, encoded: bool = True) -> None:
        """(H, W, 3): sensor values in [0, 1] when `encoded`, else radiance; `valid` (H, W) bool, default all."""
        mask = np.ones(image.shape[:2], bool) if valid is None else np.asarray(valid, bool)
        space = "sensor" if encoded else "linear"
        self.writer.exr(f"photos/{name}.exr", {**split_rgb(image), "valid": mask}, "relative", space)

    def gbuffer(self, name: str, depth: np.ndarray, face_id: np.ndarray) -> None:
        """z-depth (H, W) in metres, 0 = miss; face ids (H, W), -1 = miss."""
        channels = {"depth.Z": depth.astype(np.float32), "face.id": ids_to_disk(face_id)}
        self.writer.exr(f"gbuffer/{name}.exr", channels, "m")

    def given_instances(self, name: str, instance_id: np.ndarray) -> None:
        """Per-view ids (H, W) that the source came with, -1 = none."""
        self.writer.exr(f"given/{name}.exr", {"instance.id": ids_to_disk(instance_id)})

    def truth(self, name: str, truth: Truth) -> None:
        """Ground truth of one view."""
        channels = {
            **split_rgb(truth.albedo, "albedo"),
            "roughness": truth.roughness.astype(np.float32),
            "metallic": truth.metallic.astype(np.float32),
            **split_rgb(truth.emission, "emission"),
            **split_rgb(truth.radiance, "radiance"),
            "valid": np.asarray(truth.valid, bool),
        }
        self.writer.exr(f"truth/{name}.exr", channels, "relative")

    def finish(
        self,
        source: str,
        dynamic_range: str,
        has_truth: bool,
        notes: list[str],
        response_truth: np.ndarray | None = None,
        facts: dict[str, Any] | None = None,
    ) -> None:
        """What the capture is, and in words what was approximated or treated. `response_truth`: (3, 101) samples of f."""
        document = {"source": source, "dynamic_range": dynamic_range, "has_truth": has_truth, "notes": notes, **(facts or {})}
        if response_truth is not None:
            document["response_truth"] = np.asarray(response_truth, float).round(8).tolist()
        self.writer.json("capture.json", document)


class CaptureReader:
    """Reads the normal form of a finished capture stage."""

    def __init__(self, reader: StageReader):
        self.reader = reader
        self.facts: dict[str, Any] = reader.json("capture.json")
        table = reader.table("cameras.parquet")
        self.views = [
            View(
                int(table["view_id"][i]),
                str(table["name"][i]),
                int(table["width"][i]),
                int(table["height"][i]),
                *(float(table[c][i]) for c in ("fx", "fy", "cx", "cy")),
                table["world_from_camera"][i].reshape(4, 4),
                float(table["exposure"][i]),
                str(table["split"][i]),
            )
            for i in range(len(table["view_id"]))
        ]

    @property
    def has_truth(self) -> bool:
        return bool(self.facts["has_truth"])

    @property
    def is_hdr(self) -> bool:
        return self.facts["dynamic_range"] == "hdr"

    def __iter__(self) -> Iterator[View]:
        return iter(self.views)

    def exposures(self) -> np.ndarray:
        """(views,) exposure of every view, in order."""
        return np.array([view.exposure for view in self.views], np.float64)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, 3) float32 in metres and faces (m, 3) int32."""
        v, f = self.reader.table("vertices.parquet"), self.reader.table("faces.parquet")
        return np.stack([v["x"], v["y"], v["z"]], 1), np.stack([f["v0"], f["v1"], f["v2"]], 1)

    def faces(self) -> dict[str, np.ndarray]:
        """Columns of faces.parquet (instance ids, true emission)."""
        return self.reader.table("faces.parquet")

    def true_emission(self) -> np.ndarray | None:
        """(m, 3) radiance of the front side of every face, if known."""
        f = self.faces()
        return np.stack([f[f"emission_{c}"] for c in "rgb"], 1) if "emission_r" in f else None

    @property
    def used(self) -> list[View]:
        """The views that may be read to find anything: all but those held out."""
        return [view for view in self.views if view.split != "test"]

    def photo(self, view: View, held_out: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) float32 sensor values or radiance, and (H, W) bool: which pixels count.

        A held-out photograph is refused unless `held_out` says that it is read to score or to show, never to fit.
        """
        if view.split == "test" and not held_out:
            raise AssertionError(f"view {view.name} is held out: its photograph is for scores alone")
        channels = self.reader.exr(f"photos/{view.name}.exr")
        return rgb(channels), channels["valid"] > 0.5

    def gbuffer(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """z-depth (H, W) float32 metres (0 = miss) and face ids (H, W) int32 (-1 = miss)."""
        channels = self.reader.exr(f"gbuffer/{view.name}.exr")
        return channels["depth.Z"], ids_from_disk(channels["face.id"])

    def given_instances(self, view: View) -> np.ndarray | None:
        """Per-view ids (H, W) int32, or None when the source has none."""
        name = f"given/{view.name}.exr"
        return ids_from_disk(self.reader.exr(name)["instance.id"]) if self.reader.has(name) else None

    def truth(self, view: View) -> Truth:
        """Ground truth of a view (only when `has_truth`)."""
        c = self.reader.exr(f"truth/{view.name}.exr")
        valid = c["valid"] > 0.5
        return Truth(rgb(c, "albedo"), c["roughness"], c["metallic"], rgb(c, "emission"), rgb(c, "radiance"), valid)

    def directions(self, view: View) -> np.ndarray:
        """(H, W, 3) world directions through pixel centres, scaled so that point = origin + z-depth * direction."""
        from iif_core.camera.pinhole import pixel_directions

        return pixel_directions(view.fx, view.fy, view.cx, view.cy, view.width, view.height, view.world_from_camera)

    def points(self, view: View, depth: np.ndarray) -> np.ndarray:
        """(H, W, 3) float32 surface points; meaningless where depth is 0."""
        origin = view.world_from_camera[:3, 3]
        return (origin + depth[..., None] * self.directions(view)).astype(np.float32)
