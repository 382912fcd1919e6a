"""Where scenes stand: running, killed and finished jobs, those of other machines, unreadable files."""

import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from workflow.artifacts import sound, stamps
from workflow.artifacts.files import sha256_of, write_json
from workflow.artifacts.manifest import SCENE_SCHEMA
from workflow.batch import standing, status
from workflow.runtime import fingerprint as fp
from workflow.runtime import job_state
from workflow.runtime.job_state import JobState, noted, process, reasons, state_file

TINY = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n"
JOB = """
import sys
from workflow.runtime.job_state import JobState
JobState("a", "base", "mark").started()
print("started", flush=True)
sys.stdin.read()
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


def stand(scene="a", quality="draft"):
    sound.forget()  # every `status` is a process of its own
    (found,) = standing.survey([scene], lambda _: quality)
    return found


def killed(state):
    """Make the process of a job one that no longer exists."""
    write_json(state.path, json.loads(state.path.read_text()) | {"start": 1.0})


def made(stage, scene="a", mark=None):
    write_json(Path(f"results/{scene}/{stage}/manifest.json"), {"fingerprint": mark or fp.fingerprint(stage, scene, "draft")})


def published(scene="a", **changed):
    document = {"schema": SCENE_SCHEMA, "scene": scene, "settings": json.loads(fp.resolved(scene, "draft")), "quality": "draft"}
    document |= {"fingerprint": fp.fingerprint("publish", scene, "draft"), "files": {}} | changed
    write_json(Path(f"scenes/{scene}/manifest.json"), document)
    noted = stamps.Stamps()
    for name in ("manifest.json", *document["files"]):
        noted.of(f"scenes/{scene}/{name}")
    noted.save(stamps.place(Path("results"), scene, stamps.DELIVERABLE))


# ------------------------------------------------------------------------------------------------------- running or killed


def test_a_job_runs_until_it_is_killed(job):
    path = state_file("a", "base")
    found = noted(path, silence=0.0)  # whatever the time stamp says, its process is there
    assert found.state == "running" and found.document["pid"] == job.pid and abs(found.since - time.time()) < 60
    assert reasons(0.0) == []  # it is no failed job of this run
    assert 0 < sum(process(found.document).cpu_times()[:2]) < 60
    job.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 20
    while noted(path).state == "running" and time.monotonic() < deadline:
        time.sleep(0.01)
    assert noted(path).state == "killed"  # as a zombie, which is not reaped yet
    job.wait()
    assert noted(path).state == "killed" and process(found.document) is None
    assert ["a: base failed" in line and "it was killed" in line for line in reasons(0.0)] == [True]


def test_a_number_that_was_given_again_is_another_process(job):
    path = state_file("a", "base")
    document = json.loads(path.read_text())
    write_json(path, document | {"start": document["start"] - 5})
    assert noted(path).state == "killed"


def test_a_job_of_another_machine_is_judged_by_its_touches(project):
    state = JobState("a", "base", "mark")
    state.started()
    write_json(state.path, json.loads(state.path.read_text()) | {"host": "another", "slurm_job": "17", "peak_mb": 1950})
    assert noted(state.path).state == "running" and noted(state.path, silence=0.0).state == "killed"
    os.utime(state.path, (0, time.time() - job_state.SILENCE - 1))
    found = noted(state.path)
    assert found.state == "killed" and "It had 1,950 MB when last seen. `sacct -j 17` says more." in found.reason
    assert process(found.document) is None


def test_a_running_job_renews_its_state_and_a_finished_one_does_not(project, monkeypatch):
    monkeypatch.setattr(job_state, "BEAT", 0.01)
    state, path = JobState("a", "base", "mark"), state_file("a", "base")
    state.started()
    os.utime(path, (0, 0))
    deadline = time.monotonic() + 20
    while "peak_mb" not in json.loads(path.read_text()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert path.stat().st_mtime > 0 and json.loads(path.read_text())["peak_mb"] > 10
    state.failed("no light")
    assert (noted(path).state, noted(path).reason) == ("failed", "no light")
    time.sleep(0.05)  # a beat that had begun
    os.utime(path, (0, 0))
    time.sleep(0.1)
    assert path.stat().st_mtime == 0
    state.done()
    assert noted(path) is None and not path.exists()


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
    found = stand()
    assert (found.state, found.stage, found.running, found.line) == ("running", "base", ("base",), "views: 3 of 9 (4 s)")
    assert found.expected_seconds > 0 and found.cpu_seconds > 12.5
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
    killed(state)
    assert stand().reason.startswith("it is published, but its last job of render killed: it was killed")
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
def test_what_was_made_otherwise_is_stale(project, changed, words):
    published(**changed)
    found = stand()
    assert (found.state, found.stage, found.reason) == ("stale", "capture", words)


def test_half_made_stages_of_other_settings_are_stale(project):
    made("capture", mark="of other settings")
    assert (stand().state, stand().stage) == ("stale", "capture")


def test_states_under_other_settings_do_not_count(project):
    JobState("a", "capture", "of other settings").failed("long ago")
    assert stand().state == "waiting"


def test_a_job_that_was_run_by_hand_counts(project):
    state = JobState("a", "capture")  # nobody planned it
    state.started()
    killed(state)
    assert stand().state == "killed"
    state.failed("no light")
    assert (stand().state, stand().reason) == ("failed", "no light")


def test_a_stage_that_several_jobs_make_runs_as_long_as_one_does(project):
    made("capture")
    for part in ("1-of-3", "2-of-3", "3-of-3"):
        JobState("a", f"prior.{part}", fp.fingerprint("prior", "a", "draft")).started()
    JobState("a", "prior.1-of-3", "").failed("no weights")
    killed(JobState("a", "prior.3-of-3"))
    assert (stand().state, stand().stage, stand().running) == ("running", "prior", ("prior",))


def test_a_scene_that_cannot_be_used_is_refused(project):
    Path("config/scenes/b.yaml").write_text("source: {kind: folder, path: no/where}\nprior: {kind: retinex}\n")
    Path("config/scenes/c.yaml").write_text(TINY + "sede: 4\n")
    assert "no/where" in stand("b").reason and "`sede`: unknown key" in stand("c").reason
    assert {stand(name).state for name in "bcd"} == {"refused"} and "not found" in stand("d").reason
    published()  # an earlier result of `a`, whose file has a mistake now
    Path("config/scenes/a.yaml").write_text(TINY + "sede: 4\n")
    for cache in (fp.resolved, fp.fingerprint):
        cache.cache_clear()
    assert "earlier result" in stand("a").reason and "earlier result" not in stand("b").reason


def test_scenes_that_were_never_begun_are_named(project, capsys):
    Path("config/batch.tsv").write_text("name\tbase\nx\ta\n")
    assert status.tell([], lambda _: "draft") == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("never begun: a")
    assert status.tell(["x"], lambda _: "draft") == 0 and "never begun" not in capsys.readouterr().out


def test_a_finished_scene_has_the_sentence_of_its_report(project, capsys):
    path = Path("scenes/a/verdict.json")
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"verdict": "poor", "sentence": "Do not rely on this.\n"}))
    published(files={"verdict.json": {"sha256": sha256_of(path), "bytes": path.stat().st_size}})
    assert stand().verdict == "Do not rely on this. "
    assert status.tell(["a"], lambda _: "draft") == 0 and "Do not rely on this." in capsys.readouterr().out


def test_a_file_of_a_deliverable_that_was_changed_is_told(project):
    path = Path("scenes/a/verdict.json")
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    published(files={"verdict.json": {"sha256": sha256_of(path), "bytes": 2}})
    assert (stand().state, stand().reason) == ("done", "")
    path.write_text("[]")
    assert stand().state == "stale" and stand().reason.startswith("scenes/a/")
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


def test_a_deliverable_that_is_gone_is_published_next(project):
    for stage in fp.NEEDED[:-1]:
        made(stage)
    assert (stand().state, stand().stage, stand().reason) == ("waiting", "publish", "")


def test_what_lies_in_the_place_of_its_folders_refuses_a_scene(project):
    Path("results/a").mkdir(parents=True)
    for path in ("scenes/a", "results/a/render"):
        Path(path).parent.mkdir(exist_ok=True)
        Path(path).touch()
        assert stand().state == "refused" and stand().reason.startswith(f"{path}: a file, where the workflow makes a folder")
        Path(path).unlink()
    Path("scenes/a").symlink_to("../config")
    assert stand().state == "refused" and stand().reason.startswith("scenes/a: a symbolic link to ")


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
    document = json.loads(status.json_line(found, time.time()))
    assert document["state"] == found.state
    assert len(status.text([found], time.time(), 80)) == 3


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(-(2**70), 2**70) | st.floats() | st.text(st.characters()),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)
KEYS = {
    "state": st.sampled_from(["started", "failed"]),
    "reason": st.just("no light"),
    "fingerprint": st.just("mark"),
    "since": st.sampled_from([1e9, -1.0, 1e300]),
    "host": st.just(platform.node()),
    "pid": st.sampled_from([2**40, 2**31, -1, 0, 2**22]),
    "start": st.sampled_from([1.0, 1e18, -1.0]),
    "slurm_job": st.sampled_from(["7", "--all", "\0"]),
    "peak_mb": st.sampled_from([900, -1, 10**30]),
}


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(document=st.fixed_dictionaries({}, optional={key: JSON | usual for key, usual in KEYS.items()}))
@example(document={"state": "started", "fingerprint": "mark", "pid": 2**40, "start": 1.0, "host": platform.node()})
@example(document={"state": "failed", "since": -1.0})
def test_a_state_that_holds_anything_stops_nobody(project, document):
    path = state_file("a", "base")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fp, "fingerprint", lambda stage, scene, quality: "mark")
        assert all(line.replace("\n", "").isprintable() for line in reasons(0.0))
        found = stand()
        assert found.state != "unknown", found.reason
        status.json_line(found, time.time())


def test_a_state_that_is_a_pipe_is_not_waited_for(project):
    path = state_file("a", "base")
    path.parent.mkdir(parents=True)
    os.mkfifo(path)
    assert noted(path) is None and reasons(0.0) == []


def test_time_stamps_of_any_year_can_be_told():
    for then in (-1e12, 0.5, 1e15):
        assert json.loads(status.json_line(standing.Standing("a", "stale", since=then), 1e9))["since"]


def test_a_bug_of_one_scene_does_not_hide_the_others(project, monkeypatch):
    monkeypatch.setattr(standing, "_jobs", lambda scene, silence: 1 / 0 if scene == "a" else {})
    found = list(standing.survey(["a", "b"], lambda _: "draft"))
    assert [one.state for one in found] == ["unknown", "refused"] and "ZeroDivisionError" in found[0].reason


def test_nothing_is_written(project):
    made("capture")
    before = sorted(Path(".").rglob("*"))
    for name in ("a", "b"):
        stand(name)
    assert status.tell([], lambda _: "draft") == 0
    assert sorted(Path(".").rglob("*")) == before


# ---------------------------------------------------------------------------------------------------------- which, and how


def test_which_scenes_are_shown(project, capsys):
    for name in ("a", "b", "studies"):
        Path(f"results/{name}/logs").mkdir(parents=True)
    assert status.scenes_to_show() == ["a", "b"]
    Path("config/batch.tsv").write_text("name\tbase\nx\ta\ny\ta\n")
    assert status.scenes_to_show() == ["a"]  # nobody uses the table yet
    assert status.tell([], lambda _: "draft") == 0 and "never begun: x, y" in capsys.readouterr().out
    Path("results/x/logs").mkdir(parents=True)
    assert status.scenes_to_show() == ["x", "y", "a"]  # it has settings and results, and is no line of the table
    JobState("b", "base", "mark").started()  # asked for by name, in addition to the batch
    JobState("a--fast", "base", "mark").failed("no light")
    JobState("gone", "base", "mark").failed("no light")  # it was taken out of the table, and its file with it
    assert status.scenes_to_show() == ["x", "y", "a--fast", "b", "a"]
    JobState("gone", "base", "mark").started()
    assert status.scenes_to_show() == ["x", "y", "a--fast", "b", "gone", "a"]
    assert status.scenes_to_show(["b", "a", "b"]) == ["b", "a"]


def test_a_table_that_cannot_be_read_hides_no_scene(project, capsys):
    Path("config/batch.tsv").write_text("name\tbase\nx y\ta\n")
    assert status.tell([], lambda _: "draft") == 1
    said = capsys.readouterr()
    assert "config/batch.tsv, line 2" in said.err and "a      waiting" in said.out


def test_lines_fit_the_terminal_and_hold_nothing_that_steers_it():
    now = 1e9
    rows = [
        standing.Standing("kitchen", "running", "base", ("base", "prior"), "draft", now - 42, 60.0, 100.0, 1234.0, 50.0),
        standing.Standing(
            "a", "failed", "room", since=now - 3 * 86400, remaining_cpu_seconds=70.0, reason="\x1b[2Jno\nlight" + "x" * 300
        ),
    ]
    first, running, failed, last = status.text(rows, now, 100)
    assert first.split() == ["scene", "state", "stage", "time", "CPU", "memory"]
    assert running.split("  ") == ["kitchen", "running", "base +1", "42 s of about 1 min", "1 min 40 s", "1.2 GB"]
    assert len(failed) == 100 and failed.endswith("x...") and "3 days" in failed and "\x1b" not in failed and "no light" in failed
    assert last == "2 scenes: 1 running, 1 failed; 1 min 40 s of CPU time so far, about 50 s to go; at quality draft"
    assert max(map(len, status.text(rows, now, 76)[:3])) <= 76


def test_json_has_these_keys():
    found = json.loads(status.json_line(standing.Standing("a", "failed", since=1.7e9), 1.7e9 + 3))
    assert list(found) == [
        *("scene", "state", "stage", "running", "quality", "since", "expected_seconds", "cpu_seconds", "max_rss_mb"),
        *("remaining_cpu_seconds", "reason", "verdict", "log", "line", "seconds"),
    ]
    assert (found["since"], found["seconds"]) == ("2023-11-14T22:13:20Z", 3.0)
