"""The folder of a stage: written by `StageWriter`, sealed by its manifest, read strictly by `StageReader`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts import links
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST, STAGE_SCHEMA
from workflow.artifacts.stamps import IN_THIS_PROCESS, Stamps

UNFINISHED = "unfinished"
PARTS = "parts.json"


def command(scene: str, stage: str, quality: str | None) -> str:
    """Return the command that makes a stage of a scene again at the same quality (`draft` need not be named)."""
    return f"snakemake --cores 2 scenes/{scene} --forcerun {stage}{chosen(quality)}"


def chosen(quality: str | None) -> str:
    """Return the option that chooses a quality; empty for `draft`, which need not be named."""
    return f" --config quality={quality}" if quality not in (None, "draft") else ""


class DamagedArtefact(InputError):
    """A file on disk is not what its stage wrote: it is missing, changed, of another schema, or not finite."""

    def __init__(self, path: Path, stage: str, scene: str, problem: str, quality: str | None = None, unfinished: bool = False):
        self.path, self.stage, self.scene = path, stage, scene
        cure = f"It was made by rule {stage}; rebuild with: {command(scene, stage, quality)}"
        if unfinished:
            cure = f"Make it with: snakemake --cores 2 {path}"
        super().__init__(f"{path}: {problem}. {cure}")


class StageWriter:
    """Writes the files of one stage and, at the end, the manifest that makes them count.

    The old manifest is removed first and the new one is written last, so a killed job leaves a stage that is visibly not done.
    Every method takes the name of a file relative to the folder of the stage, and raises `InputError` for a name that would
    leave that folder. The folder itself must not be a link, because what is not listed is removed from it.

    Attributes:
        files: name -> what the manifest says of the file.
        stamps: hashes of the files, for the next plan.
    """

    def __init__(self, directory: Path, provenance: dict[str, Any]):
        self.directory = directory
        self.provenance = provenance
        self.files: dict[str, dict[str, Any]] = {}
        self.stamps = Stamps()
        self.parts: dict[str, Any] = {}
        self._earlier = _noted_parts(directory)
        if directory.is_symlink():
            raise links.refused(directory)
        with io.named(directory):
            io.make_folder(directory)
            io.remove(directory / MANIFEST)

    def exr(
        self,
        name: str,
        channels: dict[str, np.ndarray],
        units: str = "",
        colour_space: str = "linear",
        attributes: dict[str, Any] | None = None,
    ) -> None:
        """Write one raster.

        Args:
            name: file name, ending in `.exr`.
            channels: channel name -> (H, W) float16, float32 or uint32; bool is stored as half.
            units, colour_space: recorded in the manifest.
            attributes: of the header of the file, as in `write_exr`.

        Raises:
            InputError: the name would leave the folder.
            ValueError: shapes that differ, another dtype, or a value that is not finite.
        """
        channels = {k: a.astype(np.float16) if a.dtype == bool else a for k, a in channels.items()}
        types = io.write_exr(io.inside(self.directory, name), channels, attributes, settled=False)
        shape = list(next(iter(channels.values())).shape)
        self._record(name, kind="exr", shape=shape, channels=types, units=units, colour_space=colour_space)

    def table(self, name: str, columns: dict[str, Any], units: dict[str, str] | None = None) -> None:
        """Write one table; (n, k) arrays become fixed-size lists."""
        metadata = {"iif.schema": STAGE_SCHEMA, "iif.stage": self.provenance["stage"]}
        types = io.write_parquet(io.inside(self.directory, name), columns, metadata, settled=False)
        rows = len(np.asarray(next(iter(columns.values()))))
        self._record(name, kind="parquet", shape=[rows], channels=types, units=units or {}, colour_space="linear")

    def json(self, name: str, document: Any) -> None:
        """Write a small document."""
        io.write_json(io.inside(self.directory, name), document, settled=False)
        self._record(name, kind="json")

    def bytes(self, name: str, data: bytes) -> None:
        """Write a file of any other kind."""
        io.write_atomically(io.inside(self.directory, name), lambda temporary: _write_bytes(temporary, data), settled=False)
        self._record(name, kind=Path(name).suffix.lstrip(".") or "bytes")

    def part_done(self, part: str, names: list[str], facts: dict[str, Any], by: str = "") -> None:
        """Note that a part of the stage is finished, so that a job that is killed need not repeat it; `finish` removes the note.

        Args:
            part: name of the part, such as the name of a view.
            names: the files that were written for it.
            facts: small document that `part_kept` gives back.
            by: digest of all that the part depends on, if that is less than the stage does; the note then stays in parts.json,
                and the next job of the stage takes the part over although something else has changed.
        """
        files = {name: self.files[name] for name in names}
        document = {"by": by or self.provenance["fingerprint"], "files": files, "facts": facts}
        manifests.write(io.inside(self.directory, f"{UNFINISHED}/{part}.json"), document, settled=False)
        if by:
            self.parts[part] = document

    def part_kept(self, part: str, by: str = "") -> dict[str, Any] | None:
        """Take over the files of a part that an earlier run of the same job finished, or any earlier job if `by` is given.

        Returns:
            What `part_done` noted; None if the part is to be made, because it was not finished, or under another fingerprint or
            digest `by`, or a file is missing or has changed.
        """
        note = io.inside(self.directory, f"{UNFINISHED}/{part}.json")
        try:
            done = manifests.part(manifests.sealed(io.read_record(note)) if note.exists() else self._earlier.get(part))
        except (OSError, manifests.Broken):
            return None
        if done["by"] != (by or self.provenance["fingerprint"]):
            return None
        for name, facts in done["files"].items():
            if not io.is_inside(self.directory, name):  # a forged note
                return None
            path = self.directory / name
            if not path.is_file() or self.stamps.of(path) != facts["sha256"]:
                return None
        self.files |= done["files"]
        if by:
            self.parts[part] = done
        return done["facts"]

    def channels(self, name: str) -> dict[str, np.ndarray]:
        """Return the channels of a raster that this stage has written or taken over."""
        return io.read_exr(io.inside(self.directory, name))

    def columns(self, name: str) -> dict[str, np.ndarray]:
        """Return the columns of a table that this stage has written or taken over."""
        return io.read_parquet(io.inside(self.directory, name))

    def _record(self, name: str, **facts: Any) -> None:
        path = self.directory / name
        self.files[name] = {"sha256": self.stamps.of(path), "bytes": path.stat().st_size, **facts}

    def finish(self) -> None:
        """Remove the files that an earlier run left, flush all names to disk, then write the manifest and flush its name."""
        if self.parts:
            manifests.write(self.directory / PARTS, {"parts": self.parts}, settled=False)
        kept = set(self.files) | {MANIFEST} | ({PARTS} if self.parts else set())
        for path in sorted(self.directory.rglob("*"), reverse=True):
            if path.is_dir() and not path.is_symlink():
                if not any(path.iterdir()):
                    path.rmdir()
            elif str(path.relative_to(self.directory)) not in kept:
                path.unlink()
        io.flush_folders(self.directory)
        manifests.write(self.directory / MANIFEST, {"schema": STAGE_SCHEMA, **self.provenance, "files": self.files})


def _noted_parts(directory: Path) -> dict[str, Any]:
    """Return the notes that a finished job left of parts of its stage; none if there are none, or they cannot be read. They are
    not in the manifest, which Snakemake removes before it starts a job."""
    try:
        noted = manifests.sealed(io.read_record(directory / PARTS)).get("parts")
    except (OSError, manifests.Broken):
        return {}
    return noted if isinstance(noted, dict) else {}


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


class StageReader:
    """Reads a finished stage. Every file is checked against the manifest when it is opened; its content is hashed once in a
    process, as long as nobody touches it. `digest` is the SHA-256 of the manifest.

    Attributes:
        closed: what this job may not read: beginnings of names of files, which raise AssertionError, and `file:column`.

    Raises:
        DamagedArtefact: the manifest is missing or of another schema, a file is missing or has another hash, or a value is not
            finite.
    """

    def __init__(self, directory: Path, stage: str, scene: str):
        self.directory, self.stage, self.scene = directory, stage, scene
        self.closed: tuple[str, ...] = ()
        path = directory / MANIFEST
        if not path.is_file():
            raise DamagedArtefact(path, stage, scene, "missing, so this stage is not finished", unfinished=True)
        try:
            self.manifest, self.digest = manifests.load(path)
        except manifests.Broken as error:
            raise DamagedArtefact(path, stage, scene, str(error), quality_in(path)) from None
        of = {key: self.manifest.get(key, own) for key, own in (("stage", stage), ("scene", scene))}
        if of != {"stage": stage, "scene": scene}:
            problem = f"it belongs to stage {of['stage']} of scene {of['scene']}, and was put here"
            raise DamagedArtefact(path, stage, scene, problem, self.manifest.get("quality"))

    @property
    def fingerprint(self) -> str:
        return str(self.manifest.get("fingerprint", ""))

    def _damaged(self, path: Path, problem: str) -> DamagedArtefact:
        return DamagedArtefact(path, self.stage, self.scene, problem, self.manifest.get("quality"))

    def has(self, name: str) -> bool:
        """Return whether the stage wrote this file."""
        return name in self.manifest["files"]

    def names(self, prefix: str = "") -> list[str]:
        """Return the names of files that start with `prefix`, sorted."""
        return sorted(n for n in self.manifest["files"] if n.startswith(prefix))

    def path(self, name: str) -> Path:
        """Return the path of a file after checking it, for readers of other formats."""
        if self.closed and name.startswith(self.closed):
            raise AssertionError(f"{name} of stage {self.stage} is for scores alone: this job may not read it")
        facts = self.manifest["files"].get(name)
        path = io.inside(self.directory, name)
        if facts is None:
            known = ", ".join(list(self.manifest["files"])[:8])
            raise self._damaged(path, f"not in the manifest (it lists {known}, ...)")
        if fault := io.fault_of(path, facts, IN_THIS_PROCESS.of):
            raise self._damaged(path, fault)
        return path

    def exr(self, name: str) -> dict[str, np.ndarray]:
        """Return the channels of a raster as (H, W) arrays."""
        path, facts = self.path(name), self.manifest["files"][name]
        try:
            channels = io.read_exr(path)
        except Exception as error:  # whatever the library makes of a file that only a forged manifest fits
            _raise_if_of_disk(error)
            raise self._damaged(path, f"not readable as EXR ({error})") from None
        for channel, array in channels.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise self._damaged(self.directory / name, f"channel {channel} is not finite")
            if list(array.shape) != facts.get("shape"):
                problem = f"channel {channel} has shape {array.shape}, manifest says {facts.get('shape')}"
                raise self._damaged(self.directory / name, problem)
        return channels

    def table(self, name: str, columns: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return the columns of a table as numpy arrays; fixed-size lists are (n, k). Of `columns`, those there; None = all.
        Closed ones are left out."""
        path = self.path(name)
        if shut := {own.removeprefix(f"{name}:") for own in self.closed if own.startswith(f"{name}:")}:
            columns = [own for own in columns or self.manifest["files"][name]["channels"] if own not in shut]
        try:
            return io.read_parquet(path, columns)
        except Exception as error:
            _raise_if_of_disk(error)
            raise self._damaged(path, f"not readable as Parquet ({error})") from None

    def rows(self, name: str) -> int:
        """Return the number of rows of a table from the manifest, without opening the file."""
        return int(self.manifest["files"][name]["shape"][0])

    def json(self, name: str) -> Any:
        """Return a small document."""
        path = self.path(name)
        try:
            return json.loads(path.read_text())
        except (ValueError, RecursionError) as error:
            raise self._damaged(path, f"not readable as JSON ({error})") from None


def _raise_if_of_disk(error: Exception) -> None:
    """Raise an error of the operating system again, which says nothing of the content of a file."""
    if isinstance(error, OSError) and error.errno is not None:
        raise error


def quality_in(path: Path) -> str | None:
    """Return the quality that a broken manifest names, if that can still be read, for the command that makes the stage again."""
    quality = io.facts_in(path).get("quality")
    return quality if isinstance(quality, str) and quality.isidentifier() else None


def rgb(channels: dict[str, np.ndarray], layer: str = "") -> np.ndarray:
    """Return channels `layer.R/G/B` (or `R G B`) as (H, W, 3) float32."""
    prefix = f"{layer}." if layer else ""
    return np.stack([channels[f"{prefix}{c}"].astype(np.float32) for c in "RGB"], -1)


def prediction_numbers(channels: dict[str, np.ndarray]) -> list[int]:
    """Return the numbers k of the predictions in the channels of one view."""
    return sorted({int(name.split(".")[1]) for name in channels if name.startswith("prior.")})


def material_maps(channels: dict[str, np.ndarray], prefix: str = "") -> dict[str, np.ndarray]:
    """Return albedo (H, W, 3), roughness and metallic (H, W) of the channels that start with `prefix`; float32."""
    return {
        "albedo": rgb(channels, f"{prefix}albedo"),
        "roughness": channels[f"{prefix}roughness"].astype(np.float32),
        "metallic": channels[f"{prefix}metallic"].astype(np.float32),
    }


def split_rgb(array: np.ndarray, layer: str = "", dtype: type = np.float32) -> dict[str, np.ndarray]:
    """Return an (H, W, 3) array as channels `layer.R/G/B` (or `R G B`)."""
    prefix = f"{layer}." if layer else ""
    return {f"{prefix}{c}": array[..., i].astype(dtype) for i, c in enumerate("RGB")}


NO_ID = np.uint32(0xFFFFFFFF)


def ids_to_disk(ids: np.ndarray) -> np.ndarray:
    """Convert int32 with -1 = none to uint32 with 4294967295 = none."""
    return np.where(ids < 0, NO_ID, ids.astype(np.int64)).astype(np.uint32)


def ids_from_disk(ids: np.ndarray) -> np.ndarray:
    """Convert uint32 with 4294967295 = none to int32 with -1 = none."""
    return np.where(ids == NO_ID, -1, ids.astype(np.int64)).astype(np.int32)
