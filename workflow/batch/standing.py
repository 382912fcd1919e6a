"""Where one scene stands: for `status` and for the summary of a batch, from the files that jobs have left."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import links, stamps
from workflow.artifacts.files import facts_in
from workflow.artifacts.manifest import MANIFEST
from workflow.batch.plan import check
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fp
from workflow.runtime import forecast
from workflow.runtime.job_state import SILENCE, Noted, noted, process
from workflow.runtime.timings import read_parts

STATES = {
    "done": "published, as the settings, inputs and code of now would make it",
    "running": "a job of it runs",
    "waiting": "not begun, or between two jobs",
    "failed": "a job ended with an error",
    "killed": "a job started but did not end, and its process no longer exists (memory, time limit, node)",
    "refused": "its settings or data cannot be used; no job is started",
    "stale": "made under other settings or other code, or a published file was changed; the next run makes it again",
    "unknown": "what is there cannot be read; `snakemake verify` names what is damaged",
}
TAIL = 4096
"""Bytes at the end of a log in which its last line is looked for."""


@dataclass(frozen=True)
class Standing:
    """Where a scene stands.

    Attributes:
        scene: its name.
        state: a key of `STATES`.
        stage: the first that runs, that stopped the scene or that is missing; empty if the scene is done or refused.
        running: all stages of which a job runs.
        quality: under which it is looked at.
        since: when it came into this state, in seconds as `time.time`; None if nothing tells.
        expected_seconds: wall time that the job of `stage` is expected to take, if it runs and such jobs were measured.
        cpu_seconds, max_rss_mb: that its jobs took: the last run of each, and of running ones so far.
        remaining_cpu_seconds: of the jobs that are missing; None for scenes that are done or refused.
        reason: why it is not done, where there is one; or how a job ended since, if it is done.
        verdict: what the report of a finished scene says of it, in a sentence.
        log, line: of the job of `stage`, or of that job: its path, and the last line that is not empty.
    """

    scene: str
    state: str
    stage: str = ""
    running: tuple[str, ...] = ()
    quality: str = ""
    since: float | None = None
    expected_seconds: float | None = None
    cpu_seconds: float = 0.0
    max_rss_mb: float = 0.0
    remaining_cpu_seconds: float | None = None
    reason: str = ""
    verdict: str = ""
    log: str = ""
    line: str = ""


def survey(scenes: list[str], quality_of: Callable[[str], str]) -> Iterator[Standing]:
    """Return where each scene stands, in the order given, and keep nothing of what was found out about code and inputs."""
    with stamps.unsaved():
        yield from (standing(scene, quality_of) for scene in scenes)


def standing(scene: str, quality_of: Callable[[str], str], silence: float = SILENCE) -> Standing:
    """Return where a scene stands. Never raises, whatever its files hold.

    Args:
        scene: its name.
        quality_of: returns the quality of a scene, or raises `InputError`.
        silence: as of `noted`.
    """
    try:
        jobs = _jobs(scene, silence)
        running = tuple(stage for stage in STAGES if stage in jobs and jobs[stage].state == "running")
        found = Standing(scene, "waiting", running=running, **_taken(scene, jobs, running))
        try:
            found = replace(found, quality=quality_of(scene))
            return _at_work(found, jobs) if running else _at_rest(found, jobs)
        except InputError as error:  # of a running scene: its data were taken away meanwhile
            if running:
                return replace(found, state="running", stage=running[0], since=jobs[running[0]].since)
            earlier = f" (scenes/{scene} holds an earlier result)" if os.path.isfile(f"scenes/{scene}/{MANIFEST}") else ""
            return replace(found, state="refused", reason=f"{error}{earlier}")
    except Exception as error:  # one scene must not hide hundreds of others
        return Standing(scene, "unknown", reason=f"{type(error).__name__}: {error}")


def _at_work(found: Standing, jobs: dict[str, Noted]) -> Standing:
    scene, stage = found.scene, found.running[0]
    cost = forecast.job_cost(stage, scene, found.quality).seconds
    left = _cpu_seconds(scene, found.quality, fp.missing_stages(scene, found.quality))
    found = replace(found, state="running", stage=stage, since=jobs[stage].since, remaining_cpu_seconds=left)
    return replace(found, expected_seconds=cost.middle if cost else None, **_logged(jobs[stage].log))


def _at_rest(found: Standing, jobs: dict[str, Noted]) -> Standing:
    scene, quality = found.scene, found.quality
    links.refuse(Path("results"), scene)
    faults = [fault for fault in check(scene, quality) if fault]
    path = f"scenes/{scene}/{MANIFEST}"
    published, touched = facts_in(path), os.stat(path).st_mtime if os.path.isfile(path) else None
    current = published.get("fingerprint") == fp.fingerprint("publish", scene, quality)
    missing = [] if current else fp.missing_stages(scene, quality)
    ended = _ended(jobs, missing or list(fp.needed(scene, quality)), scene, quality)
    if current and not faults:
        how = f"it is published, but its last job of {ended[0]} {ended[1].state}: {ended[1].reason}" if ended else ""
        log = ended[1].log if ended else f"results/{scene}/logs/publish.log"
        return replace(found, state="done", since=touched, reason=how, verdict=verdict_of(scene), **_logged(log))
    stage = missing[0] if missing else "publish"
    found = replace(found, stage=stage, since=touched, remaining_cpu_seconds=_cpu_seconds(scene, quality, missing))
    if ended and not current:
        stage, job = ended
        return replace(found, state=job.state, stage=stage, since=job.since, reason=job.reason, **_logged(job.log))
    if faults:
        more = f", and {len(faults) - 1} more" if len(faults) > 1 else ""
        return replace(found, state="stale", reason=faults[0] + more)
    made = published.get("quality", quality)
    if published or os.path.exists(f"results/{scene}/{stage}/{MANIFEST}"):
        why = f"made at quality {made}" if made != quality else "settings, inputs or code changed since"
        return replace(found, state="stale", reason=why)
    return found


def verdict_of(scene: str) -> str:
    """Return the sentence of the report of a published scene; nothing where it cannot be read."""
    sentence = facts_in(f"scenes/{scene}/verdict.json").get("sentence")
    return printable(sentence) if isinstance(sentence, str) else ""


def _ended(jobs: dict[str, Noted], stages: list[str], scene: str, quality: str) -> tuple[str, Noted] | None:
    """Return the first of some stages whose last job failed, or else was killed."""
    of_now = [(stage, jobs[stage]) for stage in stages if stage in jobs]
    of_now = [(stage, job) for stage, job in of_now if job.is_of(fp.fingerprint(stage, scene, quality))]
    return next((one for state in ("failed", "killed") for one in of_now if one[1].state == state), None)


def _cpu_seconds(scene: str, quality: str, stages: list[str]) -> float:
    """Return the CPU seconds that jobs will take, as far as such jobs were measured."""
    costs = [forecast.job_cost(stage, scene, quality).cpu_seconds for stage in stages]
    return sum(cost.middle for cost in costs if cost)


def with_running_jobs(known: Collection[str]) -> list[str]:
    """Return the folders of results/ in which a job of a stage runs, sorted; and those in which one did not end well, of a scene
    that still has settings. `known`: names of scenes that have; what a study derives from them has, too."""
    found = []
    for folder in sorted(Path("results").glob("*/logs")):
        scene, jobs = folder.parent.name, _jobs(folder.parent.name, SILENCE)
        runs = any(job.state == "running" for job in jobs.values())
        if runs or (jobs and (scene in known or scene.partition("--")[0] in known)):
            found.append(scene)
    return found


def _jobs(scene: str, silence: float) -> dict[str, Noted]:
    """Return the states of the jobs of a scene that run or have not ended well. If several jobs make a stage, a running one
    stands for it."""
    found: dict[str, Noted] = {}
    for path in sorted(Path(f"results/{scene}/logs").glob("*.state.json")):
        stage = path.name.partition(".")[0]  # of base.state.json and prior.3-of-8.state.json
        job = noted(path, silence) if stage in STAGES else None
        if job and (stage not in found or job.state == "running"):
            found[stage] = job
    return found


def _taken(scene: str, jobs: dict[str, Noted], running: tuple[str, ...]) -> dict[str, float]:
    """Return CPU seconds and peak memory of the jobs on record, and so far of those that run here."""
    cpu = memory = 0.0
    for stage in STAGES:
        if stage not in running:  # its record is of an earlier run
            job = read_parts(scene, stage).get("job", {})
            cpu, memory = cpu + job.get("cpu_seconds", 0.0), max(memory, job.get("max_rss_mb", 0.0))
    for stage in running:
        memory = max(memory, jobs[stage].document.get("peak_mb", 0))
        with suppress(Exception):  # it has just ended, or is of another machine
            cpu += sum(process(jobs[stage].document).cpu_times()[:2])  # type: ignore[union-attr]
    return {"cpu_seconds": cpu, "max_rss_mb": memory}


def _logged(log: str) -> dict[str, str]:
    return {"log": log, "line": last_line(log).removeprefix(f"{Path(log).stem.partition('.')[0]}: ")}


def last_line(path: str) -> str:
    """Return the last line of a file that is not empty, with a space for every character that cannot be printed."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL))
            lines = file.read(TAIL).decode(errors="replace").splitlines()
    except OSError:
        return ""
    kept = [line.strip() for line in lines if line.strip()]
    return printable(kept[-1]) if kept else ""


def printable(text: str) -> str:
    """Return a text in one line without characters that could steer a terminal."""
    return "".join(character if character.isprintable() else " " for character in text)
