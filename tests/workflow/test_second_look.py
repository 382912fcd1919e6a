"""Stage second_look: when it is made, what it writes, and who reads it."""

import shutil

import numpy as np
import pytest
from light_room import AFFINES, EMISSION, SHADING, build, of, opened, run

from iif_core.fitting.predictions import PredictionErrors
from workflow.artifacts.store import StageWriter
from workflow.fitting.inputs import prediction_errors
from workflow.scene.base_scene import SECOND_LOOK, read_base
from workflow.scene.normal_form import CaptureReader
from workflow.stages import base, second_look

LEARNED = {"kind": "learned", "samples": 2, "device": "cpu"}
MADE = {"base.json", "cells.parquet", "objects.parquet", "segments.parquet", "selection.parquet"}


@pytest.fixture(scope="module")
def lit(tmp_path_factory, llvm):
    """A room with its light, as stage shading leaves it."""
    from workflow.stages import emission, shading

    folder = tmp_path_factory.mktemp("lit")
    room = build(folder, views=4, size=48, samples=64)
    settings = {"capture": {"dynamic_range": "hdr"}, "emission": EMISSION, "affines": AFFINES, "shading": SHADING}
    run(folder, {"emission": emission, "shading": shading}, **settings)
    return folder, room


def look(folder, prior=LEARNED, enabled=True):
    """Run the stage, and return its job."""
    job = of(folder, second_look={"enabled": enabled}, prior=prior).job("second_look")
    second_look.run(job)
    job.writer.finish()
    return job


def copied(lit, tmp_path):
    for stage in ("capture", "plan", "prior", "segmentation", "base", "emission", "shading"):
        shutil.copytree(lit[0] / stage, tmp_path / stage)
    return tmp_path


@pytest.mark.parametrize(("prior", "enabled"), [(LEARNED, False), ({**LEARNED, "kind": "retinex"}, True)])
def test_without_a_second_look_the_first_base_is_read(lit, tmp_path, prior, enabled):
    folder = copied(lit, tmp_path)
    job = look(folder, prior, enabled)
    assert set(job.writer.files) == {SECOND_LOOK} and not opened(folder, "second_look").json(SECOND_LOOK)["made"]
    assert read_base(of(folder).job("affines")).stage == "base"


def test_a_second_look_makes_a_base_of_the_same_cells_that_the_fit_and_all_after_it_read(lit, tmp_path):
    folder, room = copied(lit, tmp_path), lit[1]
    first = of(folder, prior=LEARNED).job("base")
    base.fuse(first, _learned_without_light(folder))
    first.writer.finish()
    job = look(folder)
    views = CaptureReader(job.read("capture")).views
    assert set(job.writer.files) == MADE | {SECOND_LOOK} | {f"maps/{view.name}.exr" for view in views}
    for stage in ("affines", "render", "metrics", "export", "room", "report", "relight", "lamp_images"):
        assert read_base(of(folder).job(stage)).stage == "second_look", stage
    for stage in ("emission", "shading", "unwrap"):
        assert read_base(of(folder).job(stage)).stage == "base", stage
    old, new = (opened(folder, stage).table("cells.parquet") for stage in ("base", "second_look"))
    for name in ("cell_id", "object_id", *"ijk", *"xyz"):
        assert np.array_equal(old[name], new[name]), name
    error = {}
    for name, cells in (("first", old), ("second", new)):
        albedo = np.stack([cells[f"albedo_{c}"] for c in "rgb"], 1)
        truth = np.array([room.material[room.object_id == i, :3].mean(0) for i in range(len(room.names))])[cells["object_id"]]
        seen = (cells["coverage"] > 0) & (truth > 0.05).all(1)
        ratio = np.log(np.maximum(albedo[seen], 0.01) / truth[seen])
        error[name] = np.abs(ratio - np.median(ratio, 0)).mean()
    assert error["second"] < error["first"], error


def test_a_second_look_is_the_same_bytes_again(lit, tmp_path):
    folder = copied(lit, tmp_path)
    first = dict(look(folder).writer.files)
    shutil.rmtree(folder / "second_look")
    assert {name: facts["sha256"] for name, facts in look(folder).writer.files.items()} == {
        name: facts["sha256"] for name, facts in first.items()
    }


def test_the_fit_is_told_that_the_second_base_errs_less(lit, tmp_path):
    folder = copied(lit, tmp_path)
    stated = {"level": 0.15, "brightness": 0.2, "roughness": [0.6, 0.6, 1.0, 0.2], "metal": [3.0, 1.0]}
    prior = StageWriter(folder / "prior", {"scene": "room", "stage": "prior", "fingerprint": "test"})
    prior.json("model.json", {"object_errors": stated})
    prior.finish()
    look(folder, enabled=False)
    plain = prediction_errors(of(folder).job("affines"))
    look(folder)
    again = prediction_errors(of(folder).job("affines"))
    assert plain == PredictionErrors.from_facts(stated, "here")
    assert 0 < again.brightness < plain.brightness and again.level == plain.level and again.metal == plain.metal


def test_predictions_that_are_pooled_with_the_learned_ones_stay(lit, tmp_path):
    folder = copied(lit, tmp_path)
    writer = StageWriter(folder / "prior", {"scene": "room", "stage": "prior", "fingerprint": "test"})
    views = CaptureReader(opened(folder, "capture")).views
    for view in views:
        plain = np.full((view.height, view.width), 0.25, np.float16)
        layers = [
            {f"prior.{k:03d}.{name}": plain for name in ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic")}
            for k in range(3)
        ]
        writer.exr(f"maps/{view.name}.exr", {name: values for layer in layers for name, values in layer.items()})
    ids = [view.view_id for view in views]
    writer.table(
        "predictions.parquet",
        {"view_id": np.repeat(ids, 3).astype(np.int32), "k": np.tile(np.arange(3, dtype=np.int32), len(ids))},
    )
    writer.finish()
    other = {"kind": "files", "samples": 1}
    job = of(folder, prior={"kind": "pooled", "samples": 8, "of": [other, LEARNED]}).job("second_look")
    found = second_look._Predictions(job, CaptureReader(job.read("capture")))
    made = found.maps(views[0], 3)
    assert found.samples == 3 and np.allclose(made[0], 0.25)
    alone = second_look._Predictions(of(folder, prior=LEARNED).job("second_look"), CaptureReader(job.read("capture")))
    assert np.array_equal(made[1:], alone.maps(views[0], 2)) and np.ptp(made[1].astype(float)) > 0.1
    assert np.array_equal(found.maps(views[0], 2), made[:2]) and np.array_equal(found.scale(views[0]), alone.scale(views[0]))


def _learned_without_light(folder):
    """Predictions of the first look."""
    from workflow.priors import learned

    job = of(folder, prior=LEARNED).job("prior")
    capture = CaptureReader(job.read("capture"))
    predict = learned.prepare(job.settings, capture, 0, lambda array: array)

    class First:
        samples = LEARNED["samples"]

        def has(self, view):
            return True

        def maps(self, view, samples):
            return np.clip(predict(view).maps[:samples], 0, 1).astype(np.float16)

        def scale(self, view):
            return predict(view).scale

    return First()
