"""What `python -m lab.freeze` makes and compares."""

from __future__ import annotations

import json

import pytest

from lab import freeze
from workflow.settings import load


def test_every_scene_of_the_freeze_has_valid_settings_and_every_prior_and_segmentation_is_among_them(tmp_path, repository):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/quality").symlink_to(repository / "config/quality")
    every = freeze.scenes()
    kinds = set()
    for name, one in every.items():
        (tmp_path / f"config/scenes/{name}.yaml").write_text(one.text)
        found = load(name, one.quality, tmp_path)
        kinds |= {("prior", found.prior.kind), ("segmentation", found.segmentation.kind), ("quality", one.quality)}
    assert next(iter(every)) == freeze.SOURCE_OF_FILES
    # Diffusion models bring weights of their own.
    wanted = {("prior", k) for k in ("learned", "retinex", "simulated", "files", "pooled")}
    wanted |= {("segmentation", k) for k in ("given", "geometry", "masks")} | {
        ("quality", q) for q in ("draft", "standard", "paper")
    }
    assert wanted <= kinds


def test_what_is_new_gone_or_changed_is_named():
    before = {"room": {"base/a": "1", "base/b": "2", "base/c": "3"}}
    after = {"room": {"base/a": "1", "base/b": "9", "base/d": "4"}, "other": {"base/a": "1"}}
    assert freeze.differences(before, after) == [
        "room: base/b: differs",
        "room: base/c: gone",
        "room: base/d: new",
        "other: base/a: new",
    ]
    assert freeze.differences(after, after) == []


@pytest.mark.parametrize(("changed", "code"), [(False, 0), (True, 1)])
def test_compare_ends_with_an_error_where_a_byte_changed(tmp_path, monkeypatch, changed, code):
    made = {"tiny": {"base/a": "1"}}
    monkeypatch.setattr(freeze, "make", lambda *arguments: made)
    kept = tmp_path / "before.json"
    assert freeze.main(["record", str(kept)]) == 0 and json.loads(kept.read_text()) == made
    if changed:
        made = {"tiny": {"base/a": "2"}}
    assert freeze.main(["compare", str(kept)]) == code
