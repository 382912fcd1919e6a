"""The cost of jobs is fitted again from the table that is kept."""

import json
import math
from operator import itemgetter

import numpy as np
import pytest

from lab.costs import fit, records, refit
from workflow import settings
from workflow.costs import model
from workflow.registry import STAGES

TRUE = {"job": 2.0, "pixels": 30.0, "faces": 0.0, "paths": 1.5}


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """Settings of a room that is rendered."""
    root = tmp_path_factory.mktemp("scene")
    (root / "config/scenes").mkdir(parents=True)
    (root / "config/scenes/room.yaml").write_text("source: {kind: builtin, scene: kitchen}\n")
    return settings.dump(settings.load("room", "draft", root))


def planted(rooms=6, of_room=8, noise=0.0, seed=0):
    """Rows of jobs whose cost is `TRUE`, with errors that a room shares."""
    random = np.random.default_rng(seed)
    rows = []
    for room in range(rooms):
        factor = math.exp(noise * random.standard_normal())
        for i in range(of_room):
            counts = {"job": 1.0, **{name: float(10 ** random.uniform(-2, 1)) for name in ("pixels", "faces", "paths")}}
            cost = factor * sum(TRUE[name] * counts[name] for name in counts)
            measures = {"cpu_seconds": cost, "seconds": cost / 2, "memory_mb": 100 * cost, "disk_mb": cost}
            facts = {
                "scene": f"r{room}",
                "stage": "render",
                "kind": "all",
                "threads": 1 + i % 2,
                "machine": 1.0,
                "fingerprint": "f",
            }
            rows.append({**facts, **measures, **counts})
    return rows


def test_planted_coefficients_are_recovered():
    found = fit.fit_rows(planted())["render", "all", "cpu_seconds"]
    assert found.coefficients == pytest.approx({name: value for name, value in TRUE.items() if value}, rel=1e-3)
    assert (found.low, found.high, found.jobs, found.rooms) == (1.0, 1.0, 48, 6)


def test_a_room_with_many_jobs_and_a_job_that_went_wrong_do_not_decide():
    """One room has fifty times the jobs and takes twice as long; in another a job took a hundred times as long."""
    rows = planted()
    rows[0]["cpu_seconds"] *= 100
    crowd = [{**row, "cpu_seconds": 2 * row["cpu_seconds"]} for row in planted(rooms=1, of_room=400, seed=2)]
    for row in crowd:
        row["scene"] = "crowded"
    found = fit.fit_rows([*rows, *crowd])["render", "all", "cpu_seconds"]
    ratios = [found.predict(row).middle / row["cpu_seconds"] for row in rows[1:]]
    assert 1 < np.median(ratios) < 1.5


def test_an_error_counts_the_same_in_both_directions():
    rows = planted(rooms=4, of_room=40)
    for i, row in enumerate(rows):
        row["cpu_seconds"] *= 1.3 ** (1 if i % 4 in (0, 3) else -1)
    found = fit.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert np.median([math.log(found.predict(row).middle / row["cpu_seconds"]) for row in rows]) == pytest.approx(0.0, abs=0.2)
    truth = [sum(value * row[name] for name, value in TRUE.items()) for row in rows]
    ratios = [found.predict(row).middle / true for row, true in zip(rows, truth, strict=True)]
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.05)


def test_the_range_is_that_of_rooms_that_were_not_seen():
    """Eight of ten further rooms lie in the range, within what forty rooms can tell."""
    found = fit.fit_rows(planted(rooms=40, noise=0.3))["render", "all", "cpu_seconds"]
    others = planted(rooms=200, noise=0.3, seed=1)
    inside = [found.low <= row["cpu_seconds"] / found.predict(row).middle <= found.high for row in others]
    assert 0.7 < np.mean(inside) < 0.9


def test_memory_follows_one_photograph_and_is_judged_by_sizes_that_were_not_seen():
    """A job holds one photograph at a time, whatever their number; times do not depend on the size of one photograph. If a single
    room shows what pixels cost, it is left out size by size, so that the range comes from its sizes."""
    rows = planted(rooms=4)
    for i, row in enumerate(rows):
        row["a_view"] = (0.1, 0.4)[i % 2]
        row["memory_mb"] = 300 + 1000 * row["a_view"]
    fits = fit.fit_rows(rows)
    memory, cpu = (fits["render", "all", name] for name in ("memory_mb", "cpu_seconds"))
    assert memory.coefficients == pytest.approx({"job": 300, "a_view": 1000}, rel=1e-3)
    assert "a_view" not in cpu.coefficients and (memory.low, memory.high) == pytest.approx((1, 1), abs=1e-3)
    alone = [row for row in rows if row["scene"] == "r0" or row["a_view"] < 0.2]
    assert fit.fit_rows(alone)["render", "all", "memory_mb"].high == pytest.approx(1, abs=1e-3)
    few = [row for row in rows if row["scene"] in ("r0", "r1")]
    assert fit.fit_rows(few)["render", "all", "memory_mb"].high == fit.UNMEASURED_SIZE[1]


def test_few_rooms_say_little():
    found = fit.fit_rows(planted(rooms=2))["render", "all", "cpu_seconds"]
    assert (found.low, found.high) == fit.UNMEASURED


def test_jobs_of_one_size_do_not_promise_that_a_larger_one_costs_the_same():
    rows = planted()
    for row in rows:
        row.update(pixels=1.5 + 0.01 * row["faces"], paths=2.0, cpu_seconds=90.0)
    found = fit.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert "job" not in found.coefficients
    one = {"job": 1.0, "pixels": 1.5, "paths": 2.0, "faces": 1.0}
    larger = {name: value * (1 if name == "job" else 30) for name, value in one.items()}
    assert found.predict(one).middle == pytest.approx(90.0, rel=0.1)
    assert found.predict(larger).middle > 20 * found.predict(one).middle


@pytest.mark.parametrize(("wall", "divided"), [(0.5, 1.0), (0.9, 0.2), (1.02, 0.0)])
def test_jobs_of_two_threads_tell_what_they_divide(wall, divided):
    rows = planted()
    for row in rows:
        row["seconds"] = row["cpu_seconds"] * (1.05 if row["threads"] == 1 else wall)
    found = fit.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert found.divided == pytest.approx(divided, abs=1e-6)
    assert fit.fit_rows([row for row in rows if row["threads"] == 1])["render", "all", "cpu_seconds"].divided == 0.0


def test_rows_come_back_as_they_were_written(tmp_path):
    rows = planted(rooms=1, of_room=3)
    records.write_rows(tmp_path / "a.csv", rows)
    key = itemgetter("seconds")
    back = sorted(records.read_rows(tmp_path / "a.csv"), key=key)
    assert back == [{**row, "threads": float(row["threads"])} for row in sorted(rows, key=key)]


def test_rows_of_finished_jobs(tmp_path, document):
    """A chain of manifests as stages leave them; what lost its upstream, or its measurement, has no row."""
    folder = tmp_path / "results/room--s1"

    def finish(stage, keys, inputs=(), files=None, measured=True):
        facts = {"stage": stage, "scene": "room--s1", "fingerprint": f"{stage}0", "settings": settings.select(document, keys)}
        manifest = {**facts, "inputs": {name: {"fingerprint": f"{name}0"} for name in inputs}, "files": files or {}}
        (folder / stage).mkdir(parents=True)
        (folder / stage / "manifest.json").write_text(json.dumps(manifest))
        if measured:
            (folder / "benchmarks").mkdir(exist_ok=True)
            job = {"seconds": 4.0, "cpu_seconds": 6.0, "max_rss_mb": 500.0, "threads": 2}
            (folder / f"benchmarks/{stage}.parts.json").write_text(json.dumps({"job": job}))

    photos = {f"photos/{i}.exr": {"shape": [20, 30], "bytes": 1000} for i in range(3)}
    files = {**photos, "cameras.parquet": {"shape": [3], "bytes": 10}, "faces.parquet": {"shape": [77], "bytes": 10}}
    finish("capture", STAGES["capture"].settings, files=files)
    finish("segmentation", STAGES["segmentation"].settings, ["capture"])
    finish("prior", STAGES["prior"].settings, ["capture"], measured=False)
    finish("base", STAGES["base"].settings, ["capture", "prior", "gone"])
    rows = {row["stage"]: row for row in records.gather([tmp_path / "results"])}
    assert set(rows) == {"capture", "segmentation"}
    capture = rows["capture"]
    assert (capture["scene"], capture["kind"], capture["threads"]) == ("room", "builtin", 2)
    assert (capture["pixels"], capture["faces"], capture["paths"]) == pytest.approx((1800e-6, 77e-6, 1800e-6 * 64))
    assert capture["disk_mb"] == pytest.approx(0.003, abs=1e-3) and capture["memory_mb"] == 500.0


def test_jobs_are_added_once_and_the_fit_is_that_of_the_table(tmp_path, monkeypatch):
    table, fits = tmp_path / "costs.csv", tmp_path / "coefficients.json"
    records.write_rows(table, planted(rooms=3))
    new = planted(rooms=4)[-3:]
    monkeypatch.setattr(refit, "gather", lambda folders: [*new, *planted(rooms=3)[:2]])
    lines = refit.refit([tmp_path], table, fits)
    assert lines[1] == f"{table}: 27 jobs, 3 of them new"
    assert refit.refit([tmp_path], table, fits)[1] == f"{table}: 27 jobs, 0 of them new"
    assert any(line.startswith("| render, all | 27 | 4 | ") for line in lines)
    found = model.read_fits(fits)
    assert found == fit.fit_rows(records.read_rows(table)) and len(found) == 3


def test_jobs_of_a_slower_machine_fit_as_if_they_were_of_the_first(tmp_path, monkeypatch):
    table, fits = tmp_path / "costs.csv", tmp_path / "coefficients.json"
    records.write_rows(table, planted(rooms=3))
    slow = [row for row in planted(rooms=5) if row["scene"] in ("r3", "r4")]
    for row in slow:
        row.update(cpu_seconds=1.6 * row["cpu_seconds"], seconds=1.6 * row["seconds"])
    monkeypatch.setattr(refit, "gather", lambda folders: slow)
    assert "16 new jobs of a machine that takes 1.6 times as long" in refit.refit([tmp_path], table, fits)[0]
    found = model.read_fits(fits)["render", "all", "cpu_seconds"]
    assert found.coefficients == pytest.approx({name: value for name, value in TRUE.items() if value}, rel=1e-3)
    assert {row["machine"] for row in records.read_rows(table)} == {1.0, 1.6}
