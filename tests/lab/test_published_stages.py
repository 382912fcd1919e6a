"""Stages emission, shading and affines as published on the tiny room: artefacts, resumption, refusal."""

from __future__ import annotations

import hashlib
import shutil

import numpy as np
import pytest

from lab.published.stages.affines import every_pixel
from tests.errors import refused
from tests.unit.test_fit_pixels import VIEW, _pixels
from workflow.artifacts import StageReader
from workflow.runtime import fingerprint
from workflow.runtime.job import run_stage
from workflow.scene.normal_form import CaptureReader

SCENE = """\
source: {kind: builtin, scene: tiny}
capture: {views: 4, width: 32, height: 32, samples: 16}
prior: {kind: simulated, samples: 2}
segmentation: {kind: given}
base: {solver: direct}
emission: {solver: published, iterations: 110, samples: 4}
shading: {method: published, pixels: all}
second_look: {enabled: false}
affines: {solver: published, pixels: all, batch: 1024}
"""
FIRST = ("capture", "plan", "prior", "segmentation", "base")


def run(folder, stages, monkeypatch, scene=SCENE):
    (folder / "config/scenes").mkdir(parents=True, exist_ok=True)
    (folder / "config/scenes/tiny.yaml").write_text(scene)
    monkeypatch.chdir(folder)
    for cached in (fingerprint.resolved, fingerprint.fingerprint):
        cached.cache_clear()
    for stage in stages:
        run_stage(stage, "tiny")
    return {stage: StageReader(folder / "results/tiny" / stage, stage, "tiny") for stage in stages}


@pytest.fixture(scope="module")
def finished(llvm, tmp_path_factory):
    """Folder and readers of a run to the end of stage affines."""
    folder = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        yield folder, run(folder, (*FIRST, "emission", "shading", "second_look", "affines"), patch)


def digests(reader):
    return {
        name: hashlib.sha256((reader.directory / name).read_bytes()).hexdigest() for name in (*reader.names(), "manifest.json")
    }


@pytest.mark.long
def test_emission_is_a_radiance_for_every_bright_triangle(finished):
    _, readers = finished
    facts, table, faces = (
        readers["emission"].json("emission.json"),
        readers["emission"].table("emitters.parquet"),
        readers["emission"].table("emitter_faces.parquet"),
    )
    assert facts["solver"] == "published" and facts["steps"] == 110 and facts["level_error"] == 0
    assert (table["faces"] == 1).all() and len(faces["face_id"]) == len(table["emitter_id"]) and table["kept"].any()
    assert (table["observations"] > 0).all()
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1)
    assert (radiance >= 0).all() and radiance[table["kept"]].sum(1).min() > 0.031
    truth = readers["capture"].table("faces.parquet")["emission_r"]
    assert truth[faces["face_id"][table["kept"][faces["emitter_id"]]]].max() > 0
    assert facts["loss"][-1] < 0.7 * facts["loss"][0]
    cache = readers["emission"].table("radiance_cache.parquet")
    assert not cache["censored"].any() and max(int(cache[c].max()) for c in "ijk") < 256


def test_shading_has_six_even_levels_and_no_halves(finished):
    _, readers = finished
    np.testing.assert_allclose(readers["shading"].table("levels.parquet")["roughness"], 0.02 + 0.98 * np.arange(6) / 5)
    light = readers["shading"].exr("maps/000.exr")
    np.testing.assert_array_equal(light["half0.diffuse.R"], light["half1.diffuse.R"])
    specular = readers["shading"].table("pixels/000.parquet")
    assert specular["half0_s0"].shape == (32 * 32, 18) and (specular["half0_s0"] == specular["half1_s0"]).all()
    assert light["half0.diffuse.R"].mean() > 0.01


def test_materials_are_fitted_to_all_pixels(finished):
    _, readers = finished
    facts = readers["affines"].json("affines.json")
    pixels = facts["pixels"]
    assert facts["solver"] == "published" and facts["light_scale"] == 1
    assert facts["iterations"] == 3 * -(-pixels // 1024) and facts["converged"] and facts["history"][-1] < facts["history"][0]
    assert facts["response"]["family"] == "ggcm"


@pytest.mark.long
def test_a_killed_descent_goes_on_where_it_was(finished, tmp_path, monkeypatch):
    from lab.published.light import single_bounce

    folder, readers = finished
    shutil.copytree(folder / "results", tmp_path / "results")
    whole, steps = single_bounce.trace_bounce, []

    def killed(*arguments, **options):
        steps.append(len(steps))
        if len(steps) == 75:
            raise KeyboardInterrupt
        return whole(*arguments, **options)

    monkeypatch.setattr(single_bounce, "trace_bounce", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, ("emission",), monkeypatch)
    assert not (tmp_path / "results/tiny/emission/manifest.json").exists()
    resumed = run(tmp_path, ("emission",), monkeypatch)
    assert len(steps) == 75 + 60  # from step 50
    assert digests(resumed["emission"]) == digests(readers["emission"])


def test_a_killed_material_fit_goes_on_after_its_last_epoch(finished, tmp_path, monkeypatch):
    from lab.published.fitting import descent as published

    folder, readers = finished
    shutil.copytree(folder / "results", tmp_path / "results")
    whole, steps = published.loss_and_gradient, []
    per_epoch = readers["affines"].json("affines.json")["iterations"] // 3

    def killed(*arguments):
        steps.append(len(steps))
        if len(steps) == 2 * per_epoch + 1:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(published, "loss_and_gradient", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, ("affines",), monkeypatch)
    assert not (tmp_path / "results/tiny/affines/manifest.json").exists()
    resumed = run(tmp_path, ("affines",), monkeypatch)
    assert len(steps) == 3 * per_epoch + 1
    assert digests(resumed["affines"]) == digests(readers["affines"])


@pytest.mark.parametrize("texture", ["hashgrid, hash_levels: 4, hash_entries: 10", pytest.param("cells", marks=pytest.mark.long)])
def test_a_killed_base_goes_on_after_its_last_epoch(finished, tmp_path, monkeypatch, texture):
    from lab.published.fusion.sgd import engine
    from lab.published.stages import base

    folder, _ = finished
    shutil.copytree(folder / "results", tmp_path / "results")
    descent = SCENE.replace("{solver: direct}", f"{{solver: sgd, preset: paper, texture: {texture}, iterations: 12}}")
    monkeypatch.setattr(base, "KEPT_EVERY", 0.0)
    whole, steps = engine.Engine.step, []

    def killed(self, step):
        steps.append(len(steps))
        if len(steps) == 8:
            raise KeyboardInterrupt
        return whole(self, step)

    written = base.keep_state

    def noted(writer, name, arrays, facts):
        kept.append(facts["step"])
        written(writer, name, arrays, facts)

    kept = []
    monkeypatch.setattr(base, "keep_state", noted)
    monkeypatch.setattr(engine.Engine, "step", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, ("base",), monkeypatch, descent)
    assert kept and kept == [kept[0] * (i + 1) for i in range(len(kept))] and 7 - kept[0] < kept[-1] <= 7
    monkeypatch.setattr(base, "keep_state", written)
    resumed = digests(run(tmp_path, ("base",), monkeypatch, descent)["base"])
    assert len(steps) == 8 + 12 - kept[-1]
    monkeypatch.setattr(engine.Engine, "step", whole)
    shutil.rmtree(tmp_path / "results/tiny/base")
    assert digests(run(tmp_path, ("base",), monkeypatch, descent)["base"]) == resumed


def test_estimated_exposures_are_refused(finished, tmp_path, monkeypatch):
    folder, _ = finished
    shutil.copytree(folder / "results", tmp_path / "results")
    whole = CaptureReader.__init__

    def estimated(self, reader):
        whole(self, reader)
        self.facts["exposure_estimated"] = True

    monkeypatch.setattr(CaptureReader, "__init__", estimated)
    with refused("emission.solver: published", "exposures"):
        run(tmp_path, ("emission",), monkeypatch)


def test_linear_photographs_of_a_folder_are_refused(finished, tmp_path, monkeypatch):
    """Settings refuse `dynamic_range: hdr`; what a folder holds is known to the stage alone."""
    folder, _ = finished
    shutil.copytree(folder / "results", tmp_path / "results")
    monkeypatch.setattr(CaptureReader, "is_hdr", True)
    with refused("emission.solver: published", "capture: {dynamic_range: ldr}"):
        run(tmp_path, ("emission",), monkeypatch)


def test_every_pixel_of_an_object_is_taken_where_it_is_asked_for():
    pixels, mixed = _pixels(), np.arange(10) == 9
    chosen = every_pixel(4, mixed).of(pixels, VIEW)
    np.testing.assert_array_equal(chosen, np.flatnonzero(pixels.valid & ~mixed[pixels.face]))
