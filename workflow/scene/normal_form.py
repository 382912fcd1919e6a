"""The normal form of a capture: every source writes it, and every later stage reads it (docs/reference/artefacts.md, capture)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.pinhole import up_axis
from iif_core.camera.view import View
from workflow.artifacts.store import StageReader, StageWriter, ids_from_disk, ids_to_disk, rgb, split_rgb


@dataclass(frozen=True)
class Truth:
    """Ground truth of one view; `valid` excludes pixels without a material truth, such as glass and background."""

    albedo: np.ndarray  # (H, W, 3) linear
    roughness: np.ndarray  # (H, W) perceptual
    metallic: np.ndarray  # (H, W)
    emission: np.ndarray  # (H, W, 3) radiance
    radiance: np.ndarray  # (H, W, 3) with the noise of the rendering
    valid: np.ndarray  # (H, W) bool


class CaptureWriter:
    """Writes the normal form. The order of the calls does not matter, except that `finish` comes last."""

    def __init__(self, writer: StageWriter):
        self.writer = writer

    def cameras(self, views: list[View]) -> None:
        """Write all cameras; their names must be unique."""
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
        """Write the mesh.

        Args:
            vertices: (n, 3) metres.
            faces: (m, 3).
            instance_id: (m,) object of each face, -1 = none.
            instance_names: one per id.
            emission: (m, 3) radiance of the front side, where it is known.
        """
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
        """Write a photograph.

        Args:
            name: of the view.
            image: (H, W, 3) sensor values in [0, 1], or radiance.
            valid: (H, W) bool, the pixels that may be used; None = all.
            encoded: whether the values are sensor values.
        """
        mask = np.ones(image.shape[:2], bool) if valid is None else np.asarray(valid, bool)
        space = "sensor" if encoded else "linear"
        self.writer.exr(f"photos/{name}.exr", {**split_rgb(image), "valid": mask}, "relative", space)

    def gbuffer(self, name: str, depth: np.ndarray, face_id: np.ndarray) -> None:
        """Write z-depth (H, W) in metres, 0 = miss, and face ids (H, W), -1 = miss."""
        channels = {"depth.Z": depth.astype(np.float32), "face.id": ids_to_disk(face_id)}
        self.writer.exr(f"gbuffer/{name}.exr", channels, "m")

    def given_instances(self, name: str, instance_id: np.ndarray) -> None:
        """Write the object ids (H, W) that the source gives for a view, -1 = none."""
        self.writer.exr(f"given/{name}.exr", {"instance.id": ids_to_disk(instance_id)})

    def truth(self, name: str, truth: Truth) -> None:
        """Write the ground truth of one view."""
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
        """Write capture.json.

        Args:
            source: kind of the source.
            dynamic_range: `ldr` or `hdr`.
            has_truth: whether ground truth was written for all views.
            notes: what was approximated or corrected, as text.
            response_truth: (3, 101) samples of the true camera response on [0, 1], where it is known.
            facts: further entries of the document.
        """
        document = {"source": source, "dynamic_range": dynamic_range, "has_truth": has_truth, "notes": notes, **(facts or {})}
        if response_truth is not None:
            document["response_truth"] = np.asarray(response_truth, float).round(8).tolist()
        self.writer.json("capture.json", document)


def stated_exposures(facts: Mapping[str, Any], views: Sequence[View]) -> np.ndarray | None:
    """Return the exposures (views,) that the files of the photographs state, up to one factor, NaN = none; None: no file states
    one. `facts`: of the capture."""
    stated = facts.get("stated_exposure") or {}
    return np.array([stated.get(view.name, np.nan) for view in views], np.float64) if stated else None


WIDE_CELL = 0.2
"""Edge in metres of the cells of surface by which it is told which photograph shows most."""
_WIDE_PIXELS = 20_000


def widest(capture: CaptureReader) -> View:
    """Return the view that shows most surface, of those that are not held out; the first of equals."""

    def cells(view: View) -> int:
        depth, face = capture.gbuffer(view)
        step = max(1, int(np.sqrt(depth.size / _WIDE_PIXELS)))
        points = capture.points(view, depth)[::step, ::step][(face >= 0)[::step, ::step]]
        return len(np.unique(np.floor(points / WIDE_CELL).astype(np.int64), axis=0))

    return max(capture.used or capture.views, key=cells)


class CaptureReader:
    """Reads the normal form of a finished capture stage."""

    def __init__(self, reader: StageReader):
        self.reader = reader
        self.facts: dict[str, Any] = reader.json("capture.json")
        if "truth/" in reader.closed:
            self.facts = {key: value for key, value in self.facts.items() if not key.endswith("_truth")}
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

    @property
    def up(self) -> np.ndarray:
        """(3,) direction that is up in the world: as capture.json says, or else the axis nearest to that of the cameras."""
        return np.asarray(self.facts.get("up") or up_axis([view.world_from_camera for view in self.views]), np.float64)

    def __iter__(self) -> Iterator[View]:
        return iter(self.views)

    def exposures(self) -> np.ndarray:
        """Return the exposures (views,) in the order of the views."""
        return np.array([view.exposure for view in self.views], np.float64)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (n, 3) float32 in metres and faces (m, 3) int32."""
        v, f = self.reader.table("vertices.parquet"), self.reader.table("faces.parquet", ("v0", "v1", "v2"))
        return np.stack([v["x"], v["y"], v["z"]], 1), np.stack([f["v0"], f["v1"], f["v2"]], 1)

    def faces(self) -> dict[str, np.ndarray]:
        """Return the columns of faces.parquet, with instance ids and true emission only for jobs that may read them."""
        return self.reader.table("faces.parquet")

    @property
    def used(self) -> list[View]:
        """The views that are not held out: no estimate may read any other photograph."""
        return [view for view in self.views if view.split != "test"]

    def photo(self, view: View, held_out: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W, 3) float32 sensor values or radiance, and (H, W) bool, the pixels that may be used.

        Raises:
            AssertionError: the view is held out, and `held_out` is not set, or the stage is not one that `scores` (registry.py).
        """
        if view.split == "test" and not held_out:
            raise AssertionError(f"view {view.name} is held out: its photograph is for scores alone")
        channels = self.reader.exr(f"photos/{view.name}.exr")
        return rgb(channels), channels["valid"] > 0.5

    def gbuffer(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) float32 in metres (0 = miss) and face ids (H, W) int32 (-1 = miss)."""
        channels = self.reader.exr(f"gbuffer/{view.name}.exr")
        return channels["depth.Z"], ids_from_disk(channels["face.id"])

    def given_instances(self, view: View) -> np.ndarray | None:
        """Return the object ids (H, W) int32 that the source gives for a view, or None."""
        name = f"given/{view.name}.exr"
        return ids_from_disk(self.reader.exr(name)["instance.id"]) if self.reader.has(name) else None

    def truth(self, view: View) -> Truth:
        """Return the ground truth of a view; only for captures with `has_truth`."""
        c = self.reader.exr(f"truth/{view.name}.exr")
        valid = c["valid"] > 0.5
        return Truth(rgb(c, "albedo"), c["roughness"], c["metallic"], rgb(c, "emission"), rgb(c, "radiance"), valid)

    def points(self, view: View, depth: np.ndarray) -> np.ndarray:
        """Return (H, W, 3) float32 surface points in metres; they mean nothing where the depth is 0."""
        return view.points(depth)
