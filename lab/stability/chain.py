"""The stages from the plan to the materials on a capture that is held in memory, so that it can be changed before them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.loose import Loose, changed, document_of
from workflow.artifacts import StageReader
from workflow.artifacts.store import ids_from_disk, prediction_numbers, rgb, split_rgb
from workflow.priors.face_albedo import albedo_of_faces
from workflow.scene.normal_form import CaptureReader, CaptureWriter, View

SOURCES = ("capture", "prior")
FITTED = ("plan", "segmentation", "base", "emission", "shading", "second_look", "affines")
"""The stages that are run on a changed capture, in order."""
_CHANNELS = ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic")


@dataclass(frozen=True)
class Capture:
    """A capture with its predictions, in memory.

    Attributes:
        views: cameras; photo, valid, depth, face: view name -> its raster; maps: view name -> predictions (K, H, W, 5) half.
        vertices: (n, 3) float32 m; faces: (m, 3); instance: (m,) object of each face; names: of the objects.
        emission: (m, 3) true radiance of the faces.
        truth, known: view name -> true materials (H, W, 5), and the pixels where they mean something.
        facts: capture.json; document: settings of all stages; threads: of each stage.
    """

    views: tuple[View, ...]
    photo: Mapping[str, NDArray]
    valid: Mapping[str, NDArray]
    depth: Mapping[str, NDArray]
    face: Mapping[str, NDArray]
    maps: Mapping[str, NDArray]
    vertices: NDArray
    faces: NDArray
    instance: NDArray
    names: tuple[str, ...]
    emission: NDArray
    truth: Mapping[str, NDArray]
    known: Mapping[str, NDArray]
    facts: Mapping[str, Any]
    document: Mapping[str, Any]
    threads: int = 1

    def with_settings(self, **sections: dict[str, Any]) -> Capture:
        """Return the same capture with some settings changed."""
        return replace(self, document=changed(self.document, sections))


@dataclass(frozen=True)
class Result:
    """What the stages found.

    Attributes:
        maps: view name -> materials (H, W, 5) float32; seen: view name -> pixels that show an object.
        base: view name -> base texture (H, W, 5); diffuse: view name -> diffuse light (H, W, 3), mean of both halves.
        power: (3,) radiance times area, summed over the emitters that were kept.
        environment: (3,) mean radiance from outside, 0 if there is none.
        lamps: names of the objects with faces that shine, as often as they have emitters.
        decisions: component of the plan -> whether it is in; selected: (segments, 3) prediction with the largest weight.
        documents: stage -> its JSON.
    """

    maps: Mapping[str, NDArray]
    seen: Mapping[str, NDArray]
    base: Mapping[str, NDArray]
    diffuse: Mapping[str, NDArray]
    power: NDArray
    environment: NDArray
    lamps: tuple[str, ...]
    decisions: Mapping[str, bool]
    selected: NDArray
    documents: Mapping[str, Any]


def _open(folder: Path, stage: str) -> StageReader:
    return Loose(folder, {}).open(stage)


def run_stages(folder: Path, document: Mapping[str, Any], stages: tuple[str, ...], threads: int = 1) -> None:
    """Run stages one after the other in a folder that has what they read."""
    for stage in stages:
        job = Loose(folder, document).job(stage, threads)
        importlib.import_module(job.stage.module).run(job)
        job.writer.finish()


def make_capture(folder: Path, settings: dict[str, Any]) -> Capture:
    """Render a scene with ground truth and its predictions once, and hold them in memory."""
    document = document_of(settings)
    run_stages(folder, document, SOURCES)
    capture = CaptureReader(_open(folder, "capture"))
    photos = {view.name: capture.photo(view) for view in capture.used}
    surface = {view.name: capture.gbuffer(view) for view in capture}
    truths = {view.name: capture.truth(view) for view in capture}
    vertices, faces = capture.mesh()
    columns = capture.faces()
    names = capture.reader.table("instances.parquet")["name"] if capture.reader.has("instances.parquet") else ()
    return Capture(
        tuple(capture.views),
        {name: photo for name, (photo, _) in photos.items()},
        {name: valid for name, (_, valid) in photos.items()},
        {name: depth for name, (depth, _) in surface.items()},
        {name: face for name, (_, face) in surface.items()},
        _predictions(capture, folder),
        vertices,
        faces,
        columns["instance_id"],
        tuple(str(name) for name in names),
        np.stack([columns[f"emission_{c}"] for c in "rgb"], 1),
        {name: np.concatenate([t.albedo, t.roughness[..., None], t.metallic[..., None]], -1) for name, t in truths.items()},
        {name: t.valid & ~t.emission.any(-1) for name, t in truths.items()},
        capture.facts,
        document,
    )


def with_predictions(capture: Capture, folder: Path, **prior: Any) -> Capture:
    """Return a capture whose predictions were made with other settings of the prior, from the folder of `make_capture`."""
    other = capture.with_settings(prior=prior)
    run_stages(folder, other.document, ("prior",))
    return replace(other, maps=_predictions(CaptureReader(_open(folder, "capture")), folder))


def _predictions(capture: CaptureReader, folder: Path) -> dict[str, NDArray]:
    prior, maps = _open(folder, "prior"), {}
    for view in capture.used:
        channels = prior.exr(f"maps/{view.name}.exr")
        layers = [f"prior.{k:03d}" for k in prediction_numbers(channels)]
        maps[view.name] = np.stack([np.stack([channels[f"{layer}.{name}"] for name in _CHANNELS], -1) for layer in layers])
    return {name: values.astype(np.float16) for name, values in maps.items()}


def run(capture: Capture, folder: Path) -> Result:
    """Write a capture to a folder as the stages `SOURCES` would have, and run the stages `FITTED` on it."""
    _write(capture, folder)
    run_stages(folder, capture.document, FITTED, capture.threads)
    return read(capture, folder)


def _write(capture: Capture, folder: Path) -> None:
    free = Loose(folder, capture.document)
    writer, prior = free.plant("capture"), free.plant("prior")
    form = CaptureWriter(writer)
    form.cameras(list(capture.views))
    form.mesh(capture.vertices, capture.faces, capture.instance, list(capture.names) or None, capture.emission)
    hdr = capture.facts["dynamic_range"] == "hdr"
    rows = []
    for view in capture.views:
        name = view.name
        form.gbuffer(name, capture.depth[name], capture.face[name])
        form.photo(name, capture.photo[name], capture.valid[name], encoded=not hdr)
        channels: dict[str, NDArray] = {}
        for k, maps in enumerate(capture.maps[name]):
            layer = f"prior.{k:03d}"
            channels |= split_rgb(maps[..., :3], f"{layer}.albedo", np.float16)
            channels |= {f"{layer}.roughness": maps[..., 3], f"{layer}.metallic": maps[..., 4]}
            rows.append((view.view_id, k))
        prior.exr(f"maps/{name}.exr", channels)
    facts = {key: value for key, value in capture.facts.items() if key not in ("source", "dynamic_range", "has_truth", "notes")}
    truth = facts.pop("response_truth", None)
    form.finish(capture.facts["source"], capture.facts["dynamic_range"], False, [], truth, facts)
    writer.finish()
    view_id, k = np.array(rows, np.int32).T
    used = np.ones(len(rows), bool)
    prior.table("predictions.parquet", {"view_id": view_id, "k": k, "used": used, "reason": np.array([""] * len(rows), object)})
    reader = CaptureReader(free.open("capture"))
    prior.table("faces.parquet", albedo_of_faces(prior, reader, set(view_id.tolist())))
    prior.finish()


def read(capture: Capture, folder: Path) -> Result:
    """Read what the stages wrote to a folder."""
    affines, segmentation, emission, base, shading, plan = (
        _open(folder, stage) for stage in ("affines", "segmentation", "emission", "base", "shading", "plan")
    )
    maps, seen, texture, diffuse = {}, {}, {}, {}
    for view in capture.views:
        file = f"maps/{view.name}.exr"
        maps[view.name], texture[view.name] = _materials(affines.exr(file)), _materials(base.exr(file))
        seen[view.name] = ids_from_disk(segmentation.exr(file)["object.id"]) >= 0
        halves = shading.exr(file)
        diffuse[view.name] = 0.5 * (rgb(halves, "half0.diffuse") + rgb(halves, "half1.diffuse"))
    emitters = emission.table("emitters.parquet")
    kept, area = np.asarray(emitters["kept"], bool), np.asarray(emitters["kind"]) == "area"
    radiance = np.stack([emitters[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float64)
    size = np.asarray(emitters["area_m2"], np.float64)
    outside = radiance[kept & ~area]
    plans = [plan.json("plan.json"), emission.json("emission.json")]
    selection = base.table("selection.parquet")
    numbers = int(np.max(selection["k"], initial=0)) + 1
    weight = np.stack([selection[f"weight_{name}"] for name in ("albedo", "roughness", "metallic")], 1)
    return Result(
        maps,
        seen,
        texture,
        diffuse,
        (radiance * np.where(kept & area, size, 0)[:, None]).sum(0),
        outside.mean(0) if len(outside) else np.zeros(3),
        _lamps(capture, emission, np.asarray(emitters["emitter_id"])[kept & area]),
        {item["component"]: bool(item["included"]) for plan in plans for item in plan["plan"]},
        weight.reshape(-1, numbers, 3).argmax(1),
        {
            "base": base.json("base.json"),
            "emission": plans[1],
            "shading": shading.json("shading.json"),
            "affines": affines.json("affines.json"),
        },
    )


def _lamps(capture: Capture, emission: StageReader, kept: NDArray) -> tuple[str, ...]:
    """Objects of the emitters that were kept, by the true segmentation."""
    faces = emission.table("emitter_faces.parquet")
    first = [int(faces["face_id"][faces["emitter_id"] == number][0]) for number in kept]
    owner = capture.instance[first] if first else []
    return tuple(sorted(capture.names[i] if 0 <= i < len(capture.names) else "none" for i in owner))


def _materials(channels: dict[str, NDArray]) -> NDArray:
    parts = [rgb(channels, "albedo"), channels["roughness"][..., None], channels["metallic"][..., None]]
    return np.concatenate(parts, -1).astype(np.float32)


ROOMS: dict[str, dict[str, Any]] = {
    "tiny": {
        "source": {"kind": "builtin", "scene": "tiny"},
        "capture": {"dynamic_range": "hdr", "views": 6, "width": 48, "height": 48, "samples": 64},
        "prior": {"kind": "simulated", "samples": 3, "strength": 0.5},
        "segmentation": {"kind": "given"},
        "emission": {"rows": 4000, "samples": 16},
        "shading": {"samples": 16, "levels": 6},
        "affines": {"pixels": 20000},
        "components": {"specular": "on"},
    },
    "kitchen": {
        "source": {"kind": "builtin", "scene": "kitchen"},
        "capture": {"dynamic_range": "ldr", "views": 10, "width": 96, "height": 96, "samples": 64},
        "prior": {"kind": "simulated", "samples": 4},
        "segmentation": {"kind": "given"},
        "emission": {"rows": 10000, "samples": 16},
        "shading": {"samples": 16, "levels": 8},
        "affines": {"pixels": 50000},
        "components": {"specular": "on", "environment": "off"},
    },
}
"""Captures that are made once and changed: linear photographs of a closed room, and 8-bit ones of unknown response. What the plan
would decide is pinned, because a decision that flips moves everything; how often that happens is counted elsewhere."""
