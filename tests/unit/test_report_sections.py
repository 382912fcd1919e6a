"""Sections of the report by themselves: what they say of tables and documents."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.errors import named
from workflow.decisions import held
from workflow.report import scores, views
from workflow.report.emitters import emitter_note, emitter_rows
from workflow.report.evidence import roughness_interval, unfitted_share
from workflow.report.facts import end_words, objects_words
from workflow.report.materials import intervals_note, material_rows
from workflow.report.response import response_drawing
from workflow.report.strips import exposure_of_emission

PSNR = {"psnr": {"mean": 25.04, "views": 3}}


def test_objects_that_take_what_others_have_count_by_their_pixels():
    pixels = np.array([60, 30, 10])
    model = np.array(["full, roughness", "population (3 pixels)", "identity (0 pixels)"])
    assert unfitted_share({"model": model, "pixels": pixels}) == pytest.approx(0.4)
    assert unfitted_share({"pixels": pixels}) is None and unfitted_share({"model": model, "pixels": 0 * pixels}) is None


def object_row(value="0.5", low="0.0", high="1.0", pixels="1"):
    return {"roughness": value, "roughness_low": low, "roughness_high": high, "pixels": pixels}


def test_the_interval_of_roughness_is_that_of_half_of_the_pixels():
    narrow, wide = object_row(low="0.4", high="0.55", pixels="6"), object_row(low="0.1", high="0.6", pixels="5")
    assert roughness_interval([wide, narrow]) == pytest.approx(0.1)  # on its longer side
    assert roughness_interval([wide, wide, narrow]) == pytest.approx(0.4)
    assert roughness_interval([narrow, object_row(pixels="7")]) is None  # no photograph shows that of most pixels
    assert roughness_interval([]) is None and roughness_interval([object_row(pixels="")]) is None


def test_the_headline_says_what_was_scored():
    means = {"result": {"rgb": {"raw": PSNR}, "rgb_held_out": {"raw": {"psnr": {"mean": 22.0, "views": 2}}}}}
    text = scores.headline({"means": means}, has_lamps=True, has_truth=False)
    assert "25.0 dB" in text and "2 held-out photographs: 22.0 dB" in text and "no ground truth" in text
    means["result"]["albedo"] = {"raw": PSNR, "scaled": {"psnr": {"mean": 27.0}}}
    gain = {"albedo": {"scaled": {"psnr_db": 4.2}}}
    text = scores.headline({"means": means, "gain_over_raw_predictions": gain}, has_lamps=False, has_truth=True)
    assert "25.0 dB as it is and 27.0 dB up to scale, 4.2 dB above predictions." in text and "No lamp was found" in text
    means["object_mean"] = {"albedo": {"scaled": {"psnr": {"mean": 21.5}}}}
    text = scores.headline({"means": means, "gain_over_raw_predictions": gain}, has_lamps=True, has_truth=True)
    assert text.endswith("4.2 dB above predictions; one flat colour per object, the mean of its predictions, reaches 21.5 dB.")
    means["corrected"] = {"rgb": {"raw": {"psnr": {"mean": 26.5}}}}
    text = scores.headline({"means": means}, has_lamps=True, has_truth=False)
    assert "as the other photographs show it: 26.5 dB." in text and "photographs: 22.0 dB. " in text
    means["corrected"]["rgb_held_out"] = {"raw": {"psnr": {"mean": 22.8}}}
    text = scores.headline({"means": means}, has_lamps=True, has_truth=False)
    assert "photographs: 22.0 dB, with that light 22.8 dB. " in text
    rivals = {"photo_mean": 23.4, "photo_nearest": 25.6}
    means |= {name: {"rgb_held_out": {"raw": {"psnr": {"mean": mean, "views": 2}}}} for name, mean in rivals.items()}
    means["photo_as_albedo"] = {"albedo": {"scaled": {"psnr": {"mean": 19.1}}}}
    text = scores.headline({"means": means, "gain_over_raw_predictions": gain}, has_lamps=True, has_truth=True)
    assert "22.8 dB. The mean of the other photographs, with no model of light, reaches 23.4 dB," in text and "25.6 dB" in text
    assert text.endswith("; the mean photograph, taken for albedo, 19.1 dB.")
    assert scores.headline({"means": {}}, has_lamps=True, has_truth=True) == ""


def test_numbers_at_the_head_name_what_would_be_good():
    means = {"result": {"rgb": {"raw": PSNR}, "albedo": {"raw": {"shading_left": {"mean": 0.123}}}}}
    found = {number.explained: number for number in scores.head_numbers(means)}
    assert list(found) == ["rgb-raw-psnr", "albedo-raw-shading-left"]
    assert found["rgb-raw-psnr"].value == "25.0 dB" and found["rgb-raw-psnr"].good == "good from 20 dB"
    assert found["albedo-raw-shading-left"].good == "0 is none"
    means["photo_as_albedo"] = {"albedo": {"raw": {"shading_left": {"mean": 0.8}}}}
    assert "0.800" in scores.head_numbers(means)[1].good
    assert {key for key, *_ in scores.explanations(means)} == set(found)
    means["result"]["rgb_held_out"] = means["result"]["rgb"]
    means["photo_mean"] = {"rgb_held_out": {"raw": {"psnr": {"mean": 23.66}}}}
    assert "23.7" in scores.head_numbers(means)[0].good


def test_views_go_from_worst_to_best_and_those_without_a_score_come_last():
    all_of = [SimpleNamespace(name=name, view_id=i) for i, name in enumerate("abcd")]
    ordered = views.ranked(all_of, {"a": 30.0, "c": 20.0, "d": 30.0})
    assert [view.name for view in ordered] == ["c", "a", "d", "b"]
    assert [view.name for view in views.spread(ordered, 2)] == ["c", "b"] and views.spread(ordered, 9) == ordered
    table = {"quantity": ["rgb", "rgb_held_out", "albedo", "rgb"], "metric": ["psnr", "psnr", "psnr", "l2"]}
    table |= {"protocol": ["raw"] * 4, "view": ["a", "b", "a", "a"], "value": [1.0, 2.0, 3.0, 4.0]}
    assert views.psnr_of_views({name: np.array(column) for name, column in table.items()}) == {"a": 1.0, "b": 2.0}
    assert "median" in views.hero_note(all_of[0], 21.0) and views.hero_note(all_of[0], None) == "View a"
    said = views.pairs_note(100, {"scored": 10, "of": 100})
    assert "10 of 100 views were scored" in said and f"{views.PAIRS} of 100 views, evenly" in said
    assert "views" not in views.pairs_note(4, {"scored": 4, "of": 4})


def test_how_the_fit_ended_and_what_the_objects_are():
    assert end_words({"history": [3.0, 2.0, 2.0], "converged": True}) == "converged in 2 steps"
    assert end_words({"history": [4.0, 2.0], "converged": False}).endswith("lowered the objective by 1e+02 %")
    facts = {"kind": "geometry", "objects_seen": 4, "stability": 0.756, "perturbed": "photographs left out"}
    assert objects_words(facts, 5).startswith("5 (geometry), 4 of them seen; stability 0.76")
    assert objects_words(facts | {"stability": None}, 5).endswith("seen") and objects_words({}, 5) == "5"


def test_materials_that_most_pixels_show_come_first():
    plain = {f"base_colour_{c}": v for c, v in zip("rgb", ("0.5", "0.25", "0.125"), strict=True)}
    plain |= {"base_colour_r_low": "0.4", "base_colour_r_high": "0.75"}
    plain |= {"roughness": "0.5", "roughness_low": "0.25", "roughness_high": "0.75", "model": "full"}
    plain |= {"metallic": "0", "metallic_low": "0.0", "metallic_high": "1.0"}
    rows = material_rows([plain | {"pixels": ""}, plain | {"pixels": "8"}])
    assert [row["pixels"] for row in rows] == ["8", ""]
    assert rows[0]["level"] == "(0.40 to 0.75)" and rows[0]["roughness_interval"] == "(0.25 to 0.75)"
    assert (
        rows[0]["metallic_interval"] == "(0.00 to 1.00)" and rows[0]["linear"] == "0.500, 0.250, 0.125" and "linear" not in plain
    )


def test_what_intervals_held_is_what_was_measured(monkeypatch):
    shares = {"pooled": 0.951, "lowest": 0.874, "highest": 1.0}
    document = {"held": {name: shares for name in ("albedo", "roughness", "metallic")}, "rooms": 2}
    document["metals"] = {"true": 71, "held": 43}
    monkeypatch.setattr(held, "measured", lambda: document)
    assert held.words("albedo") == "95 % (87 to 100 % in a room)" and held.rooms() == 2
    note = intervals_note()
    assert note.count(held.words("albedo")) == 3
    named(note, 71, 43)


@pytest.mark.parametrize("base, worse", [(17.5, True), (13.15, False), (12.0, False)])
def test_the_headline_says_if_the_fit_made_albedo_worse(base, worse):
    def of(psnr):
        return {"albedo": {protocol: {"psnr": {"mean": psnr, "views": 3}} for protocol in ("raw", "scaled")}}

    means = {"result": of(13.1), "base": of(base), "object_mean": of(19.8)}
    text = scores.headline({"means": means, "gain_over_raw_predictions": {"albedo": {"scaled": {"psnr_db": 0.6}}}}, True, True)
    assert (f"{base:.1f} dB" in text) == worse and "13.1 dB" in text


def test_lamps_are_told_by_their_power():
    table = {"emitter_id": [4, 5, 6], "name": list("xyz"), "object": list("abc"), "kind": ["area", "area", "environment"]}
    table |= {
        "faces": [1, 2, 0],
        "side": [1, 0, 1],
        "area_m2": [1.0, 1.0, 0.0],
        "observations": [1, 2, 3],
        "kept": [True, True, True],
    }
    table |= {f"radiance_{c}": [2.0, 3.0, 9.0] for c in "rgb"} | {f"error_{c}": [0.1] * 3 for c in "rgb"}
    rows = emitter_rows({name: np.array(column) for name, column in {**table, "reason": [""] * 3}.items()})
    assert [row["name"] for row in rows] == ["y", "x", "z"]
    # A second part of the light from outside shares the row of the first.
    more = {name: np.append(column, column[-1]) for name, column in {**table, "reason": [""] * 3}.items()}
    more["radiance_r"] = np.array([2.0, 3.0, 9.0, 5.0])
    joined = emitter_rows(more)
    assert [row["name"] for row in joined] == ["y", "x", "z, 2 parts"]
    assert joined[2]["radiance"].startswith("7") and joined[2]["observations"] == 6 and joined[2]["share"] == "–"
    assert [(row["id"], row["share"]) for row in rows] == [(5, "75.0 %"), (4, "25.0 %"), (6, "–")]  # both sides of b shine
    assert {row["probability"] for row in rows} == {"–"}  # light of another solver
    table |= {"reason": [""] * 3, "probability": [0.932, 0.051, -1.0]}
    told = {name: np.array(column) for name, column in table.items()}
    assert [row["probability"] for row in emitter_rows(told)] == ["5 %", "93 %", "–"]
    assert emitter_note(True, 1.0) == emitter_note(False, 1.0)[: len(emitter_note(True, 1.0))] != emitter_note(False, 1.0)
    assert "1.5" in emitter_note(True, 1.5)


def test_the_response_is_compared_with_what_the_camera_did():
    x = np.linspace(0, 1, 11)
    table = {"channel": np.repeat(["R", "G", "B"], 11), "kind": np.array(["sample"] * 33), "x": np.tile(x, 3)}
    table["value"] = np.tile(x, 3)
    drawing, note = response_drawing(table, None)
    assert drawing.count("<polyline") == 3 and "Dashed" not in note
    drawing, note = response_drawing(table, [np.clip(x - 0.5, -1, 1) for _ in range(3)])
    assert drawing.count("<polyline") == 6 and re.search(r"difference 0\.5000", note)
    assert response_drawing(table | {"kind": np.array(["parameter"] * 33)}, None) == ("", "")


def test_half_of_the_shining_area_is_shown_without_clipping():
    def room(radiance):
        emits = np.array(radiance) > 0
        light = SimpleNamespace(emits=emits, radiance=np.repeat(np.array(radiance)[:, None], 3, 1))
        return SimpleNamespace(light=light, surface=SimpleNamespace(areas=np.array([1.0, 5.0, 1.0])))

    assert exposure_of_emission(room([1.0, 4.0, 100.0])) == pytest.approx(0.2)
    assert exposure_of_emission(room([0.0, 0.0, 0.0])) == 1.0
