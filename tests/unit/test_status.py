"""Where scenes stand: running, killed and finished jobs, those of other machines, unreadable files; events of jobs."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.errors import missing, refused
from workflow.artifacts import stamps
from workflow.artifacts.files import write_json
from workflow.batch import summary
from workflow.runtime import alive, attempts, events, job_state, slurm
from workflow.runtime import fingerprint as fp
from workflow.runtime.job_state import JobState, noted, reasons, retold, state_file
from workflow.status import standing, table

TINY = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n"
JOB = """
import sys
from workflow.runtime.job_state import JobState
JobState("a", "base", "mark").started()
print("started", flush=True)
sys.stdin.read()
"""
TELL = """
import sys
from workflow.runtime import events
for i in range(2000):
    events.tell("failed", sys.argv[1], "base", str(i), reason="x" * (i % 900))
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A working folder with the scene `a`."""
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/a.yaml").write_text(TINY)
    monkeypatch.chdir(tmp_path)
    for cache in (fp.resolved, fp.fingerprint):
        cache.cache_clear()
    yield tmp_path
    for cache in (fp.resolved, fp.fingerprint):
        cache.cache_clear()


@pytest.fixture
def job(project, repository):
    """Another process that runs stage `base` of `a` until its input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", JOB],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(repository)},
    )
    process.stdout.readline()
    yield process
    process.kill()
    process.communicate()


def stand(scene="a", quality="draft", now=None):
    (found,) = standing.survey([scene], lambda _: quality, now or time.time())
    return found


def made(stage, scene="a", mark=None):
    write_json(Path(f"results/{scene}/{stage}/manifest.json"), {"fingerprint": mark or fp.fingerprint(stage, scene, "draft")})


def published(scene="a", **changed):
    document = {"settings": json.loads(fp.resolved(scene, "draft")), "quality": "draft"}
    document |= {"fingerprint": fp.fingerprint("publish", scene, "draft"), "files": {}} | changed
    write_json(Path(f"scenes/{scene}/manifest.json"), document)
    noted = stamps.Stamps()
    for name in ("manifest.json", *document["files"]):
        noted.of(f"scenes/{scene}/{name}")
    noted.save(stamps.place(Path("results"), scene, stamps.DELIVERABLE))


# ------------------------------------------------------------------------------------------------------- running or killed


def test_a_job_runs_until_it_is_killed(job):
    path = state_file("a", "base")
    document = json.loads(path.read_text())
    assert document["pid"] == job.pid and document["host"] and abs(noted(path, 0).since - time.time()) < 60
    assert noted(path, time.time() + 1e6).state == "running"  # whatever the time stamp says, its process is there
    assert reasons(0.0) == []  # it is no failed job of this run
    usage = alive.usage(document)
    assert 0 < usage.cpu_seconds < 60 and 5 < usage.max_rss_mb < 2000
    job.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 20
    while noted(path, 0).state == "running" and time.monotonic() < deadline:
        time.sleep(0.01)
    assert noted(path, 0).state == "killed"  # as a zombie, which is not reaped yet
    job.wait()
    assert noted(path, 0).state == "killed" and alive.usage(document) is None
    assert ["a: base failed" in line and "it was killed" in line for line in reasons(0.0)] == [True]


def test_a_number_that_was_given_again_is_another_process(job):
    path = state_file("a", "base")
    document = json.loads(path.read_text())
    write_json(path, document | {"start": document["start"] - 1})
    assert noted(path, 0).state == "killed"


@pytest.mark.parametrize("change", [{"kernel": "of another machine"}, {"start": None}, {"pid": "x"}, {"kernel": ""}])
def test_a_job_of_another_machine_is_judged_by_its_touches(project, change):
    JobState("a", "base", "mark").started()
    path = state_file("a", "base")
    write_json(path, json.loads(path.read_text()) | change)
    touched = path.stat().st_mtime
    assert noted(path, touched + alive.SILENCE - 1).state == "running"
    assert noted(path, touched + alive.SILENCE + 1).state == "killed"
    assert alive.usage(json.loads(path.read_text())) is None


def test_a_running_job_touches_its_state_and_a_finished_one_does_not(project, monkeypatch):
    monkeypatch.setattr(alive, "BEAT", 0.01)
    monkeypatch.setattr(job_state, "LOOK", 0.01)
    state, path = JobState("a", "base", "mark"), state_file("a", "base")
    state.started()
    os.utime(path, (0, 0))
    deadline = time.monotonic() + 20
    while path.stat().st_mtime == 0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert path.stat().st_mtime > 0
    state.failed("no light")
    found = noted(path, 0)
    assert (found.state, found.document["reason"]) == ("failed", "no light")
    time.sleep(0.05)  # a touch that had begun
    os.utime(path, (0, 0))
    time.sleep(0.1)
    assert path.stat().st_mtime == 0
    state.done()
    assert noted(path, 0) is None and not path.exists()


# ------------------------------------------------------------------------------------------------------------ one scene


def test_a_scene_goes_from_waiting_to_done(project):
    assert (stand().state, stand().stage, stand().since) == ("waiting", "capture", None)
    assert stand().remaining_cpu_seconds > 1
    for stage in ("capture", "plan", "prior", "segmentation"):
        made(stage)
    write_json(Path("results/a/benchmarks/capture.parts.json"), {"job": {"cpu_seconds": 7, "max_rss_mb": 300.0}})
    write_json(Path("results/a/benchmarks/prior.parts.json"), {"job": {"cpu_seconds": 5.5, "max_rss_mb": 200.0}})
    found = stand()
    assert (found.state, found.stage, found.cpu_seconds, found.max_rss_mb) == ("waiting", "base", 12.5, 300.0)
    state = JobState("a", "base", fp.fingerprint("base", "a", "draft"))
    state.started()
    Path("results/a/logs/base.log").write_text("base: first\nbase: views: 3 of 9 (4 s)\n\n")
    found = stand(now=time.time() + 100)
    assert (found.state, found.stage, found.running, found.line) == ("running", "base", ("base",), "views: 3 of 9 (4 s)")
    assert found.expected_seconds > 0 and found.cpu_seconds > 12.5 and "100 s" not in found.line
    state.failed("the disk is full")
    found = stand()
    assert (found.state, found.stage, found.reason, found.log) == (
        "failed",
        "base",
        "the disk is full",
        "results/a/logs/base.log",
    )
    state.done()
    for stage in fp.NEEDED:
        made(stage)
    published()
    found = stand()
    assert (found.state, found.stage, found.remaining_cpu_seconds) == ("done", "", None) and time.time() - found.since < 60


def test_a_published_scene_whose_last_job_failed_says_so(project):
    for stage in fp.NEEDED:
        made(stage)
    published()
    state = JobState("a", "render", fp.fingerprint("render", "a", "draft"))
    state.failed("no room")
    found = stand()
    assert (found.state, found.stage, found.reason) == ("done", "", "it is published, but its last job of render failed: no room")
    state.started()
    write_json(state.path, json.loads(state.path.read_text()) | {"start": 1})
    assert stand().reason == "it is published, but its last job of render was killed"
    state.done()
    JobState("a", "render", "of other settings").failed("long ago")
    assert (stand().state, stand().reason) == ("done", "")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"fingerprint": "other"}, "settings, inputs or code changed since"),
        ({"fingerprint": "other", "quality": "paper"}, "made at quality paper"),
    ],
)
def test_what_was_made_otherwise_is_stale(project, changed, words, monkeypatch):
    monkeypatch.setattr(standing, "_code_changed", lambda: float("inf"))
    published(**changed)
    found = stand()
    assert (found.state, found.stage, found.reason) == ("stale", "capture", words)


def test_other_settings_are_found_without_a_look_at_inputs(project, monkeypatch):
    """Of a finished scene whose settings and code are as they were, nothing is read but its manifest."""
    monkeypatch.setattr(standing, "_code_changed", lambda: 0.0)
    published(fingerprint="of other inputs")
    assert stand().state == "done"
    published(settings={}, fingerprint="of other settings")
    assert stand().state == "stale"


def test_a_copy_is_compared_by_its_fingerprint(project, monkeypatch):
    monkeypatch.setattr(standing, "_code_changed", lambda: 0.0)
    published(fingerprint="of other code")
    shutil.copy("scenes/a/manifest.json", "scenes/a/copy.json")
    os.replace("scenes/a/copy.json", "scenes/a/manifest.json")
    assert stand().state == "stale"
    published()
    stamps.place(Path("results"), "a", stamps.DELIVERABLE).unlink()
    assert stand().state == "done"


def test_a_changed_file_of_the_code_is_seen(repository, project, monkeypatch):
    standing._code_changed.cache_clear()
    newest = standing._code_changed()
    stats = [path.stat() for name in ("iif_core/errors.py", "workflow/report/page.css") for path in [repository / name]]
    assert newest >= max(max(status.st_mtime, status.st_ctime) for status in stats[1:]) and newest <= time.time()


def test_half_made_stages_of_other_settings_are_stale(project):
    made("capture", mark="of other settings")
    assert (stand().state, stand().stage) == ("stale", "capture")


def test_states_under_other_settings_do_not_count(project):
    JobState("a", "capture", "of other settings").failed("long ago")
    assert stand().state == "waiting"


def test_a_job_that_was_run_by_hand_counts(project):
    state = JobState("a", "capture")  # nobody planned it
    state.started()
    write_json(state.path, json.loads(state.path.read_text()) | {"start": 1})
    assert (stand().state, summary._why_not("a", "draft")["status"]) == ("killed", "killed")
    state.failed("no light")
    assert (stand().state, stand().reason) == ("failed", "no light")
    assert summary._why_not("a", "draft")["reason"] == "no light"


def test_a_stage_that_several_jobs_make_runs_as_long_as_one_does(project):
    made("capture")
    for part in ("1-of-3", "2-of-3", "3-of-3"):
        JobState("a", f"prior.{part}", fp.fingerprint("prior", "a", "draft")).started()
    JobState("a", "prior.1-of-3", "").failed("no weights")
    path = Path("results/a/logs/prior.3-of-3.state.json")
    write_json(path, json.loads(path.read_text()) | {"start": 1})
    assert (stand().state, stand().stage, stand().running) == ("running", "prior", ("prior",))


def test_a_scene_that_cannot_be_used_is_refused(project):
    Path("config/scenes/b.yaml").write_text("source: {kind: folder, path: no/where}\nprior: {kind: retinex}\n")
    Path("config/scenes/c.yaml").write_text(TINY + "sede: 4\n")
    assert not missing(stand("b").reason, "no/where") and not missing(stand("c").reason, "sede", "seed")
    assert {stand(name).state for name in "bcd"} == {"refused"} and not missing(stand("d").reason, "config/scenes/d.yaml")


def test_a_file_of_a_deliverable_that_was_changed_is_told(project):
    path = Path("scenes/a/verdict.json")
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    published(files={"verdict.json": {}})
    assert stand().state == "done"
    path.write_text("[]")
    assert (stand().state, stand().reason) == ("stale", "scenes/a/verdict.json: changed or gone since it was published")
    path.unlink()
    assert stand().state == "stale"


@pytest.mark.parametrize(
    "name", ["scenes/a/manifest.json", "results/a/stamps/deliverable.json", "results/a/benchmarks/base.parts.json"]
)
def test_a_pipe_or_a_giant_in_the_place_of_a_record_is_not_waited_for(project, name):
    published()
    made("base")
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    stand()
    path.unlink()
    with open(path, "wb") as file:
        file.truncate(300 << 30)
    stand()


def test_a_deliverable_that_is_gone_is_told_as_such(project):
    for stage in standing.fp.NEEDED:
        made(stage)
    assert (stand().state, stand().reason) == ("stale", "scenes/a is not there; the next run publishes it")
    Path("scenes/a").mkdir(parents=True)
    assert stand().reason == "scenes/a/manifest.json is not there; the next run publishes it"
    Path("scenes/a/manifest.json").write_text("rubbish")
    assert stand().reason == "scenes/a/manifest.json is not what was published; the next run publishes it"


def test_what_lies_in_the_place_of_its_folders_refuses_a_scene(project):
    Path("results/a").mkdir(parents=True)
    for path in ("scenes/a", "results/a/render"):
        Path(path).parent.mkdir(exist_ok=True)
        Path(path).touch()
        assert stand().state == "refused" and stand().reason.startswith(f"{path}: ")
        Path(path).unlink()
    Path("scenes/a").symlink_to("../config")
    assert stand().state == "refused" and stand().reason.startswith("scenes/a: ")


def test_beyond_those_looked_into_missing_data_are_seen(project, monkeypatch):
    monkeypatch.setattr(standing, "LOOKED_INTO", 1)
    Path("data/x").mkdir(parents=True)
    for name, path in (("b", "data/x"), ("c", "no/where")):
        Path(f"config/scenes/{name}.yaml").write_text(f"source: {{kind: folder, path: {path}}}\nprior: {{kind: retinex}}\n")
    found = list(standing.survey(["a", "b", "c"], lambda _: "draft", time.time()))
    assert [one.state for one in found] == ["waiting", "waiting", "refused"]  # b has no photographs, which is not looked at
    assert [one.remaining_cpu_seconds is not None for one in found] == [True, False, False]
    left = found[0].remaining_cpu_seconds
    assert f"about {table.duration(2 * left)} to go" in table.total(found)


GARBAGE = [
    b"",
    b"{",
    b"[]",
    b"null",
    b'{"state": 3}',
    b'{"state": "started", "pid": 1e400, "since": []}',
    b"\xff\xfe" * 9,
    b"[" * 99999,
]


@pytest.mark.parametrize("content", GARBAGE, ids=range(len(GARBAGE)))
def test_files_that_hold_anything_do_not_raise(project, content):
    names = (
        "results/a/logs/base.state.json",
        "results/a/logs/base.log",
        "scenes/a/manifest.json",
        "results/a/capture/manifest.json",
    )
    for name in (*names, "results/a/benchmarks/base.parts.json"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(content)
    found = stand()
    assert found.state in ("waiting", "stale", "running"), found
    document = json.loads(table.json_line(found, time.time()))
    assert document["state"] == found.state
    assert len(table.text([found], time.time(), 80, False)) == 3


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(-(2**70), 2**70) | st.floats() | st.text(st.characters()),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)
KEYS = {
    "state": st.sampled_from(["started", "failed"]),
    "reason": st.just("no light"),
    "fingerprint": st.just("mark"),
    "since": st.sampled_from(["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "2026-01-01T00:00:00+00:00"]),
    "host": st.just("vm"),
    "pid": st.sampled_from([2**40, 2**31, -1, 0, 2**22]),
    "kernel": st.builds(alive.kernel),
    "start": st.sampled_from([1, 2**61, -1]),
    "attempt": st.sampled_from([1, -5, 10**30]),
    "peak_mb": st.sampled_from([900, -1, 10**30]),
    "earlier": st.just(["attempt 1 failed: no light"]),
    "slurm": st.fixed_dictionaries(
        {key: st.sampled_from(["7", "--all", "\0"]) | JSON for key in ("job", "node", "log")},
        optional={key: st.just(5) | JSON for key in ("memory_mb", "minutes", "restarts")},
    ),
    "told": st.just("attempt 2"),
}


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(document=st.fixed_dictionaries({}, optional={key: JSON | usual for key, usual in KEYS.items()}))
@example(document={"state": "started", "fingerprint": "mark", "pid": 2**40, "start": 1, "kernel": alive.kernel()})
@example(document={"state": "failed", "since": "0001-01-01T00:00:00+14:00"})
def test_a_state_that_holds_anything_stops_nobody(project, document):
    path = state_file("a", "base")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    path.with_name("base.attempts.json").write_text(json.dumps(document))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slurm, "_answer", lambda *command: ("", ""))  # a controller that does not know the job
        patch.setattr(fp, "fingerprint", lambda stage, scene, quality: "mark")
        before = job_state._read(path)
        said = [*reasons(0.0), *retold(0.0), attempts.killed(before), attempts.told(attempts.facts_of(before, "mark"))]
        assert all(line.replace("\n", "").isprintable() for line in said)
        found = stand()
        assert found.state != "unknown", found.reason
        table.json_line(found, time.time())
        summary._why_not("a", "draft")


def test_a_state_that_is_a_pipe_is_not_waited_for(project):
    path = state_file("a", "base")
    path.parent.mkdir(parents=True)
    os.mkfifo(path)
    assert noted(path, time.time()) is None and reasons(0.0) == []


def test_time_stamps_of_any_year_can_be_told():
    for then in (-1e12, 0.5, 1e15):
        assert json.loads(table.json_line(standing.Standing("a", "stale", since=then), 1e9))["since"]


def test_a_bug_of_one_scene_does_not_hide_the_others(project, monkeypatch):
    monkeypatch.setattr(standing, "_jobs", lambda scene, now: 1 / 0 if scene == "a" else {})
    found = list(standing.survey(["a", "b"], lambda _: "draft", time.time()))
    assert [one.state for one in found] == ["unknown", "refused"] and "ZeroDivisionError" in found[0].reason


def test_nothing_is_written(project):
    made("capture")
    before = sorted(Path(".").rglob("*"))
    for name in ("a", "b"):
        stand(name)
    assert table.tell([], lambda _: "draft") == 0
    assert sorted(Path(".").rglob("*")) == before


# ---------------------------------------------------------------------------------------------------------- which, and how


def test_which_scenes_are_shown(project):
    for name in ("a", "b", "studies"):
        Path(f"results/{name}/logs").mkdir(parents=True)
    assert table.scenes_to_show() == ["a", "b"]
    Path("config/batch.tsv").write_text("name\tbase\nx\ta\ny\ta\n")
    assert table.scenes_to_show() == ["x", "y"]
    JobState("b", "base", "mark").started()  # asked for by name, in addition to the batch
    JobState("a--fast", "base", "mark").failed("no light")
    JobState("gone", "base", "mark").failed("no light")  # it was taken out of the table, and its file with it
    assert table.scenes_to_show() == ["x", "y", "a--fast", "b"]
    JobState("gone", "base", "mark").started()
    assert table.scenes_to_show() == ["x", "y", "a--fast", "b", "gone"]
    assert table.scenes_to_show(["b", "a", "b"]) == ["b", "a"]


def test_a_table_that_cannot_be_read_hides_no_scene(project, capsys):
    Path("config/batch.tsv").write_text("name\tbase\nx y\ta\n")
    assert table.tell([], lambda _: "draft") == 1
    said = capsys.readouterr()
    assert "config/batch.tsv, line 2" in said.err and "a      waiting" in said.out


def test_lines_fit_the_terminal_and_hold_nothing_that_steers_it():
    now = 1e9
    rows = [
        standing.Standing("kitchen", "running", "base", ("base", "prior"), "draft", now - 42, 60.0, 100.0, 1234.0, 50.0),
        standing.Standing("a", "failed", "room", since=now - 3 * 86400, reason="\x1b[2Jno\nlight" + "x" * 300),
    ]
    first, running, failed, last = table.text(rows, now, 100, coloured=False)
    assert first.split() == ["scene", "state", "stage", "for", "CPU", "memory"]
    assert running.split("  ") == ["kitchen", "running", "base +1", "42 s of about 1 min", "1 min 40 s", "1.2 GB"]
    assert len(failed) == 100 and failed.endswith("x...") and "3 days" in failed and "\x1b" not in failed and "no light" in failed
    assert last == "2 scenes: 1 running, 1 failed; 1 min 40 s of CPU time so far, about 1 min 40 s to go; at quality draft"
    assert max(map(len, table.text(rows, now, 76, coloured=False)[:3])) <= 76
    coloured = table.text(rows, now, 100, coloured=True)
    assert "\x1b[31mfailed " in coloured[2] and len(coloured[2]) == 100 + len("\x1b[31m\x1b[0m")


def test_colour_is_for_terminals_that_want_it(monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert table._coloured()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not table._coloured()
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False, raising=False)
    assert not table._coloured()


def test_json_has_these_keys():
    found = json.loads(table.json_line(standing.Standing("a", "failed", since=1.7e9), 1.7e9 + 3))
    assert list(found) == [
        *("scene", "state", "stage", "running", "quality", "since", "expected_seconds", "cpu_seconds", "max_rss_mb"),
        *("remaining_cpu_seconds", "reason", "log", "line", "seconds"),
    ]
    assert (found["since"], found["seconds"]) == ("2023-11-14T22:13:20Z", 3.0)


# ---------------------------------------------------------------------------------------------------------------- events


def read(path):
    return [json.loads(line) for line in Path(path).read_text().splitlines()]


def test_a_job_tells_how_it_begins_and_ends(project, monkeypatch):
    JobState("a", "base", "mark").started()
    assert not Path("events.jsonl").exists()  # nothing is reported unless it is asked for
    monkeypatch.setenv(events.VARIABLE, str(project / "events.jsonl"))
    state = JobState("a", "base", "mark")
    state.started()
    state.failed("no light\nat all")
    state.started()
    state.done()
    found = read("events.jsonl")
    assert [one["event"] for one in found] == ["started", "failed", "started", "finished"]
    common = {"v": 1, "scene": "a", "stage": "base", "fingerprint": "mark", "pid": os.getpid()}
    assert all(common.items() <= one.items() and one["host"] and one["time"].endswith("Z") for one in found)
    assert found[1]["reason"] == "no light\nat all" and found[3]["seconds"] < 10
    assert found[3]["cpu_seconds"] > 0 and found[3]["max_rss_mb"] > 10


def test_progress_is_told_now_and_then(monkeypatch):
    monkeypatch.delenv(events.VARIABLE, raising=False)
    monkeypatch.setattr(events, "_told", float("-inf"))
    assert not events.due()
    monkeypatch.setenv(events.VARIABLE, "x")
    assert events.due() and not events.due()
    monkeypatch.setattr(events, "_told", time.monotonic() - events.EVERY)
    assert events.due()


def test_a_line_is_never_longer_than_a_page():
    for reason in ("x" * 99999, "\u2603" * 5000, "", "\n" * 3000):
        line = events.line_of({"v": 1, "reason": reason, "scene": "s"})
        assert len(line) <= events.LONGEST and line.count(b"\n") == 1 and json.loads(line)["scene"] == "s"
    assert len(json.loads(events.line_of({"reason": "x" * 9999}))["reason"]) > 3000


def test_lines_of_two_processes_do_not_mix(tmp_path, repository):
    environment = {**os.environ, "PYTHONPATH": str(repository), events.VARIABLE: str(tmp_path / "e.jsonl")}
    jobs = [subprocess.Popen([sys.executable, "-c", TELL, name], env=environment) for name in "ab"]
    assert [job.wait() for job in jobs] == [0, 0]
    found = [(one["scene"], int(one["fingerprint"]), len(one["reason"])) for one in read(tmp_path / "e.jsonl")]
    for name in "ab":
        assert [one[1:] for one in found if one[0] == name] == [(i, i % 900) for i in range(2000)]


def test_a_line_that_did_not_fit_on_the_disk_spoils_no_other(tmp_path, monkeypatch, caplog):
    path, write = tmp_path / "e.jsonl", os.write
    monkeypatch.setenv(events.VARIABLE, str(path))
    events.tell("started", "a", "base", "mark")
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda handle, data: write(handle, data[:20]))
        events.tell("progress", "a", "base", "mark")
    assert "No space left on device" in caplog.text
    events.tell("finished", "a", "base", "mark")
    assert [one["event"] for one in read(path)] == ["started", "finished"]


def test_every_key_of_an_event_is_on_its_page(repository, project, monkeypatch):
    monkeypatch.setenv(events.VARIABLE, str(project / "e.jsonl"))
    for end in (JobState.done, lambda state: state.failed("no light")):
        state = JobState("a", "base", "mark")
        state.started()
        end(state)
    page = (repository / "docs/reference/events.md").read_text()
    table = [line.split("|")[1:3] for line in page.splitlines() if line.startswith("| `")]
    known = {key: of for keys, of in table for key in keys.replace("`", "").replace(" ", "").split(",")}
    for one in read(project / "e.jsonl"):
        for key in one:
            assert key in known and ("all" in known[key] or f"`{one['event']}`" in known[key]), (key, one["event"])


def test_where_events_go(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert events.checked("results/e.jsonl") == f"{tmp_path}/results/e.jsonl"
    assert events.place(events.checked("results/events")) == tmp_path / f"results/events/{events.platform.node()}.jsonl"
    Path("file").write_text("")
    Path("folder.jsonl").mkdir()
    os.mkfifo("pipe.jsonl")
    for named in ("", " ", "scenes/a", "scenes/e.jsonl", "results/a/events.jsonl"):
        with refused(f"--config events={named}", "results/events.jsonl"):
            events.checked(named)
    assert events.checked("/proc/events", tried=False) == "/proc/events"  # on a node, where a job continues without
    for named in ("file", "folder.jsonl", "file/e.jsonl", "/proc/events", "/proc/version.jsonl/x", "pipe.jsonl"):
        with refused(f"--config events={named}: "):
            events.checked(named)


def test_a_place_that_cannot_be_written_to_is_a_warning_once(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(events.VARIABLE, str(tmp_path / "file/e.jsonl"))
    for _ in range(3):
        events.tell("started", "a", "base", "mark")
    assert [
        record.getMessage().endswith("no events are written there (docs/reference/events.md)") for record in caplog.records
    ] == [True]
