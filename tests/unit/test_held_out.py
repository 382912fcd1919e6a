"""Held-out photographs: nothing that is fitted may depend on what they show."""

import shutil
from pathlib import Path

import numpy as np

from tests.errors import refused
from tests.unit import own_scene as own
from workflow.artifacts.files import read_parquet
from workflow.registry import STAGES
from workflow.runtime.job import Job

FITTED = ("capture", "plan", "prior", "segmentation", "base", "emission", "shading", "second_look", "affines")
"""All stages before the first that scores."""
CAPTURE = {"views": 8, "width": 32, "height": 24, "test_every": 4, "exposure": "estimate"}
HELD_OUT = ("003", "007")
GAINS = [1.0, 0.8, 1.1, 0.9, 0.7, 1.0, 1.2, 0.6]


def everything(root):
    """Bytes of every file of the stages but manifests and the held-out photographs themselves."""
    folder = Path(root) / "results/own"
    files = sorted(
        p for p in folder.rglob("*") if p.is_file() and p.name != "manifest.json" and p.parts[-2] not in ("benchmarks", "stamps")
    )
    own = {folder / f"capture/photos/{name}.exr" for name in HELD_OUT}
    return {str(p.relative_to(folder)): p.read_bytes() for p in files if p not in own}


def rivals_are_scored(root):
    """The room is as bright from everywhere, so the other photographs predict a held-out one well, at its own exposure."""
    own.run(root, "render", "metrics")
    table = read_parquet(Path(root) / "results/own/metrics/variants.parquet")
    for variant in ("photo_mean", "photo_nearest"):
        rows = (table["variant"] == variant) & (table["metric"] == "psnr")
        assert set(table["view"][rows]) == set(HELD_OUT) and set(table["quantity"][rows]) == {"rgb_held_out"}
        assert table["value"][rows].min() > 30, variant
    for stage in ("render", "metrics"):
        shutil.rmtree(Path(root) / "results/own" / stage)


def with_noise(path):
    """Replace the held-out photographs by noise of the same size."""
    rng = np.random.default_rng(0)
    for name in HELD_OUT:
        own.save_png(path / f"images/{name}.png", rng.random((own.CAMERA.height, own.CAMERA.width, 3)))


def test_nothing_that_is_fitted_sees_a_held_out_photograph(tmp_path):
    """Noise in their place: every artefact of every stage before the score stays the same, byte for byte."""
    path = own.project(tmp_path, {"registration": "off"}, CAPTURE)
    own.photographed(path, 8, gains=GAINS)
    capture = own.run(tmp_path, *FITTED)
    assert tuple(view.name for view in capture if view not in capture.used) == HELD_OUT
    first = everything(tmp_path)
    rivals_are_scored(tmp_path)
    assert "base/maps/003.exr" in first and "prior/maps/003.exr" not in first and "affines/maps/003.exr" in first
    with_noise(path)
    capture = own.run(tmp_path, *FITTED)
    second = everything(tmp_path)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    with refused("view 003", kind=AssertionError):
        capture.photo(capture.views[3])
    assert capture.views[3].exposure == 1.0 and capture.photo(capture.views[3], held_out=True)[1].all()
    with own.working_in(tmp_path):
        for stage in FITTED[1:]:
            with refused("photos/003.exr", kind=AssertionError):
                Job(stage, "own", "draft", 1).read("capture").exr("photos/003.exr")
        assert STAGES["metrics"].scores and not any(STAGES[stage].scores for stage in FITTED)


def test_rays_of_pixels_next_to_a_hole_stay_in_their_middle():
    from iif_core.camera.pixels import pixel_steps
    from workflow.scene.normal_form import View

    view = View(0, "a", 5, 4, 8.0, 8.0, 2.5, 2.0, np.eye(4))
    face = np.zeros((4, 5), np.int32)
    face[1, 1] = -1
    plain, holed = pixel_steps(view, face, False), pixel_steps(view, face, True)
    for one, each in zip(plain, holed, strict=True):
        assert one.shape == (3,) and each.shape == (20, 3) and np.abs(one).max() > 0
        still = (each == 0).all(1).reshape(4, 5)
        np.testing.assert_array_equal(still, [[True] * 3 + [False] * 2] * 3 + [[False] * 5])
        np.testing.assert_array_equal(each.reshape(4, 5, 3)[0, 4], one)
