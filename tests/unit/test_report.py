"""The last stages on a made-up scene: render, metrics, export, report and publish over artefacts written here."""

import json
import os
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
import yaml

from iif_core.camera.pinhole import direction_derivatives, look_at, pixel_directions
from iif_core.surface.cells import grid_origin, voxel_indices
from lab.loose import Loose, changed, document_of
from tests.errors import refused
from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import read_exr, read_parquet, sha256_of
from workflow.artifacts.manifest import SCENE_SCHEMA
from workflow.artifacts.store import ids_to_disk, rgb, split_rgb
from workflow.artifacts.verify import damaged
from workflow.decisions.record import PROVISIONAL, SETTLED, not_probed
from workflow.report import pictures as pic
from workflow.report.downloads import commands, downloads
from workflow.report.page import content_hash
from workflow.report.scores import score_table
from workflow.report.wording import number
from workflow.runtime.timings import read_timings
from workflow.scene.cached_light import SpecularLight, table_of
from workflow.scene.normal_form import CaptureReader, CaptureWriter, Truth, View
from workflow.scene.recovered import read_recovered, read_response, response_samples
from workflow.scoring.of_views import PredictionMeans
from workflow.stages import export, metrics, publish, render, report, room, unwrap

BOX = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
OUTWARD = np.array([[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]])
OUTWARD = np.concatenate([OUTWARD, [[2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]])
TRUE = np.array([[0.6, 0.5, 0.4, 0.8, 0.0], [0.2, 0.3, 0.7, 0.3, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0]])
LAMP = np.array([6.0, 5.0, 4.0])
WIDTH, HEIGHT, K = 40, 32, 3


def scene_of(root, written=None, **sections):
    """The stages of the scene `toy` under a folder, with quick settings; `written`: the folder under which they are written."""
    quick = {
        "render": {"samples": 256, "denoise": False},
        "export": {"max_faces_glb": 100_000, "texture_size": 256},
        "report": {"views": 2, "credit": "by <nobody> & co"},
        "room": {"lightmap_size": 64, "samples": 16, "denoise": False},
        "seed": 3,
        "device": os.environ.get("IIF_TEST_DEVICE", "cpu"),
    }
    document = changed(changed(document_of({"source": {"kind": "builtin", "scene": "tiny"}}), quick), sections)
    return Loose(root / "results/toy", document, "toy", written and written / "results/toy")


def made(scene, name, stage):
    """Run a stage; returns its job."""
    job = scene.job(name, 2)
    stage.run(job)
    job.writer.finish()
    return job


def material_columns(values):
    names = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
    return {name: values[:, i].astype(np.float32) for i, name in enumerate(names)}


def material_channels(values, shape, prefix=""):
    maps = values.reshape(*shape, 5)
    rough, metal = (maps[..., i].astype(np.float32) for i in (3, 4))
    return {**split_rgb(maps[..., :3], f"{prefix}albedo"), f"{prefix}roughness": rough, f"{prefix}metallic": metal}


def make_scene(root, truth=True, dynamic_range="ldr"):
    """Every artefact that the last stages read, of a room with a box and a lamp; the base is 20 % too dark."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry, trace
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from tests.oracles.face_materials import FaceMaterials

    rng = np.random.default_rng(0)
    quad = np.array([[1.0, 0.7, 2.4], [2.0, 0.7, 2.4], [2.0, 1.3, 2.4], [1.0, 1.3, 2.4]])
    vertices = np.concatenate([BOX * [3, 2, 2.5], BOX * 0.6 + [2.0, 1.1, 0.0], quad]).astype(np.float32)
    faces = np.concatenate([OUTWARD, OUTWARD + 8, np.array([[0, 2, 1], [0, 3, 2]]) + 16]).astype(np.int32)
    object_id = np.repeat([0, 1, 2], [12, 12, 2]).astype(np.int32)
    lit = object_id == 2
    radiance = np.where(lit[:, None], LAMP, 0)
    geometry = build_geometry(vertices, faces, object_id)
    emitters = Emitters(geometry, radiance, lit.astype(np.int8))

    scene = scene_of(root)
    writer = scene.plant("capture")
    form = CaptureWriter(writer)
    poses = [look_at([0.3, 0.3, 1.6], [2.2, 1.3, 0.8], [0, 0, 1]), look_at([2.7, 0.4, 1.4], [0.8, 1.4, 1.9], [0, 0, 1])]
    centre = (WIDTH / 2, HEIGHT / 2)
    views = [View(i, f"v{i}", WIDTH, HEIGHT, 30.0, 30.0, *centre, pose, 0.5 + 0.5 * i) for i, pose in enumerate(poses)]
    form.cameras(views)
    form.mesh(vertices, faces, object_id, ["walls", "box", "lamp"], radiance)
    seen = []
    for view in views:
        eye = view.world_from_camera[:3, 3]
        rays = pixel_directions(view.fx, view.fy, view.cx, view.cy, WIDTH, HEIGHT, view.world_from_camera).reshape(-1, 3)
        face, depth = trace(geometry, eye, rays)
        material = FaceMaterials(TRUE[object_id])
        jitter = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        image = render(Scene(geometry, material, emitters), eye, rays, PathOptions(256, 4, 1), jitter).reshape(HEIGHT, WIDTH, 3)
        exposed = np.clip(view.exposure * image, 0, 1)
        photo = image if dynamic_range == "hdr" else exposed ** (1 / 2.2)
        form.photo(view.name, photo, np.ones((HEIGHT, WIDTH), bool), dynamic_range == "ldr")
        form.gbuffer(view.name, depth.reshape(HEIGHT, WIDTH), face.reshape(HEIGHT, WIDTH))
        values = TRUE[object_id[face]]
        maps = values.reshape(HEIGHT, WIDTH, 5)
        emission = np.where(lit[face][:, None], LAMP, 0).reshape(HEIGHT, WIDTH, 3)
        valid = np.ones((HEIGHT, WIDTH), bool)
        if truth:
            form.truth(view.name, Truth(maps[..., :3], maps[..., 3], maps[..., 4], emission, image, valid))
        seen.append((view, eye + depth[:, None] * rays, object_id[face], values))
    curve = np.linspace(0, 1, 101) ** (1 / 2.2)
    samples = np.stack([curve] * 3) if truth and dynamic_range == "ldr" else None
    form.finish("made up", dynamic_range, truth, ["a note with <angle> brackets"], samples)
    writer.finish()

    writer = scene.plant("plan")
    closed = not_probed("environment", False, "the mesh is closed", SETTLED)
    open_yet = [not_probed(name, True, "decided later", PROVISIONAL) for name in ("metallic", "vignetting")]
    writer.json("plan.json", {"plan": [closed, *open_yet]})
    writer.finish()

    writer = scene.plant("prior", settings={"prior": {"kind": "simulated", "samples": K}})
    for view, _, _, values in seen:
        channels = {}
        for k in range(K):
            spoilt = np.clip(values * rng.uniform(0.5, 1.2, 5) + rng.normal(0, 0.05, values.shape), 0, 1)
            channels |= material_channels(spoilt, (HEIGHT, WIDTH), f"prior.{k:03d}.")
        writer.exr(f"maps/{view.name}.exr", channels)
    writer.finish()

    writer = scene.plant("segmentation")
    ids = np.arange(3, dtype=np.int32)
    writer.table("faces.parquet", {"face_id": np.arange(26), "object_id": object_id})
    writer.table("objects.parquet", {"object_id": ids, "name": ["walls", "box", "lamp"]})
    for view, _, objects, _ in seen:
        segment = (3 * view.view_id + objects).reshape(HEIGHT, WIDTH)
        channels = {"object.id": ids_to_disk(objects.reshape(HEIGHT, WIDTH)), "segment.id": ids_to_disk(segment)}
        channels["interior"] = np.ones((HEIGHT, WIDTH), np.float32)
        writer.exr(f"maps/{view.name}.exr", channels)
    writer.finish()

    writer = scene.plant("base", fingerprint="print of base")
    edge = 0.1
    points = np.concatenate([p for _, p, _, _ in seen])
    owner = np.concatenate([o for _, _, o, _ in seen])
    origin = grid_origin(points, edge)
    ijk = voxel_indices(points, edge, origin)
    cells, cell_of = np.unique(np.column_stack([ijk, owner]), axis=0, return_inverse=True)
    cell_of = cell_of.ravel()
    base = TRUE[cells[:, 3]] * [0.8, 0.8, 0.8, 1, 1]
    centres = origin + (cells[:, :3] + 0.5) * edge
    columns = {
        "cell_id": np.arange(len(cells)),
        **{c: cells[:, i] for i, c in enumerate("ijk")},
        "object_id": cells[:, 3],
    }
    columns |= {c: centres[:, i] for i, c in enumerate("xyz")}
    writer.table("cells.parquet", {**columns, **material_columns(base)})
    counts = np.bincount(cells[:, 3], minlength=3)
    writer.table("objects.parquet", {"object_id": ids, "cells": counts, **material_columns(TRUE * [0.8, 0.8, 0.8, 1, 1])})
    rows = {"segment_id": np.repeat(np.arange(6), K), "k": np.tile(np.arange(K), 6)}
    writer.table("selection.parquet", {**rows, "weight_albedo": rng.uniform(0, 1, 6 * K)})
    start = 0
    for view, p, _, values in seen:
        channels = {"cell.id": ids_to_disk(cell_of[start : start + len(p)].reshape(HEIGHT, WIDTH))}
        channels["coverage"] = np.ones((HEIGHT, WIDTH), np.float32)
        channels |= material_channels(values * [0.8, 0.8, 0.8, 1, 1], (HEIGHT, WIDTH))
        writer.exr(f"maps/{view.name}.exr", channels)
        start += len(p)
    plan = [{"component": "metallic", "included": False, "measure": "median predicted metalness", "value": 0.02}]
    plan[0] |= {"threshold": 0.25, "reason": "no object looks like a <metal>"}
    writer.json("base.json", {"cell_edge_m": edge, "origin": origin.tolist(), "plan": plan, "seen_once_share": 0.25})
    writer.finish()

    writer = scene.plant("emission")
    rows = {
        "emitter_id": np.array([0, 1]),
        "name": ["ceiling light 1", "walls"],
        "kind": ["area", "area"],
        "faces": np.array([2, 0]),
        "area_m2": np.array([0.6, 0.1]),
    }
    rows |= {"side": np.array([1, 0]), "observations": np.array([40, 9]), "kept": np.array([True, False])}
    rows |= {f"radiance_{c}": np.array([LAMP[i] / 2, 0.01]) for i, c in enumerate("rgb")}
    rows |= {f"error_{c}": np.array([0.1, 0.1]) for c in "rgb"} | {"reason": ["", "below 1 % of the power"]}
    writer.table("emitters.parquet", rows)
    none = {name: np.zeros(0, np.float32) for name in ("gain_r", "gain_g", "gain_b", "transmittance")}
    writer.table("object_gains.parquet", {"object_id": np.zeros(0, np.int32), **none})
    writer.table("emitter_faces.parquet", {"face_id": np.array([24, 25]), "emitter_id": [0, 0], "side": [1, 1]})
    writer.table("radiance_cache.parquet", {f"radiance_{c}": np.full(5, 0.05, np.float32) for c in "rgb"})
    exposure = [view.exposure for view, *_ in seen]
    gains = {"exposure": exposure, "gain": [[e] * 3 for e in exposure], "vignetting": [0.0, 0.0]}
    escape = {"primary": 0.0, "secondary": 0.0}
    writer.json("emission.json", {"notes": ["a note on light"], "plan": [], "escape_share": escape, **gains})
    writer.finish()

    writer = scene.plant("second_look")
    writer.json("second_look.json", {"made": False, "reason": "planted"})
    writer.finish()

    writer = scene.plant("shading")
    for view, p, _, _ in seen:
        light = np.repeat(1 + 0.3 * p[:, :1], 3, 1).reshape(HEIGHT, WIDTH, 3).astype(np.float32)
        halves = (split_rgb(light, f"half{half}.diffuse") for half in range(2))
        writer.exr(f"maps/{view.name}.exr", {name: value for half in halves for name, value in half.items()})
        dark = np.zeros((2, HEIGHT * WIDTH, 2, 3), np.float32)
        writer.table(table_of(view), SpecularLight(np.arange(HEIGHT * WIDTH), dark, dark).columns())
    writer.table("levels.parquet", {"level": np.arange(2, dtype=np.int32), "roughness": [0.02, 1.0]})
    writer.json("shading.json", {"diffuse": {"cell_edge_m": 0.1}, "plan": []})
    writer.finish()

    writer = scene.plant("affines")
    gain = np.concatenate([np.eye(3) / 0.8, np.zeros((3, 1))], 1).ravel()
    tables = {"T_albedo": np.tile(gain, (3, 1)), "T_roughness": np.tile([1.0, 0.0], (3, 1))}
    tables["T_metallic"] = np.tile([1.0, 0.0], (3, 1))
    writer.table("objects.parquet", {"object_id": ids, "name": ["walls", "box", "lamp"], **tables})
    fitted = {"cell_id": np.arange(len(cells)), **material_columns(TRUE[cells[:, 3]])}
    writer.table("cells.parquet", {**fitted, "uncertainty": np.full(len(cells), 0.02)})
    writer.json("affines.json", {"light_scale": 2.0, "history": [3.0, 2.0], "converged": False})
    if dynamic_range == "ldr":
        n = np.repeat(["R", "G", "B"], 101)
        response = {"channel": n, "kind": ["sample"] * 303, "name": [""] * 303, "x": np.tile(np.linspace(0, 1, 101), 3)}
        writer.table("camera_response.parquet", {**response, "value": np.tile(curve, 3)})
    for view, _, _, values in seen:
        channels = material_channels(values, (HEIGHT, WIDTH))
        writer.exr(f"maps/{view.name}.exr", {**channels, "uncertainty": np.full((HEIGHT, WIDTH), 0.02, np.float32)})
    writer.finish()
    benchmarks = root / "results/toy/benchmarks"
    benchmarks.mkdir(parents=True)
    measured = {"seconds": 12.5, "cpu_seconds": 20.25, "max_rss_mb": 300.5, "threads": 2}
    (benchmarks / "base.parts.json").write_text(
        json.dumps({"job": measured, "solve": {"seconds": 1.0}, "expected": {"cpu_seconds": 10.0, "memory_mb": 77.0}})
    )
    (benchmarks / "base.jsonl").write_text('{"s": 99.0, "cpu_time": 1, "max_rss": 1, "threads": 7}\n')  # of Snakemake
    (benchmarks / "affines.parts.json").write_text('{"job": {"seconds": 0.2, "cpu_seconds": "NA", "max_rss_mb": 1e999}}')
    (benchmarks / "publish.parts.json").write_text('{"job": {"seconds": 9.0}}')


def finish(root, upto="publish"):
    for name, stage in (
        ("render", render),
        ("metrics", metrics),
        ("unwrap", unwrap),
        ("export", export),
        ("room", room),
        ("report", report),
        ("publish", publish),
    ):
        made(scene_of(root), name, stage)
        if name == upto:
            return


@pytest.fixture(scope="module")
def toy(llvm, tmp_path_factory):
    root = tmp_path_factory.mktemp("toy")
    make_scene(root)
    here = os.getcwd()
    os.chdir(root)
    try:
        finish(root)
    finally:
        os.chdir(here)
    return root


def test_recovered_scene(toy):
    scene = read_recovered(scene_of(toy).job("publish"))
    assert scene.object_names == ["walls", "box", "lamp"]
    np.testing.assert_allclose(scene.emitter_radiance, [LAMP, [0, 0, 0]])  # light scale applied, dropped emitter is dark
    np.testing.assert_array_equal(np.flatnonzero(scene.emitter_id >= 0), [24, 25])
    np.testing.assert_allclose(scene.surface.object_values[:2], TRUE[:2], atol=1e-6)  # base mean through T_o
    np.testing.assert_allclose(scene.light.environment, 0)
    below = scene.emission_map(np.array([[24, 0, -1]]), np.array([1.5, 1, 1]))
    np.testing.assert_allclose(below[0], [LAMP, [0, 0, 0], [0, 0, 0]])
    above = scene.emission_map(np.array([[24]]), np.array([1.5, 1, 2.45]))
    assert (above == 0).all()


def test_response_is_read_back(toy):
    curve = read_response(scene_of(toy).open("affines"))
    np.testing.assert_allclose(curve(np.array([0.0, 0.5, 1.0])), [0, 0.5 ** (1 / 2.2), 1], atol=1e-3)
    assert curve(np.array([2.0, 2.0, 2.0]))[0] > 1.2  # continues as a straight line


def test_response_of_different_grids_is_refused():
    table = {"channel": np.array(["r", "g", "b", "b"]), "kind": np.array(["sample"] * 4), "x": np.array([0, 0, 0, 1.0])}
    with refused("camera_response.parquet", "r, g, b", "--forcerun affines"):
        response_samples(table | {"value": np.zeros(4)})


def test_rerendering_matches_the_photographs(toy):
    """Materials and light are the true ones, so only noise is left."""
    table = read_parquet(toy / "scenes/toy/metrics.parquet")
    psnr = {
        (q, p): v
        for q, m, p, v in zip(table["quantity"], table["metric"], table["protocol"], table["value"], strict=True)
        if m == "psnr"
    }
    assert psnr["rgb", "raw"] > 27
    assert psnr["albedo", "raw"] > 60
    assert list(table) == ["scene", "view", "quantity", "metric", "protocol", "value"]
    assert set(table["quantity"]) == {"albedo", "roughness", "metallic", "emission", "rgb"}
    assert np.isfinite(table["value"].astype(float)).all()


def test_variants_and_gain(toy):
    table = read_parquet(toy / "results/toy/metrics/variants.parquet")
    assert set(table["variant"]) == {"prior_k0", "prior_mean_k", "object_mean", "texel_mean", "photo_as_albedo", "base", "result"}
    summary = json.loads((toy / "results/toy/metrics/summary.json").read_text())
    means = summary["means"]
    assert means["base"]["albedo"]["scaled"]["psnr"]["mean"] > 60 > means["base"]["albedo"]["raw"]["psnr"]["mean"]
    gain = means["result"]["albedo"]["raw"]["psnr"]["mean"] - means["prior_mean_k"]["albedo"]["raw"]["psnr"]["mean"]
    assert summary["gain_over_raw_predictions"]["albedo"]["raw"]["psnr_db"] == pytest.approx(gain, abs=1e-3)
    assert {entry["metric"] for entry in summary["not_scored"]} == {"lpips"}  # the toy's images are too small for it
    scores = [
        v
        for variant, q, m, p, v in zip(*(table[c] for c in ("variant", "quantity", "metric", "protocol", "value")), strict=True)
        if (variant, q, m, p) == ("result", "emission", "iou", "raw")
    ]
    assert min(scores) > 0.99


def test_absent_weights_of_vgg_are_said(toy, tmp_path, monkeypatch, caplog):
    """Asked for and not there: the same scores without it, and one line that tells what to do."""
    monkeypatch.chdir(tmp_path)  # no results/weights here
    made(scene_of(toy, tmp_path, metrics={"lpips_vgg": True}), "metrics", metrics)
    found, without = (read_parquet(root / "results/toy/metrics/variants.parquet") for root in (tmp_path, toy))
    for name, column in without.items():
        np.testing.assert_array_equal(found[name], column)
    missing = json.loads((tmp_path / "results/toy/metrics/summary.json").read_text())["not_scored"]
    assert sum(entry["metric"] == "lpips_vgg" for entry in missing) == 1
    assert "snakemake --cores 1 results/weights/lpips_vgg.npz" in caplog.text


def test_some_views_stand_for_all(toy, tmp_path):
    """Each score of a chosen view is the one that it has among all views."""
    job = made(scene_of(toy, tmp_path, metrics={"views": 1}), "metrics", metrics)
    some, every = (pd.DataFrame(read_parquet(root / "results/toy/metrics/metrics.parquet")) for root in (tmp_path, toy))
    views = set(some.view) - {"all"}
    capture = CaptureReader(job.read("capture"))
    held_out = {view.name for view in capture.views if view.split == "test"}
    assert len(views - held_out) == 1 and len(views & held_out) == min(1, len(held_out))
    keys = ["view", "quantity", "metric", "protocol"]
    both = some[some.view != "all"].merge(every, on=keys, suffixes=("", "_every"))
    assert len(both) == (some.view != "all").sum() == every.view.isin(views).sum()
    np.testing.assert_allclose(both.value, both.value_every, rtol=1e-6)
    summary = json.loads((tmp_path / "results/toy/metrics/summary.json").read_text())
    assert summary["views"] == {"scored": len(views), "of": len(capture.views)}


def test_object_mean_is_the_mean_of_the_predictions(toy):
    job = scene_of(toy).job("metrics")
    capture = CaptureReader(job.read("capture"))
    means = PredictionMeans(job, capture.views)
    total, count = np.zeros(3), 0
    for view in capture.views:
        channels = job.read("prior").exr(f"maps/{view.name}.exr")
        box = job.read("segmentation").exr(f"maps/{view.name}.exr")["object.id"] == 1
        for k in range(K):
            total += rgb(channels, f"prior.{k:03d}.albedo")[box].astype(np.float64).sum(0)
        count += K * box.sum()
    np.testing.assert_allclose(means.means["object_mean"][1, :3], total / count, rtol=1e-5)


def test_maps_hold_everything(toy):
    channels = read_exr(toy / "scenes/toy/maps/v0.exr")
    assert set(channels) == {
        *("R", "G", "B", "ldr.R", "ldr.G", "ldr.B", "albedo.R", "albedo.G", "albedo.B", "roughness", "metallic"),
        *("emission.R", "emission.G", "emission.B", "uncertainty", "instance.id"),
    }
    assert channels["instance.id"].dtype == np.uint32


def test_deliverable_is_complete_and_verifies(toy):
    scene = toy / "scenes/toy"
    names = {p.relative_to(scene).as_posix() for p in scene.rglob("*") if p.is_file()}
    expected = {"scene.glb", "mitsuba/scene.xml", "maps/v0.exr", "maps/v1.exr", "objects.parquet", "emitters.parquet"}
    expected |= {
        "camera_response.parquet",
        "plan.yaml",
        "verdict.json",
        "metrics.parquet",
        "timings.parquet",
        "report.html",
        "manifest.json",
        "objects.csv",
        *("cameras.json", "photos/v0.png", "photos/v1.png", "camera_response.cube", "blender_import.py"),
        *("room.html", "scene_unlit.glb", "scene.usdc", "textures/base_color.png", "textures/seen.png"),
    }
    program = {"mitsuba/render.py", *(f"mitsuba/iif_bsdf/{name}.py" for name in ("__init__", "xp", "brdf", "mitsuba_bsdf"))}
    assert expected | program <= names and all(
        n in expected | program or n.startswith(("mitsuba/meshes/", "mitsuba/textures/", "textures/")) for n in names
    )
    manifest = json.loads((scene / "manifest.json").read_text())
    assert set(manifest["files"]) == names - {"manifest.json"}
    assert manifest["settings"]["seed"] == 3 and manifest["fingerprints"]["base"] == "print of base"
    assert not list((toy / "scenes").glob(".*"))
    assert list(damaged(toy)) == []
    emitters = read_parquet(scene / "emitters.parquet")
    np.testing.assert_allclose(emitters["radiance_r"][0], LAMP[0])
    assert list(emitters["object"]) == ["lamp", ""]  # the second was not kept
    assert re.search(r'<th scope="row"[^>]*>ceiling light 1 <small>lamp, 0</small>', (scene / "report.html").read_text())


def test_damage_is_named(toy, tmp_path):
    copy = tmp_path / "toy"
    shutil.copytree(toy, copy)
    with open(copy / "scenes/toy/plan.yaml", "a") as handle:
        handle.write("# edited\n")
    assert [line.split(":")[0].rsplit("/", 1)[1] for line in damaged(copy)] == ["plan.yaml"]


def test_publishing_again_replaces_what_is_its_own(toy, tmp_path, monkeypatch):
    place = tmp_path / "toy"
    shutil.copytree(toy, place)
    monkeypatch.chdir(place)
    (place / "scenes/toy/room.blend").write_text("of a user")
    (place / "scenes/toy/report.html").write_text("edited")
    publish.run(scene_of(place).job("publish"))
    assert (place / "scenes/toy/room.blend").read_text() == "of a user"
    assert (place / "scenes/toy/report.html").read_bytes() == (toy / "scenes/toy/report.html").read_bytes()
    assert not list((place / "scenes").glob(".*"))


def test_failed_publication_leaves_the_old_one(toy, monkeypatch):
    monkeypatch.chdir(toy)
    monkeypatch.setattr(publish, "copy", lambda source, target: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        publish.run(scene_of(toy).job("publish"))
    assert (toy / "scenes/toy/manifest.json").is_file() and not list((toy / "scenes").glob(".*"))


def test_a_copy_that_differs_from_what_a_stage_wrote_is_not_published(toy, tmp_path, monkeypatch):
    place = tmp_path / "toy"
    shutil.copytree(toy, place)
    monkeypatch.chdir(place)
    before, original = (place / "scenes/toy/manifest.json").read_bytes(), publish.copy

    def harmful(source, target):
        original(source, target)
        if target.name == "objects.parquet":
            target.write_bytes(target.read_bytes()[:-1] + b"x")

    with monkeypatch.context() as disk:
        disk.setattr(publish, "copy", harmful)
        with refused("scenes/.toy.tmp/objects.parquet", "affines", "results/toy/affines/objects.parquet"):
            publish.run(scene_of(place).job("publish"))
        assert (place / "scenes/toy/manifest.json").read_bytes() == before


def test_a_file_that_was_changed_with_its_manifest_is_not_what_was_published(toy, tmp_path):
    place = tmp_path / "toy"
    shutil.copytree(toy, place)
    path = place / "scenes/toy/objects.parquet"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    document = manifests.read(path.with_name("manifest.json"), SCENE_SCHEMA)
    document["files"]["objects.parquet"]["sha256"] = sha256_of(path)
    manifests.write(path.with_name("manifest.json"), document)
    assert [line for line in damaged(place) if line.startswith(f"{place}/scenes/toy")]


def test_editing_the_deliverable_does_not_reach_the_results(toy, tmp_path):
    source, copy = tmp_path / "plan.yaml", tmp_path / "deep" / "plan.yaml"
    source.write_text("one")
    publish.copy(source, copy)
    copy.write_text("two")
    assert source.read_text() == "one"


def test_timings(toy):
    rows = read_timings("toy", toy)
    assert [row["rule"] for row in rows] == ["base", "affines"]
    assert [rows[0][key] for key in ("seconds", "cpu_seconds", "max_rss_mb", "threads")] == [12.5, 20.25, 300.5, 2]
    assert [rows[1][key] for key in ("seconds", "cpu_seconds", "max_rss_mb", "threads")] == [0.2, 0.0, 0.0, 0]
    assert rows[0]["expected"] == {"cpu_seconds": 10.0, "memory_mb": 77.0} and rows[1]["expected"] == {}
    page = (toy / "scenes/toy/report.html").read_text()
    assert '<td class="off" title="off by more than a factor of 2">10.0</td>' in page
    table = read_parquet(toy / "scenes/toy/timings.parquet")
    assert list(table) == ["rule", "wildcards", "seconds", "cpu_seconds", "max_rss_mb", "threads"]
    assert read_timings("nothing", toy) == []


def test_plan_is_collected(toy):
    plan = yaml.safe_load((toy / "scenes/toy/plan.yaml").read_text())
    assert plan["scene"] == "toy"
    found = [(item["component"], item["included"], item["status"], item["rule"]) for item in plan["components"]]
    assert found == [
        ("environment", False, "settled", "plan"),
        ("metallic", False, "settled", "base"),  # as a later stage settled it
        ("vignetting", False, "settled", "plan"),  # nobody had a reason to try it
        ("denoiser", False, "forced", "render"),
        ("unexplained_light", False, "settled", "render"),  # two photographs cannot tell
    ]
    words = {item["component"]: item.get("override") for item in plan["components"]}
    assert words["denoiser"] == "components: {denoiser: on}" and words["vignetting"] is None


# ---------------------------------------------------------------------------------------------------------------- page


class Tags(HTMLParser):
    """Addresses, ids, text, and the inline style and scripts of a page whose tags close in order."""

    def __init__(self):
        super().__init__()
        self.addresses, self.open, self.text, self.ids, self.inline = [], [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.addresses += [value for name, value in attributes if name in ("src", "href", "action", "srcset")]
        self.ids += [value for name, value in attributes if name == "id"]
        assert tag not in ("link", "iframe", "object", "base", "form")
        assert not any(name == "style" or name.startswith("on") for name, _ in attributes)  # the policy would ignore them
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        assert tag in ("path", "polyline", "rect")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("script", "style"):
            self.inline.append((self.open[-1], data))
        else:
            self.text.append(data)


def parsed(page):
    tags = Tags()
    tags.feed(page)
    assert not tags.open
    return tags


def test_page_is_self_contained(toy):
    """Pictures are in the page; links lead to its own parts and to files of the deliverable; nothing else is asked for."""
    folder = toy / "scenes/toy"
    page = (folder / "report.html").read_text()
    tags = parsed(page)
    assert len(tags.ids) == len(set(tags.ids))
    assert sum(a.startswith("data:image/") for a in tags.addresses) > 10
    links = {a for a in tags.addresses if not a.startswith("data:image/")}
    assert {a[1:] for a in links if a.startswith("#")} <= set(tags.ids)
    for address in links:
        assert address.startswith("#") or (not address.startswith(("/", "..")) and (folder / address).exists()), address
    assert not re.search(r"https?://|@import|url\(", page)


def test_every_file_of_the_deliverable_is_linked(toy):
    folder = toy / "scenes/toy"
    links = set(parsed((folder / "report.html").read_text()).addresses)
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files - {"report.html"} <= links


def test_policy_allows_its_own_style_and_script_alone(toy):
    page = (toy / "scenes/toy/report.html").read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert "default-src 'none'" in policy and "unsafe" not in policy
    inline = parsed(page).inline
    assert [kind for kind, _ in inline] == ["style", "script", "script"]
    (_, style), (_, palettes), (_, script) = inline
    assert f"style-src '{content_hash(style)}'" in policy and f"script-src '{content_hash(script)}'" in policy
    assert set(json.loads(palettes)) == {"error", "value"}  # data, which no policy needs to allow


def test_every_explained_number_has_its_explanation(toy):
    page = (toy / "scenes/toy/report.html").read_text()
    described = set(re.findall(r'aria-describedby="([^"]*)"', page))
    assert len(described) > 10 and described <= set(parsed(page).ids)


def test_scalars_are_read_back_from_their_colours():
    """What the script of the page does: the place of a colour in the palette is the value."""
    values = np.linspace(-0.1, 0.3, 50).reshape(5, 10)
    for scheme in ("error", "value"):
        colours = pic.palette(scheme)
        assert len(set(colours)) == len(colours) == pic.SCALAR_STEPS
        mask = np.ones(values.shape, bool)
        mask[0, 0] = False
        picture = decoded(pic.data_uri(pic.scalar(values, 0, 0.2, scheme, mask), True))
        found = np.array([[colours.index("#{:02x}{:02x}{:02x}".format(*p)) if p[0] != p[1] or mask[i, j] else -1
                           for j, p in enumerate(row)] for i, row in enumerate(picture)])  # fmt: skip
        assert found[0, 0] == -1 and "#595959" not in colours
        back = found / (pic.SCALAR_STEPS - 1) * 0.2
        np.testing.assert_allclose(back[mask], np.clip(values, 0, 0.2)[mask], atol=0.51 * 0.2 / (pic.SCALAR_STEPS - 1))


def decoded(address):
    import base64
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))).convert("RGB"))


def test_large_pictures_are_made_smaller():
    ramp = np.repeat(np.linspace(0, 255, 100).astype(np.uint8)[None, :, None], 3, -1).repeat(40, 0)
    assert decoded(pic.data_uri(ramp, longest=50)).shape == (20, 50, 3)
    ids = pic.ids(np.arange(400).reshape(20, 20) // 37)
    small = decoded(pic.data_uri(ids, True, 10))
    known = {tuple(c) for c in ids.reshape(-1, 3).tolist()}
    assert {tuple(c) for c in small.reshape(-1, 3).tolist()} <= known  # no colour in between
    many = np.arange(3 * 30 * 30).reshape(30, 30, 3).astype(np.uint8)
    np.testing.assert_array_equal(decoded(pic.data_uri(many, True)), many)  # more colours than a palette holds


def test_downloads_are_told_by_their_names():
    names = ["report.html", "scene.glb", "maps/b.exr", "maps/a.exr", "mitsuba/scene.xml", "mitsuba/meshes/x.ply", "new.thing"]
    found = downloads(names)
    assert [d.href for d in found] == ["scene.glb", "mitsuba/scene.xml", "mitsuba/", "maps/", "new.thing"]
    assert found[3].files == ["maps/a.exr", "maps/b.exr"] and "2 files" in found[3].what
    assert found[-1].what == "" and all(d.what for d in found[:-1])
    assert downloads(["report.html"]) == []


def test_commands_name_scene_and_quality():
    words = "components: {specular: off}"
    said = {c.text for c in commands("room", "standard", [("specular", words)], ["scene.glb"], "room")}
    assert "snakemake --cores 2 relight/room --config quality=standard" in said
    assert {f"snakemake --cores 2 scenes/room --config quality={q}" for q in ("draft", "paper")} <= said
    assert f"{words}\nsnakemake --cores 2 scenes/room --config quality=standard" in said
    assert not any("blender" in text or "mitsuba" in text for text in said)  # files that this deliverable lacks
    more = {c.text for c in commands("room", "draft", [], ["blender_import.py", "mitsuba/render.py"], "example")}
    assert "blender --python scenes/room/blender_import.py" in more and "python scenes/room/mitsuba/render.py" in more
    assert "snakemake --cores 2 relight/room" in more


def test_page_says_what_matters(toy):
    text = "".join(parsed((toy / "scenes/toy/report.html").read_text()).text)
    for wanted in ("geometry: good", "1 lamp found", "What next?", "objects.csv", "snakemake --cores 2 relight/toy"):
        assert wanted in text
    for wanted in (
        "by <nobody> & co",
        "a note with <angle> brackets",
        "no object looks like a <metal>",
        "below 1 % of the power",
    ):
        assert wanted in text
    for wanted in (
        "raw predictions (mean score)",
        "base texture (fused)",
        "PSNR",
        "alignment",
        "selected prediction",
        "12.5",
    ):
        assert wanted in text
    assert "Dashed: what the camera did; difference 0.0000" in text


@pytest.mark.parametrize("dynamic_range", ["ldr", "hdr"])
def test_scene_without_truth(llvm, tmp_path, monkeypatch, dynamic_range):
    monkeypatch.chdir(tmp_path)
    make_scene(tmp_path, truth=False, dynamic_range=dynamic_range)
    finish(tmp_path)
    table = read_parquet(tmp_path / "scenes/toy/metrics.parquet")
    assert set(table["quantity"]) == {"rgb", "albedo"} and set(table["view"]) == {"v0", "v1", "all"}
    found = {m: v for q, m, v in zip(table["quantity"], table["metric"], table["value"], strict=True) if q == "albedo"}
    assert list(found) == ["shading_left", "shading_slope", "view_spread"]
    assert found["shading_left"] == 0 and found["view_spread"] < 1e-3  # objects of one colour each
    page = (tmp_path / "scenes/toy/report.html").read_text()
    text = "".join(parsed(page).text)
    assert "no ground truth" in text and "albedo error" not in text
    rows = page[page.index('id="maps"') :]
    assert rows.count(': photograph" src') == 2  # each view shows what it was made from
    assert (tmp_path / "scenes/toy/camera_response.parquet").exists() == (dynamic_range == "ldr")
    values = dict(zip(zip(table["metric"], table["protocol"], strict=True), table["value"], strict=True))
    assert values["psnr", "raw"] > 27
    assert (("log_l2", "raw") in values) == (dynamic_range == "hdr")


def test_stages_write_the_same_bytes_again(toy):
    for name, stage in (("render", render), ("export", export)):
        job = made(scene_of(toy, toy / "twice"), name, stage)
        first = json.loads((toy / f"results/toy/{name}/manifest.json").read_text())["files"]
        assert {n: f["sha256"] for n, f in job.writer.files.items()} == {n: f["sha256"] for n, f in first.items()}


def test_number():
    assert [number(v) for v in (None, "", True, False, 12345, 0.123456, 2.5e7, "x")] == [
        *("–", "–", "yes", "no", "12 345", "0.123", "2.50e+07", "x")
    ]


def test_score_table_marks_the_best():
    means = {
        "prior_k0": {"albedo": {"raw": {"psnr": {"mean": 13.0}, "l2": {"mean": 0.05}}}},
        "result": {"albedo": {"raw": {"psnr": {"mean": 20.0}, "l2": {"mean": 0.05}}}},
    }
    table = score_table("t", means, [("albedo", "raw", "l2"), ("albedo", "raw", "psnr"), ("albedo", "scaled", "psnr")])
    assert table.heads == ["L2 ↓", "PSNR ↑"] and table.groups == [("albedo", 2)]
    assert table.best == {(0, 0), (1, 0), (1, 1)}
    assert table.rows == [["raw prediction (first)", "0.0500", "13.00"], ["result", "0.0500", "20.00"]]
    assert score_table("t", {}, [("albedo", "raw", "l2")]) is None


def test_edges_and_selection():
    values = np.zeros((4, 5), int)
    values[:, 3:] = 1
    found = pic.edges(values)
    assert found[:, 2].all() and found.sum() == 4
    u = np.arange(40.0)
    wall = np.tile(1 / (0.05 + 0.1 * u), (4, 1))  # a plane, seen at a grazing angle
    assert not pic.depth_edges(wall).any()
    wall[:, 20:] *= 1.5
    assert set(np.flatnonzero(pic.depth_edges(wall)[1])) == {19, 20}
    wall[:, 30:] = 0
    assert set(np.flatnonzero(pic.depth_edges(wall)[1])) == {19, 20, 29, 30}
    segment = np.array([[0, 1, 2, -1]])
    rows = (np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0.2, 0.8, 0.5, 0.5]))
    np.testing.assert_array_equal(pic.selected_prediction(segment, *rows), [[1, 0, -1, -1]])
    np.testing.assert_array_equal(pic.selected_prediction(segment, *(r[:0] for r in rows)), -np.ones((1, 4)))


def test_pictures_are_bounded():
    image = np.full((4, 4, 3), np.nan)
    assert pic.linear(image).max() == 0
    assert (pic.difference(image, image * 0, np.zeros((4, 4), bool)) == 89).all()
    assert pic.data_uri(pic.linear(image)) == pic.data_uri(pic.linear(image))


def test_overlay_shows_photograph_and_borders():
    ids = np.array([[0, 0, 1, 1]] * 2)
    photo = np.linspace(0, 1, 4)[None, :, None] * np.ones((2, 4, 3))
    picture = pic.overlay(photo, ids).astype(int)
    assert (picture[0, 1] < 20).all() and (picture[0, 1] == picture[1, 1]).all()  # the border belongs to the left pixel
    np.testing.assert_allclose(picture[0, 3] - picture[0, 2], 0.5 * 255 / 3, atol=1)  # the same colour over another grey
