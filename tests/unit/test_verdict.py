"""The verdict of the report: extremes, thresholds, words."""

import dataclasses
import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iif_core.camera.response import SATURATION, response
from iif_core.evaluation.light import dark_where_saturated
from workflow.decisions import materials
from workflow.report import calibration, evidence, wording
from workflow.report.emitters import lamp_power
from workflow.report.evidence import BRIGHT, SHOWN, doubtful_area, of_geometry
from workflow.report.verdict import (
    AMBER,
    GREEN,
    LIGHT_OF,
    LIMITS,
    MEANS,
    NOTED,
    ORDER,
    RED,
    Evidence,
    foreseen,
    judge,
    limits_table,
)

GOOD = Evidence(
    escape=0.0, escape_camera=0.0, depth=0.004, edges=0.45, agreement=0.92, photographs=24, photographed=0.95, stability=0.9,
    lamps=3, doubtful_area=0.0, misfit=0.02, held_out=27.0, held_out_views=4, used=28.0, albedo=27.0, roughness=24.0,
    metallic=30.0, has_truth=True, prior="files", level="found",
    uncertainty=0.03, unfitted=0.01, level_error=0.1, raised=1.0, light_scale=1.03, discrepancy=0.8, light_spread=0.03,
)  # fmt: skip


DOUBTS = ("misfit", "doubtful_area")
"""Where these are not green, no light is."""


def levels(evidence):
    return {light.name: light.level for light in judge(evidence).lights}


def changed(**facts):
    return levels(dataclasses.replace(GOOD, **facts))


def test_a_good_result_is_green():
    verdict = judge(GOOD)
    assert verdict.level == GREEN and set(levels(GOOD).values()) == {GREEN}
    assert verdict.sentence == "No check found a fault."
    assert all(not finding.remedy for light in verdict.lights for finding in light.findings)


def test_a_result_that_loses_to_the_mean_of_other_photographs_is_no_good_one():
    """By more than a decibel on held-out ones; without light it knows nothing of another light, so it is never poor by that."""
    assert changed(others=27.9)["materials"] == GREEN and changed(others=28.1)["materials"] == AMBER
    assert changed(others=60.0)["materials"] == AMBER and changed(others=None)["materials"] == GREEN
    finding = judge(dataclasses.replace(GOOD, others=29.2)).lights[2].findings[0]
    assert "29.2 dB" in finding.text and finding.remedy


@pytest.mark.parametrize("level", ["white_patch", "lamp"])
def test_a_level_that_is_fixed_is_not_doubted_for_light_that_was_raised_before(level):
    """The patch then sets the level, whatever was raised."""
    assert changed(raised=1.4)["scale"] == AMBER and changed(raised=1.4, level=level)["scale"] == GREEN
    assert not any("albedos" in f.text for f in judge(dataclasses.replace(GOOD, raised=1.4, level=level)).lights[3].findings)


def test_the_plan_says_what_the_report_will_say_of_photographs_and_mesh():
    facts = {"alignment": {"edge_correlation": 0.4}, "left_out_views": {"a": "blurred"}, "notes": []}
    known = of_geometry(facts, 19, {}, {"primary": 0.05, "secondary": 0.64}, 0.9)
    word, first = foreseen(Evidence(**known))
    finding = judge(Evidence(**known)).lights[0].findings[0]
    assert word == "geometry: poor" and first == f"{finding.text}. To do: {finding.remedy}" and "64.0 %" in first
    assert known["lost"] == 1 and foreseen(Evidence(**{**known, "escape": 0.02})) == ["geometry: good"]
    alone = of_geometry(facts, 8, {"depth_share": [0.2, 0.4], "left_out": {"b": "", "c": ""}, "planes": []}, {}, None)
    assert (alone["lost"], alone["depth"], alone["escape"]) == (3, None, None) and alone["confirmed"] == pytest.approx(0.3)
    assert any("between them" in line for line in foreseen(Evidence(**alone)))


def test_a_hopeless_capture_says_so_first():
    """A scan without a ceiling: no lamp, most rays leave, all light raised (the Red Kitchen at 160 x 120)."""
    poor = dataclasses.replace(
        GOOD, escape=0.633, escape_camera=0.046, lamps=0, environment=True, raised=4.7, has_truth=False, albedo=None,
        light_spread=None, held_out=21.5, prior="retinex", roughness_interval=0.2, discrepancy=1.94, level_error=0.19,
    )  # fmt: skip
    verdict = judge(poor)
    assert levels(poor) == {"geometry": RED, "light": RED, "materials": AMBER, "scale": RED}
    assert verdict.sentence.startswith("Do not rely on this result for geometry, light and scale: 63.3 % of the rays")
    said = {light.name: light.findings[0] for light in verdict.lights}
    assert "Close the mesh" in said["geometry"].remedy and "63.3 %" in said["geometry"].text
    assert said["light"].text.startswith("0 lamps found") and "Photograph every lamp" in said["light"].remedy
    assert "factor of 4.70" in said["scale"].text and "white patch" in said["scale"].remedy


def test_what_to_do_about_a_mesh_that_was_found_from_photographs():
    """It has no axes to set and no scan to mend."""
    poor = dataclasses.replace(GOOD, escape=0.6, edges=0.02, agreement=0.2, depth=None)
    given, found = (judge(dataclasses.replace(poor, confirmed=own)).lights[0] for own in (None, 0.56))
    assert [f.level for f in given.findings] == [f.level for f in found.findings if "56 %" not in f.text]
    said = " ".join(finding.remedy for finding in found.findings if "56 %" not in finding.text)
    assert "overview.png" in said and "source." not in said and "scan" not in said and "COLMAP" not in said


def test_a_mesh_that_only_its_own_photographs_judge_is_never_good():
    """What lets no light out was built, and the depth that fits is what it was made of."""
    light = judge(dataclasses.replace(GOOD, confirmed=0.56, built=21.2)).lights[0]
    assert light.level == AMBER and "56 %" in light.findings[0].text and "21 m²" in light.findings[0].text
    assert not any("leave the mesh" in finding.text for finding in light.findings)
    assert levels(dataclasses.replace(GOOD, confirmed=0.56, escape=0.6))["geometry"] == RED


def test_lamps_that_are_more_likely_surface_light_no_room():
    assert changed(unlikely=("a", "b"), unlikely_power=0.1)["light"] == GREEN  # one is left, and has most of the light
    assert changed(unlikely=("a", "b"), unlikely_power=0.9)["light"] == AMBER
    said = judge(dataclasses.replace(GOOD, unlikely=("a", "b"), unlikely_power=0.1)).lights[1].shown
    assert any("bright surface: a, b, with 10 %" in finding.text for finding in said)
    many = judge(dataclasses.replace(GOOD, lamps=9, unlikely=tuple("abcdef"), unlikely_power=0.1)).lights[1].shown
    assert any("a, b, c and 3 more" in finding.text for finding in many)
    assert changed(unlikely=("a", "b", "c"))["light"] == RED
    assert changed(unlikely=("a", "b", "c"), environment=True)["light"] == AMBER
    assert changed(unlikely=("a", "b", "c"), environment=True, escape=0.5)["light"] == RED


def test_the_worst_photograph_is_named():
    said = judge(dataclasses.replace(GOOD, worst=("IMG_004", 15.93))).lights[2]
    assert any("IMG_004" in finding.text and "15.9" in finding.text for finding in said.findings)


def test_held_out_scores_stand_next_to_those_of_the_other_photographs():
    said = judge(dataclasses.replace(GOOD, others=27.9, held_out_each=(23.5, 29.1, 27.0, 28.4))).lights[2]
    assert any(not missing(finding.text, "27.0", "23.5", "29.1") for finding in said.findings) and said.level == GREEN
    assert any("27.9" in finding.text for finding in said.findings)
    alone = judge(dataclasses.replace(GOOD, held_out_views=1, held_out_each=(27.0,))).lights[2]
    assert not any("27.0 to" in finding.text for finding in alone.findings)


def missing(text, *words):
    return [word for word in words if word not in text]


def test_nothing_that_lights_the_room():
    assert changed(lamps=0)["light"] == RED
    finding = judge(dataclasses.replace(GOOD, lamps=0)).lights[1].findings[0]
    assert "Photograph a lamp" in finding.remedy


def test_a_room_that_daylight_alone_lights_is_good():
    assert changed(lamps=0, environment=True, escape=0.022)["light"] == GREEN


def test_nothing_known_is_never_green():
    """An empty result is not praised for what nobody measured."""
    verdict = judge(Evidence())
    assert verdict.level != GREEN
    assert levels(Evidence()) == {"geometry": AMBER, "light": RED, "materials": AMBER, "scale": AMBER}
    assert all(light.findings for light in verdict.lights)


@pytest.mark.parametrize(
    ("field", "light", "worst"),
    [
        ("escape", "geometry", RED), ("depth", "geometry", RED), ("agreement", "geometry", RED),
        ("photographed", "geometry", RED),
        ("misfit", "light", RED), ("doubtful_area", "light", AMBER), ("light_spread", "light", RED), ("albedo", "materials", RED),
        ("unlikely_power", "light", AMBER), ("missed", "light", AMBER),
        ("roughness", "materials", RED), ("metallic", "materials", RED), ("uncertainty", "materials", RED),
        ("unfitted", "materials", RED), ("stability", "materials", AMBER), ("level_error", "scale", RED),
        ("raised", "scale", RED), ("light_scale", "scale", RED), ("discrepancy", "scale", RED),
    ],
)  # fmt: skip
def test_every_number_turns_its_light_at_its_limits(field, light, worst):
    """Exactly at a limit the better colour holds; a hair beyond it the worse one; NaN is as bad as it gets."""
    limit = LIMITS[field]
    beyond = 1e-6 if limit.red > limit.amber else -1e-6
    for value, expected in (
        (limit.amber, GREEN), (limit.amber + beyond, AMBER), (limit.red, AMBER), (limit.red + beyond, worst), (math.nan, worst),
    ):  # fmt: skip
        found = changed(**{field: value})
        assert found[light] == expected, (field, value)
        others = GREEN if field not in DOUBTS or expected == GREEN else AMBER
        assert all(level == others for name, level in found.items() if name != light)


def test_lamps_that_are_missing_are_told_by_what_is_saturated():
    light = judge(dataclasses.replace(GOOD, missed=0.116, missed_in=["019", "020"])).lights[1]
    assert light.level == AMBER and "12 %" in light.findings[0].text and "019 and 020" in light.findings[0].text
    assert evidence._missed({"share": 0.02, "dark_share": 0.3, "worst": ["a"]}) == {"missed": 0.3, "missed_in": ["a"]}
    assert evidence._missed({"share": 0.0002, "dark_share": 1.0, "worst": ["a"]}) == evidence._missed({}) == {}


def test_saturated_pixels_that_are_rendered_dark_are_counted():
    """Nine pixels: saturated and bright, dark, dark in one channel, at the limit, not valid; and some that are not saturated."""
    srgb, half = response("srgb"), 0.5 * response("srgb").inverse(np.full((1, 3), SATURATION))[0, 0]
    at = float(srgb(np.full((1, 3), half))[0, 0])
    photo = np.array([[1.0] * 3] * 5 + [[1.0, 1.0, 0.98], [0.2] * 3])
    shown = np.array([[1.0] * 3, [0.1] * 3, [0.1, 0.1, 1.0], [at + 1e-6] * 3, [0.1] * 3, [0.1] * 3, [0.1] * 3])
    valid = np.array([True, True, True, True, False, True, True])
    assert dark_where_saturated(photo, shown, valid, srgb.inverse, SATURATION) == (4, 1)
    shown[3] = at - 1e-6
    assert dark_where_saturated(photo, shown, valid, srgb.inverse, SATURATION) == (4, 2)


def test_the_score_of_held_out_photographs_counts_before_that_of_the_others():
    assert changed(held_out=15.0, used=30.0)["materials"] == RED
    assert changed(held_out=30.0, used=17.0)["materials"] == GREEN
    assert changed(held_out=None, used=15.0)["materials"] == RED


def test_one_good_photograph_does_not_make_up_for_most():
    """20.0 dB in the mean of 19.1, 19.2 and 21.9 is below the limit of 20 for most of them, and so is a mean that one spoils."""
    assert changed(held_out=20.1, held_out_each=(19.1, 19.2, 21.9), held_out_views=3)["materials"] == AMBER
    assert changed(held_out=20.1, held_out_each=(18.0, 20.9, 21.4), held_out_views=3)["materials"] == GREEN
    assert changed(held_out=19.5, held_out_each=(15.0, 21.0, 22.5), held_out_views=3)["materials"] == AMBER


def test_without_truth_something_must_be_held_out():
    alone = dict(has_truth=False, albedo=None, held_out=None, light_spread=None, roughness_interval=0.05)
    assert changed(**alone)["materials"] == AMBER
    text = judge(dataclasses.replace(GOOD, **alone)).lights[2].findings[0]
    assert "test_every" in text.remedy
    assert changed(**{**alone, "held_out": 27.0})["materials"] == GREEN


def test_gloss_is_judged_by_the_truth_alone():
    """Without truth it is said how well roughness is known, in whatever colour the albedo has."""
    assert changed(roughness=15.9)["materials"] == AMBER
    assert "error of 0.16" in judge(dataclasses.replace(GOOD, roughness=15.9)).sentence
    without = dict(has_truth=False, albedo=None, roughness=None, metallic=None)
    for width in (0.05, 0.9, None):
        assert changed(**without, roughness_interval=width)["materials"] == GREEN, width
    said = [finding.text for finding in judge(dataclasses.replace(GOOD, **without, roughness_interval=0.31)).lights[2].findings]
    assert any("0.31" in text for text in said)
    assert "none of them compares" in judge(dataclasses.replace(GOOD, **without, roughness_interval=0.05)).sentence
    # What was not judged did not pass.
    light = judge(dataclasses.replace(GOOD, **without, roughness_interval=None)).lights[2]
    noted = [finding for finding in light.findings if finding.level == NOTED]
    assert len(noted) == 2 and list(light.rest[-2:]) == noted  # gloss, and that there is no truth
    assert light.rest_words == f"{len(light.rest) - 2} more checks passed, 2 not judged"
    said = judge(dataclasses.replace(GOOD, **without)).document()["lights"]["materials"]["findings"]
    assert [one["verdict"] for one in said][-2:] == ["not judged"] * 2


NUMBERS = {name: st.one_of(st.none(), st.floats(0, 40)) for name in ("misfit", "doubtful_area", "held_out", "used", "escape")}


@given(st.fixed_dictionaries(NUMBERS), st.floats(1, 50), st.floats(0, 12))
def test_nothing_is_green_next_to_a_shining_table_or_a_wrong_rendering(numbers, area, score):
    """Whatever else was measured: a square metre that may be no lamp, or a re-rendering of 12 dB, held out or not."""
    for fault in ({"doubtful_area": area}, {"used": score}, {"held_out": score}):
        found = changed(**{**numbers, **fault})
        assert GREEN not in found.values(), (numbers, fault)


@given(
    st.sampled_from([name for name in LIMITS if name not in ("edges", "rerendering", "rival", "lost")]),
    st.floats(0, 5),
    st.floats(0, 5),
)
def test_worse_evidence_never_brightens_a_light(name, one, other):
    limit = LIMITS[name]
    better, worse = sorted((one, other), reverse=limit.red < limit.amber)
    if name == "light_scale":  # a factor in either direction
        better, worse = 1 + better, 1 + worse
    ranks = [[ORDER.index(level) for level in changed(**{name: value}).values()] for value in (better, worse)]
    assert all(a <= b for a, b in zip(*ranks, strict=True))


def emitters(radiance, area, observations, kept=True):
    n = len(radiance)
    return {
        **{f"radiance_{c}": np.asarray(radiance, float) for c in "rgb"},
        "area_m2": np.asarray(area, float), "observations": np.asarray(observations), "kept": np.full(n, kept),
        "kind": np.array(["area"] * n),
    }  # fmt: skip


SURFACE = {f"radiance_{c}": np.linspace(0, 1, 101) for c in "rgb"}  # nine tenths are at most 0.9


def test_what_is_dim_or_hardly_photographed_may_be_no_lamp():
    """By hand: a bright lamp, a white table, a window that one corner of a photograph shows."""
    found = emitters([2 * 0.9 * BRIGHT, 3.0, 20.0], [0.4, 1.5, 2.0], [400, 900, 2000 * SHOWN - 1])
    assert doubtful_area(found, SURFACE, 1000.0) == pytest.approx(1.5 + 2.0)
    found["kept"][1] = False
    assert doubtful_area(found, SURFACE, 1000.0) == pytest.approx(2.0)
    found["kind"][2] = "environment"
    assert doubtful_area(found, SURFACE, 1000.0) == 0.0
    nothing_to_compare_with = {name: values[:0] for name, values in SURFACE.items()}
    assert doubtful_area(found, nothing_to_compare_with, 1000.0) == pytest.approx(0.4)


LAMPS = st.lists(st.tuples(st.floats(0, 100), st.floats(0.01, 5), st.integers(0, 5000)), min_size=1, max_size=6)


@given(LAMPS, st.floats(1, 3000), st.floats(0.1, 10))
def test_doubt_grows_with_what_is_dimmer_and_not_with_exposure(lamps, density, exposure):
    """It lies between nothing and all that was found, falls as lamps get brighter, and does not change with the exposure."""
    radiance, area, seen = (np.array(column) for column in zip(*lamps, strict=True))
    found = doubtful_area(emitters(radiance, area, seen), SURFACE, density)
    assert 0 <= found <= area.sum() * (1 + 1e-9)
    assert doubtful_area(emitters(2 * radiance, area, seen), SURFACE, density) <= found
    brighter = {name: 4 * values for name, values in SURFACE.items()}  # a power of two: no rounding at the limit
    assert doubtful_area(emitters(4 * radiance, area, seen), brighter, density) == found


def test_every_light_says_what_its_colour_meant_in_rooms_with_truth():
    """The counts of the file are printed, and the file has what the lights mean."""
    assert set(MEANS) == set(calibration.measured()["lights"]) == set(levels(GOOD))
    green, poor = judge(GOOD), judge(dataclasses.replace(GOOD, escape=0.9))
    for light in (*green.lights, *poor.lights):
        counts = calibration.measured()["lights"][light.name][light.level]
        assert 0 <= counts["right"] <= counts["of"] and f" {counts['of']} " in light.means
        assert green.document()["lights"][light.name]["means"]
    for name, lights in calibration.measured()["lights"].items():  # of one result, all or none is right, which says nothing
        for level in (AMBER, RED):
            is_told = "as good all the same" in calibration.words(name, level, "it is")
            assert is_told == (lights[level]["of"] >= 5)
    assert all(MEANS["geometry"].words in verdict.lights[0].means for verdict in (green, poor))
    assert green.lights[0].means != poor.lights[0].means


def test_edges_weigh_less_where_depth_was_measured():
    assert changed(edges=0.01)["geometry"] == AMBER
    assert changed(edges=0.01, depth=None)["geometry"] == RED
    assert changed(edges=0.3, edges_warn=True)["geometry"] == AMBER


@pytest.mark.parametrize(
    ("facts", "level"),
    [
        (dict(level="white_patch"), GREEN),
        (dict(level="lamp", light_scale=5.0), GREEN),  # a known lamp may be far from what was found
        (dict(level="mean_albedo"), AMBER),
        (dict(level="prior", level_error=0.3), AMBER),
        (dict(level="found", level_error=None), AMBER),
        (dict(light_scale=1 / 3), RED),
        (dict(light_scale=0.0), RED),
    ],
)
def test_what_fixes_the_level(facts, level):
    assert changed(**facts)["scale"] == level


def test_warnings_turn_the_light_of_their_stage():
    assert changed(warnings=[("shading", "noise of the light: 0.9")])["light"] == AMBER
    found = changed(warnings=[("base", "x"), ("affines", "y")])
    assert found == {"geometry": GREEN, "light": GREEN, "materials": AMBER, "scale": GREEN}


def test_lost_photographs():
    assert changed(lost=2)["geometry"] == GREEN and changed(lost=6)["geometry"] == AMBER and changed(lost=30)["geometry"] == RED
    assert "6 of 30" in judge(dataclasses.replace(GOOD, lost=6)).lights[0].findings[0].text


def test_words_for_every_combination():
    """Every light that is not green says what to do, with a number; the worst findings come first."""
    for escape, misfit, used, error in product((0.0, 0.2, 0.9), (0.01, 0.2, 5.0), (30.0, 18.0, 3.0), (0.05, 0.4, 2.0)):
        verdict = judge(dataclasses.replace(GOOD, escape=escape, misfit=misfit, held_out=None, used=used, level_error=error))
        assert verdict.sentence.endswith(".") and "{" not in verdict.sentence
        for light in verdict.lights:
            ranks = [ORDER.index(finding.level) for finding in light.findings]
            assert ranks == sorted(ranks, reverse=True)
            assert set(light.shown) | set(light.rest) == set(light.findings)
            for finding in light.findings:
                assert bool(finding.remedy) == (finding.level != GREEN)
                assert any(c.isdigit() for c in finding.text) and "{" not in finding.text


def test_the_page_of_the_documentation_holds_the_limits(repository):
    assert limits_table() in (repository / "docs/guide/results.md").read_text()
    assert set(LIGHT_OF) == set(LIMITS)


def test_every_limit_has_a_reason_and_an_order():
    for name, limit in LIMITS.items():
        assert limit.amber != limit.red and len(limit.why) > 20, name


def test_terms_and_numbers_are_written_for_people():
    assert wording.fit_words("full, roughness, metal") == "colour by a matrix, roughness, taken as metal"
    assert (
        wording.fit_words("population (0 pixels), roughness given")
        == "nothing (0 usable pixels): as other objects, roughness given"
    )
    assert wording.fit_words("identity (1 pixels)") == "nothing (1 usable pixel): as predicted"
    reason = materials.affine_size(["full", "gain+bias", "full", "population (3 pixels)"])["reason"]
    told = "2 objects: colour by a matrix; 1 object: colour by factors and offsets; 1 object: nothing, as other objects"
    assert wording.reason_words("affine_size", reason) == told and wording.reason_words("scale", reason) == reason
    assert wording.reason_words("affine_size", materials.affine_size([])["reason"]) == "no objects"
    assert [wording.significant(v) for v in (5.0, 4.519, 16.2, 123.4, 1234.5, 0.0)] == [
        "5.00",
        "4.52",
        "16.2",
        "123",
        "1234",
        "0",
    ]
    assert wording.prose("`filmic` <b> 0.0% +- 3") == "<code>filmic</code> &lt;b&gt; 0.0\u00a0% ± 3"


def test_power_of_lamps_counts_both_sides_and_what_was_kept():
    table = {
        "kind": np.array(["area", "area", "area", "environment"]), "kept": np.array([1, 1, 0, 1]), "side": np.array([1, 0, 0, 1]),
        "area_m2": np.array([0.5, 0.5, 9.0, 0.0]), **{f"radiance_{c}": np.array([2.0, 4.0, 8.0, 1.0]) for c in "rgb"},
    }  # fmt: skip
    assert lamp_power(table).tolist() == [3.0, 12.0, 0.0, 0.0]
