import json
import math
import os

import pytest
from PIL import Image

from workflow import settings
from workflow.costs import machine, model, size
from workflow.costs.work import SceneSize, Work, work_of
from workflow.registry import STAGES
from workflow.runtime import forecast

ROOM = SceneSize(views=16, pixels=409_600.0, faces=58_882.0)


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """Settings of a room that is rendered."""
    root = tmp_path_factory.mktemp("scene")
    (root / "config/scenes").mkdir(parents=True)
    (root / "config/scenes/room.yaml").write_text("source: {kind: builtin, scene: kitchen}\n")
    return settings.dump(settings.load("room", "draft", root))


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
        cost = model.predict(stage, work_of(stage, document, ROOM))
        more = model.predict(stage, work_of(stage, document, SceneSize(64, 4 * ROOM.pixels, 4 * ROOM.faces)))
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
