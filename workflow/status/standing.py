"""Where one scene stands, from small files alone: settings, states of jobs, manifests, what jobs took, the last line of a log."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import DamagedArtefact, links, stamps
from workflow.artifacts.files import read_record
from workflow.artifacts.manifest import MANIFEST
from workflow.registry import STAGES
from workflow.runtime import alive, forecast
from workflow.runtime import fingerprint as fp
from workflow.runtime.job_state import Noted, noted
from workflow.scene.named import check_overrides
from workflow.settings import study_files

STATES = {
    "done": "published, as the settings and code of now would make it",
    "running": "a job of it runs",
    "waiting": "not begun, or between two jobs",
    "failed": "its last job ended with an error",
    "killed": "its last job started but did not end, and its process no longer exists",
    "refused": "its settings or data cannot be used; no job will be started",
    "stale": "made under other settings or other code; the next run makes it again",
    "unknown": "what is there cannot be read",
}
LOOKED_INTO = 40
"""So many scenes are looked into as a plan does, which reads headers of their photographs: those that have not begun, for
mistakes; all that are not done, for what they will take. The others count like their mean."""
TAIL = 4096
"""Bytes at the end of a log in which its last line is looked for."""
BESIDE = ("workflow.status", "workflow.rules", "workflow.profiles")
"""Folders, in addition to the infrastructure, that hold nothing that results depend on."""


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
        remaining_cpu_seconds: that are expected to make the scene complete; None where that was not looked at.
        reason: why it is not done, where there is one; or how a job ended since, if it is done.
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
    log: str = ""
    line: str = ""


def survey(scenes: list[str], quality_of: Callable[[str], str], now: float) -> Iterator[Standing]:
    """Return where each scene stands, in the order given. Never raises, whatever the files of a scene hold.

    Args:
        scenes: their names.
        quality_of: returns the quality of a scene, or raises `InputError`.
        now: the present time, as `time.time`.
    """
    unbegun = unfinished = 0
    with stamps.unsaved():
        for scene in scenes:
            try:
                found = _standing(scene, quality_of, now, unbegun < LOOKED_INTO)
                unbegun += found.state in ("waiting", "refused") and not _begun(scene)
                if found.state in ("running", "waiting", "failed", "killed", "stale") and unfinished < LOOKED_INTO:
                    unfinished += 1
                    found = replace(found, remaining_cpu_seconds=_remaining(found, now))
            except Exception as error:  # one scene must not hide hundreds of others
                found = Standing(scene, "unknown", reason=f"{type(error).__name__}: {error} (a bug: please report it)")
            yield found


def with_running_jobs(now: float, known: Collection[str]) -> list[str]:
    """Return the folders of results/ in which a job of a stage runs, sorted; and those in which one did not end well, of a scene
    that still has settings.

    Args:
        now: the present time, as `time.time`.
        known: names of scenes that have settings; what a study derives from them has, too.
    """
    found: dict[str, bool] = {}
    for path in sorted(Path("results").glob("*/logs/*.state.json")):
        scene = path.parents[1].name
        if path.name.partition(".")[0] in STAGES and not found.get(scene):
            job = noted(path, now)
            found[scene] = job is not None and (job.state == "running" or scene in known or scene.partition("--")[0] in known)
    return [scene for scene, shown in found.items() if shown]


def _begun(scene: str) -> bool:
    return os.path.isdir(f"results/{scene}")


def _standing(scene: str, quality_of: Callable[[str], str], now: float, look: bool) -> Standing:
    jobs = _jobs(scene, now)
    running = tuple(stage for stage in STAGES if stage in jobs and jobs[stage].state == "running")
    base = Standing(scene, "waiting", running=running, **_taken(scene, {stage: jobs[stage].document for stage in running}))
    try:
        quality = quality_of(scene)
        fp.resolved(scene, quality)
        base = replace(base, quality=quality)
        if running:
            return _of_running(base, jobs, quality)
        _check_places(scene)
        found, touched = _published(scene)
        if found and _is_current(found, touched, scene, quality):
            if changed := _changed(scene):
                reason = f"scenes/{scene}/{changed}: changed or gone since it was published"
                return replace(base, state="stale", stage="publish", since=touched, reason=reason)
            return _done(replace(base, since=touched), jobs, quality)
        if look or _begun(scene):
            return _unfinished(base, jobs, found, touched, quality)
        _source_is_there(scene, quality)
        return replace(base, stage=fp.NEEDED[0])
    except InputError as error:
        if running:
            return _of_running(base, jobs, None)
        return replace(base, state="refused", reason=str(error))


def _check_places(scene: str) -> None:
    """Look at the folders of a scene as a plan does.

    Raises:
        InputError: a file or a link is where the workflow makes one of them, or where jobs write.
    """
    links.refuse(Path("results"), scene)
    links.check_folders(Path("results"), scene, *fp.NEEDED)


def _of_running(base: Standing, jobs: dict[str, Noted], quality: str | None) -> Standing:
    stage = base.running[0]
    expected = None
    if quality:
        try:
            cost = forecast.job_cost(stage, base.scene, quality)
            expected = cost.seconds.middle if cost.seconds else None
        except InputError:  # its data were taken away meanwhile
            pass
    return replace(
        base, state="running", stage=stage, since=jobs[stage].since, expected_seconds=expected, **_logged(base.scene, stage)
    )


def _done(base: Standing, jobs: dict[str, Noted], quality: str) -> Standing:
    """A scene that is published as it is wanted; a job that did not end well, as where damage was to be mended, is no secret."""
    ended = _ended(jobs, fp.NEEDED, base.scene, quality)
    if not ended:
        return replace(base, state="done", **_logged(base.scene, "publish"))
    stage, job = ended
    how = f"failed: {job.document.get('reason', '')}" if job.state == "failed" else "was killed"
    reason = f"it is published, but its last job of {stage} {how}"
    return replace(base, state="done", reason=reason, **_logged(base.scene, stage))


def _ended(jobs: dict[str, Noted], stages: Sequence[str], scene: str, quality: str) -> tuple[str, Noted] | None:
    """Return the first of some stages whose last job failed, or else was killed."""
    ended = [
        (stage, jobs[stage]) for stage in stages if stage in jobs and jobs[stage].is_of(fp.fingerprint(stage, scene, quality))
    ]
    return next((one for state in ("failed", "killed") for one in ended if one[1].state == state), None)


def _unfinished(base: Standing, jobs: dict[str, Noted], published: dict[str, Any], touched: float, quality: str) -> Standing:
    """A scene that is not done and of which nothing runs."""
    scene, missing = base.scene, fp.missing_stages(base.scene, quality)
    with suppress(DamagedArtefact):  # of a segmentation that will be made again; then its objects are known
        check_overrides("affines", scene, quality)
    if ended := _ended(jobs, missing, scene, quality):
        stage, job = ended
        reason = job.document.get("reason", "")
        return replace(base, state=job.state, stage=stage, since=job.since, reason=reason, **_logged(scene, stage))
    stage = missing[0] if missing else "publish"
    if not missing and published.get("fingerprint") != fp.fingerprint("publish", scene, quality):
        what = f"scenes/{scene}/{MANIFEST} is" if os.path.isdir(f"scenes/{scene}") else f"scenes/{scene} is"
        how = "not what was published" if os.path.exists(f"scenes/{scene}/{MANIFEST}") else "not there"
        return replace(base, state="stale", stage=stage, since=touched or None, reason=f"{what} {how}; the next run publishes it")
    if published:
        made = published.get("quality")
        reason = f"made at quality {made}" if made != quality else "settings, inputs or code changed since"
        return replace(base, state="stale", stage=stage, since=touched, reason=reason)
    before = fp.NEEDED.index(stage)
    earlier = _touched(f"results/{scene}/{fp.NEEDED[before - 1]}/manifest.json") if before else None
    if os.path.exists(f"results/{scene}/{stage}/manifest.json"):
        return replace(base, state="stale", stage=stage, since=earlier, reason="settings, inputs or code changed since")
    return replace(base, stage=stage, since=earlier)


def _remaining(found: Standing, now: float) -> float:
    """Return the CPU seconds that a scene still needs, as far as such jobs were measured."""
    total = 0.0
    try:
        missing = fp.missing_stages(found.scene, found.quality) if _begun(found.scene) else list(fp.NEEDED)
        for stage in missing:
            cost = forecast.job_cost(stage, found.scene, found.quality)
            if cost.cpu_seconds is None:
                continue
            share = 1.0
            if stage == found.stage and found.state == "running" and cost.seconds and found.since is not None:
                share = max(0.0, 1 - (now - found.since) / max(cost.seconds.middle, 1e-3))
            total += share * cost.cpu_seconds.middle
    except InputError:
        pass  # its data were taken away meanwhile
    return total


# --------------------------------------------------------------------------------------------------- what is published


def _published(scene: str) -> tuple[dict[str, Any], float]:
    path = f"scenes/{scene}/manifest.json"
    return _document(path), _touched(path) or 0.0


def _is_current(document: dict[str, Any], touched: float, scene: str, quality: str) -> bool:
    """Return whether a deliverable is what settings and code of now would make.

    Fingerprints read headers of all photographs, so they are computed only where settings differ, a file of the code was changed
    since, or the deliverable is a copy, whose time stamp says nothing.
    """
    same = document.get("settings") == json.loads(fp.resolved(scene, quality))
    if same and "fingerprint" in document and touched > _code_changed() and _is_original(scene):
        return True
    return bool(document.get("fingerprint") == fp.fingerprint("publish", scene, quality))


def _changed(scene: str) -> str:
    """Return the name of a file of a deliverable that is missing, or whose size or time stamp changed since it was published;
    empty if there is none, or if the deliverable is a copy, whose time stamps say nothing."""
    if not _is_original(scene):
        return ""
    noted_of = stamps.Stamps(stamps.place(Path("results"), scene, stamps.DELIVERABLE))
    names = _document(f"scenes/{scene}/{MANIFEST}").get("files", {})
    return next((name for name in names if noted_of.known(f"scenes/{scene}/{name}") is None), "")


def _is_original(scene: str) -> bool:
    """Return whether the manifest of a deliverable has the time stamps that were noted when it was published."""
    noted_of = stamps.Stamps(stamps.place(Path("results"), scene, stamps.DELIVERABLE))
    return noted_of.known(f"scenes/{scene}/{MANIFEST}") is not None


@lru_cache(None)
def _code_changed() -> float:
    """Return when a file on which results depend was last changed. The inode's time counts too, because it cannot be set back."""
    newest = 0.0
    for package in fp.PACKAGES:
        top = fp.REPOSITORY / package
        for folder, names, files in os.walk(top):
            module = ".".join(Path(folder).relative_to(fp.REPOSITORY).parts)
            if module in BESIDE or (fp.is_infrastructure(module) and module not in fp.PACKAGES):
                names.clear()
                continue
            names[:] = [name for name in names if name != "__pycache__"]
            for name in files:
                if name == "__main__.py":
                    continue
                status = os.stat(os.path.join(folder, name))
                newest = max(newest, status.st_mtime, status.st_ctime)
    return newest


def _source_is_there(scene: str, quality: str) -> None:
    """A scene that is not looked into is at least asked whether its data are there.

    Raises:
        InputError: they are not.
    """
    path = json.loads(fp.resolved(scene, quality))["source"].get("path")
    if path and not os.path.exists(path):
        raise InputError(f"{path}: not found")


# -------------------------------------------------------------------------------------------------------- small files


def _jobs(scene: str, now: float) -> dict[str, Noted]:
    """Return the states of the jobs of a scene that run or have not ended well. If several jobs make a stage, a running one
    stands for it."""
    found: dict[str, Noted] = {}
    for stage, name in _files(scene, "logs", ".state.json"):
        job = noted(Path(f"results/{scene}/logs/{name}"), now)
        if job and (stage not in found or job.state == "running"):
            found[stage] = job
    return found


def _files(scene: str, folder: str, ending: str) -> Iterator[tuple[str, str]]:
    """Return (stage, name) of the files of a folder of a scene that belong to a stage, such as `base.state.json` and
    `prior.3-of-8.state.json`."""
    try:
        names = os.listdir(f"results/{scene}/{folder}")
    except OSError:
        return
    for name in sorted(names):
        stage = name.partition(".")[0]
        if name.endswith(ending) and stage in STAGES:
            yield stage, name


def _taken(scene: str, running: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return CPU seconds and peak memory of the jobs on record, and so far of those that run here."""
    cpu = memory = 0.0
    for stage, name in _files(scene, "benchmarks", ".parts.json"):
        if name == f"{stage}.parts.json" and stage in running:
            continue  # of an earlier run
        job = _document(f"results/{scene}/benchmarks/{name}").get("job")
        if isinstance(job, dict):
            cpu += _number(job.get("cpu_seconds"))
            memory = max(memory, _number(job.get("max_rss_mb")))
    for document in running.values():
        usage = alive.usage(document)
        if usage:
            cpu, memory = cpu + usage.cpu_seconds, max(memory, usage.max_rss_mb)
    return {"cpu_seconds": cpu, "max_rss_mb": memory}


def _number(value: Any) -> float:
    fits = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 1e12
    return float(value) if fits else 0.0


def _logged(scene: str, stage: str) -> dict[str, str]:
    path = f"results/{scene}/logs/{stage}.log"
    return {"log": path, "line": last_line(path).removeprefix(f"{stage}: ")} if os.path.isfile(path) else {}


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


def _document(path: str) -> dict[str, Any]:
    try:
        document = json.loads(read_record(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _touched(path: str) -> float | None:
    try:
        return os.stat(path).st_mtime
    except OSError:
        return None


def quality_of(scene: str, quality: str) -> str:
    """Return the quality of a scene in a run of `quality`: variants of `bench` have the quality of their point."""
    parts = study_files.derived(scene)
    return parts.variant if parts and parts.study == study_files.BENCH else quality
