"""The resources that Snakemake gets for each job, and the forecast that a person reads before the jobs start."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

from iif_core.errors import InputError
from workflow import plugins
from workflow.artifacts.files import facts_in
from workflow.costs.machine import machine_factor
from workflow.costs.model import Cost, Range, predict
from workflow.costs.size import estimate, size_of_capture
from workflow.costs.work import SceneSize, Work, work_of
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fingerprints

MEMORY_MARGIN = 1.1
BESIDE_MB = 150
"""MB that are added on a cluster, where a Snakemake process runs with each job (docs/development/costs.md)."""
TIME_MARGIN, TIME_LEAST = 4.0, 10
"""A scheduler ends a job that takes longer than it said, so this is generous, and minutes."""
UNKNOWN_MEMORY, UNKNOWN_MINUTES, UNKNOWN_DISK = 12_000, 720, 20_000
"""Of kinds of jobs that nobody has measured yet: networks as priors or for masks, stages of plug-ins."""
START, START_OF_JOB = 5.0, 0.9
"""Wall seconds that Snakemake takes to start, and that the start of a job adds to what the job measures itself."""
COMPILATION = {"base": 15.0, "affines": 15.0}
"""CPU seconds that the first job of a stage takes longer in a checkout whose kernels were never compiled."""
COMPILED = "iif_core/{}/__pycache__/kernels.*.nbi"
"""Where numba keeps what it compiled."""


@lru_cache(None)
def scene_size(scene: str, quality: str) -> SceneSize:
    """Return the size of a scene.

    Raises:
        InputError: the settings or the files of the scene cannot be used.
    """
    manifest = facts_in(f"results/{fingerprints.home('capture', scene, quality)}/capture/manifest.json")
    if manifest.get("fingerprint") == fingerprints.fingerprint("capture", scene, quality):
        with suppress(ValueError, KeyError, TypeError, IndexError):  # damaged: it will be made again
            return size_of_capture(manifest)
    document = fingerprints.parsed(fingerprints.resolved(scene, quality))
    return estimate(document, fingerprints.raw_inputs("capture", document))


def job_work(stage: str, scene: str, quality: str) -> Work:
    """Return the work of a job.

    Raises:
        InputError: the settings or files of the scene cannot be used.
    """
    document = fingerprints.parsed(fingerprints.resolved(scene, quality))
    if stage == "reconstruction":  # a finished capture does not tell how many photographs it had
        return work_of(stage, document, estimate(document, fingerprints.raw_inputs(stage, document)))
    return work_of(stage, document, scene_size(scene, quality))


def job_cost(stage: str, scene: str, quality: str, threads: int = 2, machine: float | None = None) -> Cost:
    """Return what a job will cost on this machine, or on one of factor `machine`."""
    factor = machine_factor() if machine is None else machine
    return predict(stage, job_work(stage, scene, quality), threads, factor)


def together(stages: Iterable[str], scene: str, quality: str) -> tuple[float, float, float] | None:
    """Return what stages are expected to cost together: CPU seconds, peak memory and disk in MB; None where one is of a kind that
    was never measured, or the settings or files of the scene cannot be used."""
    try:
        costs = [job_cost(stage, scene, quality) for stage in stages]
        cpu, memory, disk = ([cost[i].middle for cost in costs] for i in (0, 2, 3))  # type: ignore[union-attr]
    except (InputError, AttributeError):
        return None
    return sum(cpu), max(memory), sum(disk)


def memory_mb(cost: Cost, on_node: bool = False) -> int:
    """Return the memory to ask for: a tenth above what nine of ten such jobs took. The next attempt asks for twice that.

    Args:
        cost: of the job.
        on_node: whether it is submitted to a cluster, which counts the memory of the Snakemake that starts it there as well.
    """
    if not cost.memory_mb:
        return UNKNOWN_MEMORY
    return _rounded(cost.memory_mb.high * MEMORY_MARGIN + (BESIDE_MB if on_node else 0))


def minutes(cost: Cost) -> int:
    """Return the time to ask for."""
    return TIME_LEAST + math.ceil(cost.seconds.high * TIME_MARGIN / 60) if cost.seconds else UNKNOWN_MINUTES


def disk_mb(cost: Cost) -> int:
    """Return the disk that the files of the job will take."""
    return math.ceil(cost.disk_mb.high) if cost.disk_mb else UNKNOWN_DISK


def _rounded(mb: float) -> int:
    return math.ceil(mb / 50) * 50


class Wall(NamedTuple):
    """Wall time of a whole scene from its photographs to scenes/<scene>, and a text about what it does not count."""

    seconds: Range
    beside: str


def wall(scene: str, quality: str, cores: int) -> Wall:
    """Return how long a scene takes on this machine, with the start of Snakemake and of the jobs and compilation, whatever is
    finished already. Photographs that are rendered are taken as given: making them is no part of it.

    Raises:
        InputError: the settings or files of the scene cannot be used, or a stage is of a kind that was never measured.
    """
    settings = fingerprints.parsed(fingerprints.resolved(scene, quality))
    rendered = plugins.function("SIZES", settings["source"]["kind"]) is not None
    total, needed = [START, START, START], fingerprints.needed(scene, quality)
    for stage in STAGES.values():
        if stage.name not in needed or (stage.name == "capture" and rendered):
            continue
        threads = min(stage.threads, cores)
        cost = job_cost(stage.name, scene, quality, threads)
        if cost.seconds is None:
            kind = job_work(stage.name, scene, quality).kind
            raise InputError(
                f"scene {scene}: how long stage {stage.name} takes with {kind!r} was never measured, so no time can be promised;"
                " choose a quality by name, or fit the costs to a finished run (docs/development/costs.md)"
            )
        # The jobs of a scene run one after the other: no second one fits next to a job of two threads.
        more = START_OF_JOB + _compilation(stage.name)
        total = [sum_ + part + more for sum_, part in zip(total, cost.seconds, strict=True)]
    making = job_cost("capture", scene, quality, min(2, cores)).seconds if rendered else None
    beside = f", plus about {duration(making.middle)} to render the photographs" if making else ""
    return Wall(Range(*total), beside)


@lru_cache(None)
def _compilation(stage: str) -> float:
    """Return the seconds that numba will take to compile the kernels of a stage, which it keeps in the checkout."""
    package = {"base": "fusion", "affines": "fitting"}.get(stage)
    if package is None or any(fingerprints.REPOSITORY.glob(COMPILED.format(package))):
        return 0.0
    return COMPILATION[stage]


def span(seconds: Range) -> str:
    """Return a range of seconds as text."""
    return _span(seconds.low, seconds.high, duration)


class Planned(NamedTuple):
    """A job that Snakemake is going to run."""

    stage: str
    scene: str
    threads: int
    quality: str


def forecast(jobs: Iterable[Planned], cores: int) -> list[str]:
    """Return lines for a person: a range of time, memory and disk for each stage, and for all jobs together."""
    of_stage: dict[str, list[Cost]] = {}
    of_scene: dict[str, dict[str, Range]] = {}
    busy = [0.0, 0.0, 0.0]  # middle, low, high of the seconds, times the share of the cores
    for job in jobs:
        cost = job_cost(job.stage, job.scene, job.quality, job.threads)
        of_stage.setdefault(job.stage, []).append(cost)
        if cost.seconds:
            of_scene.setdefault(job.scene, {})[job.stage] = cost.seconds
            share = min(job.threads, cores) / max(cores, 1)
            busy = [total + share * (part + START_OF_JOB) for total, part in zip(busy, cost.seconds, strict=True)]
    if not of_stage:
        return []
    rows = [("stage", "jobs", "time", "memory", "disk")]
    for stage in (name for name in STAGES if name in of_stage):
        costs = of_stage[stage]
        rows.append((stage, str(len(costs)), *_cells(costs)))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    unknown = sorted(stage for stage, costs in of_stage.items() if any(cost.seconds is None for cost in costs))
    if len(unknown) == len(of_stage):
        return [*lines, f"expected: unknown, because nothing was measured yet of {', '.join(unknown)}"]
    beside = f", without {', '.join(unknown)}, of which nothing was measured yet" if unknown else ""
    low, high = (START + max(busy[i], *(_chain(stages, i) for stages in of_scene.values())) for i in (1, 2))
    whole = f"expected: {_span(low, high, duration)} of wall time on {cores} cores{beside}"
    return [*lines, whole]


def _chain(seconds: Mapping[str, Range], bound: int) -> float:
    """Return how long those stages of one scene take that wait for one another: the longest way through them, however many cores
    there are. `bound` is the index of a Range."""
    ends: dict[str, float] = {}
    for stage in STAGES.values():
        own = seconds[stage.name][bound] + START_OF_JOB if stage.name in seconds else 0.0
        before = (*stage.upstream, *(name for _, more in stage.also for name in more))
        ends[stage.name] = own + max((ends[name] for name in before), default=0.0)
    return max(ends.values())


def _cells(costs: list[Cost]) -> tuple[str, str, str]:
    times, memory, disk = ([cost[i] for cost in costs] for i in (1, 2, 3))
    return (
        "not measured" if None in times else _span(sum(t.low for t in times), sum(t.high for t in times), duration),
        "not measured" if None in memory else _span(max(m.low for m in memory), max(m.high for m in memory), size),
        "not measured" if None in disk else _span(sum(d.low for d in disk), sum(d.high for d in disk), size),
    )


def _span(low: float, high: float, show: Any) -> str:
    first, last = show(low), show(high)
    return first if first == last else f"{first} to {last}"


def duration(seconds: float) -> str:
    """Return seconds as text.

    >>> [duration(x) for x in (0.4, 42.4, 100, 4000, 7199)]
    ['1 s', '42 s', '1 min 40 s', '1 h 7 min', '2 h 0 min']
    """
    whole = max(1, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s" if whole % 60 else f"{whole // 60} min"
    hours, minutes = divmod(round(whole / 60), 60)
    return f"{hours} h {minutes} min"


def size(mb: float) -> str:
    """Return megabytes as text.

    >>> [size(x) for x in (0.3, 812, 1234)]
    ['1 MB', '812 MB', '1.2 GB']
    """
    return f"{max(1, round(mb))} MB" if mb < 1000 else f"{mb / 1000:.1f} GB"


def expected(cost: Cost) -> dict[str, float]:
    """Return the middle of each range of a cost. It is stored together with what the job took."""
    names: Mapping[str, Range | None] = cost._asdict()
    return {name: round(found.middle, 3) for name, found in names.items() if found}
