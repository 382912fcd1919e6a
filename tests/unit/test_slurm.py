"""What Slurm is asked, with commands that answer as it does (tests/slurm/ asks a real one); what attempts say of earlier ones."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from workflow.runtime import attempts, job_state, slurm
from workflow.runtime.attempts import killed
from workflow.runtime.job_state import JobState, reasons, retold

NODES = [slurm.Node(12, 24_000, "main", True), slurm.Node(4, 256_000, "main", True), slurm.Node(64, 512_000, "large", False)]
SHOWN = (
    "JobId={job} JobName=wrap UserId=root(0) Account=(null) JobState={state} Reason=None Restarts={restarts} BatchFlag=1"
    " TimeLimit=01:30:00 Partition=main BatchHost=n{job} NumCPUs=6 MinMemoryNode=2000M Features=(null) StdErr={log} StdOut={log}"
)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Commands `scontrol` and `sacct` that print what is put into files, and a working folder."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("scontrol", "sacct", "sinfo"):
        (programs / name).write_text(
            f'#!/bin/sh\neval "job=\\${{$#}}"\ncat {programs}/{name}.$job 2>/dev/null || cat {programs}/{name}.all\n'
        )
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)

    def put(job, state, restarts=0, log="", program="scontrol"):
        text = SHOWN.format(job=job, state=state, restarts=restarts, log=log) if program == "scontrol" else f"{state}\n"
        (programs / f"{program}.{job}").write_text(text)

    def enter(job):
        put(job, "RUNNING")
        monkeypatch.setenv("SLURM_JOB_ID", str(job))

    put.enter, put.programs = enter, programs
    return put


def attempt(peak=None):
    """Start a job whose process ended without a report; `peak` is the memory with which it was last seen."""
    state = JobState("a", "base", "mark")
    state.started()
    state._ended.set()
    document = json.loads(state.path.read_text()) | {"start": 1}  # of a process that no longer exists
    state.path.write_text(json.dumps(document | ({"peak_mb": peak} if peak else {})))
    return json.loads(state.path.read_text())


def test_the_job_of_a_process(cluster):
    cluster(7, "RUNNING", restarts=2, log="/x/7.log")
    assert slurm.own({}) is None
    assert slurm.own({"SLURM_JOB_ID": "7"}) == slurm.Own("7", "n7", 2000, 90, 2, "/x/7.log")
    cluster(9, "RUNNING", log="/data/my rooms/.snakemake/slurm_logs/9.log")
    assert slurm.own({"SLURM_JOB_ID": "9"}) == slurm.Own("9", "n9", 2000, 90, 0, "/data/my rooms/.snakemake/slurm_logs/9.log")
    assert slurm.own({"SLURM_JOB_ID": "8", "SLURMD_NODENAME": "x", "SLURM_RESTART_COUNT": "1"}) == slurm.Own(
        "8", "x", None, None, 1, ""
    )


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (
            "OUT_OF_MEMORY",
            "was killed for its memory: it had asked for 2,000 MB and 90 minutes; this process had 1,950 MB when last seen",
        ),
        ("TIMEOUT", "was ended at its time limit: it had asked for"),
        ("NODE_FAIL", "was lost with its node (NODE_FAIL)"),
        ("CANCELLED", "was cancelled (scancel"),
        ("PREEMPTED", "was preempted"),
        ("FAILED", "was killed without a word (for its memory? it had asked for 2,000 MB"),
        ("COMPLETED", "Slurm says COMPLETED"),
        ("RUNNING", "has not ended: Slurm says RUNNING"),
    ],
)
def test_the_next_attempt_says_how_the_one_before_ended(cluster, caplog, state, words):
    began = time.time() - 1
    cluster.enter(1)
    assert attempt(peak=1950)["attempt"] == 1 and not caplog.records and not retold(began)
    cluster.enter(2)
    cluster(1, state)
    document = attempt()
    assert document["attempt"] == 2 and document["slurm"]["job"] == "2"
    (line,) = document["earlier"]
    assert line.startswith("attempt 1 (Slurm job 1 on n1) ") and words in line
    assert [record.getMessage() for record in caplog.records] == [f"attempt 2, which asks for 2,000 MB and 90 minutes: {line}"]
    assert retold(began) == [f"a: base: {caplog.records[0].getMessage()}"]


def test_a_job_that_slurm_forgot_is_asked_of_accounting_and_of_its_log(cluster, tmp_path):
    """In this order: the log of a job says more than FAILED or CANCELLED."""
    log = tmp_path / "1.log"
    cluster(1, "RUNNING", log=log)
    own = slurm.own({"SLURM_JOB_ID": "1"})._asdict()
    (cluster.programs / "scontrol.1").unlink()
    document = {"state": "started", "slurm": own}
    assert attempts.ending(document).startswith("was killed without a word (out of memory, or over its time limit?")
    cluster(1, "TIMEOUT", program="sacct")
    assert attempts.ending(document).startswith("was ended at its time limit")
    cluster(1, "CANCELLED by 0", program="sacct")
    assert attempts.ending(document).startswith("was cancelled")
    log.write_text("slurmstepd-vm: error: StepId=1.0 exceeded memory limit (697028608 > 314572800), being killed\n")
    assert attempts.ending(document).startswith("was killed for its memory")


@pytest.mark.parametrize(
    ("line", "state"),
    [
        (
            "slurmstepd: error: Detected 1 oom_kill event in StepId=12.batch. Some of the step tasks have been OOM Killed.",
            "OUT_OF_MEMORY",
        ),
        ("slurmstepd: error: *** JOB 12 ON n1 CANCELLED AT 2026-01-01T00:00:00 DUE TO TIME LIMIT ***", "TIMEOUT"),
        ("slurmstepd: error: *** STEP 12.0 ON n1 CANCELLED AT 2026-01-01T00:00:00 DUE TO NODE FAILURE ***", "NODE_FAIL"),
        ("slurmstepd: error: *** JOB 12 ON n1 CANCELLED AT 2026-01-01T00:00:00 ***", "CANCELLED"),
        ("slurmstepd: error: *** JOB 112 ON n1 CANCELLED AT 2026-01-01T00:00:00 DUE TO TIME LIMIT ***", ""),
        ("base: it talks about DUE TO TIME LIMIT of JOB 12", ""),
    ],
)
def test_words_of_slurm_in_the_log_of_a_job(tmp_path, line, state):
    log = tmp_path / "log"
    log.write_bytes(b"\xff" * 100_000 + b"\n" + line.encode() + b"\n")
    assert slurm.said_in(str(log), "12") == state
    assert slurm.said_in(str(tmp_path / "gone"), "12") == ""


def test_a_job_that_slurm_itself_starts_again_keeps_its_number(cluster):
    cluster.enter(1)
    attempt()
    cluster(1, "RUNNING", restarts=1)
    (line,) = attempt()["earlier"]
    assert "was put back into the queue by Slurm" in line


def test_the_reason_is_that_of_the_run_and_of_the_batch(cluster):
    cluster.enter(1)
    document = attempt(peak=700)
    cluster(1, "TIMEOUT")
    (message,) = reasons(0.0)
    told = "attempt 1 (Slurm job 1 on n1) was ended at its time limit: it had asked for 2,000 MB and 90 minutes"
    assert message.startswith(f"error: a: base failed (results/a/logs/base.log): {told}")
    assert killed(document | {"peak_mb": 700}).startswith(told)


def test_attempts_of_an_earlier_run_do_not_count(cluster, monkeypatch):
    """A repeated command has already reported why its earlier jobs failed. A run without a number counts as another run."""
    for run, number in (("1", 1), ("1", 2), ("2", 1), ("2", 2), ("", 1)):
        monkeypatch.setenv(attempts.RUN, run)
        state = JobState("a", "base", "mark")
        state.started()
        state.failed("no light")
        document = json.loads(state.path.read_text())
        assert document["attempt"] == number and ("earlier" in document) == (number == 2), run
    attempt()  # one that was killed, and its run perhaps with it
    monkeypatch.setenv(attempts.RUN, "3")
    document = attempt()
    assert document["attempt"] == 1 and document["earlier"][0].startswith(
        "the last one of an earlier run was killed without a word"
    )


def test_without_slurm_attempts_are_counted_until_one_ends_well(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    JobState("a", "base", "mark").failed("no faces")
    for number in range(2, 7):
        document = attempt()
        assert document["attempt"] == number
    assert len(document["earlier"]) == attempts.REMEMBERED and "was killed without a word" in document["earlier"][-1]
    JobState("a", "base", "mark").done()
    document = attempt()
    assert document["attempt"] == 1 and not {"earlier", "slurm", "peak_mb"} & document.keys()
    assert not list(Path("results/a/logs").glob("*.attempts.json"))
    JobState("a", "base", "of other settings").failed("long ago")
    assert attempt()["attempt"] == 1


def test_a_state_that_was_tampered_with_is_no_obstacle(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = job_state.state_file("a", "base")
    path.parent.mkdir(parents=True)
    for text in ("[1]", "{", '{"fingerprint": "mark", "state": "started", "attempt": "x", "slurm": {"job": 1}, "earlier": [3]}'):
        path.write_text(text)
        assert attempt()["attempt"] in (1, 2)


def test_the_memory_of_a_running_job_is_noted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job_state, "LOOK", 0.01)
    before = set(threading.enumerate())  # other tests start jobs that never end
    state = JobState("a", "base", "mark")
    state.started()
    deadline = time.monotonic() + 20
    while "peak_mb" not in json.loads(state.path.read_text()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert json.loads(state.path.read_text())["peak_mb"] > 10
    state.failed("no faces")
    assert json.loads(state.path.read_text())["state"] == "failed"
    state.done()
    time.sleep(0.1)
    assert not state.path.exists() and "watch" not in {one.name for one in set(threading.enumerate()) - before}


# ----------------------------------------------------------------------------------------------------------------- nodes


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (slurm.Asked("base of a", {"base": 12}, 12, 24_000), ""),
        (slurm.Asked("base of a", {"base": 64}, 64, 1000, ("large",)), ""),
        (slurm.Asked("base of a", {"base": 64}, 64, 1000, anywhere=True), ""),
        (slurm.Asked("base of a", {"base": 64}, 64, 1000, ("elsewhere",)), ""),
        (
            slurm.Asked("base of a", {"base": 16}, 16, 3000),
            "base of a asks for 16 cores and 3,000 MB of memory on one node, and no node of partition main has that; the largest"
            " has 12 cores and 24,000 MB or 4 cores and 256,000 MB. Lower the cores: --set-threads base=12 (or `set-threads`",
        ),
        (slurm.Asked("base of a", {"base": 2}, 2, 300_000), "--set-resources base:mem_mb=256000"),
        (slurm.Asked("base of a", {"base": 12}, 12, 30_000), "no node of partition main has that"),
        (slurm.Asked("a", {"room": 20, "export": 1, "render": 20}, 41), "--set-threads render=4 room=4"),
    ],
)
def test_jobs_that_no_node_can_run(asked, words):
    found = slurm.too_large([asked, asked], NODES)
    assert len(found) == bool(words) and all(words in line for line in found)
    assert slurm.too_large([asked], []) == []


def test_nodes_that_sinfo_does_not_tell_refuse_nothing(cluster):
    (cluster.programs / "sinfo.all").write_text("12 24000 main*\n4+ 256000 main*\n64 512000 large\n")
    assert slurm.nodes() == NODES
    (cluster.programs / "sinfo").write_text("#!/bin/sh\nexit 1\n")
    assert slurm.nodes() == []


@pytest.mark.parametrize(
    ("state", "answer"),
    [
        ("COMPLETED", "success"),
        ("PENDING", "running"),
        ("COMPLETING", "running"),
        ("STAGE_OUT", "running"),
        ("TIMEOUT", "failed"),
        ("CANCELLED", "failed"),
    ],
)
def test_what_snakemake_is_told(cluster, state, answer):
    cluster(3, state)
    assert slurm.answer_to_snakemake("3") == answer


@pytest.mark.parametrize(
    "error",
    [
        "slurm_load_jobs error: Unable to contact slurm controller (connect failure)",
        "slurm_load_jobs error: Socket timed out on send/recv operation",
        "slurm_load_jobs error: Zero Bytes were transmitted or received",
        "",
    ],
)
def test_a_controller_that_does_not_answer_ends_no_job(cluster, error):
    """Not even where it answers to `scontrol ping`, which is cheap, or where accounting knows an earlier end of the job."""
    cluster(4, "NODE_FAIL", program="sacct")
    ping = "Slurmctld(primary) at vm is UP"
    (cluster.programs / "scontrol").write_text(f"#!/bin/sh\n[ $1 = ping ] && echo '{ping}' && exit\necho '{error}' >&2\nexit 1\n")
    assert slurm.answer_to_snakemake("4") == "running"


def test_a_job_that_the_controller_has_forgotten_is_asked_of_accounting(cluster):
    (cluster.programs / "scontrol").write_text("#!/bin/sh\necho 'slurm_load_jobs error: Invalid job id specified' >&2\nexit 1\n")
    assert slurm.answer_to_snakemake("4") == "success"  # Snakemake looks for its files
    cluster(4, "TIMEOUT", program="sacct")
    assert slurm.answer_to_snakemake("4") == "failed"


def test_why_jobs_were_refused(cluster, capfd):
    """`sbatch` for the executor cluster-generic, which does not tell what it said of a group of jobs; and the log of slurm."""
    program = cluster.programs / "sbatch"
    refuses = "echo 'sbatch: error: no such QOS' >&2; exit 1"
    program.write_text(f"#!/bin/sh\nif test $1 = good; then echo 17; echo note >&2; else {refuses}; fi\n")
    program.chmod(0o755)
    assert slurm.submit("sbatch", "good") == 0 and capfd.readouterr() == ("17\n", "note\n")
    assert slurm.refusals("") == []
    assert [slurm.submit("sbatch", "bad", f"--comment={scene}") for scene in "ab"] == [1, 1]
    assert capfd.readouterr() == ("", "sbatch: error: no such QOS\n" * 2)
    assert slurm.submit("no-sbatch-here") == 127
    log = "    SLURM sbatch failed. The error message was 'sbatch: error: too\nlong'.\n    sbatch call:\n        sbatch -x\n"
    kept = ["sbatch: error: no such QOS", "no-sbatch-here: No such file or directory"]
    assert slurm.refusals(log) == [*kept, "sbatch: error: too long"]
    assert slurm.submit("sbatch", "good", "--comment=a") == 0  # the next attempt of a was taken; b had none
    assert slurm.refusals("") == kept
    assert slurm.submit("sbatch", "good", "--comment=b") == 0
    assert slurm.refusals("") == kept[1:]
    bare = "import sys, workflow.runtime.slurm; sys.exit('numpy' in sys.modules)"  # it is asked about each job every few seconds
    assert subprocess.run([sys.executable, "-c", bare], cwd=Path(__file__).parents[2]).returncode == 0


def test_jobs_of_other_clusters_and_answers_without_a_number_are_refused(cluster, capfd):
    """In a federation `sbatch --parsable` prints the cluster, too; Slurm is asked about jobs of this one alone."""
    for name, text in (("sbatch", 'echo "$1"'), ("scancel", f'echo "$@" >> {cluster.programs}/cancelled')):
        (cluster.programs / name).write_text(f"#!/bin/sh\n{text}\n")
        (cluster.programs / name).chmod(0o755)
    (cluster.programs / "scontrol.config").write_text("Configuration data\nClusterName             = west\n")
    assert slurm.submit("sbatch", "17;west") == 0 and capfd.readouterr().out == "17\n"
    assert slurm.submit("sbatch", "18;east") == 1 and capfd.readouterr().out == ""
    assert (cluster.programs / "cancelled").read_text() == "-M east 18\n"
    (told,) = slurm.refusals("")
    assert told.startswith("job 18 went to cluster east and was cancelled")
    assert slurm.submit("sbatch", "") == 1 and "printed no number of a job" in slurm.refusals("")[0]


def test_a_job_that_would_never_start_has_failed(cluster):
    (cluster.programs / "scancel").write_text(f'#!/bin/sh\necho "$@" >> {cluster.programs}/cancelled\n')
    (cluster.programs / "scancel").chmod(0o755)
    for number, reason, answer in ((1, "Resources", "running"), (2, "JobHeldUser", "running"), (3, slurm.STUCK[0], "failed")):
        cluster(number, "PENDING")
        shown = cluster.programs / f"scontrol.{number}"
        shown.write_text(shown.read_text().replace("Reason=None", f"Reason={reason}"))
        assert slurm.answer_to_snakemake(str(number)) == answer
    assert (cluster.programs / "cancelled").read_text() == "3\n"
    assert slurm.refusals("") == ["job 3 would never have started (Slurm says launch_failed_requeued_held) and was cancelled"]
