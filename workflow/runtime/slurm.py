"""`python -m workflow.runtime.slurm <number>`: what became of a Slurm job, as the executor cluster-generic asks for it
(workflow/profiles/slurm-scenes). Snakemake's own Slurm executor asks by itself."""

from __future__ import annotations

import re
import subprocess
import sys

PATIENCE = 10.0
"""Seconds that a command may take; a busy controller answers late."""
FAILED = ("BOOT_FAIL", "CANCELLED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "PREEMPTED", "REVOKED", "TIMEOUT")
"""States that a job does not leave by itself; in any other, such as STAGE_OUT or RESV_DEL_HOLD, it is still Slurm's."""
STUCK = ("launch_failed_requeued_held", "BadConstraints")
"""Reasons for which Slurm will never start a waiting job by itself. A job that a person holds is not stuck; it keeps waiting."""


def answer(job: str) -> str:
    """Return `running`, `success` or `failed`. Why a job failed goes to stderr, which Snakemake passes on to the terminal.

    Of a job that the controller has forgotten (MinJobAge after its end, 300 s by default), accounting is asked. Without it the
    job counts as finished: Snakemake looks for its files and tries again if they lack. While the controller does not answer, jobs
    count as running. One that Slurm will never start by itself is cancelled, and has failed.
    """
    shown, error = _ask("scontrol", "-o", "show", "job", job)
    state = _field(shown, "JobState")
    if not state and "Invalid job id specified" in error:
        words = _ask("sacct", "-n", "-X", "-P", "-D", "-o", "State", "-j", job)[0].split("\n")
        state = next((line.split()[0].rstrip("+") for line in reversed(words) if line.strip()), "COMPLETED")
    reason = _field(shown, "Reason")
    if state == "PENDING" and reason in STUCK:
        _ask("scancel", job)
        state = "FAILED"
        print(f"Slurm job {job} would never have started and was cancelled: {reason}", file=sys.stderr)
    elif state in FAILED:
        print(f"Slurm job {job} ended with {state}; `sacct -j {job}` and {_field(shown, 'StdErr')} say more", file=sys.stderr)
    return "success" if state == "COMPLETED" else "failed" if state in FAILED else "running"


def _field(shown: str, name: str) -> str:
    found = re.search(rf"(?:^|\s){name}=(\S*)", shown)
    return found[1] if found else ""


def _ask(*command: str) -> tuple[str, str]:
    """Return what a command prints, or else what a command that failed prints to stderr; both are empty if there is no answer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=PATIENCE, check=False)
    except (OSError, subprocess.SubprocessError):
        return "", ""
    return (done.stdout, "") if done.returncode == 0 else ("", done.stderr)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m workflow.runtime.slurm <number of a job>")
    print(answer(sys.argv[1]))
