"""Inputs and crops of the laboratory, as files that are made once."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from iif_core.priors.features import CHANNELS
from lab.prior import __main__ as command
from lab.prior import inputs, photographs, rooms, shards
from lab.prior.assets import Assets
from workflow.priors.views import CaptureViews


@pytest.fixture
def maker(llvm, tmp_path):
    """Makes rooms of three photographs of 32 x 32 pixels."""
    return shards.Maker(shards.Folder(tmp_path / "shards"), Assets(), None, samples=2, size=32, views=3)


def test_crops_are_cut_from_the_inputs_of_the_product(capture):
    whole = inputs.all_inputs(capture, seed=5)
    made = inputs.crops(capture, seed=5, edge=32)
    assert whole.shape == (3, len(CHANNELS), 48, 48) and np.isfinite(whole).all()
    assert len(made) and made.inputs.shape[1:] == (len(CHANNELS), 32, 32) and made.truth.shape[1:] == (5, 32, 32)
    for number, view in enumerate(made.view):
        places = np.lib.stride_tricks.sliding_window_view(whole[view], (32, 32), (1, 2)).transpose(1, 2, 0, 3, 4)
        same = np.isclose(places.astype(np.float16), made.inputs[number]).all((2, 3, 4))
        assert same.any()
        top, left = np.argwhere(same)[0]
        assert np.array_equal(capture.truth.stacked(view)[:, top : top + 32, left : left + 32], made.truth[number])


@pytest.mark.long
def test_what_is_on_disk_is_not_made_again(maker, monkeypatch):
    assert maker.make_all(range(50, 52)) == 2
    files = {seed: path.stat().st_mtime_ns for seed, path in shards.crop_files(maker.folder.path)}
    room_files = {seed: maker.folder.room(seed).stat().st_mtime_ns for seed in (50, 51)}
    assert sorted(files) == [50, 51]
    assert maker.make_all(range(50, 52)) == 0
    monkeypatch.setattr(shards, "inputs_digest", lambda: "other code")
    monkeypatch.setattr(rooms, "build", lambda *_: pytest.fail("a room that is on disk was built again"))
    assert maker.make_all(range(50, 52)) == 2, "inputs of other code are computed again, from the captures"
    assert {seed: path.stat().st_mtime_ns for seed, path in shards.crop_files(maker.folder.path)} != files
    assert {seed: maker.folder.room(seed).stat().st_mtime_ns for seed in (50, 51)} == room_files
    lines = maker.folder.manifest()
    assert [line["seed"] for line in lines] == [50, 51, 50, 51] and lines[0]["generator"] == rooms.VERSION


def test_a_room_that_fails_is_noted_and_not_tried_again(maker, monkeypatch):
    calls = []

    def build(seed, assets):
        calls.append(seed)
        raise ValueError("no such thing")

    monkeypatch.setattr(rooms, "build", build)
    assert maker.make_all([60, 61]) == 0 and maker.make_all([60, 61]) == 0
    assert calls == [60, 61]
    assert "no such thing" in maker.folder.manifest()[0]["error"]


def test_a_manifest_with_half_a_line_is_read(maker):
    maker.folder.note({"seed": 1})
    with open(maker.folder.path / "rooms.jsonl", "a") as file:
        file.write('{"seed": 2, "gen')
    assert maker.folder.manifest() == [{"seed": 1}]


def test_rooms_without_captures_leave_crops_alone(maker):
    bare = replace(maker, folder=shards.Folder(maker.folder.path, keep_rooms=False))
    assert bare.make_all([70]) == 1
    assert not maker.folder.room(70).exists() and maker.folder.crops(70).exists()
    crops = shards.load_crops(maker.folder.crops(70))
    assert crops.inputs.dtype == np.float16 and crops.counts.dtype == bool


def test_one_room_in_25_is_kept_back():
    assert sum(shards.is_held_out(seed) for seed in range(30_000, 31_000)) == 40


def test_the_command_makes_rooms(llvm, tmp_path, capsys):
    arguments = ["rooms", str(tmp_path), "--seeds", "80:81", "--size", "32", "--views", "2", "--samples", "1", "--no-denoiser"]
    assert command.main(arguments) == 0
    assert "1 rooms made" in capsys.readouterr().out
    assert json.loads((tmp_path / "rooms.jsonl").read_text())["crops"] >= 0


def test_a_wrong_range_is_refused(capsys):
    with pytest.raises(SystemExit):
        command.main(["rooms", "x", "--seeds", "9:3"])
    assert "FIRST:STOP" in capsys.readouterr().err


def test_light_is_gathered_again_with_roughly_known_albedo(capture):
    known = inputs._known_albedo(capture, np.random.default_rng(0))
    views = inputs.Views(capture, True)
    once = views.gather(None)
    asked = []

    def albedo_of(gathering, i):
        asked.append(i)
        assert gathering.group.shape == once.group.shape
        return known(gathering, i)

    twice = views.gather(albedo_of, every=2)
    assert asked == [0, 2] and np.array_equal(once.group, twice.group)
    assert not np.allclose(once.light.log_light, twice.light.log_light)
    counts = capture.truth.valid[0] & (capture.gbuffer(capture.used[0])[1] >= 0)
    ratio = np.log(known(once, 0)[counts] / np.maximum(capture.truth.albedo[0][counts], 1e-3))
    assert 0.02 < ratio.std() < 0.5 and np.isnan(known(once, 0)[~counts]).all()


@pytest.mark.long
def test_the_response_of_photographs_that_are_read_smaller_is_that_of_their_pixels(llvm, room):
    # Photographs much larger than those of the training are read at half or a third of their size; the last block is not full.
    capture = photographs.photograph(room, 5, photographs.Session(4, 251, 1))
    gains = np.tile([0.4, 1.6], 4)
    exposed = np.clip(gains[:, None, None, None] * np.repeat(capture.truth.albedo, 2, 0).astype(np.float64), 0, 1)
    encoded = photographs.sensor.Photographs(np.rint(255 * exposed ** (1 / 1.8)).astype(np.uint8), gains)
    capture = replace(capture, photographs=encoded, poses=np.repeat(capture.poses, 2, 0))
    values = np.linspace(0.2, 0.9, 100)
    for factor in (1, 2, 3):
        views = CaptureViews(capture, True, factor)
        reason = views.calibrate()
        assert views.response is not None, reason
        linear = views._linear(np.repeat(values[:, None, None], 3, 2))[:, 0]
        assert np.allclose(linear / values[:, None] ** 1.8, (linear / values[:, None] ** 1.8).mean(0), rtol=0.05), factor
        assert views[0].depth.shape == (-(-251 // factor),) * 2
