"""What the executor cluster-generic is told of jobs, by commands that answer as Slurm does (tests/slurm/ asks a real one)."""

import os

import pytest

from workflow.runtime import slurm

SHOWN = (
    "JobId={job} JobName=wrap UserId=root(0) Account=(null) JobState={state} Reason=None Restarts={restarts} BatchFlag=1"
    " TimeLimit=01:30:00 Partition=main BatchHost=n{job} NumCPUs=6 MinMemoryNode=2000M Features=(null) StdErr={log} StdOut={log}"
)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Commands `scontrol` and `sacct` that print what is put into files, and a working folder."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("scontrol", "sacct"):
        (programs / name).write_text(
            f'#!/bin/sh\neval "job=\\${{$#}}"\ncat {programs}/{name}.$job 2>/dev/null || cat {programs}/{name}.all\n'
        )
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)

    def put(job, state, restarts=0, log="", program="scontrol"):
        text = SHOWN.format(job=job, state=state, restarts=restarts, log=log) if program == "scontrol" else f"{state}\n"
        (programs / f"{program}.{job}").write_text(text)

    put.programs = programs
    return put


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
def test_what_snakemake_is_told_and_why_a_job_failed(cluster, capsys, state, answer):
    cluster(3, state)
    assert slurm.answer("3") == answer
    assert (f"Slurm job 3 ended with {state}" in capsys.readouterr().err) == (answer == "failed")


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
    assert slurm.answer("4") == "running"


def test_a_job_that_the_controller_has_forgotten_is_asked_of_accounting(cluster):
    (cluster.programs / "scontrol").write_text("#!/bin/sh\necho 'slurm_load_jobs error: Invalid job id specified' >&2\nexit 1\n")
    assert slurm.answer("4") == "success"  # Snakemake looks for its files
    cluster(4, "TIMEOUT", program="sacct")
    assert slurm.answer("4") == "failed"


def test_a_job_that_would_never_start_has_failed(cluster, capsys):
    (cluster.programs / "scancel").write_text(f'#!/bin/sh\necho "$@" >> {cluster.programs}/cancelled\n')
    (cluster.programs / "scancel").chmod(0o755)
    for number, reason, answer in ((1, "Resources", "running"), (2, "JobHeldUser", "running"), (3, slurm.STUCK[0], "failed")):
        cluster(number, "PENDING")
        shown = cluster.programs / f"scontrol.{number}"
        shown.write_text(shown.read_text().replace("Reason=None", f"Reason={reason}"))
        assert slurm.answer(str(number)) == answer
    assert (cluster.programs / "cancelled").read_text() == "3\n"
    assert "job 3 would never have started and was cancelled: launch_failed_requeued_held" in capsys.readouterr().err
