import json
import math
import os
from operator import itemgetter

import numpy as np
import pytest
from PIL import Image

from workflow import settings
from workflow.costs import machine, model, records, size
from workflow.costs.work import SceneSize, Work, work_of
from workflow.registry import STAGES
from workflow.runtime import forecast

ROOM = SceneSize(views=16, pixels=409_600.0, faces=58_882.0)
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
    fit = model.fit_rows(planted())["render", "all", "cpu_seconds"]
    assert fit.coefficients == pytest.approx({name: value for name, value in TRUE.items() if value}, rel=1e-3)
    assert (fit.low, fit.high, fit.jobs, fit.rooms) == (1.0, 1.0, 48, 6)


def test_a_room_with_many_jobs_and_a_job_that_went_wrong_do_not_decide():
    """One room has fifty times the jobs and takes twice as long; in another a job took a hundred times as long."""
    rows = planted()
    rows[0]["cpu_seconds"] *= 100
    crowd = [{**row, "cpu_seconds": 2 * row["cpu_seconds"]} for row in planted(rooms=1, of_room=400, seed=2)]
    for row in crowd:
        row["scene"] = "crowded"
    fit = model.fit_rows([*rows, *crowd])["render", "all", "cpu_seconds"]
    ratios = [fit.predict(row).middle / row["cpu_seconds"] for row in rows[1:]]
    assert 1 < np.median(ratios) < 1.5


def test_an_error_counts_the_same_in_both_directions():
    rows = planted(rooms=4, of_room=40)
    for i, row in enumerate(rows):
        row["cpu_seconds"] *= 1.3 ** (1 if i % 4 in (0, 3) else -1)
    fit = model.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert np.median([math.log(fit.predict(row).middle / row["cpu_seconds"]) for row in rows]) == pytest.approx(0.0, abs=0.2)
    truth = [sum(value * row[name] for name, value in TRUE.items()) for row in rows]
    ratios = [fit.predict(row).middle / true for row, true in zip(rows, truth, strict=True)]
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.05)


def test_the_range_is_that_of_rooms_that_were_not_seen():
    """Eight of ten further rooms lie in the range, within what forty rooms can tell."""
    fit = model.fit_rows(planted(rooms=40, noise=0.3))["render", "all", "cpu_seconds"]
    others = planted(rooms=200, noise=0.3, seed=1)
    inside = [fit.low <= row["cpu_seconds"] / fit.predict(row).middle <= fit.high for row in others]
    assert 0.7 < np.mean(inside) < 0.9


def test_memory_follows_one_photograph_and_is_judged_by_sizes_that_were_not_seen():
    """A job holds one photograph at a time, whatever their number; times do not depend on the size of one photograph. If a single
    room shows what pixels cost, it is left out size by size, so that the range comes from its sizes."""
    rows = planted(rooms=4)
    for i, row in enumerate(rows):
        row["a_view"] = (0.1, 0.4)[i % 2]
        row["memory_mb"] = 300 + 1000 * row["a_view"]
    fits = model.fit_rows(rows)
    memory, cpu = (fits["render", "all", name] for name in ("memory_mb", "cpu_seconds"))
    assert memory.coefficients == pytest.approx({"job": 300, "a_view": 1000}, rel=1e-3)
    assert "a_view" not in cpu.coefficients and (memory.low, memory.high) == pytest.approx((1, 1), abs=1e-3)
    alone = [row for row in rows if row["scene"] == "r0" or row["a_view"] < 0.2]
    assert model.fit_rows(alone)["render", "all", "memory_mb"].high == pytest.approx(1, abs=1e-3)
    few = [row for row in rows if row["scene"] in ("r0", "r1")]
    assert model.fit_rows(few)["render", "all", "memory_mb"].high == model.UNMEASURED_SIZE[1]


def test_few_rooms_say_little():
    fit = model.fit_rows(planted(rooms=2))["render", "all", "cpu_seconds"]
    assert (fit.low, fit.high) == model.UNMEASURED


def test_jobs_of_one_size_do_not_promise_that_a_larger_one_costs_the_same():
    rows = planted()
    for row in rows:
        row.update(pixels=1.5 + 0.01 * row["faces"], paths=2.0, cpu_seconds=90.0)
    fit = model.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert "job" not in fit.coefficients
    one = {"job": 1.0, "pixels": 1.5, "paths": 2.0, "faces": 1.0}
    larger = {name: value * (1 if name == "job" else 30) for name, value in one.items()}
    assert fit.predict(one).middle == pytest.approx(90.0, rel=0.1)
    assert fit.predict(larger).middle > 20 * fit.predict(one).middle


def test_wall_time_follows_threads():
    fits = {
        ("render", "all", "cpu_seconds"): model.Fit({"job": 10.0}, 0.8, 1.25, 9, 3, 0.8),
        ("render", "all", "memory_mb"): model.Fit({"job": 500.0}, 0.9, 1.1, 9, 3),
    }
    work = Work("all", {"job": 1.0})

    def seconds(threads, slow=1.0):
        return model.predict("render", work, threads, slow, fits).seconds

    assert [seconds(n).middle for n in (1, 2, 4)] == pytest.approx([10.0, 6.0, 4.0])  # 2 s alone and 8 s shared
    assert seconds(10**6).middle == pytest.approx(2.0, rel=1e-4)
    assert tuple(seconds(2, slow=3.0)) == pytest.approx((18.0, 14.4, 22.5))
    cost = model.predict("render", work, 2, 3.0, fits)
    assert cost.memory_mb.middle == 500.0 and cost.disk_mb is None  # neither follows the speed of the machine
    assert model.predict("render", Work("new", {"job": 1.0}), 2, 1.0, fits) == (None, None, None, None)


@pytest.mark.parametrize(("wall", "divided"), [(0.5, 1.0), (0.9, 0.2), (1.02, 0.0)])
def test_jobs_of_two_threads_tell_what_they_divide(wall, divided):
    rows = planted()
    for row in rows:
        row["seconds"] = row["cpu_seconds"] * (1.05 if row["threads"] == 1 else wall)
    fit = model.fit_rows(rows)["render", "all", "cpu_seconds"]
    assert fit.divided == pytest.approx(divided, abs=1e-6)
    assert model.fit_rows([row for row in rows if row["threads"] == 1])["render", "all", "cpu_seconds"].divided == 0.0


@pytest.mark.parametrize("quality", ["draft", "standard", "paper"])
def test_every_stage_has_work(repository, tmp_path, quality):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/x.yaml").write_text("source: {kind: builtin, scene: kitchen}\nprior: {kind: simulated}\n")
    document = settings.dump(settings.load("x", quality, tmp_path))
    for stage in STAGES:
        work = work_of(stage, document, ROOM)
        assert work.counts["job"] == 1.0 and all(value >= 0 and math.isfinite(value) for value in work.counts.values())
        larger = work_of(stage, document, SceneSize(160, 10 * ROOM.pixels, 10 * ROOM.faces))
        assert all(larger.counts[name] >= value for name, value in work.counts.items())


def test_what_comes_with_the_project_covers_the_default_of_every_stage(document):
    for stage, facts in STAGES.items():
        if facts.on_demand:
            continue
        cost = model.cost_of(stage, document, ROOM)
        more = model.cost_of(stage, document, SceneSize(64, 4 * ROOM.pixels, 4 * ROOM.faces))
        for name, found in cost._asdict().items():
            assert found is not None and 0 < found.low <= found.middle <= found.high, (stage, name)
            assert getattr(more, name).middle >= found.middle, (stage, name)


def test_size_from_headers(document, tmp_path):
    mesh, photo = tmp_path / "mesh.ply", tmp_path / "0.png"
    mesh.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nelement face 1234\nend_header\n" + b"\0" * 9999)
    Image.new("RGB", (640, 480)).save(photo)
    box = {**document, "capture": {**document["capture"], "views": 16, "width": 160, "height": 160}}
    folder = {**box, "source": {"kind": "folder"}}
    extras = [tmp_path / "masks/0.png", tmp_path / "truth/albedo/0.png"]
    for extra in extras:
        extra.parent.mkdir(parents=True)
        Image.new("L", (640, 480)).save(extra)
    found = size.estimate(folder, [mesh, photo, tmp_path / "gone.png", *extras])
    assert (found.views, found.pixels, found.faces, found.exact) == (1, 160 * 120, 1234, False)
    assert found.source_mb == pytest.approx(sum(path.stat().st_size for path in (mesh, photo, *extras)) / 1e6)
    photo.write_bytes(b"no picture")
    mesh.write_bytes(b"ply\nelement face 999999999999\n")  # a header that cannot be true
    found = size.estimate(folder, [mesh, photo])
    assert found.pixels == 160 * 160 and found.faces < 100
    assert size.estimate(box, []).pixels == 16 * 160 * 160


def test_machine_factor_is_that_of_finished_jobs(tmp_path):
    def factor():
        machine.machine_factor.cache_clear()
        return machine.machine_factor(tmp_path)

    def job(name, taken, expected):
        path = tmp_path / name / "benchmarks/render.parts.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"job": {"cpu_seconds": taken}, "expected": {"cpu_seconds": expected}}))

    assert factor() == 1.0
    job("short", 0.1, 9.0)
    job("other", 9.0, 0.0)
    (tmp_path / "other/benchmarks/base.parts.json").write_text("{")
    (tmp_path / "other/benchmarks/affines.parts.json").write_text('{"job": {"cpu_seconds": 9.0}}')
    assert factor() == 1.0
    job("a", 20.0, 10.0)
    assert factor() == pytest.approx(2 ** (1 / 5))
    for i in range(36):
        job(f"b{i}", 20.0, 10.0)
    assert 1.85 < factor() < 2.0
    job("wild", 1e9, 1.0)
    assert factor() < 2.1
    machine.machine_factor.cache_clear()


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


def test_what_snakemake_is_told():
    fits = {("render", "all", name): model.Fit({"job": 100.0}, 0.5, 2.0, 9, 3) for name in model.MEASURES}
    cost = model.predict("render", Work("all", {"job": 1.0}), 2, 1.0, fits)
    assert forecast.memory_mb(cost) == 250 and forecast.disk_mb(cost) == 200
    assert forecast.memory_mb(cost, on_node=True) == 400  # with the Snakemake next to it
    assert forecast.minutes(cost) == forecast.TIME_LEAST + 14
    nothing = model.Cost(None, None, None, None)
    told = forecast.memory_mb(nothing), forecast.minutes(nothing), forecast.disk_mb(nothing)
    assert told == (forecast.UNKNOWN_MEMORY, forecast.UNKNOWN_MINUTES, forecast.UNKNOWN_DISK)
    assert set(forecast.expected(cost)) == {*model.MEASURES, "seconds"} and forecast.expected(nothing) == {}


def test_the_forecast_names_every_stage_and_the_whole(repository, monkeypatch):
    monkeypatch.chdir(repository)
    machine.machine_factor.cache_clear()
    lines = forecast.forecast([forecast.Planned(stage, "kitchen", 2, "draft") for stage in ("render", "capture")], 2)
    assert [line.split()[0] for line in lines] == ["stage", "capture", "render", "expected:"]
    assert lines[-1].endswith("of wall time on 2 cores")
    assert forecast.forecast([], 2) == []
    found = forecast.job_cost
    monkeypatch.setattr(forecast, "job_cost", lambda stage, *_: model.Cost(None, None, None, None))
    unknown = forecast.forecast([forecast.Planned("relight", "kitchen", 2, "draft")], 2)
    assert unknown[-1] == "expected: unknown, because nothing was measured yet of relight"
    monkeypatch.setattr(forecast, "job_cost", found)
    assert os.getcwd() == str(repository)


def test_many_cores_are_no_faster_than_the_longest_chain_of_a_scene(monkeypatch):
    """What waits for one another takes the sum, however many cores there are, also across a stage that is finished."""
    seconds = {"capture": 10.0, "prior": 20.0, "segmentation": 5.0, "base": 40.0}
    costs = {stage: model.Cost(None, model.Range(wall, wall, wall), None, None) for stage, wall in seconds.items()}
    monkeypatch.setattr(forecast, "job_cost", lambda stage, *_: costs[stage])

    def told(scenes, stages, cores):
        jobs = [forecast.Planned(stage, scene, 2, "draft") for scene in scenes for stage in stages]
        return forecast.forecast(jobs, cores)[-1]

    chain = forecast.START + 10 + 20 + 5 + 40 + 4 * forecast.START_OF_JOB
    assert f"expected: {forecast.duration(chain)} of wall time on 10000 cores" == told("ab", seconds, 10_000)
    without_prior = forecast.START + 10 + 40 + 2 * forecast.START_OF_JOB
    assert f"expected: {forecast.duration(without_prior)} of" in told("ab", ("capture", "base"), 10_000)
    work = forecast.START + 2 * (75 + 4 * forecast.START_OF_JOB)
    assert f"expected: {forecast.duration(work)} of wall time on 2 cores" == told("ab", seconds, 2)
