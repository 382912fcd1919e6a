"""Every way to make the base, on the tiny scene: the same artefacts, readable, finite, and what each variant promises."""

import json
import os

import numpy as np
import pytest
from support import TINY

from iif_core.fusion.direct import solve_direct
from lab.published.stages.base import one_segment_per_view
from tests.errors import refused
from tests.unit.test_fusion_direct import finite, oracle_psnr, simulated
from workflow import settings
from workflow.artifacts import StageReader
from workflow.artifacts.store import ids_from_disk, rgb
from workflow.runtime import fingerprint
from workflow.runtime.job import run_stage

VARIANTS = {
    "full": "{}",
    "hard": "{final_temperature: 0}",
    "distribution": "{objective: distribution, polish: 3, judge: true}",
    "uniform": "{variant: uniform}",
    "image_affine": "{variant: image_affine}",
    "texel_mean": "{variant: texel_mean}",
    "object_mean": "{variant: object_mean}",
    "raw": "{variant: raw}",
    "two predictions": "{predictions: 2}",
    "by footprint": "{footprint_power: 1, border_weight: 1, seams: false}",
    "sgd on cells": "{solver: sgd, iterations: 30, judge: true, polish: 5}",
    "sgd on a hash grid": "{solver: sgd, texture: hashgrid, iterations: 10, hash_levels: 4, hash_entries: 12}",
    "sgd as published": "{solver: sgd, preset: paper, iterations: 5, hash_levels: 4, hash_entries: 12}",
}


@pytest.fixture(scope="module")
def folder(llvm, tmp_path_factory):
    """The tiny scene up to what stage base reads; working folder for the stage."""
    folder, before = tmp_path_factory.mktemp("variants"), os.getcwd()
    (folder / "config/scenes").mkdir(parents=True)
    (folder / "config/scenes/tiny.yaml").write_text(TINY)
    os.chdir(folder)
    for stage in ("capture", "prior", "segmentation"):
        run_stage(stage, "tiny", threads=2)
    yield folder
    os.chdir(before)


def base_of(folder, name):
    path = folder / "config/scenes/tiny.yaml"
    text = "\n".join(line for line in path.read_text().splitlines() if not line.startswith("base:"))
    path.write_text(f"{text}\nbase: {VARIANTS[name]}\n")
    for cached in (fingerprint.resolved, fingerprint.fingerprint):
        cached.cache_clear()
    run_stage("base", "tiny", threads=2)
    return StageReader(folder / "results/tiny/base", "base", "tiny")


@pytest.mark.long
@pytest.mark.parametrize("name", VARIANTS)
def test_variant(folder, name):
    reader = base_of(folder, name)
    facts = reader.json("base.json")
    cells, segments, selection = (reader.table(f"{t}.parquet") for t in ("cells", "segments", "selection"))
    numbers = [c for c in cells if c.startswith(("albedo", "roughness", "metallic", "scale_", "uncertainty_"))]
    assert len(numbers) == 15 and all(np.isfinite(cells[c]).all() for c in numbers)
    assert (cells["roughness"] >= 0.02).all() and all((cells[c] >= 0).all() and (cells[c] <= 1).all() for c in numbers[:5])
    assert (cells["part_id"] >= 0).all() and (cells["coverage"] > 0).all()
    assert len(selection["k"]) == len(segments["segment_id"]) * facts["predictions"]
    views = 4
    if name == "image_affine":
        assert len(segments["segment_id"]) == views
    if name in ("two predictions", "raw"):
        assert facts["predictions"] == (2 if name == "two predictions" else 1)
    if name == "object_mean":
        for o in np.unique(cells["object_id"]):
            assert np.ptp(cells["albedo_r"][cells["object_id"] == o]) < 1e-6
    if name == "raw":
        prior = StageReader(folder / "results/tiny/prior", "prior", "tiny")
        file = prior.names("maps/")[0]
        channels, own = prior.exr(file), reader.exr(file)
        surface = ids_from_disk(own["cell.id"]) >= 0
        np.testing.assert_array_equal(rgb(own, "albedo")[surface], rgb(channels, "prior.000.albedo")[surface])
    if "judge" in VARIANTS[name]:
        loss = facts["reference_loss"]
        assert all(np.isfinite(entry["total"]) for entry in loss.values())
        assert set(loss) == ({"sgd", "direct_at_the_same_selection"} if "sgd" in name else {"direct"})
        json.dumps(loss)


def test_combinations_that_mean_nothing_are_refused(folder):
    path = folder / "config/scenes/tiny.yaml"
    text = "\n".join(line for line in path.read_text().splitlines() if not line.startswith("base:"))
    for bad, names in (
        ("{solver: sgd, variant: uniform}", ["solver: sgd", "variant: full", "uniform", "solver: direct"]),
        ("{objective: distribution, variant: texel_mean}", ["objective: distribution", "variant: texel_mean"]),
    ):
        path.write_text(f"{text}\nbase: {bad}\n")
        with refused("config/scenes/tiny.yaml", *names):
            settings.load("tiny")
    path.write_text(text + "\n")


@pytest.mark.long
def test_one_correction_an_image_underfits():
    """Objects err differently, so one affine map per image cannot correct them (the paper's ablation)."""
    problem, truth = simulated()
    image = one_segment_per_view(problem)
    assert image.n_segments == len(problem.cell_of_pixel)
    by_object, by_image = solve_direct(problem), solve_direct(image)
    assert finite(by_image)
    assert oracle_psnr(problem, by_object.value, truth) > oracle_psnr(problem, by_image.value, truth)
    assert by_image.object_value.shape[0] == by_object.object_value.shape[0]
