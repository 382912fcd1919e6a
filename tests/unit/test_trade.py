"""Speed against accuracy: the front, and the point of it that a time or a score asks for."""

import json

import numpy as np
import pytest

from iif_core.errors import InputError
from tests.errors import refused
from workflow.costs.model import Range
from workflow.runtime import fingerprint as fp
from workflow.runtime import forecast
from workflow.settings import loading
from workflow.settings.names import QUALITIES, REPOSITORY, quality_names
from workflow.settings.yaml_file import read_yaml
from workflow.trade import bench, choose
from workflow.trade import points as trade_points
from workflow.trade.points import Point

SECONDS = {"p01": 30, "p02": 60, "p03": 110, "p04": 400}
ALBEDO = {"p01": 20.0, "p02": 22.0, "p03": 23.0, "p04": 25.0}


@pytest.fixture
def table(monkeypatch, tmp_path):
    """Four points, what they take and what they score in two rooms; the current folder is empty."""
    known = {
        name: Point(name, {"a": {"albedo": a - 1, "held_out": a + 1}, "b": {"albedo": a + 1, "held_out": a + 3}})
        for name, a in ALBEDO.items()
    }
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(choose, "points", lambda: known)
    monkeypatch.setattr(choose, "overridden", lambda scene, name: ["capture.views"] if scene == "fixed" else [])
    monkeypatch.setattr(choose, "scene_origin", lambda scene: f"config/scenes/{scene}.yaml")
    monkeypatch.setattr(choose, "canonical", lambda name: {"p02": "draft"}.get(name, name))
    monkeypatch.setattr(choose.fingerprints, "fingerprint", lambda stage, scene, quality: f"{stage} {scene} {quality}")
    document = {"capture": {"test_every": 8}}
    resolved = {"bare": json.dumps({"capture": {"test_every": 0}})}
    monkeypatch.setattr(choose.fingerprints, "resolved", lambda scene, quality: resolved.get(scene, json.dumps(document)))

    def wall(scene, name, cores):
        middle = float(SECONDS[name])
        return forecast.Wall(Range(middle, middle * 0.8, middle * 1.3), "")

    monkeypatch.setattr(choose.forecast, "wall", wall)
    return known


def chosen(value, scene="room"):
    return choose.choice(choose.read({"quality": value}, 2), scene)


@pytest.mark.parametrize(("budget", "point"), [(30, "p01"), (59.9, "p01"), (60, "draft"), (399, "p03"), (1000000, "p04")])
def test_a_budget_gets_the_best_point_that_keeps_to_it(table, budget, point):
    assert chosen(f"{budget}s").quality == point


def test_a_budget_below_the_cheapest_point_is_refused_with_the_least_and_what_holds_it_up(table):
    with refused("p01", "30 s", "24 s", "39 s"):
        chosen("29s")
    with refused("config/scenes/fixed.yaml", "capture.views"):
        chosen("29s", "fixed")
    assert "sets capture.views itself" in chosen("70s", "fixed").line
    assert "quality p02 (draft), about 60 s (48 s to 1 min 18 s)" in chosen("70s").line


@pytest.mark.parametrize(("target", "point"), [("albedo:19", "p01"), ("albedo:22.5", "p03"), ("held_out:27", "p04")])
def test_a_target_gets_the_cheapest_point_that_reaches_it(table, target, point):
    assert chosen(target).quality == point


def test_a_target_follows_what_was_measured_in_the_room(table, tmp_path, monkeypatch):
    (tmp_path / "bench/room").mkdir(parents=True)
    scores = {"p01": {"albedo": 17.5}, "p03": {"albedo": 19.5}, "p04": {"albedo": 99.0}}  # 2.5 and 3.5 dB worse than in the table
    found = {name: {"metrics": "old" if name == "p04" else name, "scores": of} for name, of in scores.items()}
    (tmp_path / "bench/room/bench.json").write_text(json.dumps({"points": found}))
    monkeypatch.setattr(bench, "marks", lambda scene: {name: name for name in ALBEDO})
    assert chosen("albedo:19.5").quality == "p03" and chosen("albedo:19.5", "other").quality == "p01"
    assert "from bench/room/bench.json" in chosen("albedo:19.5").line
    assert chosen("albedo:19").quality == "draft"  # 3 dB worse in the mean
    with refused("p04", "albedo", "22.0 dB", "bench/room"):
        chosen("albedo:22.1")
    with refused("held_out"):
        chosen("held_out:20")
    with refused("held_out", "bare"):
        chosen("held_out:20", "bare")
    (tmp_path / "bench/room/bench.json").write_text("{")
    with refused("bench/room/bench.json", "snakemake --cores 2 bench/room --force"):
        chosen("albedo:19.5")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"qualty": "draft"}, ["qualty", "quality", "maps", "colour"]),
        ({"budget": 120}, ["budget", "--config quality=120s"]),
        ({"quality": "draft", "target": "held_out:24"}, ["target", "--config quality=held_out:24"]),
        ({"point": "p05"}, ["point", "--config quality=p05"]),
        ({"events": "x"}, ["events", "python -m workflow status --json"]),
        *(({"quality": value}, [f"quality={value}"]) for value in ("soon", "0s", "-3s", "nans", "120", "p99")),
        *(({"quality": value}, ["albedo:24"]) for value in ("beauty:3", "albedo", "albedo:inf", "albedo:0", "albedo:-1")),
        ({"quality": "drafty"}, ["drafty", "draft"]),
    ],
)
def test_what_cannot_be_asked_for_is_one_clear_error(config, words):
    with refused(*words):
        choose.read(config, 2)


def test_a_choice_is_kept_while_nothing_but_the_machine_changes(table, monkeypatch, tmp_path):
    asked = choose.read({"quality": "110s"}, 2)
    made = choose.choice(asked, "room")
    choose.keep(asked, {"room": made})
    monkeypatch.setitem(SECONDS, "p03", 130)  # the machine turns out to be slower
    assert choose.choice(asked, "room") == made and made.quality == "p03"
    assert chosen("111s").quality == "draft"
    monkeypatch.setattr(choose.fingerprints, "resolved", lambda scene, quality: "{}")  # the scene file changed
    assert choose.choice(asked, "room").quality == "draft"
    (tmp_path / "results/room/choice.json").write_text("{")
    assert choose.choice(asked, "room").quality == "draft"


def test_points_that_do_not_go_with_a_scene_are_left_out(table, monkeypatch):
    def wall(scene, name, cores):
        if name != "p04":
            raise InputError(f"{name} contradicts the scene")
        return forecast.Wall(Range(50.0, 40.0, 60.0), "")

    monkeypatch.setattr(choose.forecast, "wall", wall)
    assert chosen("60s").quality == "p04"
    monkeypatch.setattr(choose, "points", lambda: {"p01": table["p01"]})
    with refused("p01"):
        chosen("60s")


def test_studies_and_named_qualities_are_not_chosen_anew(table):
    assert chosen("60s", "room--aggregation-full-s0").quality == "draft"
    assert chosen("paper").quality == "paper" and chosen("p01").quality == "p01"


def test_after_the_run_a_person_learns_whether_the_target_was_reached(table, tmp_path):
    folder = tmp_path / "results/room/metrics"
    folder.mkdir(parents=True)
    means = {"result": {"albedo": {"scaled": {"psnr": {"mean": 21.456, "views": 3}}}}}
    (folder / "summary.json").write_text(json.dumps({"means": means}))
    (folder / "manifest.json").write_text(json.dumps({"fingerprint": "metrics room p03"}))

    def said(target):
        return choose.reached(choose.read({"quality": target}, 2), ["room", "elsewhere"])

    assert said("albedo:23") == [
        "room: albedo:23: missed, 21.46 dB; `snakemake --cores 2 bench/room` measures what this room can"
        " reach, and the next choice follows it"
    ]
    assert said("albedo:21") == []  # the scores that are there are not of the point that this asks for
    (folder / "manifest.json").write_text(json.dumps({"fingerprint": "metrics room draft"}))
    assert said("albedo:21") == ["room: albedo:21: reached, 21.46 dB"]
    assert "no such score" in said("held_out:23.5")[0]
    assert choose.reached(choose.read({"quality": "3s"}, 2), ["room"]) == []


def test_shipped_points_are_a_front_and_every_quality_can_be_loaded():
    known = trade_points.points()
    assert len(known) >= 6 and list(known) == sorted(known) and set(known) <= set(quality_names())
    albedo = [point.expected("albedo").mean for point in known.values()]
    cost = [np.exp(np.mean([np.log(room["cpu_seconds"]) for room in point.rooms.values()])) for point in known.values()]
    assert (np.diff(albedo) > 0).all() and (np.diff(cost) > 0).all()
    assert set(trade_points.named().values()) <= set(known)
    for name in (*known, *QUALITIES):
        loading.load("kitchen", name, REPOSITORY)
    assert len(trade_points.bench_points()) == 3


def test_a_quality_by_name_says_what_it_takes_what_it_scored_and_which_scenes_set_it_themselves(monkeypatch):
    monkeypatch.chdir(REPOSITORY)  # in a checkout, the folder of the run holds the shipped points
    request = choose.read({"quality": "draft"}, 2)
    point = trade_points.point_of("draft")
    assert point is trade_points.points()[trade_points.named()["draft"]]
    lines = choose.told(request, {"kitchen": choose.Choice("draft")})
    taken = read_yaml(REPOSITORY / f"config/quality/{point.name}.yaml")["capture"]
    assert len(lines) == 1 and f"at most {taken['views']} photographs of {taken['width']} x {taken['height']}" in lines[0]
    assert " dB" not in lines[0] and "accuracy.md" in lines[0]  # it was measured with predictions that no photograph gives
    monkeypatch.setattr(choose.fingerprints, "resolved", lambda *_: '{"prior": {"kind": "simulated"}}')
    (line,) = choose.told(request, {"kitchen": choose.Choice("draft")})
    assert f"albedo up to scale {point.expected('albedo').mean:.1f} dB" in line and choose.LABORATORY in line
    monkeypatch.undo()
    monkeypatch.chdir(REPOSITORY)
    assert [choose.fits(stage, "kitchen") for stage in ("capture", "affines", "relight", "lamp_images")] == [
        True,
        True,
        False,
        False,
    ]
    assert not choose.fits("affines", "kitchen--bench-p01-s0")
    lines = choose.told(request, dict.fromkeys(["kitchen", "redkitchen"], choose.Choice("draft")))
    assert lines[1:] == ["config/scenes/redkitchen.yaml sets capture.views itself"]


def test_named_qualities_are_points_in_order_and_neither_end_of_the_front():
    order, named = list(trade_points.points()), trade_points.named()
    assert set(named) == {"draft", "standard"}  # the paper's sizes are dearer than every point that was measured
    assert 0 < order.index(named["draft"]) < order.index(named["standard"])


def test_a_bench_runs_the_point_that_its_name_says_and_holds_photographs_out():
    for point, scene in bench.scenes("kitchen").items():
        found = loading.load(scene, "draft", REPOSITORY)
        wanted = read_yaml(REPOSITORY / f"config/quality/{point}.yaml")["capture"]
        assert found.capture.views == wanted["views"] and found.capture.test_every == 8
        assert loading.load(scene, "paper", REPOSITORY) == found


def test_wall_time_grows_along_the_front(monkeypatch):
    monkeypatch.setattr(forecast, "_compilation", lambda stage: 0.0)  # that of a checkout in which nothing ran yet
    seconds = [forecast.wall("kitchen", name, 2).seconds.middle for name in trade_points.points()]
    assert seconds[0] < 180 and seconds[-1] > 2 * seconds[0]
    assert forecast.wall("kitchen", "draft", 1).seconds.middle > forecast.wall("kitchen", "draft", 2).seconds.middle


def test_a_kind_of_work_that_was_never_measured_has_no_promised_time(monkeypatch):
    document = json.loads(fp.resolved("kitchen", "draft"))
    document["prior"]["kind"] = "rgbx"
    monkeypatch.setattr(fp, "resolved", lambda scene, quality: json.dumps(document))
    with refused("prior", "rgbx"):
        forecast.wall("kitchen", "draft", 2)
