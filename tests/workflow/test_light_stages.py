"""emission, shading and affines on a room whose light and materials are known."""

import logging
import shutil
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from light_room import AFFINES, BULB, EMISSION, LAMP, SHADING, Room, build, of, opened, run, write_plan

from iif_core.reflectance.material import IDENTITY
from lab.simulated.photographs import response_curve
from tests.errors import refused
from workflow.artifacts import files
from workflow.fitting import asked, interreflection
from workflow.scene import emission_views
from workflow.scene.base_scene import read_base_scene
from workflow.scene.cached_light import read_diffuse, read_specular
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import read_recovered
from workflow.stages import affines, emission, plan, shading

TRUE = np.array([[LAMP, 0.95 * LAMP, 0.85 * LAMP], [BULB, 0.8 * BULB, 0.6 * BULB]])


def _run(folder, dynamic_range, upto="affines", **changes):
    stages = {"emission": emission, "shading": shading, "affines": affines}
    settings = {"emission": EMISSION, "shading": SHADING, "affines": AFFINES}
    settings = {name: {**own, **changes.get(name, {})} for name, own in settings.items()}
    some = dict(list(stages.items())[: list(stages).index(upto) + 1])
    run(folder, some, capture={"dynamic_range": dynamic_range}, **settings)


def _emitters(folder):
    table = opened(folder, "emission").table("emitters.parquet")
    return table, np.stack([table[f"radiance_{c}"] for c in "rgb"], 1)


def _psnr(folder, room, stage, scaled=False):
    errors = []
    for view in CaptureReader(opened(folder, "capture")):
        _, face = CaptureReader(opened(folder, "capture")).gbuffer(view)
        lit = (face >= 0) & ~room.emission.any(1)[face]
        maps = opened(folder, stage).exr(f"maps/{view.name}.exr")
        albedo, truth = np.stack([maps[f"albedo.{c}"] for c in "RGB"], -1)[lit], room.material[face[lit], :3]
        if scaled:
            albedo = albedo * (albedo * truth).sum(0) / (albedo**2).sum(0)
        errors.append(np.mean((albedo - truth) ** 2))
    return -10 * np.log10(np.mean(errors))


@pytest.fixture(scope="module")
def hdr(tmp_path_factory, llvm):
    folder = tmp_path_factory.mktemp("hdr")
    room = build(folder, views=6, size=48, samples=128, spoil=0.25)
    _run(folder, "hdr")
    return folder, room


def test_hdr_emission_is_recovered(hdr):
    folder, room = hdr
    table, radiance = _emitters(folder)
    kept = np.flatnonzero(table["kept"])
    assert len(kept) == 2
    np.testing.assert_allclose(radiance[kept], TRUE, rtol=0.03)
    faces = opened(folder, "emission").table("emitter_faces.parquet")
    assert set(faces["face_id"]) == set(np.flatnonzero(room.emission.any(1))) and (faces["side"] == 1).all()


def test_a_third_of_the_pixels_finds_the_same_light(hdr, tmp_path):
    """Where photographs have more pixels than the stage looks at, a part of each stands for it."""
    folder, _ = hdr
    for stage in ("capture", "prior", "plan", "segmentation", "base"):
        shutil.copytree(folder / stage, tmp_path / stage)
    _run(tmp_path, "hdr", upto="emission", emission={"pixels": 6 * 48 * 48 // 3})
    table, radiance = _emitters(tmp_path)
    kept = np.flatnonzero(table["kept"])
    assert len(kept) == 2
    np.testing.assert_allclose(radiance[kept], TRUE, rtol=0.06)
    assert _emitters(folder)[0]["observations"].sum() > 2 * table["observations"].sum()


def test_faces_between_the_chosen_pixels_are_seen(hdr):
    """No lamp may hide in a face that a photograph shows, though none of the pixels that are looked at lies on it."""
    folder, _ = hdr
    job = of(folder, capture={"dynamic_range": "hdr"}, emission=EMISSION, affines=AFFINES).job("emission")
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    records = emission_views.ViewRecords(job, capture, scene, 1000)
    of_pixels, seen = set(), set()
    for view in capture.views:
        record = records[view]
        assert len(record.pixels.index) < 300
        of_pixels |= set(record.pixels.face)
        seen |= set(record.seen)
        assert set(np.unique(capture.gbuffer(view)[1])) - {-1} == set(record.seen)
    assert of_pixels < seen


def test_without_lobes_no_path_is_traced_for_a_pixel(hdr, tmp_path):
    """The light of a pixel is the light of its cell, as if it came from everywhere. Albedo is fitted alone, nearly as well."""
    folder, room = hdr
    for stage in ("capture", "prior", "segmentation", "base", "emission", "second_look"):
        shutil.copytree(folder / stage, tmp_path / stage)
    write_plan(tmp_path, specular="off")
    settings = {"capture": {"dynamic_range": "hdr"}, "emission": EMISSION, "shading": SHADING, "affines": AFFINES}
    run(tmp_path, {"shading": shading, "affines": affines}, **settings)
    facts = opened(tmp_path, "shading").json("shading.json")
    assert facts["specular"] == {"pixels": 0}
    assert {item["component"]: item["status"] for item in facts["plan"]}["specular"] == "forced"
    fitted = opened(tmp_path, "affines").table("objects.parquet")
    rough, metal = np.stack(fitted["T_roughness"]), np.stack(fitted["T_metallic"])
    assert (rough[:, 0] == 0).all() and (rough[:, 1] >= 0.85).all() and (metal == 0).all()
    assert _psnr(tmp_path, room, "affines") > _psnr(folder, room, "base") + 1
    job, view = of(tmp_path).job("affines"), CaptureReader(opened(tmp_path, "capture")).views[0]
    diffuse, own = read_diffuse(job, view), read_specular(job, view)
    light = diffuse.reshape(2, -1, 3)[:, own.index]
    roughest = own.s0[:, :, -1] + own.s1[:, :, -1]
    lit = light.min(-1) > 0
    assert (roughest[lit] < light[lit]).all() and (roughest[lit] > 0.1 * light[lit]).all()


@pytest.mark.parametrize(("roughness", "included"), [(0.95, False), (0.4, True)])
def test_predictions_settle_the_lobes_where_the_photographs_left_them_open(hdr, tmp_path, roughness, included):
    folder, _ = hdr
    for stage in ("capture", "prior", "segmentation", "base", "emission", "second_look"):
        shutil.copytree(folder / stage, tmp_path / stage)
    write_plan(tmp_path, specular="auto")
    job = of(tmp_path, shading=SHADING).job("shading")
    scene = read_base_scene(job)
    values = scene.cell_values.copy()
    values[:, 3], values[:, 4] = roughness, 0
    settled = shading._specular(job, replace(scene, cell_values=values))
    assert (settled["included"], settled["status"]) == (included, "settled")


def test_hdr_albedo_comes_closer_to_the_truth(hdr):
    folder, room = hdr
    assert _psnr(folder, room, "affines") > _psnr(folder, room, "base") + 3


def test_tables_and_maps_are_complete(hdr):
    folder, room = hdr
    fitted, base = (opened(folder, stage).table("cells.parquet") for stage in ("affines", "base"))
    np.testing.assert_array_equal(fitted["cell_id"], base["cell_id"])
    objects = opened(folder, "affines").table("objects.parquet")
    assert objects["T_albedo"].shape == (len(room.names), 12) and (objects["std_albedo"] >= 0).all()
    channels = opened(folder, "shading").exr("maps/v000.exr")
    assert {f"half{h}.diffuse.{c}" for h in range(2) for c in "RGB"} == set(channels)
    specular = opened(folder, "shading").table("pixels/v000.parquet")
    assert specular["half1_s0"].shape == specular["half0_s1"].shape == (len(specular["index"]), 30)
    levels = opened(folder, "shading").table("levels.parquet")["roughness"]
    assert levels[0] == pytest.approx(0.02) and levels[-1] == 1 and (np.diff(levels) > 0).all()
    facts = opened(folder, "affines").json("affines.json")
    # The level of linear photographs is known but for what a lamp in sight leaves open.
    assert facts["light_scale"] == pytest.approx(1, abs=1e-2)
    assert (np.diff(facts["history"]) <= 1e-9).all()
    assert not opened(folder, "affines").has("camera_response.parquet")


def test_halves_are_independent(hdr):
    """Same mean, uncorrelated noise."""
    channels = opened(hdr[0], "shading").exr("maps/v000.exr")
    first, second = (channels[f"half{h}.diffuse.G"].ravel() for h in range(2))
    lit = (first > 0) & (second > 0)
    assert abs(np.log(first[lit].mean() / second[lit].mean())) < 0.05
    assert not np.array_equal(first, second)


@pytest.mark.long
def test_specular_light_is_traced_where_the_fit_reads_it(hdr):
    """A draw of 600 pixels: no more are traced, evenly over the objects, and the fit has exactly these."""
    folder, _ = hdr
    every = opened(folder, "shading")
    diffuse = every.exr("maps/v000.exr")["half0.diffuse.G"]
    try:
        _run(folder, "hdr", upto="affines", shading={"pixels": 600}, affines={**AFFINES, "pixels": 600})
        drawn = opened(folder, "shading")
        count = sum(drawn.rows(name) for name in drawn.names("pixels/"))
        assert count == drawn.json("shading.json")["specular"]["pixels"] and 500 < count < 800
        of_objects = opened(folder, "affines").table("objects.parquet")["pixels"]
        assert count == opened(folder, "affines").json("affines.json")["pixels"] == of_objects.sum()
        largest = np.sort(of_objects)[-4:]
        assert largest.min() > 0.6 * largest.max()
        assert ((drawn.exr("maps/v000.exr")["half0.diffuse.G"] > 0) == (diffuse > 0)).all()
    finally:
        _run(folder, "hdr")


def test_same_bytes_twice(hdr):
    folder, _ = hdr
    before = {s: opened(folder, s).manifest["files"] for s in ("emission", "shading", "affines")}
    _run(folder, "hdr")
    assert before == {s: opened(folder, s).manifest["files"] for s in before}


def _emission_reading_files(folder, monkeypatch, budget):
    """Hashes of what stage emission writes, and how often it reads files of each view, within `budget` megabytes."""
    reads, real = Counter(), files.read_exr

    def counted(path):
        reads[path.stem] += 1
        return real(path)

    with monkeypatch.context() as patch:
        patch.setattr(files, "read_exr", counted)
        patch.setattr(emission_views, "VIEW_MEMORY_MB", budget)
        _run(folder, "ldr", upto="emission")
    return {name: facts["sha256"] for name, facts in opened(folder, "emission").manifest["files"].items()}, reads


def test_each_view_is_decoded_once_within_the_memory_budget(tmp_path, llvm, monkeypatch):
    """Photograph, G-buffer, segmentation and base maps of a view are read once; without memory the result is the same."""
    exposures = np.array([0.5, 1.0, 2.0, 1.0])
    build(tmp_path, views=4, size=32, samples=32, dynamic_range="ldr", curve="filmic", exposures=exposures)
    written, reads = _emission_reading_files(tmp_path, monkeypatch, emission_views.VIEW_MEMORY_MB)
    assert len(reads) == 4 and max(reads.values()) <= 4
    again, more = _emission_reading_files(tmp_path, monkeypatch, 0.0)
    assert again == written and min(more.values()) > 4


def test_ldr_with_unknown_response(tmp_path, llvm):
    exposures = np.array([1, 0.5, 2, 0.25, 1, 0.5, 2, 1.0])
    room = build(tmp_path, views=8, size=48, samples=128, spoil=0.25, dynamic_range="ldr", curve="srgb", exposures=exposures)
    _run(tmp_path, "ldr")
    table, radiance = _emitters(tmp_path)
    assert table["kept"].sum() == 2
    ratio = radiance[table["kept"]] / TRUE
    assert 0.6 < ratio.min() and ratio.max() < 1.4
    error = opened(tmp_path, "emission").json("emission.json")["level_error"]
    assert 0.03 < error < 0.4 and abs(np.log(radiance[table["kept"]].sum() / TRUE.sum())) < 2 * error
    assert _psnr(tmp_path, room, "affines") > _psnr(tmp_path, room, "base") + 2.5
    assert _psnr(tmp_path, room, "affines", scaled=True) > _psnr(tmp_path, room, "base", scaled=True) + 1.5
    response = opened(tmp_path, "affines").table("camera_response.parquet")
    samples = response["kind"] == "sample"
    assert samples.sum() == 303 and (np.diff(response["value"][samples][:101]) > 0).all()


def test_measured_response_is_used_as_it_is(tmp_path, llvm, monkeypatch):
    truth = response_curve("filmic").samples(1024)
    np.save(tmp_path / "crf.npy", truth)
    monkeypatch.setitem(AFFINES, "response", {"file": str(tmp_path / "crf.npy")})
    build(tmp_path, views=3, size=24, samples=16, dynamic_range="ldr", curve="filmic")
    _run(tmp_path, "ldr", emission={"rows": 2000, "samples": 4}, shading={"samples": 4})
    table = opened(tmp_path, "affines").table("camera_response.parquet")
    assert set(table["kind"]) == {"sample"}
    x, value = table["x"].reshape(3, -1), table["value"].reshape(3, -1)
    np.testing.assert_allclose(
        value, [np.interp(a, np.linspace(0, 1, 1024), c) for a, c in zip(x, truth, strict=True)], atol=1e-6
    )
    decision = opened(tmp_path, "affines").json("affines.json")["plan"][0]
    assert decision["component"] == "camera_response" and "crf.npy" in decision["reason"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("dynamic_range", "brightness"),
    [
        ("ldr", 0.0),
        ("hdr", 1000.0),
        pytest.param("hdr", 0.0, marks=pytest.mark.long),
        pytest.param("ldr", 1000.0, marks=pytest.mark.long),
    ],
)
def test_dark_and_blinding_rooms_run_to_the_end(tmp_path, llvm, caplog, dynamic_range, brightness):
    caplog.set_level(logging.INFO)
    curve = "srgb" if dynamic_range == "ldr" else None
    build(tmp_path, views=3, size=24, samples=16, dynamic_range=dynamic_range, curve=curve, brightness=brightness)
    _run(tmp_path, dynamic_range, emission={"rows": 2000, "samples": 4}, shading={"samples": 4})
    table, radiance = _emitters(tmp_path)
    assert np.isfinite(radiance).all() and (radiance >= 0).all()
    if brightness == 0:
        decisions = {d["component"]: d for d in opened(tmp_path, "affines").json("affines.json")["plan"]}
        assert "fitted for 0 of 11 objects" in decisions["metallic"]["reason"] and not decisions["metallic"]["included"]
        assert not table["kept"].any() and "no emitter" in " ".join(opened(tmp_path, "emission").json("emission.json")["notes"])


def test_known_scale_of_a_lamp_and_of_a_patch(hdr):
    """One factor, stated: the light is multiplied by it and the albedos divided; what is unknown is refused before any work."""
    folder, room = hdr
    free = opened(folder, "affines").table("objects.parquet")
    table, radiance = _emitters(folder)
    lamp = int(table["emitter_id"][np.flatnonzero(table["kept"])[0]])
    job = of(folder, capture={"dynamic_range": "hdr"}, affines=AFFINES).job("affines")
    reader = CaptureReader(job.read("capture"))
    known = SimpleNamespace(mean_albedo=None, white_patch=None, lamp=None)

    def gauge(**scale):
        job.settings.affines.scale = SimpleNamespace(**{**known.__dict__, **scale})
        return asked.find_gauge(job, reader, list(room.names))

    found = float(radiance[np.flatnonzero(table["emitter_id"] == lamp)[0]].mean())
    got = gauge(lamp=SimpleNamespace(emitter_id=lamp, radiance=(2 * found,) * 3))(None, None)
    assert got.kind == "lamp" and got.factor == pytest.approx(2.0)
    with refused("emitter 99"):
        gauge(lamp=SimpleNamespace(emitter_id=99, radiance=(1, 1, 1)))
    with refused("object 'nowhere'"):
        gauge(white_patch=SimpleNamespace(object="nowhere", view=None, box=None, albedo=0.9))
    with refused("view 'v999'"):
        gauge(white_patch=SimpleNamespace(object=None, view="v999", box=(0, 0, 4, 4), albedo=0.9))
    with refused("box"):
        gauge(white_patch=SimpleNamespace(object=None, view="v000", box=(0, 0, 400, 4), albedo=0.9))
    assert len(free["name"]) == len(room.names)


@pytest.mark.parametrize("mean", [0.25, pytest.param(0.75, marks=pytest.mark.long)])
def test_another_level_of_the_albedos_leaves_the_room_as_bright(hdr, tmp_path, mean):
    """Light that was reflected falls with the albedos, so a lamp has to make up for more than it lost at its first bounce."""
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    folder, _ = hdr
    for stage in ("capture", "prior", "segmentation", "base", "emission", "shading", "second_look"):
        shutil.copytree(folder / stage, tmp_path / stage)
    settings = {"capture": {"dynamic_range": "hdr"}, "emission": EMISSION, "shading": SHADING}
    run(tmp_path, {"affines": affines}, **settings, affines={**AFFINES, "scale": {"mean_albedo": mean}})
    facts = opened(tmp_path, "affines").json("affines.json")
    light = facts["light_scale"] / facts["scale"]["factor"]
    assert light == pytest.approx(facts["interreflection"])
    assert opened(folder, "affines").json("affines.json")["interreflection"] == pytest.approx(1, abs=0.01)

    def shown(of_folder):
        capture, scene = CaptureReader(opened(folder, "capture")), read_recovered(of(of_folder, **settings).job("render"))
        geometry, material = scene.surface.traceable(scene.light.emits)
        world, out = Scene(geometry, material, scene.light.emitters(geometry)), []
        for view in capture.views:
            rays = view.directions().reshape(-1, 3)[~scene.light.emits[capture.gbuffer(view)[1].ravel()]]
            out.append(render(world, view.world_from_camera[:3, 3], rays, PathOptions(32, 16, 7)).mean(1))
        return np.concatenate(out)

    assert np.median(shown(tmp_path) / shown(folder)) == pytest.approx(1, abs=0.02)
    assert abs(np.log(light)) > 0.1  # without it the room would be darker or brighter by that


def test_brightness_is_compared_where_albedos_were_divided_and_possible(hdr, llvm):
    from iif_core.light.transport.geometry import build_geometry, trace

    folder, room = hdr
    job = of(folder, capture={"dynamic_range": "hdr"}, affines=AFFINES).job("affines")
    scene, inputs = read_base_scene(job), SimpleNamespace(capture=CaptureReader(job.read("capture")))
    affine = np.tile(IDENTITY, (scene.n_objects, 1))
    floor, table = room.names.index("floor"), room.names.index("table")
    affine[floor, :12] *= 10  # an albedo above 1
    counts = scene.object_id != table
    origins, rays = interreflection.camera_rays(job, inputs, SimpleNamespace(affine=affine), scene, counts)
    geometry = build_geometry(scene.vertices, scene.faces, scene.object_id)
    shown = np.concatenate([scene.object_id[trace(geometry, o, r[None])[0]] for o, r in zip(origins, rays, strict=True)])
    assert set(range(scene.n_objects)) - set(shown) == {floor, table}
    assert len(rays) == min(interreflection.RAYS, len(rays)) > 2000
    views = np.unique(origins, axis=0, return_counts=True)[1]
    assert len(views) == len(inputs.capture.used) and views.max() <= -(-interreflection.RAYS // len(views))


PLANNED = {
    "components": {"specular": "auto", "metallic": "auto"},
    "emission": EMISSION,
    "shading": SHADING,
}


def _planned(folder):
    run(folder, {"plan": plan}, **PLANNED)
    facts = opened(folder, "plan").json("plan.json")
    return {item["component"]: item for item in facts["plan"]}, facts["probes"]


def test_the_plan_of_a_closed_room(hdr, tmp_path):
    folder, _ = hdr
    shutil.copytree(folder / "capture", tmp_path / "capture")
    of, probes = _planned(tmp_path)
    assert (of["environment"]["included"], of["environment"]["status"]) == (False, "settled")
    assert of["camera_response"]["included"] is False and of["emitters"]["status"] == "provisional"
    assert probes["points"] > 500 and probes["photographed_share"] > 0.5 and probes["outside_brightness"] is None
    again, _ = _planned(tmp_path)
    assert again == of  # the same photographs, the same plan


def test_light_from_outside_is_seen_by_the_plan(tmp_path, llvm):
    """A hole in the ceiling under a bright sky is found; under a black one it is not."""
    hole = {"ceiling": None, "lamp": None}
    for name, sky in (("bright", 5.0), ("black", 0.0)):
        room = Room(parts=hole, lights={"bulb": BULB * np.ones(3)})
        build(tmp_path / name, views=6, size=48, samples=64, room=room, sky=sky)
        of, probes = _planned(tmp_path / name)
        assert probes["escape_share"]["secondary"] > 0.05
        if sky:
            assert (of["environment"]["included"], of["environment"]["status"]) == (True, "settled")
        else:
            assert not of["environment"]["included"] or of["environment"]["status"] == "provisional"


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_photographs_without_anything_to_see_leave_all_open(tmp_path, llvm, value):
    build(tmp_path, views=3, size=24, samples=1, curve="srgb", dynamic_range="ldr", retouch=lambda _, image: value + 0 * image)
    of, probes = _planned(tmp_path)
    assert probes["points"] == 0 and of["specular"]["status"] == "provisional" and of["specular"]["included"]
    assert of["environment"]["status"] == "provisional" or "closed" in of["environment"]["reason"]
