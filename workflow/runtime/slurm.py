"""What Slurm knows: about the job that this process belongs to, how a job ended, and what the nodes offer.

Everything is asked with `scontrol`, `sacct` and `sinfo`. A command that is missing, fails or takes longer than a few seconds
counts as no answer, because no run may depend on it.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

PATIENCE = 10.0
"""Seconds that a command may take; a busy controller answers late."""
KILLED = {
    "OUT_OF_MEMORY": "was killed for its memory",
    "TIMEOUT": "was ended at its time limit",
    "DEADLINE": "was ended at its deadline",
    "NODE_FAIL": "was lost with its node (NODE_FAIL)",
    "BOOT_FAIL": "was lost because its node did not start (BOOT_FAIL)",
    "PREEMPTED": "was preempted by another job",
    "CANCELLED": "was cancelled (scancel, or Snakemake was stopped)",
}
"""How Slurm ends jobs that say nothing themselves."""
ENDED = (*KILLED, "COMPLETED", "FAILED", "REVOKED")
"""States that a job does not leave by itself; in any other, such as STAGE_OUT or RESV_DEL_HOLD, it is still Slurm's."""
STUCK = ("launch_failed_requeued_held", "BadConstraints")
"""Reasons for which Slurm will never start a waiting job by itself. A job that a person holds is not stuck; it keeps waiting."""
LOGS = ".snakemake/slurm_logs"
"""Where Slurm writes what jobs say."""
REFUSALS = f"{LOGS}/refused.log"
"""What `sbatch` says when it refuses a job of the executor cluster-generic, which does not report it for a group of jobs."""
REFUSED = re.compile(r"sbatch failed\. The error message was '(.*?)'\.\n\s+sbatch call:", re.S)
"""What the executor slurm logs when Slurm refuses a job."""


def _answer(*command: str) -> tuple[str, str]:
    """Return what a command prints, and what a command that failed prints to stderr; both are empty if there is no answer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return "", ""
    return (done.stdout, "") if done.returncode == 0 else ("", done.stderr)


def _shown(job: str) -> tuple[dict[str, str], bool]:
    """Return the fields of `scontrol show job`, and whether the controller says that it has no such job: it forgets a finished
    one after MinJobAge (300 s by default). Any other failure, as of a controller that is busy, says nothing of the job.

    Fields are not quoted: a value, such as the path of a log, may hold spaces and ends before the next key.
    """
    text, error = _answer("scontrol", "-o", "show", "job", job)
    fields = re.findall(r"(?:^|\s)([A-Za-z:/_]+)=(.*?)(?=\s+[A-Za-z:/_]+=|\s*$)", text, re.M)
    return dict(fields), "Invalid job id specified" in error


class Own(NamedTuple):
    """The Slurm job that a process runs in.

    Attributes:
        job: id; empty outside of Slurm.
        node: name of the node.
        memory_mb, minutes: what the job asked for; None where Slurm does not say, or sets no limit.
        restarts: how often Slurm itself has put the job back into its queue.
        log: file to which Slurm writes what it says about the job; empty where it does not tell.
    """

    job: str
    node: str
    memory_mb: int | None
    minutes: int | None
    restarts: int
    log: str


def own(environment: Mapping[str, str] = os.environ) -> Own | None:
    """Return the Slurm job that this process runs in, or None outside of Slurm."""
    job = environment.get("SLURM_JOB_ID", "")
    if not job:
        return None
    shown, _ = _shown(job)
    node = environment.get("SLURMD_NODENAME") or shown.get("BatchHost") or environment.get("SLURM_JOB_NODELIST", "")
    restarts = shown.get("Restarts", environment.get("SLURM_RESTART_COUNT", "0"))
    count = int(restarts) if restarts.isdigit() else 0
    return Own(job, node, _memory_of(shown), _minutes(shown.get("TimeLimit", "")), count, shown.get("StdErr", ""))


def _memory_of(shown: Mapping[str, str]) -> int | None:
    """Return the memory in MB of one node of a job."""
    if "MinMemoryNode" in shown:
        return _megabytes(shown["MinMemoryNode"])
    each, cores = _megabytes(shown.get("MinMemoryCPU", "")), shown.get("NumCPUs", "")
    return each * int(cores) if each and cores.isdigit() else None


def _megabytes(text: str) -> int | None:
    """Return a size as Slurm prints it in MB; None if there is none, or no limit.

    >>> [_megabytes(text) for text in ("2000M", "4G", "1.5G", "", "0", "512K", "1T")]
    [2000, 4096, 1536, None, None, 1, 1048576]
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([KMGT]?)", text)
    if not found or not float(found[1]):
        return None
    return math.ceil(float(found[1]) * {"K": 1 / 1024, "": 1, "M": 1, "G": 1024, "T": 1024**2}[found[2]])


def _minutes(text: str) -> int | None:
    """Return a time limit as Slurm prints it in minutes; None if there is none.

    >>> [_minutes(text) for text in ("00:30:00", "1-02:00:00", "UNLIMITED", "", "00:00:30")]
    [30, 1560, None, None, 1]
    """
    found = re.fullmatch(r"(?:(\d+)-)?(\d+):(\d\d):(\d\d)", text)
    if not found:
        return None
    days, hours, minutes, seconds = (int(part or 0) for part in found.groups())
    return days * 1440 + hours * 60 + minutes + (seconds > 0)


def state_of(job: str) -> str:
    """Return the state of a job in Slurm's word (`TIMEOUT`, `RUNNING`, ...); empty if it is not known any more."""
    return _shown(job)[0].get("JobState", "") or _accounted(job)


def _accounted(job: str) -> str:
    """Return the state of a job in the records of accounting; empty where there are none."""
    lines = _answer("sacct", "-n", "-X", "-P", "-D", "-o", "State", "-j", job)[0].split("\n")
    words = [line.split()[0] for line in lines if line.strip()]
    return words[-1].rstrip("+") if words else ""


SAID = (
    (r"exceeded (?:job )?memory limit|oom[-_]kill", "OUT_OF_MEMORY"),
    (r"DUE TO TIME LIMIT", "TIMEOUT"),
    (r"DUE TO NODE FAILURE", "NODE_FAIL"),
    (r"DUE TO PREEMPTION", "PREEMPTED"),
    (r"\*\*\* (?:JOB|STEP) \S+ ON \S+ CANCELLED AT \S+ \*\*\*", "CANCELLED"),
)
"""What Slurm writes into the log of a job that it ends, the strongest first: a job over its memory is cancelled, too."""
TAIL = 65536
"""Bytes at the end of such a log that are read."""


def said_in(log: str, job: str) -> str:
    """Return how Slurm says in the log of a job that it ended it, in the words of `state_of`; empty if it does not say.

    This is the only witness of memory where Slurm measures it itself and not the kernel: the state is FAILED then.
    """
    if not os.path.isfile(log):
        return ""
    try:
        with open(log, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    own_words = "\n".join(line for line in lines if line.startswith("slurmstepd") and re.search(rf"\b{re.escape(job)}\b", line))
    return next((state for pattern, state in SAID if re.search(pattern, own_words)), "")


class Node(NamedTuple):
    """What one kind of node offers."""

    cores: int
    memory_mb: int
    partition: str
    default: bool


def nodes() -> list[Node]:
    """Return the kinds of nodes of each partition; empty if `sinfo` does not answer."""
    return read_nodes(_answer("sinfo", "-h", "-e", "-o", "%c %m %P")[0])


def read_nodes(text: str) -> list[Node]:
    """Return the nodes in the output of `sinfo -h -e -o '%c %m %P'`.

    >>> [tuple(node) for node in read_nodes("32 128000 main*\\n8+ 24000+ old\\n")]
    [(32, 128000, 'main', True), (8, 24000, 'old', False)]
    """
    found = re.findall(r"^(\d+)\+? +(\d+)\+? +(\S+?)(\*?)$", text, re.M)
    return [Node(int(cores), int(memory), name, bool(star)) for cores, memory, name, star in found]


class Asked(NamedTuple):
    """What a job asks of one node.

    Attributes:
        what: description of the job.
        rules: rule -> cores; of a job that runs several stages, each of them.
        cores, memory_mb: of the whole job; memory None = whatever there is.
        partitions: names; empty = the default one.
        anywhere: whether Snakemake chooses the partition itself, from a file that describes them.
    """

    what: str
    rules: Mapping[str, int]
    cores: int
    memory_mb: int | None = None
    partitions: tuple[str, ...] = ()
    anywhere: bool = False


AT_ONCE = 3
"""Stages of a scene that can run at the same time."""


def too_large(asked: Iterable[Asked], offered: list[Node]) -> list[str]:
    """Return one message for each kind of job that no node can run; none if nothing is known of the nodes.

    Slurm takes such a job and lets it wait for ever, or refuses it after others have run for hours.
    """
    out: dict[tuple[Any, ...], str] = {}
    for job in asked:
        known = {node.partition for node in offered}
        if job.partitions and not known.issuperset(job.partitions):
            continue  # of another cluster, or a name that sbatch will refuse
        usual = [node for node in offered if node.default] or offered
        among = offered if job.anywhere else [node for node in offered if node.partition in job.partitions] or usual
        if not among or any(node.cores >= job.cores and node.memory_mb >= (job.memory_mb or 0) for node in among):
            continue
        rules = tuple(sorted(job.rules))
        out.setdefault((rules, job.cores, job.partitions), _too_large(job, among))
    return list(out.values())


def _too_large(job: Asked, among: list[Node]) -> str:
    where = "" if job.anywhere else f" of partition {', '.join(sorted({node.partition for node in among}))}"
    asks = f"{job.cores} cores" + (f" and {job.memory_mb:,} MB of memory" if job.memory_mb else "")
    widest = max(among, key=lambda node: (node.cores, node.memory_mb))
    largest = max(among, key=lambda node: (node.memory_mb, node.cores))
    kinds = dict.fromkeys((widest, largest))
    offers = " or ".join(f"{node.cores} cores and {node.memory_mb:,} MB" for node in kinds)
    cures = []
    if job.cores > widest.cores:
        beside = min(len(job.rules), AT_ONCE) - 1  # each of them keeps one core
        fitting = {rule: max(1, (widest.cores - beside) * cores // job.cores) for rule, cores in sorted(job.rules.items())}
        lower = [f"{rule}={cores}" for rule, cores in fitting.items() if cores < job.rules[rule]]
        cures.append(f"lower the cores: --set-threads {' '.join(lower)} (or `set-threads` of the profile)")
    if (job.memory_mb or 0) > largest.memory_mb or not cures:
        resources = " ".join(f"{rule}:mem_mb={largest.memory_mb}" for rule in sorted(job.rules))
        cures.append(
            "name a partition with more memory (`slurm_partition` of the profile), make the scene smaller (`capture.width`,"
            f" `capture.views`), or try with less: --set-resources {resources}"
        )
    return f"{job.what} asks for {asks} on one node, and no node{where} has that; the largest has {offers}. " + "; ".join(
        cure[0].upper() + cure[1:] if not number else cure for number, cure in enumerate(cures)
    )


def answer_to_snakemake(job: str) -> str:
    """Return `running`, `success` or `failed`, as the executor cluster-generic asks for.

    Of a job that the controller has forgotten, accounting is asked. Without it the job counts as finished: Snakemake looks for
    its files and tries again if they lack. While the controller does not answer, jobs count as running. One that Slurm will never
    start by itself is cancelled, and has failed.
    """
    shown, forgotten = _shown(job)
    state = shown.get("JobState") or (_accounted(job) or "COMPLETED" if forgotten else "")
    if state == "COMPLETED":
        return "success"
    if state == "PENDING" and (reason := shown.get("Reason", "")) in STUCK:
        _answer("scancel", job)
        _keep(job, f"job {job} would never have started (Slurm says {reason}) and was cancelled")
        return "failed"
    return "failed" if state in ENDED else "running"


def submit(*command: str) -> int:
    """Run `sbatch` for the executor cluster-generic: print the number of the job, and keep why it was refused in `REFUSALS`.

    A job that went to another cluster is cancelled and counts as refused: nothing that is asked about it would be answered.

    Returns:
        The exit code.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        code, out, error = done.returncode, done.stdout, done.stderr
    except OSError as failure:
        code, out, error = 127, "", f"{command[0]}: {failure.strerror}\n"
    sys.stderr.write(error)
    of = " ".join(option for option in command if option.startswith("--comment="))
    if code:
        _keep(of, error.strip() or f"{command[0]} ended with exit code {code}")
        return code
    found = next(filter(None, (re.fullmatch(r"(\d+)(?:;(\S+))?", line.strip()) for line in out.splitlines())), None)
    problem = ""
    if found is None:
        problem = f"{command[0]} printed no number of a job: {out.strip()[:200]!r}"
    elif found[2] and found[2] != _cluster():
        _answer("scancel", "-M", found[2], found[1])
        problem = (
            f"job {found[1]} went to cluster {found[2]} and was cancelled: jobs must go to the cluster of this machine."
            " Unset SLURM_CLUSTERS and SBATCH_CLUSTERS, and leave out --clusters"
        )
    if problem:
        sys.stderr.write(problem + "\n")
        _keep(of, problem)
        return 1
    _keep(of, "")
    sys.stdout.write(f"{found[1]}\n")
    return 0


def _cluster() -> str:
    """Return the name of the cluster of this machine; empty if Slurm does not say."""
    found = re.search(r"^ClusterName\s*=\s*(\S+)", _answer("scontrol", "show", "config")[0], re.M)
    return found[1] if found else ""


def _keep(job: str, reason: str) -> None:
    """Keep why Slurm refused a job, or an empty reason when it took it after all."""
    os.makedirs(LOGS, exist_ok=True)
    with open(REFUSALS, "a", encoding="utf-8") as file:
        file.write(json.dumps([job, reason]) + "\n")


def refusals(log: str) -> list[str]:
    """Return why Slurm refused jobs of this run that it did not take later, each reason once.

    Args:
        log: text of Snakemake's own log of the run.
    """
    from workflow.artifacts.files import read_record  # not for every question about a job, of which there are many

    kept: dict[str, str] = {}
    with suppress(OSError, ValueError):
        for line in read_record(REFUSALS).decode().splitlines():
            job, reason = json.loads(line)
            kept.pop(str(job), None)
            kept[str(job)] = str(reason)
    return list(dict.fromkeys(" ".join(text.split()) for text in [*kept.values(), *REFUSED.findall(log)] if text.strip()))


if __name__ == "__main__":  # commands of workflow/profiles/slurm-scenes
    if sys.argv[1:2] == ["submit"] and len(sys.argv) > 2:
        sys.exit(submit(*sys.argv[2:]))
    if len(sys.argv) != 2:
        sys.exit("usage: python -m workflow.runtime.slurm submit sbatch ... | <number of a job>")
    print(answer_to_snakemake(sys.argv[1]))
