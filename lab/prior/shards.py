"""Rooms and crops as files: a folder that grows, and that several processes may fill together.

    rooms/<seed>.npz    captures (`captures.Capture.save`)
    crops/<seed>.npz    crops (`inputs.Crops`) with the digest of the code that made the inputs
    rooms.jsonl         a line for every room that was made: seed, version of the generator, facts, seconds

What is on disk is not made again, except crops whose inputs are computed differently by now.
"""

from __future__ import annotations

import ast
import hashlib
import json
import logging
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lab.prior import captures, inputs, photographs, rooms
from lab.prior.assets import Assets
from lab.prior.captures import Capture
from lab.prior.inputs import Crops
from lab.prior.photographs import Denoiser

INPUT_MODULES = [
    "iif_core.camera.pixels",
    "iif_core.light.irradiance",
    "iif_core.priors.features",
    "iif_core.priors.reprojection",
    "lab.prior.inputs",
    "workflow.priors.views",
]
"""The code that decides what crops hold."""
HELD_OUT = (25, 3)
"""Rooms whose seed has this remainder are kept back from training: one in 25."""
_LOG = logging.getLogger("shards")


def is_held_out(seed: int) -> bool:
    """Tell whether a room is kept back from training."""
    return seed % HELD_OUT[0] == HELD_OUT[1]


@dataclass(frozen=True)
class Folder:
    """A folder of rooms and crops; `keep_rooms` False leaves captures out, for crops that are used at once."""

    path: Path
    keep_rooms: bool = True

    def __post_init__(self) -> None:
        for name in ("rooms", "crops"):
            (self.path / name).mkdir(parents=True, exist_ok=True)

    def room(self, seed: int) -> Path:
        """File of a capture."""
        return self.path / "rooms" / f"{seed}.npz"

    def crops(self, seed: int) -> Path:
        """File of the crops of a room."""
        return self.path / "crops" / f"{seed}.npz"

    def note(self, line: dict[str, Any]) -> None:
        """Append a line to the manifest; short lines of several processes do not mix."""
        with open(self.path / "rooms.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")

    def manifest(self) -> list[dict[str, Any]]:
        """Return all lines of the manifest; a line that a killed process left half is skipped."""
        path = self.path / "rooms.jsonl"
        lines = []
        for line in path.read_text().splitlines() if path.exists() else []:
            try:
                lines.append(json.loads(line))
            except ValueError:
                _LOG.warning("%s: a line is incomplete and was skipped", path)
        return lines


@dataclass(frozen=True)
class Maker:
    """What is needed to make rooms.

    Attributes:
        folder: where they go.
        assets: of the generator.
        denoise: of the renderings; None = none.
        samples: paths per pixel.
        size: pixels of every photograph; 0 = drawn per room, as for training.
        views: photographs per room; 0 = drawn.
    """

    folder: Folder
    assets: Assets
    denoise: Denoiser | None
    samples: int = 40
    size: int = 0
    views: int = 0

    def session(self, seed: int) -> photographs.Session:
        """Return how the room of a seed is photographed."""
        drawn = photographs.draw_session(seed, self.samples)
        return photographs.Session(self.views or drawn.views, self.size or drawn.size, self.samples)

    def make(self, seed: int) -> dict[str, Any] | None:
        """Make room and crops of a seed, as far as they are not there, and note it.

        Returns:
            The line of the manifest; None if nothing had to be made.
        """
        digest = inputs_digest()
        fresh = is_current(self.folder.crops(seed), digest)
        if fresh and (not self.folder.keep_rooms or self.folder.room(seed).exists()):
            return None
        line: dict[str, Any] = {"seed": seed, "generator": rooms.VERSION}
        clock = time.perf_counter()
        capture = self._capture(seed, line)
        line["seconds_capture"] = round(time.perf_counter() - clock, 2)
        if not fresh:
            clock = time.perf_counter()
            made = inputs.crops(capture, seed, min(inputs.EDGE, capture.photographs.values.shape[1]))
            save_crops(self.folder.crops(seed), made, digest)
            line |= {"crops": len(made), "inputs": digest, "seconds_inputs": round(time.perf_counter() - clock, 2)}
        self.folder.note(line)
        return line

    def _capture(self, seed: int, line: dict[str, Any]) -> Capture:
        path = self.folder.room(seed)
        if path.exists():
            capture = captures.load(path)
        else:
            room = rooms.build(seed, self.assets)
            capture = photographs.photograph(room, seed, self.session(seed), self.denoise)
            capture.facts |= {"objects": len(room.parts), "textures": len(self.assets.textures), "skies": len(self.assets.skies)}
            if self.folder.keep_rooms:
                capture.save(path)
        line |= capture.facts
        return capture

    def make_all(self, seeds: Iterable[int], stop: float = np.inf) -> int:
        """Make the rooms of many seeds until the clock (`time.time()`) reaches `stop`; a room that fails is noted and left out.

        Returns:
            The number of rooms that were made.
        """
        made, failed = (
            0,
            {line["seed"] for line in self.folder.manifest() if "error" in line and line["generator"] == rooms.VERSION},
        )
        for seed in seeds:
            if time.time() >= stop:
                break
            if seed in failed:
                continue
            try:
                line = self.make(seed)
            except Exception as error:  # one room in thousands must not end a run of hours
                _LOG.exception("room %d failed", seed)
                self.folder.note({"seed": seed, "generator": rooms.VERSION, "error": f"{type(error).__name__}: {error}"[:300]})
                continue
            if line is not None:
                made += 1
                _LOG.info(
                    "room %d: %s",
                    seed,
                    json.dumps({k: v for k, v in line.items() if k.startswith(("seconds", "crops", "size", "views"))}),
                )
        return made


@lru_cache(1)
def inputs_digest() -> str:
    """Return the digest of the code that computes inputs, blind to comments and layout; as it was when it was first asked for."""
    # Not `workflow.runtime.fingerprint`: machines that only train have no pydantic.
    root = Path(__file__).parents[2]
    sources = [(root / module.replace(".", "/")).with_suffix(".py").read_text() for module in INPUT_MODULES]
    return hashlib.sha256("".join(ast.dump(ast.parse(source)) for source in sources).encode()).hexdigest()[:16]


def save_crops(path: Path, crops: Crops, digest: str) -> None:
    """Write crops; they are not compressed, because reading them must not cost more than a step of training."""
    captures.write_arrays(path, {**asdict(crops), "inputs_code": np.array(digest)}, compressed=False)


def is_current(path: Path, digest: str) -> bool:
    """Tell whether a file has crops that the present code would make."""
    if not path.exists():
        return False
    with np.load(path) as file:
        return str(file["inputs_code"]) == digest


def load_crops(path: Path) -> Crops:
    """Read crops that `save_crops` wrote."""
    with np.load(path) as file:
        return Crops(*(file[name] for name in ("inputs", "truth", "counts", "group", "view")))


def crop_files(folder: Path) -> Iterator[tuple[int, Path]]:
    """List the finished crops of a folder as (seed, file), by seed."""
    found = {int(path.stem): path for path in (folder / "crops").glob("*.npz") if path.stem.isdigit()}
    yield from sorted(found.items())
