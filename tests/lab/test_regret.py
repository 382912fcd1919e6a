import json
import math

import pandas as pd
import pytest

from lab.studies import regret
from lab.studies.files import Opposite, load_study
from lab.studies.table import KEPT
from tests.errors import refused

SCORES = [("albedo", "psnr", "scaled"), ("roughness", "l2", "raw"), ("rgb", "psnr", "raw")]
OPPOSITES = {
    "environment": Opposite(forced_in="outside", forced_out="inside"),
    "denoiser": Opposite(forced_out="noisy"),
}


def rows(scene, variant, seed, albedo, roughness, held_out, cpu=100.0):
    found = {("albedo", "psnr", "scaled"): albedo, ("roughness", "l2", "raw"): roughness, regret.CURRENCY: held_out}
    return [(scene, variant, seed, *score, value, 9, cpu, cpu, 500.0, 40.0, "f") for score, value in found.items()]


def frame(*groups):
    return pd.DataFrame([row for group in groups for row in group], columns=KEPT)


def test_what_is_kept_is_worth_the_gain_on_held_out_photographs():
    table = frame(
        *(rows(room, "plan", seed, 25.0, 0.1, 30.0 + seed) for room in "abc" for seed in (0, 1, 2)),
        *(
            rows(room, "noisy", seed, 25.0, 0.1, 30.0 + seed - gain + noise, cpu=75.0)
            for room, gain in zip("abc", (4.0, 6.0, 20.0), strict=True)
            for seed, noise in ((0, -0.1), (1, 0.0), (2, 0.1))
        ),
    )
    kept, left_out = regret.judge(table, OPPOSITES, "plan", SCORES)
    assert not left_out and [(one.component, one.scene) for one in kept] == [("denoiser", room) for room in "abc"]
    assert [one.gain for one in kept] == pytest.approx([4.0, 6.0, 20.0])
    assert [one.claim for one in kept] == pytest.approx([13.0, 12.0, 5.0])
    assert [one.as_claimed for one in kept] == [False, True, False]
    assert kept[0].error == pytest.approx(2 * 0.1 / math.sqrt(3)) and kept[0].shares == pytest.approx(
        {"cpu_seconds": 0.25, "max_rss_mb": 0.0, "disk_mb": 0.0}
    )
    text = "\n".join(regret.regret_lines(kept, left_out))
    assert [one.claimed for one in kept] == [pytest.approx(pair) for pair in ((6.0, 20.0), (4.0, 20.0), (4.0, 6.0))]
    assert [one.in_range for one in kept] == [True, True, False]
    assert "| denoiser | a | 4.0 ± 0.1 | 13.0 (6.0 to 20.0) | in the range | none | 25 % | 0 % | 0 % |" in text
    assert "1 of 3 within" in text and "2 within that of their range; 0 improve a score" in text
    (one, *_), _ = regret.judge(table, OPPOSITES, "plan", [*SCORES, regret.CURRENCY])
    assert [score[:2] for score in one.helped] == [regret.CURRENCY[:2]] and one.helped[0][3] > 0.1


def test_a_variant_that_does_what_the_plan_does_says_nothing():
    """Bound on what is left out: both 1 % and two standard errors, in the direction in which a score is better."""
    table = frame(
        *(rows(room, "plan", seed, 25.0, 0.1, 30.0) for room in "abcd" for seed in (0, 1)),
        *(rows("a", name, seed, 25.0, 0.1, 30.0) for name in ("outside", "inside") for seed in (0, 1)),
        *(rows("b", "outside", seed, 25.2, 0.0995, 20.0, cpu=150.0) for seed in (0, 1)),  # less than 1 %
        *(rows("c", "outside", seed, 24.0, 0.08, 30.0) for seed in (0, 1)),  # roughness is better by a fifth
        *(rows("d", "outside", seed, 26.0 + 9 * seed, 0.2, 30.0) for seed in (0, 1)),  # within two standard errors
    )
    kept, left_out = regret.judge(table, OPPOSITES, "plan", SCORES)
    assert not kept and [one.scene for one in left_out] == ["b", "c", "d"]
    assert left_out[0].helped == () and left_out[0].shares["cpu_seconds"] == pytest.approx(0.5)
    assert left_out[2].helped == ()
    (helped,) = left_out[1].helped
    assert helped[:3] == ("roughness", "l2", "raw") and helped[3] == pytest.approx(0.2)
    text = "\n".join(regret.regret_lines(kept, left_out))
    assert "roughness l2 (raw) by 20.0 %" in text and "2 of 3 improve no score" in text


def test_a_gain_that_is_none_is_not_as_claimed():
    one = regret.Kept("denoiser", "a", -0.2, math.nan, 3.0, (2.0, 4.0), (), {})
    assert not one.in_range and one._replace(gain=0.9, error=0.1).in_range and one._replace(gain=8.0).in_range
    assert one._replace(gain=-0.5, claimed=(-0.4, 1.0)).in_range and not one._replace(gain=-0.9, claimed=(-0.4, 1.0)).in_range
    assert not one._replace(gain=math.nan).in_range and not one._replace(claimed=(math.nan, math.nan)).in_range
    assert not one.as_claimed and not one._replace(gain=3.0, claim=math.nan).as_claimed
    assert one._replace(gain=3.0).as_claimed


def test_the_study_names_the_components_that_can_be_forced(repository, monkeypatch):
    from workflow.decisions.plan import OVERRIDDEN

    monkeypatch.chdir(repository)
    study = load_study("regret")
    assert set(study.opposites) == set(OVERRIDDEN) and study.reference == "plan"
    for component, opposite in study.opposites.items():
        forced = study.variants[opposite.forced_out].overrides["components"]
        assert list(forced) == [component]


def test_claims_are_medians_of_the_rooms_and_old_tables_lack_costs(tmp_path):
    table = frame(
        *(rows(room, "plan", 0, 25.0, 0.1, 30.0) for room in "abc"),
        *(rows(room, "noisy", 0, 25.0, 0.1, 30.0 - gain, cpu=75.0) for room, gain in zip("abc", (4.0, 6.0, 20.0), strict=True)),
        rows("a", "outside", 0, 24.0, 0.1, 29.0, cpu=110.0),
    ).drop(columns=["disk_mb"])
    found = regret.claims(*regret.judge(table, OPPOSITES, "plan", SCORES))
    assert found == {
        "denoiser": {"included": {"held_out_db": [6.0, 4.0, 20.0], "cpu_seconds": 0.25, "max_rss_mb": 0.0, "rooms": 3}},
        "environment": {"left_out": {"held_out_db": [-1.0, -1.0, -1.0], "cpu_seconds": 0.1, "max_rss_mb": 0.0, "rooms": 1}},
    }
    study = load_study("regret").model_copy(update={"opposites": OPPOSITES})
    with refused("none.csv", "python -m lab study regret --keep"):
        regret.write_claims(study, tmp_path / "none.csv", tmp_path / "claims.json")
    table.to_csv(tmp_path / "rows.csv", index=False)
    regret.write_claims(study, tmp_path / "rows.csv", tmp_path / "claims.json")
    assert json.loads((tmp_path / "claims.json").read_text()) == found
