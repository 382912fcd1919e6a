"""A packed capture is the capture: `python -m lab pack` and source `folder` are each other's inverse."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lab.packing import pack
from lab.settings.capture import Capture
from lab.settings.source import BuiltinSource
from lab.sources import builtin
from tests.errors import refused
from workflow.artifacts.store import StageReader, StageWriter
from workflow.scene.normal_form import CaptureReader
from workflow.settings.source import FolderSource
from workflow.sources import folder

VIEWS = {"views": 4, "width": 32, "height": 24, "samples": 4, "test_every": 4}


def captured(place, module, source, capture):
    """Run a source, and return the reader of its capture."""
    writer = StageWriter(place / "capture", {"scene": "room", "stage": "capture", "fingerprint": "test"})
    settings = SimpleNamespace(
        source=SimpleNamespace(**source.model_dump(mode="json")), capture=SimpleNamespace(**capture.model_dump())
    )
    job = SimpleNamespace(
        settings=settings,
        writer=writer,
        threads=2,
        seed=0,
        log=logging.getLogger("capture"),
        scene="room",
        progress=lambda *_: None,
        timed=lambda _: nullcontext(),
    )
    module.capture(job)
    writer.finish()
    return CaptureReader(StageReader(place / "capture", "capture", "room"))


@pytest.fixture(scope="module", params=["ldr", "hdr"])
def both(request, tmp_path_factory, llvm):
    """The tiny room as the laboratory renders it, and as it is read again from its packed folder."""
    place = tmp_path_factory.mktemp(request.param)
    first = captured(place, builtin, BuiltinSource(kind="builtin", scene="tiny"), Capture(dynamic_range=request.param, **VIEWS))
    said = pack(place / "capture", place / "packed")
    assert "4 photographs" in said[0] and "truth" in said[0]
    source = FolderSource(kind="folder", path=place / "packed", alignment="off", registration="off")
    again = Capture(**{"dynamic_range": request.param, **VIEWS, "test_every": 0})
    return first, captured(place / "again", folder, source, again), place


def test_photographs_cameras_mesh_objects_and_held_out_views_come_back(both):
    first, second, _ = both
    for one, two in zip(first.mesh(), second.mesh(), strict=True):
        assert np.array_equal(one, two)
    assert np.array_equal(first.faces()["instance_id"], second.faces()["instance_id"])
    assert [view.name for view in first.views] == [view.name for view in second.views]
    for one, two in zip(first.views, second.views, strict=True):
        assert one.split == two.split
        assert np.allclose(one.world_from_camera, two.world_from_camera, atol=1e-12)
        assert (one.fx, one.fy, one.cx, one.cy, one.exposure) == (two.fx, two.fy, two.cx, two.cy, two.exposure)
        photo, again = first.photo(one, held_out=True)[0], second.photo(two, held_out=True)[0]
        # Radiance is rounded to half precision, 8 bits are kept.
        assert np.allclose(photo, again, rtol=1e-3 if first.is_hdr else 0, atol=1e-6 if first.is_hdr else 0)
        for a, b in zip(first.gbuffer(one), second.gbuffer(two), strict=True):
            assert np.array_equal(a, b)


def test_truth_comes_back_in_half_precision_where_there_is_one(both):
    first, second, _ = both
    for one, two in zip(first.views, second.views, strict=True):
        truth, again = first.truth(one), second.truth(two)
        assert np.array_equal(truth.valid, again.valid) and truth.valid.any()
        for name in ("albedo", "roughness", "metallic", "emission"):
            inside = truth.valid
            assert np.allclose(getattr(truth, name)[inside], getattr(again, name)[inside], rtol=1e-3, atol=1e-6), name


def test_nothing_is_written_over_and_no_capture_is_refused(both):
    _, _, place = both
    with refused("packed"):
        pack(place / "capture", place / "packed")
    with refused("manifest.json", "results/kitchen/capture"):
        pack(place / "packed", Path(place / "other"))
