"""One job runs one stage of one scene: it gives the stage its settings, its inputs and its writer, and nothing else."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import logging
import platform
import re
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, NamedTuple

from iif_core.errors import InputError
from workflow import plugins
from workflow import settings as settings_module
from workflow.artifacts import StageReader, StageWriter, links, stamps
from workflow.artifacts.files import facts_in, write_json
from workflow.registry import SHARED, STAGES
from workflow.runtime import device, forecast
from workflow.runtime import fingerprint as fp
from workflow.settings import derived

CLOSED_TRUTH = ("truth/", *(f"faces.parquet:emission_{c}" for c in "rgb"))
CLOSED_IDS = ("given/", "instances.parquet", "faces.parquet:instance_id")
"""Ground truth, and ids of objects, in a capture."""
_LIBRARIES = ("numpy", "scipy", "mitsuba", "drjit", "open3d", "OpenEXR", "pyarrow", "torch", "snakemake")


def stage_directory(scene: str, stage: str) -> Path:
    """Return the folder of a stage of a scene."""
    return Path("results") / scene / stage


def _namespace(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{k: _namespace(v) for k, v in value.items()})
    return value


class Planned:
    """Scenes as the workflow makes them: settings from their files, stages in results/, each of the fingerprint that is planned.

    A subclass takes them from elsewhere, for stages whose settings and inputs are changed on purpose.
    """

    def settings(self, scene: str, quality: str) -> dict[str, Any]:
        """Return the whole settings tree of a scene, which the caller may change."""
        return json.loads(fp.resolved(scene, quality))

    def fingerprint(self, stage: str, scene: str, quality: str) -> str:
        """Return what a stage is made as."""
        return fp.fingerprint(stage, scene, quality)

    def raw(self, stage: str, document: dict[str, Any]) -> dict[str, str]:
        """Return name -> SHA-256 of the files from outside that a stage reads."""
        return fp.raw_contents(stage, document)

    def directory(self, stage: str, scene: str) -> Path:
        """Return the folder that a stage writes."""
        return stage_directory(scene, stage)

    def reader(self, stage: str, scene: str, quality: str) -> StageReader:
        """Return the reader of a finished stage.

        Raises:
            InputError: the stage is not there, or was built under other settings or code.
        """
        home = fp.home(stage, scene, quality)
        reader = StageReader(stage_directory(home, stage), stage, home)
        expected = fp.fingerprint(stage, scene, quality)
        if reader.fingerprint != expected:
            raise InputError(
                f"{reader.directory / 'manifest.json'}: built as {reader.fingerprint}, needed {expected}"
                f" (settings, inputs or code changed since). Run: snakemake --cores 2 scenes/{scene}"
                f" --config quality={quality}"
            )
        return reader


class Job:
    """What the `run(job)` of a stage receives.

    Args:
        stage: name of the stage; scene, quality: of which it is made.
        threads: number of cores that it may use.
        part: the part of the stage that it makes; None = all.
        scenes: where settings and upstream stages come from.

    Attributes:
        name: of the job: the name of its stage, or such as `prior.3-of-8` if the job makes only a part.
        settings: the parts of the settings tree that the registry, or a plug-in that runs the stage, lists for it, by attribute
            (`job.settings.base.ridge`); any other raises AttributeError.
        seed: seed of the scene, if the registry lists it.
        threads: number of cores that this job may use.
        device: on which rays are traced, as the scene asks and this machine has it.
        log: logger of the job; `progress(done, total, what)` writes at most one line every five seconds.
    """

    def __init__(
        self, stage: str, scene: str, quality: str, threads: int, part: Part | None = None, scenes: Planned | None = None
    ):
        self._scenes = scenes or Planned()
        self.name = f"{stage}.{part}" if part else stage
        self.stage, self.scene, self.quality, self.threads = STAGES[stage], scene, quality, threads
        self.log = logging.getLogger(f"{stage}")
        self.document = self._scenes.settings(scene, quality)
        self.device = device.use(self.document["device"])
        self._last_progress = self._started = time.monotonic()
        self._progress_of, self._first_item = "", (0, self._started)
        self._cpu_started = time.process_time()
        self._parts: dict[str, dict[str, float]] = {}
        self._earlier = {"seconds": 0.0, "cpu_seconds": 0.0}  # of jobs that made parts of this stage
        self._readers: dict[tuple[str, str], StageReader] = {}

    @cached_property
    def settings(self) -> SimpleNamespace:
        tree: dict[str, Any] = {}
        for dotted, value in settings_module.select(self.document, fp.settings_of(self.stage.name, self.document)).items():
            node = tree
            *parents, leaf = dotted.split(".")
            for part in parents:
                node = node.setdefault(part, {})
            if isinstance(value, dict) and isinstance(node.get(leaf), dict):
                node[leaf].update(value)
            else:
                node[leaf] = value
        return _namespace(tree)

    @property
    def seed(self) -> int:
        return self.settings.seed

    @property
    def fingerprint(self) -> str:
        return self._scenes.fingerprint(self.stage.name, self.scene, self.quality)

    def read(self, stage: str) -> StageReader:
        """Return the reader of an upstream stage.

        Raises:
            InputError: the stage is not there, or was built under other settings or code.
        """
        if stage not in self.stage.reads(self.document):
            raise AssertionError(f"stage {self.stage.name} reads {stage}, which registry.py does not list as upstream")
        return self._reader(stage, self.scene)

    def read_shared(self, stage: str) -> StageReader:
        """Return the reader of a stage of the scene that all variants of a study share.

        Raises:
            InputError: as `read`.
        """
        if stage not in self.stage.shared:
            raise AssertionError(f"stage {self.stage.name} reads {stage}, which registry.py does not list as shared")
        return self._reader(stage, derived.shared_scene(self.scene))

    def _reader(self, stage: str, of: str) -> StageReader:
        if (stage, of) not in self._readers:
            reader = self._scenes.reader(stage, of, self.quality)
            if stage == "capture" and not self.stage.scores:
                reader.closed = self._closed(reader)
            self._readers[stage, of] = reader
        return self._readers[stage, of]

    def _closed(self, capture: StageReader) -> tuple[str, ...]:
        """Return what of a capture is for scores alone: held-out photographs; ground truth, and the ids of objects, unless the
        settings ask for them."""
        cameras = capture.table("cameras.parquet", ("name", "split"))
        held = [f"photos/{name}.exr" for name, split in zip(cameras["name"], cameras["split"], strict=True) if split == "test"]
        truth = [] if plugins.made_of_truth() & set(fp.kinds(self.document["prior"])) else CLOSED_TRUTH
        ids = CLOSED_IDS if truth and self.document["segmentation"]["kind"] != "given" else ()
        return (*held, *truth, *ids)

    @cached_property
    def writer(self) -> StageWriter:
        """The writer of this stage's folder; it is finished after `run`."""
        return StageWriter(self._scenes.directory(self.stage.name, self.scene), self._provenance())

    def _provenance(self) -> dict[str, Any]:
        readers = {stage: self.read(stage) for stage in self.stage.reads(self.document)}
        readers |= {f"{SHARED}{stage}": self.read_shared(stage) for stage in self.stage.shared}
        inputs = {
            name: {
                "scene": reader.scene,
                "fingerprint": reader.fingerprint,
                "manifest_sha256": reader.digest,
            }
            for name, reader in readers.items()
        }
        return {
            "scene": self.scene,
            "stage": self.stage.name,
            "quality": self.quality,
            "fingerprint": self.fingerprint,
            "settings": settings_module.recorded(self.document, fp.settings_of(self.stage.name, self.document)),
            "code": fp.code_digest(self.stage.name, self.document),
            "seed": self.document["seed"],
            "inputs": inputs,
            "raw": self._scenes.raw(self.stage.name, self.document),
            "device": self.device.facts(),
            "versions": library_versions(),
        }

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Record the wall and CPU seconds of a part of the job, over all threads; parts of the same name are added.

        They go to `results/<scene>/benchmarks/<stage>.parts.json` and not into the manifest, because no two runs take the same
        time.
        """
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            part = self._parts.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0})
            part["seconds"] += time.perf_counter() - wall
            part["cpu_seconds"] += time.process_time() - cpu

    def write_timings(self, part: str = "") -> None:
        """Write what `timed` recorded, and as `job` the seconds, CPU seconds, peak memory (MB) and threads of the whole job.

        Those of a part of a stage are added to what the stage itself took, when that is written.
        """
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in kB
        if not part:
            memory = max([memory, *self._of_parts()])
        whole = {
            "seconds": time.monotonic() - self._started + self._earlier["seconds"],
            "cpu_seconds": time.process_time() - self._cpu_started + self._earlier["cpu_seconds"],
            "max_rss_mb": memory,
            "threads": self.threads,
        }
        cost = forecast.job_cost(self.stage.name, self.scene, self.quality, self.threads, machine=1.0)
        expected = forecast.expected(cost)
        parts = {name: {key: round(value, 3) for key, value in part.items()} for name, part in self._parts.items()}
        document = {**parts, "job": {key: round(value, 3) for key, value in whole.items()}, "expected": expected}
        if part:
            document["fingerprint"] = self.fingerprint
        write_json(Path("results") / self.scene / "benchmarks" / f"{part or self.stage.name}.parts.json", document)

    def _of_parts(self) -> list[float]:
        """Add what the parts of this stage took that ran as jobs of their own to its seconds, and return their peak memories."""
        memories = []
        for path in (Path("results") / self.scene / "benchmarks").glob(f"{self.stage.name}.*-of-*.parts.json"):
            document = facts_in(path)
            with suppress(ValueError, KeyError, TypeError):  # damaged
                spent = {key: float(document["job"][key]) for key in (*self._earlier, "max_rss_mb")}
                if document["fingerprint"] == self.fingerprint:
                    memories.append(spent.pop("max_rss_mb"))
                    self._earlier = {key: value + spent[key] for key, value in self._earlier.items()}
            path.unlink(missing_ok=True)
        return memories

    def progress(self, done: int, total: int, what: str) -> None:
        """Log how far the job is, at most every five seconds and at the end."""
        now = time.monotonic()
        if self._progress_of != what or done <= 1:  # the first item includes compilation, so the estimate starts after it
            self._progress_of, self._first_item = what, (done, now)
        if done < total and now - self._last_progress < 5:
            return
        self._last_progress = now
        spent = now - self._started
        done_first, then = self._first_item
        since = (now - then) / (done - done_first) if done > done_first else 0.0
        left = f", about {since * (total - done):.0f} s left" if since and done < total else ""
        self.log.info("%s: %d of %d (%.0f s%s)", what, done, total, spent, left)


def library_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute numbers."""
    out = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "absent"
    return out


class Part(NamedTuple):
    """One of the parts into which the views of a stage are dealt out to several jobs, from 1."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}-of-{self.count}"


def read_part(text: str) -> Part:
    """Read `3-of-8` or `3/8`.

    Raises:
        InputError: it is something else.
    """
    found = re.fullmatch(r"(\d{1,6})(?:-of-|/)(\d{1,6})", text)
    part = Part(int(found[1]), int(found[2])) if found else Part(0, 0)
    if not 1 <= part.number <= part.count:
        raise InputError(f"--part {text}: not a part; give a number and the count of parts, such as 3-of-8 or 3/8")
    return part


def run_stage(
    stage: str, scene: str, quality: str = "draft", threads: int = 2, expected: str | None = None, part: Part | None = None
) -> None:
    """Run one stage of one scene in this process.

    Args:
        stage: name of the stage.
        scene: name of the scene.
        quality: preset of the settings.
        threads: number of cores that the job may use.
        expected: fingerprint under which the job was planned; None = any.
        part: make this part alone and leave the stage unfinished; None = the stage.

    Raises:
        InputError: the input cannot be used, or settings, code or input files changed since the job was planned.
    """
    job = Job(stage, scene, quality, threads, part)
    if expected and expected != job.fingerprint:
        raise InputError(
            f"scene {scene}, stage {stage}: settings, code or input files changed while the workflow was running"
            f" (planned {expected}, now {job.fingerprint}). Run the same command again."
        )
    if job.device.kind != "cpu":
        job.log.info("rays are traced on %s", job.device)
    if part:
        importlib.import_module(f"{fp.module_of(stage, job.document)}_part").run(job, *part)
        job.write_timings(job.name)
        return
    importlib.import_module(fp.module_of(stage, job.document)).run(job)
    job.writer.finish()
    job.writer.stamps.save(stamps.place(Path("results"), scene, stage), flushed=True)
    job.write_timings()


class _LogFile(logging.FileHandler):
    """A log that is begun anew, and not behind a link that lies in its place."""

    def _open(self) -> IO[str]:
        return links.open_there(self.baseFilename, self.mode)


def configure_logging(path: Path | None) -> None:
    """Log to stderr and, if `path` is given, to that file, warnings included.

    Raises:
        InputError: the file is a link.
    """
    handlers: list[logging.Handler] = [logging.StreamHandler(sys.stderr)]
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        handlers.append(_LogFile(path, mode="w"))
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", handlers=handlers, force=True)
    logging.captureWarnings(True)
